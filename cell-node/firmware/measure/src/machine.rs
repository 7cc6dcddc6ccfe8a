//! Input and output of the measurement: by semihosting on the emulator, by standard output and arguments on the host.

/// Maximum length of an output line in bytes: four times fourteen words of four digits, and a name.
const LINE: usize = 4 * 14 * 4 + 64;

/// The buffer of the current output line.
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

    /// Appends words as four hexadecimal digits each.
    pub(crate) fn words(&mut self, words: impl Iterator<Item = i16>) {
        for word in words {
            for shift in [12, 8, 4, 0] {
                let digit = (word >> shift & 15).to_le_bytes()[0];
                self.byte(if digit < 10 { b'0' + digit } else { b'a' - 10 + digit });
            }
        }
    }

    /// Appends a name and a space.
    pub(crate) fn text(&mut self, text: &str) {
        text.bytes().chain([b' ']).for_each(|byte| self.byte(byte));
    }

    /// Appends a 32-bit number as two words.
    pub(crate) fn number(&mut self, number: u32) {
        let [a, b, c, d] = number.to_be_bytes();
        self.words([[a, b], [c, d]].into_iter().map(i16::from_be_bytes));
    }

    /// Writes the line with a line feed, and empties the buffer.
    pub(crate) fn line(&mut self) {
        self.byte(b'\n');
        put(self.line.get(..self.filled).unwrap_or_default());
        self.filled = 0;
    }

    /// Returns the first letter of the task on the command line; `w` without one.
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

    /// The semihosting call that returns the command line.
    const GET_CMDLINE: usize = 0x15;
    /// The pattern that fills unused stack, to detect later how much was used.
    const PAINT: u32 = 0xCCCC_CCCC;

    /// Number of bytes below the stack pointer that are not painted: more than the registers that a function saves.
    const UNPAINTED: usize = 64;

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
        // SAFETY: the call writes at most the given number of bytes to the given address.
        let failed = unsafe { syscall(GET_CMDLINE, &block) };
        let letter = core::hint::black_box(&text).first().copied();
        letter.filter(|letter| failed == 0 && *letter != 0)
    }

    /// Returns the stack pointer.
    #[inline(always)]
    fn stack_pointer() -> usize {
        let pointer;
        // SAFETY: only reads a register.
        unsafe { asm!("mov {}, sp", out(reg) pointer, options(nomem, nostack, preserves_flags)) };
        pointer
    }

    /// Fills the free stack with the pattern. Returns the address at which the caller's stack frame ends.
    // Inlined, to read the caller's stack pointer.
    #[inline(always)]
    pub(crate) fn painted_stack() -> usize {
        let top = stack_pointer();
        paint();
        top
    }

    #[inline(never)]
    fn paint() {
        let mut place = &raw mut _stack_end;
        let top = stack_pointer() - UNPAINTED;
        while place.addr() < top {
            // SAFETY: memory from the stack's end to below this frame, which is unused: there are no
            // interrupts, and this function calls no other.
            unsafe { place.write_volatile(PAINT) };
            place = place.wrapping_add(1);
        }
    }

    /// Returns the number of bytes of stack below the address `top` that have been used since the stack was painted.
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

/// Returns 0, because the stack is not measured on the host.
#[cfg(not(target_os = "none"))]
pub(crate) fn painted_stack() -> usize {
    0
}

#[cfg(not(target_os = "none"))]
pub(crate) fn used_stack(_: usize) -> u32 {
    0
}
