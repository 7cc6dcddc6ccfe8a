//! `vcan-setup`: gives you a bus.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
