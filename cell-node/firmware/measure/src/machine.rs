//! Where words are written, and what is asked for: the emulator's semihosting, or a process' output and arguments.

/// The longest line: four times fourteen words.
const LINE: usize = 4 * 14 * 4 + 64;

/// A line that is being written.
pub(crate) struct Machine {
    line: [u8; LINE],
    filled: usize,
}

impl Default for Machine {
    fn default() -> Self {
        Self { line: [0; LINE], filled: 0 }
    }
}

impl Machine {
    fn byte(&mut self, byte: u8) {
        if let Some(place) = self.line.get_mut(self.filled) {
            *place = byte;
            self.filled += 1;
        }
    }

    /// Words as four hexadecimal digits each.
    pub(crate) fn words(&mut self, words: impl Iterator<Item = i16>) {
        for word in words {
            for shift in [12, 8, 4, 0] {
                let digit = (word >> shift & 15).to_le_bytes()[0];
                self.byte(if digit < 10 { b'0' + digit } else { b'a' - 10 + digit });
            }
        }
    }

    /// A name.
    pub(crate) fn text(&mut self, text: &str) {
        text.bytes().chain([b' ']).for_each(|byte| self.byte(byte));
    }

    /// A number, as two words.
    pub(crate) fn number(&mut self, number: u32) {
        let [a, b, c, d] = number.to_be_bytes();
        self.words([[a, b], [c, d]].into_iter().map(i16::from_be_bytes));
    }

    /// Ends the line.
    pub(crate) fn line(&mut self) {
        self.byte(b'\n');
        put(self.line.get(..self.filled).unwrap_or_default());
        self.filled = 0;
    }

    /// The first letter of the task that is asked for; `w` where there is none.
    pub(crate) fn task(&self) -> u8 {
        task().unwrap_or(b'w')
    }
}

#[cfg(target_os = "none")]
mod emulated {
    use core::arch::asm;

    use cortex_m_semihosting::debug::{EXIT_FAILURE, EXIT_SUCCESS, exit};
    use cortex_m_semihosting::nr::open;
    use cortex_m_semihosting::{hio, syscall};

    /// The number of the call that asks for the command line.
    const GET_CMDLINE: usize = 0x15;
    /// With what the stack is painted before it is used.
    const PAINT: u32 = 0xCCCC_CCCC;

    /// More than the registers that a function saves, maybe after it has read the stack pointer.
    const OWN: usize = 64;

    unsafe extern "C" {
        static mut _stack_end: u32;
    }

    pub(super) fn put(line: &[u8]) {
        let _ = open::RW;
        if let Ok(mut out) = hio::hstdout() {
            let _ = out.write_all(line);
        }
    }

    pub(super) fn task() -> Option<u8> {
        let mut text = [0_u8; 64];
        let block = [text.as_mut_ptr() as usize, text.len()];
        // SAFETY: the call writes at most as many bytes as the block says, to where it says.
        let failed = unsafe { syscall(GET_CMDLINE, &block) };
        let letter = core::hint::black_box(&text).first().copied();
        letter.filter(|letter| failed == 0 && *letter != 0)
    }

    /// The stack pointer.
    #[inline(always)]
    fn stack_pointer() -> usize {
        let pointer;
        // SAFETY: it reads a register.
        unsafe { asm!("mov {}, sp", out(reg) pointer, options(nomem, nostack, preserves_flags)) };
        pointer
    }

    /// Paints the stack that is free; where the caller's frame ends.
    // Inlined: the caller's stack pointer, and not its own.
    #[inline(always)]
    pub(crate) fn painted_stack() -> usize {
        let top = stack_pointer();
        paint();
        top
    }

    #[inline(never)]
    fn paint() {
        let mut place = &raw mut _stack_end;
        let top = stack_pointer() - OWN;
        while place.addr() < top {
            // SAFETY: memory from the stack's end to below this frame, which nothing uses: there are no interrupts, and
            // this function calls none.
            unsafe { place.write_volatile(PAINT) };
            place = place.wrapping_add(1);
        }
    }

    /// Bytes of stack that were in use at some time since it was painted, below this address.
    pub(crate) fn used_stack(top: usize) -> u32 {
        let mut place = &raw const _stack_end;
        // SAFETY: all words from the stack's end to its start are readable memory.
        while place.addr() < top && unsafe { place.read_volatile() } == PAINT {
            place = place.wrapping_add(1);
        }
        u32::try_from(top - place.addr()).unwrap_or_default()
    }

    /// Ends the emulator.
    pub(crate) fn end() -> ! {
        loop {
            exit(EXIT_SUCCESS);
        }
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        loop {
            exit(EXIT_FAILURE);
        }
    }
}

#[cfg(target_os = "none")]
pub(crate) use emulated::{end, painted_stack, used_stack};
#[cfg(target_os = "none")]
use emulated::{put, task};

#[cfg(not(target_os = "none"))]
fn put(line: &[u8]) {
    use std::io::Write as _;
    let _ = std::io::stdout().write_all(line);
}

#[cfg(not(target_os = "none"))]
fn task() -> Option<u8> {
    std::env::args_os().nth(1)?.as_encoded_bytes().first().copied()
}

/// Here that is not known.
#[cfg(not(target_os = "none"))]
pub(crate) fn painted_stack() -> usize {
    0
}

#[cfg(not(target_os = "none"))]
pub(crate) fn used_stack(_: usize) -> u32 {
    0
}
