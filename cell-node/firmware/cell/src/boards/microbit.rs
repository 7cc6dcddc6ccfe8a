//! BBC micro:bit: nRF51822, Cortex-M0 at 16 MHz, 256 KiB of flash, 16 KiB of RAM. It has no CAN controller:
//! frames are lines of slcan over its USB serial line, at 115 200 baud.
//!
//! In QEMU's `microbit` the serial line is a `-chardev` without a baud rate, the watchdog does nothing, and
//! flash does not persist: with `hosted` in the factory record, semihosting keeps it in a file.

use core::cell::RefCell;

use cortex_m::asm::wfi;
use cortex_m::interrupt::{Mutex, free};
use cortex_m::peripheral::NVIC;
use nrf51_pac::generic::{Reg, RegisterSpec, Writable};
use nrf51_pac::{self as pac, Interrupt, NVMC, TIMER0, UART0, WDT, interrupt};
use protocol::can::Frame;
use protocol::factory::FactoryRecord;
use protocol::slcan::{Decoder, SlcanLine};
use protocol::time::Micros;

use super::{factory, store};
use crate::board::{Board, Clock, counter_value};
use crate::slcan::{self, ReceiveBuffer};
use crate::store::{Flash, Page, WRITE_SIZE, WriteError};

mod hosted;

/// Size of a flash page in bytes.
const PAGE: usize = 1 << 10;
/// Pins of the serial line to the USB interface.
const TX: u32 = 24;
const RX: u32 = 25;
/// Frequency of the watchdog's clock in Hz, and the word that feeds the watchdog.
const WATCHDOG_HZ: u32 = 32_768;
const WATCHDOG_RELOAD_KEY: u32 = 0x6E52_4635;
/// Minimum time in µs from now to a timer compare. A nearer one may already have passed when it is set.
const MIN_LEAD: u64 = 10;

static RECEIVE_BUFFER: Mutex<RefCell<ReceiveBuffer>> = Mutex::new(RefCell::new(ReceiveBuffer::new()));

/// The micro:bit, the board that this build is for.
#[derive(Debug)]
pub struct SelectedBoard {
    clock: Clock,
    decoder: Decoder,
    flash: Pages,
    hosted: bool,
}

impl SelectedBoard {
    /// Initialises the board. Must be called only once.
    #[must_use]
    pub fn start() -> Self {
        // SAFETY: this is the only place that takes the peripherals, and only this type uses them.
        let pac = unsafe { pac::Peripherals::steal() };
        // Start the crystal oscillator, which the UART and the 1 % of TIME-1 require.
        write_register(&pac.CLOCK.tasks_hfclkstart, 1);
        while pac.CLOCK.events_hfclkstarted.read().bits() == 0 {}

        write_register(&pac.TIMER0.mode, 0);
        write_register(&pac.TIMER0.bitmode, 3); // 32 bits
        write_register(&pac.TIMER0.prescaler, 4); // 16 MHz / 2^4
        write_register(&pac.TIMER0.intenset, 1 << 17); // COMPARE[1]
        write_register(&pac.TIMER0.tasks_start, 1);

        write_register(&pac.WDT.config, 1); // runs while the processor sleeps, pauses while a debugger halts it
        write_register(&pac.WDT.crv, 2 * WATCHDOG_HZ - 1);
        write_register(&pac.WDT.rren, 1);
        write_register(&pac.WDT.tasks_start, 1);
        Self { clock: Clock::default(), decoder: Decoder::new(), flash: Pages, hosted: false }
    }
}

impl Board for SelectedBoard {
    type Flash = Pages;

    fn factory(&mut self) -> Option<FactoryRecord> {
        let factory = factory()?;
        self.hosted = factory.hosted;
        Some(factory)
    }

    fn open(&mut self, _: &FactoryRecord) {
        let uart = uart();
        write_register(&uart.pseltxd, TX);
        write_register(&uart.pselrxd, RX);
        write_register(&uart.baudrate, 0x01D7_E000);
        write_register(&uart.enable, 4);
        write_register(&uart.intenset, 1 << 2); // RXDRDY
        write_register(&uart.tasks_startrx, 1);
        write_register(&uart.tasks_starttx, 1);
        // SAFETY: both handlers are defined below, and share data with the loop only through a mutex.
        unsafe {
            NVIC::unmask(Interrupt::UART0);
            NVIC::unmask(Interrupt::TIMER0);
        }
    }

    fn now(&mut self) -> Micros {
        // Interrupt handlers capture the counter as well.
        free(|_| self.clock.at(counter()))
    }

    fn receive(&mut self) -> Option<(Frame, Micros)> {
        loop {
            let (line, at) = free(|cs| RECEIVE_BUFFER.borrow(cs).borrow_mut().next_line(&mut self.decoder))?;
            if let SlcanLine::Frame(frame) = line {
                return Some((frame, Clock::time_of(self.now(), at)));
            }
        }
    }

    fn send(&mut self, frame: &Frame) {
        let uart = uart();
        slcan::send(frame, |byte| {
            write_register(&uart.events_txdrdy, 0);
            write_register(&uart.txd, byte.into());
            while uart.events_txdrdy.read().bits() == 0 {}
        });
    }

    fn sleep_until(&mut self, due: Micros) {
        write_register(&timer().cc[1], counter_value(due));
        free(|cs| {
            let now = self.clock.at(counter());
            if due.elapsed_since(now).0 > MIN_LEAD && RECEIVE_BUFFER.borrow(cs).borrow().is_empty() {
                // A pending interrupt ends the wait although its handler runs only after this block.
                wfi();
            }
        });
    }

    fn feed(&mut self) {
        // SAFETY: a write of one word that only feeds the watchdog.
        write_register(unsafe { &(*WDT::ptr()).rr[0] }, WATCHDOG_RELOAD_KEY);
    }

    fn flash(&mut self) -> &mut Pages {
        &mut self.flash
    }

    fn load_external(&mut self, into: &mut [u8]) -> Option<usize> {
        if !self.hosted {
            return None;
        }
        let count = hosted::load(into);
        if count.is_none() {
            // The emulator's flash starts with zeros instead of erased.
            let erased = [Page::A, Page::B].map(|page| self.flash.erase(page));
            debug_assert_eq!(erased, [Ok(()); 2], "this board's erase cannot fail");
        }
        count
    }

    fn store_external(&mut self, image: &[u8]) -> bool {
        !self.hosted || hosted::store(image)
    }
}

/// The two flash pages for parameters, before the page of the factory record.
#[derive(Debug)]
pub struct Pages;

impl Pages {
    fn address(page: Page, at: usize) -> usize {
        match page {
            Page::A => store() + at,
            Page::B => store() + PAGE + at,
        }
    }

    /// Enables a flash operation (1 write, 2 erase), performs it and waits until it is done. The processor stalls
    /// during the operation: 46 µs for a word, 21 ms for a page. The UART buffers six bytes in that time and loses
    /// further ones.
    fn run_operation(enabled: u32, work: impl FnOnce(&pac::nvmc::RegisterBlock)) {
        // SAFETY: only this type uses the flash controller.
        let nvmc = unsafe { &*NVMC::ptr() };
        write_register(&nvmc.config, enabled);
        work(nvmc);
        while nvmc.ready.read().bits() == 0 {}
        write_register(&nvmc.config, 0);
    }
}

impl Flash for Pages {
    fn unit(&self, page: Page, at: usize) -> [u8; WRITE_SIZE] {
        // SAFETY: the address is aligned and within a page that the linker reserves for this type.
        let word =
            |at| unsafe { core::ptr::read_volatile(Self::address(page, at) as *const u32) }.to_le_bytes();
        let ([a, b, c, d], [e, f, g, h]) = (word(at), word(at + 4));
        [a, b, c, d, e, f, g, h]
    }

    fn erase(&mut self, page: Page) -> Result<(), WriteError> {
        let address = u32::try_from(Self::address(page, 0)).map_err(|_| WriteError)?;
        Self::run_operation(2, |nvmc| write_register(nvmc.erasepage(), address));
        Ok(())
    }

    fn program(&mut self, page: Page, at: usize, unit: [u8; WRITE_SIZE]) -> Result<(), WriteError> {
        let (words, _) = unit.as_chunks();
        for (index, word) in words.iter().enumerate() {
            let address = Self::address(page, at + 4 * index) as *mut u32;
            // SAFETY: as above; the page is erased, and writing is enabled.
            Self::run_operation(1, |_| unsafe {
                core::ptr::write_volatile(address, u32::from_le_bytes(*word))
            });
        }
        Ok(())
    }
}

/// Writes a register.
fn write_register<R: RegisterSpec<Ux = u32> + Writable>(register: &Reg<R>, value: u32) {
    // SAFETY: the values are those of the reference manual. These registers do not affect memory, except for
    // the flash controller's, which get the address of a page that the linker reserves for this board.
    unsafe { register.as_ptr().write_volatile(value) };
}

fn uart() -> &'static pac::uart0::RegisterBlock {
    // SAFETY: the loop sends with it and the handler receives with it, through different registers.
    unsafe { &*UART0::ptr() }
}

fn timer() -> &'static pac::timer0::RegisterBlock {
    // SAFETY: both use captures only while no handler runs.
    unsafe { &*TIMER0::ptr() }
}

/// Returns the counter in µs. It must be called only while no interrupt handler can run.
fn counter() -> u32 {
    write_register(&timer().tasks_capture[0], 1);
    timer().cc[0].read().bits()
}

#[interrupt]
fn UART0() {
    let uart = uart();
    while uart.events_rxdrdy.read().bits() != 0 {
        write_register(&uart.events_rxdrdy, 0);
        let [byte, ..] = uart.rxd.read().bits().to_le_bytes();
        free(|cs| RECEIVE_BUFFER.borrow(cs).borrow_mut().push(byte, counter()));
    }
}

/// Handles the timer interrupt, which only wakes the processor.
#[interrupt]
fn TIMER0() {
    write_register(&timer().events_compare[1], 0);
}
