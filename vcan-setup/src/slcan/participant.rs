//! A serial line and the client by which it takes part in the bus.

use std::io;
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusError, Inbox};
use rustix::event::PollFlags;

use super::account::{FaultCounts, LineAccount, describe_faults_since};
use super::event::LineEvent;
use super::incoming::LineToBusQueue;
use super::link::{LinePort, PortOpener};
use super::options::{LineOptions, OpeningStage};
use super::outgoing::{BusToLineQueue, closing_command};
use super::refusals::{RefusalAction, RefusalHistory};
use super::settings::{BridgeSettings, open};

/// The interval between two attempts to open an unavailable line or bus.
const REOPEN_INTERVAL: Duration = Duration::from_millis(100);
/// The interval between two attempts to send to a bus whose queue is full.
const SEND_RETRY_INTERVAL: Duration = Duration::from_millis(1);
/// The minimum interval between two reports of lost frames on a line.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);
/// The maximum number of batches read from a bus or a line before the next line is served.
const MAX_BATCHES: usize = 4;

/// Flags for the ends of a participant from which data can be read.
#[derive(Clone, Copy, Debug)]
pub(super) struct ReadyEnds {
    pub(super) line: bool,
    pub(super) bus: bool,
}

/// The events to poll for at an open line. The client of the bus is only polled for readability.
#[derive(Clone, Copy, Debug)]
pub(super) struct PollInterest {
    pub(super) line: Option<PollFlags>,
}

/// The connection to a line.
#[derive(Debug)]
enum LineState {
    Away(Instant),
    Open(LinePort),
}

/// The connection to the bus.
#[derive(Debug)]
enum ClientState {
    Away(Instant),
    Open(Box<Bus>),
}

/// A serial line, its client of the bus, and the queues between them.
#[derive(Debug)]
pub(super) struct LineParticipant {
    opener: PortOpener,
    line: LineState,
    client: ClientState,
    inbox: Inbox,
    outgoing: BusToLineQueue,
    incoming: LineToBusQueue,
    opened: u64,
    lost: u64,
    dropped_before: u64,
    reported: (u64, u64),
    reported_faults: FaultCounts,
    report_at: Instant,
    refusals: RefusalHistory,
    /// The time at which the adapter is set up; `None` if that need not wait for a board to start.
    settled_at: Option<Instant>,
    /// The reason that was last reported why the line is not open.
    reason: Option<io::Error>,
    began: Instant,
}

impl LineParticipant {
    pub(super) fn new(options: LineOptions, bus: Bus) -> io::Result<Self> {
        let outgoing = BusToLineQueue::from_options(&options);
        let mut incoming = LineToBusQueue::new();
        incoming.handle_bus_opened(!bus.carries_fd(), bus.is_virtual().unwrap_or(false));
        let now = Instant::now();
        Ok(Self {
            opener: PortOpener::new(options)?,
            line: LineState::Away(now),
            client: ClientState::Open(Box::new(bus)),
            inbox: Inbox::new(),
            outgoing,
            incoming,
            opened: 0,
            lost: 0,
            dropped_before: 0,
            reported: (0, 0),
            reported_faults: FaultCounts::new(),
            report_at: now,
            refusals: RefusalHistory::new(),
            settled_at: None,
            reason: None,
            began: now,
        })
    }

    pub(super) fn name(&self) -> String {
        self.opener.options().address.to_string()
    }

    pub(super) const fn is_up(&self) -> bool {
        matches!(&self.line, LineState::Open(port) if !port.is_connecting())
    }

    pub(super) fn account(&self) -> LineAccount {
        let mut to_line = self.outgoing.account;
        to_line.dropped_by_bus = self.dropped_before + u64::from(self.inbox.dropped_count());
        let to_bus = self.incoming.account();
        LineAccount {
            line: self.name(),
            opened: self.opened,
            lost: self.lost,
            reopened: self.refusals.reopen_count(),
            to_line,
            to_bus,
            faults: self.incoming.faults().clone(),
        }
    }

    /// Returns the events to poll for at the line.
    pub(super) fn poll_interest(&mut self) -> PollInterest {
        let now = self.began.elapsed();
        let line = match &self.line {
            LineState::Away(_) => None,
            LineState::Open(port) if port.is_connecting() => Some(PollFlags::OUT),
            LineState::Open(_) if self.outgoing.ready_bytes(now).0.is_empty() => Some(PollFlags::IN),
            LineState::Open(_) => Some(PollFlags::IN | PollFlags::OUT),
        };
        PollInterest { line }
    }

    /// Returns the line and the client to be polled, as far as they are open.
    pub(super) const fn poll_ends(&self) -> (Option<&LinePort>, Option<&Bus>) {
        let port = match &self.line {
            LineState::Open(port) => Some(port),
            LineState::Away(_) => None,
        };
        match &self.client {
            ClientState::Open(bus) => (port, Some(bus)),
            ClientState::Away(_) => (port, None),
        }
    }

    /// Returns the time at which there is something to do even if no data arrives.
    pub(super) fn next_deadline(&mut self, now: Instant) -> Option<Instant> {
        let elapsed = now - self.began;
        let line = match &self.line {
            LineState::Away(at) => Some(*at),
            LineState::Open(port) if port.is_connecting() => Some(now + REOPEN_INTERVAL),
            LineState::Open(_) => self.outgoing.ready_bytes(elapsed).1.map(|at| self.began + at),
        };
        let client = match &self.client {
            ClientState::Away(at) => Some(*at),
            ClientState::Open(_) if !self.incoming.waiting_frames().is_empty() => {
                Some(now + SEND_RETRY_INTERVAL)
            }
            ClientState::Open(_) => None,
        };
        let report = self.has_more_to_report().then_some(self.report_at);
        [line, client, report, self.settled_at].into_iter().flatten().min()
    }

    /// Forwards all data that is available at either end.
    pub(super) fn forward_available(
        &mut self,
        settings: &BridgeSettings,
        ready: ReadyEnds,
        report: &mut impl FnMut(LineEvent),
    ) {
        let now = Instant::now();
        self.open_line(now, report);
        if self.settled_at.is_some_and(|at| at <= now) {
            self.queue_opening();
        }
        if matches!(self.client, ClientState::Away(at) if at <= now) {
            self.open_client(settings, now, report);
        }
        if ready.line {
            self.read_line(now, report);
        }
        self.write_bus(now, report);
        if ready.bus {
            self.read_bus(now, report);
        }
        self.write_line(now, report);
        let is_due = self.report_at <= now && self.has_more_to_report();
        if is_due || self.has_new_fault() {
            self.report_losses_and_faults(report);
            self.report_at = now + REPORT_INTERVAL;
        }
    }

    fn has_more_to_report(&self) -> bool {
        self.lost_frame_counts() != self.reported || *self.incoming.faults() != self.reported_faults
    }

    /// Returns true if the adapter has reported a kind of fault for the first time. Such a fault is reported at once.
    fn has_new_fault(&self) -> bool {
        self.incoming.faults().len() > self.reported_faults.len()
    }

    /// Reports the lost frames and faults since the last report.
    fn report_losses_and_faults(&mut self, report: &mut impl FnMut(LineEvent)) {
        let faults = describe_faults_since(&self.reported_faults, self.incoming.faults());
        if !faults.is_empty() {
            self.reported_faults = self.incoming.faults().clone();
            report(LineEvent::Reported(faults));
        }
        let losses = self.lost_frame_counts();
        if losses != self.reported {
            let (to_line, to_bus) = (losses.0 - self.reported.0, losses.1 - self.reported.1);
            report(LineEvent::Lost { to_line, to_bus, account: Box::new(self.account()) });
            self.reported = losses;
        }
    }

    /// Opens the line if the time for the next attempt has come. Reports the reason if it cannot be opened.
    pub(super) fn open_line(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        let opened = match &mut self.line {
            LineState::Away(at) if *at <= now => self.opener.open(),
            LineState::Open(port) if port.is_connecting() => match port.check_connected() {
                Ok(false) => return,
                Ok(true) => {
                    self.handle_line_opened(now, report);
                    return;
                }
                Err(error) => Err(error),
            },
            LineState::Away(_) | LineState::Open(_) => return,
        };
        match opened {
            Ok(port) => {
                let up = !port.is_connecting();
                self.line = LineState::Open(port);
                if up {
                    self.handle_line_opened(now, report);
                }
            }
            Err(error) => {
                self.line = LineState::Away(now + REOPEN_INTERVAL);
                self.report_line_away(error, report);
            }
        }
    }

    /// Returns the reason why the line is not open; `None` if it is not known yet.
    pub(super) const fn closed_reason(&self) -> Option<&io::Error> {
        self.reason.as_ref()
    }

    /// Returns the reason why the line is not open, and forgets it.
    pub(super) const fn take_closed_reason(&mut self) -> Option<io::Error> {
        self.reason.take()
    }

    fn handle_line_opened(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        self.opened += 1;
        self.reason = None;
        let settle = self.opener.options().settle;
        if settle.is_zero() {
            self.queue_opening();
        } else {
            self.settled_at = Some(now + settle);
        }
        report(LineEvent::LineUp);
    }

    /// Queues the commands that open the adapter. Frames follow them.
    fn queue_opening(&mut self) {
        self.settled_at = None;
        self.outgoing.handle_line_opened(&self.opener.options().opening_steps());
    }

    /// Handles lines that the adapter refused.
    fn handle_refusals(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        let (bells, replies) = (self.incoming.account().bells, self.incoming.replies());
        let stage = self.outgoing.refused_stage();
        match self.refusals.evaluate_refusals(now - self.began, stage, bells, replies) {
            RefusalAction::Nothing => {}
            RefusalAction::Count(lines) => self.outgoing.count_refused(lines),
            RefusalAction::ReportSettings => {
                let opening = self.opener.options().opening_steps();
                let settings = opening.iter().filter(|step| step.stage == OpeningStage::Setting);
                let names = settings.map(|step| String::from_utf8_lossy(&step.bytes).trim_end().to_owned());
                report(LineEvent::SettingRefused(names.collect::<Vec<_>>().join(", ")));
            }
            RefusalAction::Reopen(lines) => {
                self.outgoing.count_refused(lines);
                self.outgoing.queue_reopening(&self.opener.options().opening_steps());
                report(LineEvent::Reopened);
            }
        }
    }

    fn handle_line_lost(&mut self, error: io::Error, now: Instant, report: &mut impl FnMut(LineEvent)) {
        self.outgoing.handle_line_lost();
        self.incoming.handle_line_lost();
        self.settled_at = None;
        self.line = LineState::Away(now + REOPEN_INTERVAL);
        self.lost += 1;
        self.report_line_away(error, report);
    }

    fn report_line_away(&mut self, error: io::Error, report: &mut impl FnMut(LineEvent)) {
        let why = error.to_string();
        if self.reason.as_ref().is_none_or(|before| before.to_string() != why) {
            report(LineEvent::LineAway(why));
        }
        self.reason = Some(error);
    }

    fn read_line(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        if !self.is_up() {
            return;
        }
        let mut buffer = [0; 4_096];
        for _ in 0..MAX_BATCHES {
            let LineState::Open(port) = &self.line else { return };
            match port.read(&mut buffer) {
                Ok(0) => return,
                Ok(count) => self.incoming.receive_bytes(buffer.get(..count).unwrap_or_default()),
                Err(error) => return self.handle_line_lost(error, now, report),
            }
            self.handle_refusals(now, report);
            self.write_bus(now, report);
        }
    }

    fn write_line(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        if !self.is_up() {
            return;
        }
        loop {
            let LineState::Open(port) = &self.line else { return };
            let (bytes, _) = self.outgoing.ready_bytes(now - self.began);
            if bytes.is_empty() {
                return;
            }
            match port.write(bytes) {
                Ok(0) => return,
                Ok(count) => {
                    let before = self.outgoing.opening_stage();
                    self.outgoing.remove_written(count);
                    if before != OpeningStage::Open && self.outgoing.opening_stage() == OpeningStage::Open {
                        self.incoming.handle_adapter_opened();
                    }
                }
                Err(error) => return self.handle_line_lost(error, now, report),
            }
        }
    }

    fn read_bus(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        for _ in 0..MAX_BATCHES {
            let ClientState::Open(bus) = &self.client else { return };
            match bus.receive(&mut self.inbox) {
                Ok(0) => return,
                Ok(_) => {
                    for received in self.inbox.frames() {
                        self.outgoing.push_frame(&received.frame);
                    }
                }
                Err(error) => return self.handle_bus_failure(&error, now, report),
            }
            self.write_line(now, report);
        }
    }

    fn write_bus(&mut self, now: Instant, report: &mut impl FnMut(LineEvent)) {
        let ClientState::Open(bus) = &self.client else { return };
        let waiting = self.incoming.waiting_frames();
        if waiting.is_empty() {
            return;
        }
        match bus.send(waiting) {
            Ok(()) => {
                let count = waiting.len();
                self.incoming.remove_sent(count);
            }
            Err(error) => {
                self.incoming.remove_sent(error.sent);
                if !matches!(error.cause, BusError::Full { .. }) {
                    self.handle_bus_failure(&error.cause, now, report);
                }
            }
        }
    }

    /// Handles an interface that went down or a bus that ended. The frames queued for it are lost.
    fn handle_bus_failure(&mut self, error: &BusError, now: Instant, report: &mut impl FnMut(LineEvent)) {
        self.incoming.handle_bus_lost();
        self.dropped_before += u64::from(self.inbox.dropped_count());
        self.inbox = Inbox::new();
        self.client = ClientState::Away(now + REOPEN_INTERVAL);
        report(LineEvent::BusAway(error.to_string()));
    }

    fn open_client(&mut self, settings: &BridgeSettings, now: Instant, report: &mut impl FnMut(LineEvent)) {
        match open(settings, self.opener.options()) {
            Ok(bus) => {
                self.incoming.handle_bus_opened(!bus.carries_fd(), bus.is_virtual().unwrap_or(false));
                self.client = ClientState::Open(Box::new(bus));
                report(LineEvent::BusUp);
            }
            Err(_) => self.client = ClientState::Away(now + REOPEN_INTERVAL),
        }
    }

    fn lost_frame_counts(&self) -> (u64, u64) {
        let to_line = &self.outgoing.account;
        let to_bus = self.incoming.account();
        let by_bus = self.dropped_before + u64::from(self.inbox.dropped_count());
        (to_line.dropped.total() + by_bus, to_bus.dropped.total() + to_bus.refused.total())
    }

    /// Reads the remaining input, and queues the command that closes the adapter. The bus is not read any more.
    pub(super) fn start_closing(&mut self) {
        let now = Instant::now();
        self.read_line(now, &mut |_| {});
        self.write_bus(now, &mut |_| {});
        self.read_bus(now, &mut |_| {});
        self.client = ClientState::Away(Instant::now());
        self.incoming.drop_remaining();
        self.outgoing.queue_closing_bytes(&closing_command());
    }

    /// Writes the remaining output. Returns true when everything is written.
    pub(super) fn write_remaining(&mut self) -> bool {
        self.write_line(Instant::now(), &mut |_| {});
        !self.is_up() || self.outgoing.is_empty()
    }

    /// Gives up the remaining output at the end of the time for it. Returns true if the adapter was closed.
    pub(super) fn give_up_closing(&mut self) -> bool {
        let closed = self.write_remaining();
        if let LineState::Open(port) = &self.line
            && !closed
        {
            port.discard_output();
        }
        self.outgoing.drop_unfinished_frame();
        closed
    }
}
