//! A node built where it stays.
//!
//! It takes more than a third of a small microcontroller's memory. What Rust assigns to a static it first builds on the
//! stack, and then copies: for a moment the node would be there twice.

use core::arch::asm;
use core::mem::MaybeUninit;

use cell_node::node::Node;
use protocol::time::Micros;

use crate::run::Beginning;

/// The node, by the calling convention of C.
#[expect(improper_ctypes_definitions, reason = "both sides are Rust, of one program")]
extern "C" fn built(beginning: &Beginning, now: &Micros) -> Node {
    beginning.node(*now)
}

/// The node that begins now, built in this place.
pub fn build<'a>(place: &'a mut MaybeUninit<Node>, beginning: &Beginning, now: Micros) -> &'a mut Node {
    const { assert!(size_of::<Node>() > 4) };
    // SAFETY: by the procedure call standard of 32-bit Arm (AAPCS32, 6.4 and 6.5) a function whose result is a struct of
    // more than 4 bytes writes it to the address in r0, and has its arguments in r1 and r2. The place is as large and as
    // aligned as a node, this reference is the only one to it, and it is a node when the function has returned.
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
