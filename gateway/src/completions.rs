//! Shell completions and man pages: `skinbus completions` and `skinbus man`.

use std::io;
use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;
use protocol::usage::{Failure, ignore_broken_pipe, print_raw};

use super::output::{OverwriteOption, is_standard_output, print_note};

/// Print completions for a shell
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus completions bash > ~/.local/share/bash-completion/completions/skinbus
  skinbus completions zsh > ~/.zfunc/_skinbus
  skinbus completions fish > ~/.config/fish/completions/skinbus.fish")]
pub(crate) struct CompletionsCommand {
    /// Shell that will use the completions
    shell: Shell,
}

impl CompletionsCommand {
    pub(crate) fn run(self, mut program: Command) -> Result<(), Failure> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut program, "skinbus", &mut script);
        print_raw(&String::from_utf8_lossy(&script))
    }
}

/// Write man pages: skinbus.1, and one per command
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus man ~/.local/share/man/man1
  skinbus man - | man -l -")]
pub(crate) struct ManCommand {
    /// Existing directory for the man pages; - prints only skinbus.1
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl ManCommand {
    pub(crate) fn run(self, mut program: Command) -> Result<(), Failure> {
        if is_standard_output(&self.folder) {
            return ignore_broken_pipe(clap_mangen::Man::new(program).render(&mut io::stdout()));
        }
        if !self.folder.is_dir() {
            let folder = self.folder.display();
            return Err(Failure::usage_error(format!("the folder {folder} does not exist: create it first")));
        }
        program.build();
        let mut pages = Vec::new();
        add_man_pages(&program, &mut pages)?;
        for (name, _) in &pages {
            self.overwrite.check_writable("", &self.folder.join(name))?;
        }
        for (name, text) in &pages {
            self.overwrite.write("", &self.folder.join(name), text)?;
        }
        print_note(format_args!("{} man pages written to {}", pages.len(), self.folder.display()));
        Ok(())
    }
}

/// Adds the man page of a command and those of its subcommands: `skinbus-skin-import.1`.
fn add_man_pages(command: &Command, pages: &mut Vec<(String, String)>) -> Result<(), Failure> {
    let mut page = Vec::new();
    clap_mangen::Man::new(command.clone()).render(&mut page).map_err(Failure::run_error)?;
    let name = command.get_display_name().unwrap_or_else(|| command.get_name());
    pages.push((format!("{name}.1"), String::from_utf8_lossy(&page).into_owned()));
    let mut below = command.get_subcommands().filter(|it| it.get_name() != "help");
    below.try_for_each(|it| add_man_pages(it, pages))
}
