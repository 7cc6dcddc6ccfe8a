//! How many cells answered joints.

use protocol::id::CellId;
use protocol::packet::Epoch;
use serde::Serialize;

use crate::fit::verdict::Cells;

/// A set of cells of a bus.
#[derive(Clone, Copy, Debug, Default)]
struct Set([u64; 4]);

impl Set {
    fn insert(&mut self, cell: CellId) {
        let (word, bit) = (cell.index() / 64, cell.index() % 64);
        self.0.get_mut(word).into_iter().for_each(|word| *word |= 1 << bit);
    }

    fn len(&self) -> u32 {
        self.0.iter().map(|word| word.count_ones()).sum()
    }
}

/// Cells that answered, epoch by epoch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Answering {
    /// Joints that were sent while cells were not halted.
    pub epochs: u64,
    /// Joints that were sent while they were.
    pub epochs_halted: u64,
    /// How many cells answered joints on average; none without joints.
    pub mean: Option<f64>,
    /// How many answered the same joints at most.
    pub most: u32,
    /// Cells of the bus, by the skin, else those that were heard.
    pub cells: u32,
    /// Whether the skin says so.
    pub described: bool,
}

impl Answering {
    /// In the words of [`crate::fit::verdict`].
    #[must_use]
    pub const fn cells(&self) -> Cells {
        Cells::Some { most: self.most, cells: self.cells, described: self.described }
    }
}

/// Counts them, however long that lasts.
#[derive(Debug)]
pub(super) struct Counter {
    heard: Set,
    /// By the number of the epoch, of joints that were sent while cells were not halted.
    open: Vec<Option<Set>>,
    newest: Option<Epoch>,
    halted: bool,
    epochs: u64,
    epochs_halted: u64,
    answers: u64,
    most: u32,
}

impl Counter {
    pub(super) fn new() -> Self {
        Self {
            heard: Set::default(),
            open: vec![None; 256],
            newest: None,
            halted: false,
            epochs: 0,
            epochs_halted: 0,
            answers: 0,
            most: 0,
        }
    }

    pub(super) fn halt(&mut self, halted: bool) {
        self.halted = halted;
    }

    /// A cell was heard.
    pub(super) fn heard(&mut self, cell: CellId) {
        self.heard.insert(cell);
    }

    /// Joints were sent; the same ones again are no others.
    pub(super) fn joints(&mut self, epoch: Epoch) {
        if self.newest.replace(epoch) == Some(epoch) {
            return;
        }
        let of_before = self.slot(epoch).and_then(Option::take);
        self.close(of_before);
        if self.halted {
            self.epochs_halted += 1;
        } else {
            self.slot(epoch).into_iter().for_each(|slot| *slot = Some(Set::default()));
        }
    }

    pub(super) fn answer(&mut self, cell: CellId, epoch: Epoch) {
        self.slot(epoch).into_iter().flatten().for_each(|cells| cells.insert(cell));
    }

    fn slot(&mut self, epoch: Epoch) -> Option<&mut Option<Set>> {
        self.open.get_mut(usize::from(epoch.0))
    }

    fn close(&mut self, cells: Option<Set>) {
        let Some(cells) = cells else { return };
        self.epochs += 1;
        self.answers += u64::from(cells.len());
        self.most = self.most.max(cells.len());
    }

    /// All of it; the skin may say how many cells there are.
    pub(super) fn report(&self, described: Option<u32>) -> Answering {
        let open = self.open.iter().flatten().map(Set::len);
        let (mut epochs, mut answers, mut most) = (self.epochs, self.answers, self.most);
        for cells in open {
            epochs += 1;
            answers += u64::from(cells);
            most = most.max(cells);
        }
        Answering {
            epochs,
            epochs_halted: self.epochs_halted,
            mean: (epochs > 0).then(|| answers as f64 / epochs as f64),
            most,
            cells: described.unwrap_or_else(|| self.heard.len()),
            described: described.is_some(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(number: i64) -> CellId {
        CellId::new(number).unwrap()
    }

    #[test]
    fn each_cell_counts_once_an_epoch_however_late_and_halted_epochs_not_at_all() {
        let mut counter = Counter::new();
        counter.answer(cell(9), Epoch(255));
        for epoch in 0..=255 {
            counter.joints(Epoch(epoch));
            let cells = if epoch == 7 { 254 } else { 2 };
            (1..=cells).chain([1]).for_each(|number| counter.answer(cell(number), Epoch(epoch)));
            (1..=cells).for_each(|number| counter.heard(cell(number)));
        }
        // One is late, and joints come again.
        counter.joints(Epoch(0));
        counter.answer(cell(3), Epoch(254));
        counter.joints(Epoch(0));
        counter.answer(cell(1), Epoch(0));
        counter.halt(true);
        counter.joints(Epoch(1));
        counter.answer(cell(1), Epoch(1));
        let report = counter.report(None);
        assert_eq!((report.epochs, report.epochs_halted, report.most), (257, 1, 254));
        assert_eq!((report.cells, report.described), (254, false));
        let answers = 256.0 * 2.0 + 252.0 + 1.0 + 1.0;
        assert!((report.mean.unwrap() - answers / 257.0).abs() < 1e-12, "{report:?}");
        assert_eq!(counter.report(Some(300)).cells, 300);
        assert_eq!(Counter::new().report(None).mean, None);
    }
}
