//! A conversation with the cell: sends, collects what the cell sends, and checks what holds of every packet.

mod accounts;
mod beats;
mod exchange;
mod joints;
mod known;
mod life;
mod receive;
mod request;

use protocol::can::{Format, Frame};
use protocol::candump::{Record, Timestamp};
use protocol::id::{CellId, Id};
use protocol::message::{Heartbeat, Joints, Message, NetworkPage, SensorPage};
use protocol::packet::{Epoch, Words};
use protocol::parameters::MAX_JOINTS;
use protocol::time::{Micros, Span};

use crate::bus::{Bus, Seen, Stop};
use crate::findings::Findings;
use crate::timings::Timings;

pub(crate) use exchange::Exchange;
pub(crate) use joints::Step;
pub(crate) use known::{About, Known};
use life::Life;
pub(crate) use request::Reply;

/// Longer than any answer takes that comes at all.
pub(crate) const PATIENT: Span = Span::from_millis(300);
/// After a sync's heartbeat nothing is awaited longer than this.
pub(crate) const LINGER: Span = Span::from_millis(5);
/// What was sent is on the bus by then, whatever else this computer does.
const ON_BUS: Span = Span::from_millis(1_200);
/// A cell that sends nothing for so long has fallen silent.
const SILENT: Span = Span::from_millis(3_000);

/// A packet of the cell.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Heard {
    /// When it, or its last segment, was on the bus.
    pub(crate) at: Micros,
    pub(crate) message: Message,
}

impl Heard {
    /// The heartbeat that it is, and its epoch byte.
    pub(crate) const fn beat(&self) -> Option<(&Heartbeat, Epoch)> {
        if let Message::Network { page: NetworkPage::Heartbeat(beat), epoch, .. } = &self.message {
            Some((beat, *epoch))
        } else {
            None
        }
    }

    pub(crate) const fn torque(&self) -> Option<(Epoch, &Words)> {
        if let Message::Torque { epoch, torque, .. } = &self.message { Some((*epoch, torque)) } else { None }
    }

    pub(crate) const fn sensors(&self) -> Option<(Epoch, &SensorPage)> {
        if let Message::Sensors { epoch, page, .. } = &self.message { Some((*epoch, page)) } else { None }
    }
}

/// Times of the conversation.
#[derive(Clone, Copy, Debug)]
struct Clock {
    /// When the cell was heard last.
    last: Micros,
    /// When the time is over.
    end: Micros,
    /// By how much the bench was late since the exchange began.
    late: Span,
    /// The same since a group of checks began, and ever.
    worst: Span,
    longest: Span,
    /// Packets whose segments came too late after each other.
    torn: usize,
    /// Heartbeats do not have the epoch of the last joints.
    other_epochs: bool,
    /// The cell is put back, whoever else is there.
    finishing: bool,
    /// The last joints were too old when the cell came to them.
    skipped: bool,
    /// What an answer takes, with the way there and back.
    round_trip: Span,
}

/// Frames of the cell and of the bench.
#[derive(Debug, Default)]
struct Log {
    frames: Vec<Seen>,
    /// Where the present exchange begins: what was sent for it may come before it.
    since: usize,
    /// Where the last exchange ended.
    ended: usize,
}

impl Log {
    /// Those of the present exchange.
    fn present(&self) -> &[Seen] {
        self.frames.get(self.since..).unwrap_or_default()
    }
}

/// The conversation.
pub struct Session<'a> {
    bus: &'a mut dyn Bus,
    name: String,
    pub(crate) cell: CellId,
    pub(crate) format: Format,
    log: Log,
    /// Packets of the cell.
    pub(crate) heard: Vec<Heard>,
    /// Where the present exchange begins there.
    pub(crate) from: usize,
    /// Up to where they were expected.
    consumed: usize,
    /// Joints whose answers came so late that the cell may have skipped them.
    pub(crate) skips: u16,
    life: Life,
    /// Frames of the cell since a restart began: it is not known yet to which life they belong.
    held: Option<Vec<(Seen, Id)>>,
    /// What was found.
    pub findings: Findings,
    pub(crate) known: Known,
    pub(crate) about: About,
    tag: u8,
    pub(crate) timings: Timings,
    clock: Clock,
}

impl core::fmt::Debug for Session<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Session")
            .field("cell", &self.cell)
            .field("known", &self.known)
            .finish_non_exhaustive()
    }
}

impl<'a> Session<'a> {
    /// Speaks to a cell on a bus of this name and format for so long at most.
    pub fn new(bus: &'a mut dyn Bus, name: &str, cell: CellId, format: Format, longest: Span) -> Self {
        let now = bus.now();
        Self {
            bus,
            name: name.to_owned(),
            cell,
            format,
            log: Log::default(),
            heard: Vec::new(),
            from: 0,
            consumed: 0,
            skips: 0,
            life: Life::default(),
            held: None,
            findings: Findings::default(),
            known: Known::default(),
            about: About::default(),
            tag: 0x50,
            timings: Timings::default(),
            clock: Clock {
                last: now,
                end: now + longest,
                late: Span(0),
                worst: Span(0),
                longest: Span(0),
                torn: 0,
                other_epochs: false,
                finishing: false,
                skipped: false,
                round_trip: Span(0),
            },
        }
    }

    pub(crate) fn bus_name(&self) -> &str {
        &self.name
    }

    pub(crate) fn now(&self) -> Micros {
        self.bus.now()
    }

    /// There is so much time from now on, and no signal interrupts.
    pub(crate) fn extend(&mut self, span: Span) {
        self.bus.finish();
        self.clock.finishing = true;
        self.clock.end = self.bus.now() + span;
        self.clock.last = self.bus.now();
    }

    /// How much time is left.
    pub(crate) fn left(&self) -> Span {
        self.clock.end.since(self.bus.now())
    }

    /// The cell was allowed to be silent until now.
    pub(crate) fn extend_life(&mut self) {
        self.clock.last = self.bus.now();
    }

    pub(crate) fn carries(&self, format: Format) -> bool {
        self.bus.carries(format)
    }

    pub(crate) fn can_restart(&self) -> bool {
        self.bus.can_restart()
    }

    /// A check of a requirement.
    pub(crate) fn check(&mut self, id: &'static str, is_so: bool, what: impl FnOnce() -> String) -> bool {
        if is_so {
            self.findings.pass(id);
        } else if !self.clock.skipped {
            let (log, name) = (&self.log, &self.name);
            self.findings.fail(id, what(), || log.present().iter().map(|seen| line(name, seen)).collect());
        }
        is_so
    }

    /// A new exchange begins. What came since the last one was not expected, unless a cell sends it by itself.
    pub(crate) fn mark(&mut self) {
        let strays: Vec<_> = self.heard.get(self.consumed..).unwrap_or_default().to_vec();
        for stray in strays {
            if let Some(id) = self.known.unexpected(&stray.message) {
                let kind = stray.message.id().kind.name();
                self.check(id, false, || format!("a {kind} packet that nothing asked for"));
            }
        }
        self.start();
    }

    /// The same where what came is expected.
    pub(crate) fn start(&mut self) {
        self.clock.skipped = false;
        self.log.since = self.log.ended;
        (self.from, self.consumed) = (self.heard.len(), self.heard.len());
        self.lateness();
        self.clock.late = Span(0);
    }

    /// What came since the exchange began was expected.
    pub(crate) fn consume(&mut self) {
        self.consumed = self.heard.len();
        self.log.ended = self.log.frames.len();
    }

    /// What came since the last exchange ended.
    pub(crate) fn unmarked(&self) -> Vec<Heard> {
        self.heard.get(self.consumed..).unwrap_or_default().to_vec()
    }

    /// Packets of the cell since the exchange began.
    pub(crate) fn answers(&self) -> &[Heard] {
        self.heard.get(self.from..).unwrap_or_default()
    }

    /// Nothing that was written is taken for granted any more.
    pub(crate) fn forget(&mut self) {
        self.known = Known {
            last_epoch: self.known.last_epoch,
            joints: self.known.joints,
            hash: None,
            ..Known::default()
        };
    }

    /// Sends frames, and waits until the last one was on the bus: when that was.
    pub(crate) fn send(&mut self, frames: &[Frame]) -> Result<Micros, Stop> {
        let times = self.send_all(frames)?;
        Ok(times.last().copied().unwrap_or_else(|| self.now()))
    }

    /// The same; when each was on the bus.
    pub(crate) fn send_all(&mut self, frames: &[Frame]) -> Result<Vec<Micros>, Stop> {
        let Some(last) = frames.last() else { return Ok(Vec::new()) };
        let before = self.log.frames.len();
        let sent = self.bus.now();
        self.bus.send(frames)?;
        let give_up = self.bus.now() + ON_BUS;
        loop {
            let own = self.log.frames.get(before..).unwrap_or_default().iter().filter(|seen| seen.own);
            let own: Vec<_> = own.map(|seen| seen.at).collect();
            if own.len() >= frames.len() {
                let waited = own.last().map_or(Span(0), |at| at.since(sent));
                self.clock.worst = self.clock.worst.max(waited);
                return Ok(own);
            }
            if self.bus.now() >= give_up {
                return Err(Stop::Bus(format!("{}: {last} was sent and was not on the bus", self.name)));
            }
            self.pump(give_up)?;
        }
    }

    /// The frames of a packet on this bus.
    pub(crate) fn frames(&self, message: &Message) -> Vec<Frame> {
        message.encode().frames(self.format).collect()
    }

    /// Sends packets: when the first of them was on the bus as a whole.
    pub(crate) fn say(&mut self, messages: &[Message]) -> Result<Micros, Stop> {
        let mut at = None;
        for message in messages {
            let frames = self.frames(message);
            let on_bus = self.send(&frames)?;
            at.get_or_insert(on_bus);
        }
        Ok(at.unwrap_or_else(|| self.now()))
    }

    /// Receives until then, or until something is true of what has come since the exchange began.
    pub(crate) fn wait(
        &mut self,
        until: Micros,
        mut done: impl FnMut(&[Heard]) -> bool,
    ) -> Result<bool, Stop> {
        loop {
            if done(self.answers()) {
                return Ok(true);
            }
            if self.bus.now() >= until {
                return Ok(false);
            }
            self.pump(until)?;
        }
    }

    /// Receives for so long.
    pub(crate) fn idle(&mut self, span: Span) -> Result<(), Stop> {
        let until = self.bus.now() + span;
        self.wait(until, |_| false).map(|_| ())
    }

    /// What the cell sends late comes now.
    pub(crate) fn settle(&mut self) -> Result<(), Stop> {
        self.idle(Span::from_millis(15))?;
        self.mark();
        Ok(())
    }

    /// By how much the bench was late since the exchange began.
    pub(crate) fn lateness(&mut self) -> Span {
        self.clock.late = self.clock.late.max(self.bus.lateness());
        self.clock.worst = self.clock.worst.max(self.clock.late);
        self.clock.longest = self.clock.longest.max(self.clock.late);
        self.clock.late
    }

    /// By how much the bench was late since this was called last, in whatever exchange.
    pub(crate) fn worst_lateness(&mut self) -> Span {
        self.lateness();
        core::mem::take(&mut self.clock.worst)
    }

    /// Checks that segments followed each other: those of a few packets may wait for a processor.
    pub(crate) fn check_segments(&mut self) -> Result<(), Stop> {
        const FEW: usize = 3;
        if self.format == Format::Classic {
            if self.life.is_waiting() {
                self.idle(Span(PATIENT.0 + 10_000))?;
            }
            let torn = self.clock.torn;
            self.check("SEND-1", torn <= FEW, || {
                format!("of {torn} packets a segment came too late after the one before")
            });
        }
        Ok(())
    }

    /// Measures what an answer takes.
    pub(crate) fn measure(&mut self) -> Result<(), Stop> {
        const TIMES: u64 = 8;
        let began = self.now();
        for _ in 0..TIMES {
            self.read(0)?;
        }
        self.clock.round_trip = Span(self.now().since(began).0 / TIMES);
        Ok(())
    }

    /// Whether answers take so long that there is no time for all that could be tried.
    pub(crate) fn is_slow(&self) -> bool {
        self.clock.round_trip > Span::from_millis(4)
    }

    /// So many attempts, or fewer with a slow cell.
    pub(crate) fn attempts(&self, many: usize) -> usize {
        if self.is_slow() { many.div_ceil(4) } else { many }
    }

    /// How long an answer took; not if the bench itself was late.
    pub(crate) fn note_time(&mut self, what: &'static str, asked: Micros, answered: Micros) {
        let late = self.lateness();
        self.timings.note(what, answered.since(asked), late);
    }

    /// Joints of this chain.
    pub(crate) fn joints(&self, epoch: u8, positions: &[i16; MAX_JOINTS]) -> Message {
        self.joints_of(epoch, positions, self.known.joints)
    }

    /// Joints with this count; words beyond it are 0.
    pub(crate) fn joints_of(&self, epoch: u8, positions: &[i16; MAX_JOINTS], in_use: u8) -> Message {
        let mut words = *positions;
        words.iter_mut().skip(in_use.into()).for_each(|word| *word = 0);
        let positions = words.map(protocol::fixed::Q1_14::from_bits);
        Message::Joints { epoch: Epoch(epoch), joints: Joints { positions, in_use } }
    }
}

/// A frame as candump writes it, with T for what the bench sent.
fn line(name: &str, seen: &Seen) -> String {
    let time = Timestamp::six_digits(seen.at.0 * 1_000);
    let record = Record { time, interface: name, frame: seen.frame, direction: None };
    format!("{record} {}", if seen.own { 'T' } else { 'R' })
}
