//! The program of the microcontroller in a cell.

#![cfg_attr(target_os = "none", no_std)]
#![cfg_attr(target_os = "none", no_main)]

#[cfg(target_os = "none")]
mod start {
    use core::mem::MaybeUninit;
    use core::panic::PanicInfo;

    use cell::board::Board as _;
    use cell::boards::SelectedBoard;
    use cell::place;
    use cell::run::{InitialState, RunningCell};
    use cell_node::node::Node;
    use cortex_m::peripheral::SCB;
    use cortex_m_rt::{ExceptionFrame, entry, exception};
    use protocol::factory::FactoryRecord;

    #[entry]
    fn main() -> ! {
        // The node is in a static instead of on the stack; `entry` makes the only reference to it.
        static mut NODE: MaybeUninit<Node> = MaybeUninit::uninit();
        let mut board = SelectedBoard::start();
        // Without a factory record the cell has no identity and must not send; it waits to be loaded again.
        let Some((factory, node)) = begin(&mut board, NODE) else { board.idle() };
        match RunningCell::start(board, factory, node).run() {}
    }

    /// Returns the factory record, and the node before its flash contents are restored.
    // Not inlined, so that the contents of flash are off the stack when the cell runs.
    #[inline(never)]
    fn begin<'a>(
        board: &mut SelectedBoard,
        place: &'a mut MaybeUninit<Node>,
    ) -> Option<(FactoryRecord, &'a mut Node)> {
        let beginning = InitialState::read(board)?;
        let now = board.now();
        let node = place::build(place, &beginning, now);
        beginning.restore(node);
        Some((*beginning.factory(), node))
    }

    /// Resets the processor, so that the cell restarts with the contents of flash.
    #[panic_handler]
    fn panic(_: &PanicInfo<'_>) -> ! {
        SCB::sys_reset()
    }

    #[exception]
    unsafe fn HardFault(_: &ExceptionFrame) -> ! {
        SCB::sys_reset()
    }
}

/// Prints that this program is for microcontrollers.
#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!(
        "cell: this program runs only on a microcontroller; docs/how-to/firmware.md explains how to build it"
    );
}
