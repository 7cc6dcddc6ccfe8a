//! The program `vcan-setup`, which sets up CAN buses.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
