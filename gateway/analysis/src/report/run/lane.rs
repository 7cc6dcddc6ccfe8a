//! What the frames of one bus say: the same accounts that the gateway kept, epoch by epoch.

use protocol::candump::{Direction, Record};
use protocol::message::Message;
use protocol::skin::{Reply, Skin};
use protocol::time::Micros;
use protocol::wire_time::Bits;

use super::{COLUMNS, GRAIN_S};
use crate::fit::rates::Chosen;
use crate::report::thin::{Binned, Thinned};
use model::decode::{Decoded, Decoder};
use model::table::{Replies, Table};
use trace::capture::InForce;

/// Time is let pass for the cells as often as a receiver does it.
const LOOK_US: u64 = 20_000;
/// Frames are counted over times that are so long at first, in s, and so many of them.
const BIN_S: f64 = 0.1;
const BINS: usize = 600;

/// How long a cell took to answer, in µs.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Latency {
    pub(super) greatest: u64,
    pub(super) sum: u64,
    pub(super) count: u64,
}

/// Replies at some time, of all cells together.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Account {
    pub(super) due: u64,
    pub(super) in_time: u64,
    pub(super) late: u64,
    pub(super) missing: u64,
}

/// The epoch that is open.
#[derive(Clone, Copy, Debug)]
struct Open {
    number: u64,
    at: f64,
    /// What was due in it.
    due: u64,
    /// What there was when it was opened.
    before: Account,
    /// Errors compared before it, and their sum.
    errors: (u64, f64),
    /// Its slowest reply, in µs.
    slowest: Option<u64>,
}

/// One bus.
#[derive(Debug)]
pub(super) struct Lane {
    pub(super) name: String,
    pub(super) table: Table,
    /// Whether cells answer with sums.
    pub(super) sums: bool,
    decoder: Decoder,
    open: Option<Open>,
    looked: Micros,
    pub(super) due: Thinned,
    pub(super) in_time: Thinned,
    pub(super) late: Thinned,
    pub(super) missing: Thinned,
    /// In ms.
    pub(super) slowest: Thinned,
    /// Mean absolute error of the whole bus' torque in an epoch that all answered, in Nm.
    pub(super) error: Thinned,
    /// By place among the bus' cells.
    pub(super) latency: Vec<Latency>,
    pub(super) frames: u64,
    /// When the first and the last joints stood on the bus, in s, and how many there were.
    pub(super) joints: Option<(f64, f64, u64)>,
    /// The bit rates of a real bus in its place.
    pub(super) rates: Chosen,
    /// Seconds that it would carry what it has to.
    pub(super) load: Binned,
    /// The same with what only a bench sends.
    pub(super) load_of_all: Binned,
    /// Frames that were lost on the way to the recording, as it says.
    pub(super) dropped: u64,
}

impl Lane {
    pub(super) fn new(skin: &Skin, bus: usize, rates: Chosen) -> Self {
        let mut table = Table::new(skin, bus);
        table.set_comparing(true);
        let roots: Vec<_> = table.cells().iter().filter(|cell| cell.root).map(|cell| cell.node).collect();
        for root in roots {
            table.set_feeds(root, true);
        }
        let described = skin.buses.get(bus);
        let thinned = || Thinned::new(COLUMNS, GRAIN_S);
        Self {
            name: described.map(|bus| bus.name.clone()).unwrap_or_default(),
            latency: vec![Latency::default(); table.cells().len()],
            table,
            sums: described.is_some_and(|bus| bus.reply != Reply::Torque),
            decoder: Decoder::new(described.map(|bus| bus.format)),
            open: None,
            looked: Micros(0),
            due: thinned(),
            in_time: thinned(),
            late: thinned(),
            missing: thinned(),
            slowest: thinned(),
            error: thinned(),
            frames: 0,
            joints: None,
            rates,
            load: Binned::new(BINS, BIN_S),
            load_of_all: Binned::new(BINS, BIN_S),
            dropped: 0,
        }
    }

    /// A frame that was on the bus before the recording began, and still says what holds.
    pub(super) fn in_force(&mut self, before: &InForce) {
        self.table.handle_frame(Micros(before.nanos / 1_000), before.own, &before.frame, &mut |_| None);
    }

    /// The recording begins.
    pub(super) fn begin(&mut self) {
        self.table.begin_accounts();
        self.open = self.table.newest().map(|(number, _, _)| Open {
            number,
            at: 0.0,
            due: 0,
            before: Account::default(),
            errors: (0, 0.0),
            slowest: None,
        });
    }

    /// The next frame, `at` seconds after the recording's beginning.
    pub(super) fn frame(&mut self, at: f64, record: &Record<'_>) {
        let now = Micros(record.time.nanos / 1_000);
        self.frames += 1;
        if now.0 >= self.looked.0 + LOOK_US {
            self.looked = now;
            self.table.handle_time(now);
            self.table.notices().for_each(drop);
        }
        let own = record.direction == Some(Direction::Sent);
        let decoded = self.decoder.decode(now, &self.name, &record.frame);
        if let Decoded::Message(message) = &decoded {
            self.answer(now, message);
        }
        let seconds = Bits::of(&record.frame).map_or(0.0, |bits| bits.seconds(self.rates.rates));
        self.load_of_all.add(at, seconds);
        self.table.handle_frame(now, own, &record.frame, &mut |_| None);
        let newest = self.table.newest().map(|(number, _, _)| number);
        if newest.is_some() && newest != self.open.map(|open| open.number) {
            self.next(newest.unwrap_or(0), at);
        }
    }

    /// What a real bus would have carried of a frame; nothing of one that only a bench sends.
    pub(super) fn carried(&mut self, at: f64, bits: Option<Bits>) {
        self.load.add(at, bits.map_or(0.0, |bits| bits.seconds(self.rates.rates)));
    }

    /// How long a cell took, if this is its answer to the newest joints.
    fn answer(&mut self, now: Micros, message: &Message) {
        let (Message::Torque { from, epoch, .. } | Message::Sum { from, epoch, .. }) = message else {
            return;
        };
        let Some((_, newest, opened)) = self.table.newest() else { return };
        let cell = self.table.cells().iter().position(|cell| cell.node == *from);
        let Some(latency) = cell.filter(|_| newest == *epoch).and_then(|cell| self.latency.get_mut(cell))
        else {
            return;
        };
        let took = now.since(opened).0;
        latency.greatest = latency.greatest.max(took);
        latency.sum = latency.sum.saturating_add(took);
        latency.count += 1;
        if let Some(open) = &mut self.open {
            open.slowest = open.slowest.max(Some(took));
        }
    }

    /// What is due and what has come of it, all epochs together.
    pub(super) fn account(&self) -> Account {
        if let Some((_, cells)) = self.table.sums() {
            return Account {
                due: cells.due,
                in_time: cells.in_time,
                late: cells.late,
                missing: cells.missing,
            };
        }
        let all = Replies::total(self.table.cells().iter().map(|cell| cell.replies));
        Account { due: all.due, in_time: all.in_time, late: all.late, missing: all.missing }
    }

    /// Errors compared so far, and their sum.
    fn errors(&self) -> (u64, f64) {
        let accuracy = self.table.accuracy();
        let errors = if self.sums { accuracy.sums } else { accuracy.whole };
        (errors.count(), errors.mean().unwrap_or(0.0) * errors.count() as f64)
    }

    /// New joints stand on the bus.
    fn next(&mut self, number: u64, at: f64) {
        let (first, _, count) = self.joints.unwrap_or((at, at, 0));
        self.joints = Some((first, at, count + 1));
        let (account, errors) = (self.account(), self.errors());
        let due = self.close(account, errors);
        self.open = Some(Open { number, at, due, before: account, errors, slowest: None });
    }

    /// Ends the epoch that is open; what has become due since.
    fn close(&mut self, account: Account, errors: (u64, f64)) -> u64 {
        let Some(open) = self.open.take() else { return account.due };
        let Open { at, before, .. } = open;
        self.due.push(at, open.due as f64);
        self.in_time.push(at, account.in_time.saturating_sub(before.in_time) as f64);
        self.late.push(at, account.late.saturating_sub(before.late) as f64);
        self.missing.push(at, account.missing.saturating_sub(before.missing) as f64);
        self.slowest.push(at, open.slowest.map_or(f64::NAN, |took| took as f64 * 1e-3));
        let compared = errors.0.saturating_sub(open.errors.0);
        self.error.push(
            at,
            if compared > 0 { (errors.1 - open.errors.1).max(0.0) / compared as f64 } else { f64::NAN },
        );
        account.due.saturating_sub(before.due)
    }

    /// No more frames follow.
    pub(super) fn finish(&mut self) {
        self.table.finish();
        let (account, errors) = (self.account(), self.errors());
        self.close(account, errors);
    }
}
