//! The program of a cell's microcontroller.

#![cfg_attr(target_os = "none", no_std)]
#![cfg_attr(target_os = "none", no_main)]

#[cfg(target_os = "none")]
mod start {
    use core::panic::PanicInfo;

    use cell::board::Board as _;
    use cell::boards::Chosen;
    use cell::run::{Beginning, Cell};
    use cortex_m::peripheral::SCB;
    use cortex_m_rt::{ExceptionFrame, entry, exception};

    #[entry]
    fn main() -> ! {
        let mut board = Chosen::take();
        // Nobody has written who this is, so that it must not send; it waits to be loaded again.
        let Some(beginning) = Beginning::read(&mut board) else { board.rest() };
        let mut node = beginning.node(board.now());
        match Cell::start(board, &beginning, &mut node).run() {}
    }

    /// The cell starts again, with what flash holds.
    #[panic_handler]
    fn panic(_: &PanicInfo<'_>) -> ! {
        SCB::sys_reset()
    }

    #[exception]
    unsafe fn HardFault(_: &ExceptionFrame) -> ! {
        SCB::sys_reset()
    }
}

/// This program is for microcontrollers.
#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("cell: built for this machine, where it does nothing: docs/how-to/firmware.md");
}
