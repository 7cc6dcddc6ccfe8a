//! How commands that bring cells along start them.

use std::path::PathBuf;

use clap::Args;

/// Which programs are started, and how many cells share one.
#[derive(Args, Clone, Debug)]
pub(super) struct Programs {
    /// Put up to N cells into one process
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=254))]
    pub(super) cells_per_process: u8,
    /// The program of the cells, when it is not beside this one
    #[arg(long, value_name = "PATH")]
    pub(super) cell_node: Option<PathBuf>,
    /// The program that serves embedded buses, when it is not beside this one
    #[arg(long, value_name = "PATH")]
    pub(super) vcan_setup: Option<PathBuf>,
}
