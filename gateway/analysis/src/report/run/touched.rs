//! Records the touches of the cells of a bus, with time and force, in bounded memory. It keeps the largest force in
//! equal bins of time, which double in width when there are too many.

use std::collections::BTreeMap;

use protocol::skin::Skin;

/// Maximum number of bins, and their initial width in s.
const MAX_BINS: usize = 600;
const INITIAL_BIN_WIDTH_S: f64 = 0.016;
/// Maximum number of touches that are kept with their details.
const MAX_TOUCHES: usize = 2_000;

/// A time span during which cells on one link are in contact.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Touch {
    /// The row of the chain that carries these cells, from 1.
    pub(super) row: u8,
    /// Start and end of the span, in s after the recording's first message.
    pub(super) seconds: (f64, f64),
    /// The cells in contact, by index on the bus.
    pub(super) cells: Vec<usize>,
    /// The cell with the largest force, and this force in N.
    pub(super) strongest: (usize, f64),
}

/// The touches of the cells of one bus.
#[derive(Debug)]
pub(super) struct TouchHistory {
    /// For each cell, by its index on the bus, the row of the chain that carries it.
    rows: Vec<u8>,
    width: f64,
    /// The largest force of each touched cell in each bin, in N.
    bins: BTreeMap<usize, Vec<f64>>,
    /// The largest force of each cell, in N; `None` while unknown.
    pub(super) max: Vec<Option<f64>>,
    /// Forces since the last joints, and the time of those joints.
    now: Vec<f64>,
    at: Option<f64>,
    /// Touches that have not ended, by row.
    open: BTreeMap<u8, Touch>,
    pub(super) touches: Vec<Touch>,
    /// Number of touches whose details were not kept.
    pub(super) further: u64,
}

impl TouchHistory {
    pub(super) fn new(skin: &Skin, bus: usize) -> Self {
        let rows: Vec<_> = skin.cells_on_bus(bus).map(|cell| cell.row).collect();
        Self {
            width: INITIAL_BIN_WIDTH_S,
            bins: BTreeMap::new(),
            max: vec![None; rows.len()],
            now: vec![0.0; rows.len()],
            rows,
            at: None,
            open: BTreeMap::new(),
            touches: Vec::new(),
            further: 0,
        }
    }

    /// Records new joints on the bus at `at` in s, with the force on each cell since these joints in N, where known.
    pub(super) fn record_joints(&mut self, at: f64, forces: impl Iterator<Item = Option<f64>>) {
        self.extend_bins_to(at);
        self.at = Some(at);
        for (place, force) in forces.enumerate().take(self.rows.len()) {
            if let (Some(max), Some(force)) = (self.max.get_mut(place), force) {
                *max = Some(max.unwrap_or(0.0).max(force));
            }
            let force = force.unwrap_or(0.0);
            if let Some(now) = self.now.get_mut(place) {
                *now = force;
            }
            if force > 0.0 {
                self.extend_touch(at, place, force);
            }
        }
        let rows: Vec<_> = self.open.keys().copied().collect();
        for row in rows {
            let mut cells = self.rows.iter().zip(&self.now).filter(|(of, _)| **of == row);
            if cells.all(|(_, force)| *force <= 0.0) {
                self.end_touch(row, at);
            }
        }
    }

    fn extend_touch(&mut self, at: f64, place: usize, force: f64) {
        let Some(row) = self.rows.get(place).copied() else { return };
        let touch = self.open.entry(row).or_insert_with(|| Touch {
            row,
            seconds: (at, at),
            cells: Vec::new(),
            strongest: (place, force),
        });
        if !touch.cells.contains(&place) {
            touch.cells.push(place);
        }
        if force > touch.strongest.1 {
            touch.strongest = (place, force);
        }
    }

    fn end_touch(&mut self, row: u8, at: f64) {
        let Some(mut touch) = self.open.remove(&row) else { return };
        touch.seconds.1 = at;
        if self.touches.len() < MAX_TOUCHES {
            self.touches.push(touch);
        } else {
            self.further += 1;
        }
    }

    /// Adds the last forces to the bins up to the time `at` in s.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "not negative; wide bins are few"
    )]
    fn extend_bins_to(&mut self, at: f64) {
        let Some(from) = self.at.map(|from| from.max(0.0)).filter(|from| at > *from) else { return };
        while at / self.width >= MAX_BINS as f64 {
            self.width *= 2.0;
            for bins in self.bins.values_mut() {
                *bins = bins.chunks(2).map(|two| two.iter().copied().fold(0.0, f64::max)).collect();
            }
        }
        let bins = (from / self.width) as usize..=((at / self.width).ceil() as usize).saturating_sub(1);
        for (place, force) in self.now.iter().enumerate().filter(|(_, force)| **force > 0.0) {
            let of_cell = self.bins.entry(place).or_default();
            if of_cell.len() <= *bins.end() {
                of_cell.resize(bins.end() + 1, 0.0);
            }
            for bin in of_cell.get_mut(bins.clone()).into_iter().flatten() {
                *bin = bin.max(*force);
            }
        }
    }

    /// Ends all open touches.
    pub(super) fn finish(&mut self) {
        let Some(at) = self.at else { return };
        let rows: Vec<_> = self.open.keys().copied().collect();
        rows.into_iter().for_each(|row| self.end_touch(row, at));
    }

    /// Returns for each touched cell its index, and the bins: start and end in s, and the largest force in N.
    pub(super) fn touch_bins_by_cell(&self) -> impl Iterator<Item = (usize, Vec<(f64, f64, f64)>)> + '_ {
        self.bins.iter().map(|(place, bins)| {
            let place_of = |at: usize| at as f64 * self.width;
            let touched = bins.iter().enumerate().filter(|(_, force)| **force > 0.0);
            (*place, touched.map(|(at, force)| (place_of(at), place_of(at + 1), *force)).collect())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model::generate::{SkinRequest, generate};

    fn touched() -> TouchHistory {
        let skin =
            Skin::parse("skin", &generate(&SkinRequest { cells: 40, ..SkinRequest::default() }).unwrap())
                .unwrap();
        TouchHistory::new(&skin, 0)
    }

    /// Records joints with these forces, each with the index of its cell; the force on other cells is 0.
    fn joints(touched: &mut TouchHistory, at: f64, forces: &[(usize, f64)]) {
        let cells = touched.rows.len();
        let force = |place| forces.iter().find(|(of, _)| *of == place).map_or(0.0, |(_, force)| *force);
        touched.record_joints(at, (0..cells).map(|place| Some(force(place))));
    }

    #[test]
    fn a_force_holds_until_the_next_joints() {
        let mut touched = touched();
        for (at, force) in [(0.0, 0.0), (0.16, 2.0), (0.32, 5.0), (0.48, 0.0), (0.64, 0.0)] {
            joints(&mut touched, at, &[(3, force)]);
        }
        let cells: Vec<_> = touched.touch_bins_by_cell().collect();
        let [(3, values)] = cells.as_slice() else { panic!("{cells:?}") };
        let of = |force: f64| values.iter().filter(|value| (value.2 - force).abs() < 1e-9).count();
        assert_eq!((of(2.0), of(5.0), values.len()), (10, 10, 20));
        assert!((values[0].0 - 0.16).abs() < 1e-9 && (values[19].1 - 0.48).abs() < 1e-9, "{values:?}");
        assert_eq!((touched.max[3], touched.max[4]), (Some(5.0), Some(0.0)));
    }

    #[test]
    fn cells_of_a_link_that_are_touched_together_are_one_touch() {
        let mut touched = touched();
        let last = touched.rows.len() - 1;
        assert_ne!(touched.rows[0], touched.rows[last], "two links");
        joints(&mut touched, 1.0, &[(0, 1.0)]);
        joints(&mut touched, 1.1, &[(0, 1.0), (1, 4.0), (last, 2.0)]);
        joints(&mut touched, 1.2, &[(1, 3.0), (last, 2.0)]);
        joints(&mut touched, 1.3, &[(last, 2.5)]);
        touched.finish();
        let [first, second] = touched.touches.as_slice() else { panic!("{:?}", touched.touches) };
        assert_eq!((first.seconds, &first.cells, first.strongest), ((1.0, 1.3), &vec![0, 1], (1, 4.0)));
        assert_eq!((second.seconds, &second.cells, second.strongest), ((1.1, 1.3), &vec![last], (last, 2.5)));
    }

    #[test]
    fn an_hour_keeps_its_touches_in_few_bins() {
        let mut touched = touched();
        for epoch in 0..225_000_u32 {
            let force = if epoch == 100_000 { 7.0 } else { 0.0 };
            joints(&mut touched, f64::from(epoch) * 0.016, &[(5, force)]);
        }
        let cells: Vec<_> = touched.touch_bins_by_cell().collect();
        let [(5, values)] = cells.as_slice() else { panic!("{cells:?}") };
        let [(from, to, force)] = values[..] else { panic!("{values:?}") };
        assert!(from <= 1_600.0 && to >= 1_600.016 && to - from < 10.0, "{from} {to}");
        assert!((force - 7.0).abs() < 1e-9);
    }
}
