//! STM32G431 with a CAN transceiver, as on a Nucleo-G431RB: Cortex-M4 at 80 MHz, FDCAN1 on PA11 and PA12, 1
//! Mbit/s and 5 Mbit/s. Every test run builds it, but no emulator exists to run it.
//!
//! Constants have the names of the registers in the reference manual (RM0440). The crate `fdcan` 0.2 is unsuitable: it
//! lacks delay compensation, replaces frames that wait to be sent, and sends empty frames as remote frames.

use core::mem::size_of;
use core::ptr::{read_volatile, write_volatile};

use cell_node::node::Node;
use cortex_m::asm::wfi;
use protocol::can::{self, EXTENDED, Format, Frame};
use protocol::factory::FactoryRecord;
use protocol::time::{Micros, Span};

use super::{factory, store};
use crate::board::{Board, Clock, counter_value};
use crate::store::{Flash, Page, WRITE_SIZE, WriteError};

mod can1;

/// Size of a flash page in bytes, and the address of flash.
const PAGE: usize = 2 << 10;
const FLASH_BASE: usize = 0x0800_0000;

const RCC_CR: usize = 0x4002_1000;
const RCC_CFGR: usize = RCC_CR + 0x08;
const RCC_PLLCFGR: usize = RCC_CR + 0x0C;
const RCC_AHB2ENR: usize = RCC_CR + 0x4C;
const RCC_APB1ENR1: usize = RCC_CR + 0x58;
const RCC_CCIPR: usize = RCC_CR + 0x88;
const FLASH_ACR: usize = 0x4002_2000;
const FLASH_KEYR: usize = FLASH_ACR + 0x08;
const FLASH_SR: usize = FLASH_ACR + 0x10;
const FLASH_CR: usize = FLASH_ACR + 0x14;
const TIM2_CR1: usize = 0x4000_0000;
const TIM2_DIER: usize = TIM2_CR1 + 0x0C;
const TIM2_SR: usize = TIM2_CR1 + 0x10;
const TIM2_EGR: usize = TIM2_CR1 + 0x14;
const TIM2_CNT: usize = TIM2_CR1 + 0x24;
const TIM2_PSC: usize = TIM2_CR1 + 0x28;
const TIM2_CCR1: usize = TIM2_CR1 + 0x34;
const IWDG_KR: usize = 0x4000_3000;
const IWDG_PR: usize = IWDG_KR + 0x04;
const IWDG_RLR: usize = IWDG_KR + 0x08;
const GPIOA_MODER: usize = 0x4800_0000;
const GPIOA_OSPEEDR: usize = GPIOA_MODER + 0x08;
const GPIOA_AFRH: usize = GPIOA_MODER + 0x24;
/// Wake-up interrupts: enabled in the NVIC but masked, so that they end `wfi` without a handler.
const NVIC_ISER: usize = 0xE000_E100;
const NVIC_ICPR: usize = 0xE000_E280;
const FDCAN1_IT0: u32 = 1 << 21;
const TIM2_IRQ: u32 = 1 << 28;
/// Bits of `FLASH_SR`.
const BUSY: u32 = 1 << 16;
const ERRORS: u32 = 0xC3FA;

/// Minimum time in µs from now to a timer compare. A nearer one may already have passed when it is set.
const MIN_LEAD: u64 = 10;

fn read(address: usize) -> u32 {
    // SAFETY: the address of a register of this microcontroller, or of a word of its message RAM.
    unsafe { read_volatile(address as *const u32) }
}

fn write(address: usize, value: u32) {
    // SAFETY: as above; none of these addresses is memory that the program uses.
    unsafe { write_volatile(address as *mut u32, value) }
}

fn change(address: usize, bits: u32, to: u32) {
    write(address, read(address) & !bits | to);
}

fn wait(address: usize, bits: u32, value: u32) {
    while read(address) & bits != value {}
}

/// The STM32G431, the board that this build is for.
#[derive(Debug)]
pub struct SelectedBoard {
    clock: Clock,
    flash: Pages,
}

impl SelectedBoard {
    /// Initialises the board. Must be called only once.
    #[must_use]
    pub fn start() -> Self {
        cortex_m::interrupt::disable();
        // The 24 MHz crystal / 6 * 80 / 4 = 80 MHz, for which flash needs two wait states.
        change(RCC_CR, 0, 1 << 16);
        wait(RCC_CR, 1 << 17, 1 << 17);
        write(RCC_PLLCFGR, 3 | 5 << 4 | 80 << 8 | 1 << 24 | 1 << 25);
        change(RCC_CR, 0, 1 << 24);
        wait(RCC_CR, 1 << 25, 1 << 25);
        change(FLASH_ACR, 15, 2);
        wait(FLASH_ACR, 15, 2);
        change(RCC_CFGR, 3, 3);
        wait(RCC_CFGR, 3 << 2, 3 << 2);

        change(RCC_AHB2ENR, 0, 1); // GPIOA
        change(RCC_APB1ENR1, 0, 1 | 1 << 25); // TIM2, FDCAN
        change(RCC_CCIPR, 3 << 24, 2 << 24); // PCLK1 clocks FDCAN
        wait(RCC_APB1ENR1, 1, 1);

        write(TIM2_PSC, 80 - 1);
        write(TIM2_EGR, 1); // load the prescaler
        write(TIM2_SR, 0);
        write(TIM2_DIER, 1 << 1); // compare 1
        write(TIM2_CR1, 1);

        // 32 kHz / 16, 4000 steps: 2 s.
        write(IWDG_KR, 0xCCCC);
        write(IWDG_KR, 0x5555);
        write(IWDG_PR, 2);
        write(IWDG_RLR, 4_000 - 1);
        Self { clock: Clock::default(), flash: Pages }
    }
}

impl Board for SelectedBoard {
    type Flash = Pages;

    fn factory(&mut self) -> Option<FactoryRecord> {
        factory()
    }

    fn open(&mut self, factory: &FactoryRecord) {
        // PA11 and PA12: alternate function 9, high speed.
        change(GPIOA_AFRH, 0xFF << 12, 0x99 << 12);
        change(GPIOA_OSPEEDR, 0xF << 22, 0xA << 22);
        change(GPIOA_MODER, 0xF << 22, 0xA << 22);
        can1::open(factory.format);
        write(NVIC_ISER, FDCAN1_IT0 | TIM2_IRQ);
    }

    fn now(&mut self) -> Micros {
        self.clock.at(read(TIM2_CNT))
    }

    fn receive(&mut self) -> Option<(Frame, Micros)> {
        // The loop comes here as soon as it wakes, so a pending frame has just arrived, except after an
        // erase.
        let frame = can1::receive()?;
        Some((frame, self.now()))
    }

    fn send(&mut self, frame: &Frame) {
        let give_up = self.now() + Span(100_000);
        while !can1::send(frame) && self.now() < give_up {
            self.feed();
        }
    }

    fn filter(&mut self, node: &Node, factory: &FactoryRecord) {
        let wires =
            factory.link_ids.into_iter().flatten().map(|link_id| link_id.reversed().raw_id() & !EXTENDED);
        can1::filter(node.received_ids().map(|id| id.to_bits().into()), wires);
    }

    fn sleep_until(&mut self, due: Micros) {
        write(TIM2_CCR1, counter_value(due));
        write(TIM2_SR, 0);
        write(NVIC_ICPR, FDCAN1_IT0 | TIM2_IRQ);
        // `is_empty` sees frames from before this; later ones end `wfi`.
        can1::acknowledge();
        if due.elapsed_since(self.now()).0 > MIN_LEAD && can1::is_empty() {
            wfi();
        }
    }

    fn feed(&mut self) {
        write(IWDG_KR, 0xAAAA);
    }

    fn flash(&mut self) -> &mut Pages {
        &mut self.flash
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

    /// Runs a flash operation and waits until it is done. The processor stalls during the operation, because the
    /// program is in the same flash bank: 82 µs for 8 bytes, 22 ms for a page. The FIFO of the CAN controller buffers
    /// three frames in that time.
    fn run_operation(bits: u32, work: impl FnOnce()) -> Result<(), WriteError> {
        wait(FLASH_SR, BUSY, 0);
        write(FLASH_SR, ERRORS);
        write(FLASH_KEYR, 0x4567_0123);
        write(FLASH_KEYR, 0xCDEF_89AB);
        write(FLASH_CR, bits);
        work();
        wait(FLASH_SR, BUSY, 0);
        let errors = read(FLASH_SR) & ERRORS;
        write(FLASH_CR, 1 << 31); // locked
        if errors == 0 { Ok(()) } else { Err(WriteError) }
    }
}

impl Flash for Pages {
    fn unit(&self, page: Page, at: usize) -> [u8; WRITE_SIZE] {
        let address = Self::address(page, at);
        let ([a, b, c, d], [e, f, g, h]) =
            (read(address).to_le_bytes(), read(address + size_of::<u32>()).to_le_bytes());
        [a, b, c, d, e, f, g, h]
    }

    fn erase(&mut self, page: Page) -> Result<(), WriteError> {
        let number = u32::try_from((Self::address(page, 0) - FLASH_BASE) / PAGE).map_err(|_| WriteError)?;
        let bits = 1 << 1 | number << 3; // PER, PNB
        Self::run_operation(bits, || write(FLASH_CR, bits | 1 << 16))
    }

    fn program(&mut self, page: Page, at: usize, unit: [u8; WRITE_SIZE]) -> Result<(), WriteError> {
        let address = Self::address(page, at);
        let [a, b, c, d, e, f, g, h] = unit;
        // Writing both words of a unit in sequence programs it with its check bits.
        Self::run_operation(1, || {
            write(address, u32::from_le_bytes([a, b, c, d]));
            write(address + size_of::<u32>(), u32::from_le_bytes([e, f, g, h]));
        })
    }
}

/// Decodes a frame from the first two words and the data of an element in the message RAM.
fn frame_of(head: [u32; 2], data: &[u8; 64]) -> Option<Frame> {
    let [first, second] = head;
    let id = if first & 1 << 30 == 0 {
        first >> 18 & can::STANDARD_MASK
    } else {
        first & can::EXTENDED_MASK | EXTENDED
    };
    let dlc = (second >> 16 & 15).to_le_bytes()[0];
    let format = if second & 1 << 21 == 0 { Format::Classic } else { Format::Fd };
    if first & 1 << 29 != 0 {
        return Frame::remote(id, dlc.min(8)).ok();
    }
    let flags = if second & 1 << 20 == 0 { 0 } else { can::BIT_RATE_SWITCH };
    let len = can::dlc_len(dlc).min(format.max_len());
    let data = data.get(..len)?;
    match format {
        Format::Classic => Frame::classic(id, data).ok(),
        Format::Fd => Frame::fd(id, flags, data).ok(),
    }
}
