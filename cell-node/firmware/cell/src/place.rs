//! Construction of a node in place, without a copy on the stack.
//!
//! A node takes more than a third of a small microcontroller's memory. An assignment to a static first builds
//! the value on the stack and then copies it, so the node would exist twice for a moment.

use core::arch::asm;
use core::mem::MaybeUninit;

use cell_node::node::Node;
use protocol::time::Micros;

use crate::run::InitialState;

/// Creates a node. The calling convention of C makes the caller pass the address at which it is built.
#[expect(improper_ctypes_definitions, reason = "both sides are Rust, of one program")]
extern "C" fn built(beginning: &InitialState, now: &Micros) -> Node {
    beginning.node(*now)
}

/// Builds the node in the memory `place`, and returns a reference to it.
pub fn build<'a>(place: &'a mut MaybeUninit<Node>, beginning: &InitialState, now: Micros) -> &'a mut Node {
    const { assert!(size_of::<Node>() > 4) };
    // SAFETY: by the procedure call standard of 32-bit Arm (AAPCS32, 6.4 and 6.5), a function that returns a
    // struct of more than 4 bytes writes it to the address in r0, and takes its arguments in r1 and r2. The
    // place has the size and alignment of a node, this reference is the only one to it, and it contains a
    // node when the function has returned.
    unsafe {
        asm!(
            "bl {built}",
            built = sym built,
            in("r0") place.as_mut_ptr(),
            in("r1") &raw const *beginning,
            in("r2") &raw const now,
            clobber_abi("C"),
        );
        place.assume_init_mut()
    }
}
