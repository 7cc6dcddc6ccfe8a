//! The sensor words of every cell in every epoch, from touches and sensor faults.
//!
//! The words are a pure function of the scenario and the epoch: epoch 0 is the start of the scenario, epoch k follows k
//! broadcast periods later. A cell answers the joints of an epoch with these words. Imperfect sensors are computed
//! epoch by epoch.

use protocol::id::CellId;
use protocol::message::{SensorPage, SensorReadings, SkinSensors};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};

use super::curve::seconds;
use super::force::contact_words;
use super::measured::{ImperfectSensors, TrueSensorInput};
use super::{FaultKind, Scenario, SensorFault, Touch};

/// The sensor words of a cell, valid from an epoch on.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Stimulus {
    /// The cell, as an index into [`Skin::cells`].
    pub cell: usize,
    /// The bus of the cell, as an index into [`Skin::buses`].
    pub bus: usize,
    /// Node id of the cell on that bus.
    pub node: CellId,
    /// Its readings.
    pub readings: SensorReadings,
    /// The pages to send, by [`SensorPage::simulated_index`].
    sent: [bool; SensorPage::SIMULATED_PAGE_NAMES.len()],
}

impl Stimulus {
    /// Returns the pages to send: those that changed.
    pub fn pages(&self) -> impl Iterator<Item = SensorPage> {
        self.readings
            .simulated_pages()
            .into_iter()
            .zip(self.sent)
            .filter_map(|(page, is_sent)| is_sent.then_some(page))
    }
}

/// The touches of a scenario, by cell. A cell without a touch has [`SensorReadings::default`], as every cell has before
/// the first epoch.
#[derive(Clone, Debug)]
pub struct Touches {
    /// Broadcast period, in µs.
    period_us: f64,
    touches: Vec<Touch>,
    /// The period with which all touches repeat, if they do.
    repeat: Option<Span>,
    /// Scratch memory of [`Touches::stimuli_between`]: for each touch, its forces in N in the previous and in the
    /// present epoch.
    levels: Vec<[Option<f64>; 2]>,
    cells: Vec<AffectedCell>,
    /// The imperfect sensors, if there are any; `cells` then contains every cell of the skin.
    measured: Option<ImperfectSensors>,
    /// Scratch memory of [`Touches::stimuli_between`]; the next two fields are, too.
    changed: Vec<Stimulus>,
    there: Vec<TrueSensorInput>,
    before: Vec<SensorReadings>,
    /// The pages that touches set: the skin's, and others that differ from their default in some touch.
    set: [bool; SensorPage::SIMULATED_PAGE_NAMES.len()],
}

/// A cell with touches or sensor faults.
#[derive(Clone, Debug)]
struct AffectedCell {
    cell: usize,
    bus: usize,
    node: CellId,
    /// Indices into the touches of the scenario.
    touches: Vec<usize>,
    faults: Vec<TimedSensorFault>,
}

#[derive(Clone, Copy, Debug)]
struct TimedSensorFault {
    at: Micros,
    length: Span,
    fault: SensorFault,
}

impl Touches {
    /// Collects the touches and sensor faults of each cell.
    #[must_use]
    pub fn new(scenario: &Scenario, skin: &Skin) -> Self {
        let of_cell = |(index, cell): (usize, &protocol::skin::Cell)| AffectedCell {
            cell: index,
            bus: cell.bus,
            node: cell.node,
            touches: Vec::new(),
            faults: Vec::new(),
        };
        let mut cells: Vec<AffectedCell> = skin.cells.iter().enumerate().map(of_cell).collect();
        for (index, touch) in scenario.touches.iter().enumerate() {
            for &cell in &touch.cells {
                if let Some(touched) = cells.get_mut(cell) {
                    touched.touches.push(index);
                }
            }
        }
        for fault in &scenario.faults {
            let FaultKind::Sensor { fault: wrong, length, cells: hit } = &fault.kind else { continue };
            for &cell in hit {
                if let Some(touched) = cells.get_mut(cell) {
                    touched.faults.push(TimedSensorFault { at: fault.at, length: *length, fault: *wrong });
                }
            }
        }
        let measured = (!scenario.sensors.is_force_perfect())
            .then(|| ImperfectSensors::new(&scenario.sensors, scenario.seed, skin));
        if measured.is_none() {
            cells.retain(|touched| !touched.touches.is_empty() || !touched.faults.is_empty());
        }
        let mut readings = SensorReadings::default();
        scenario.touches.iter().for_each(|touch| touch.values.apply(&mut readings));
        let mut set = differing_pages(&SensorReadings::default(), &readings);
        let [of_skin, ..] = &mut set;
        *of_skin = true;
        Self {
            set,
            period_us: 1e6 / skin.timing.broadcast_hz(),
            levels: vec![[None; 2]; scenario.touches.len()],
            touches: scenario.touches.clone(),
            repeat: scenario.touches_repeat,
            changed: Vec::with_capacity(cells.len()),
            there: Vec::with_capacity(cells.len()),
            before: Vec::with_capacity(cells.len()),
            cells,
            measured,
        }
    }

    /// Returns the cells whose words in `epoch` differ from those in the previous epoch.
    pub fn stimuli_for(&mut self, epoch: u64) -> impl Iterator<Item = Stimulus> {
        self.stimuli_between(epoch.checked_sub(1), epoch)
    }

    /// Returns the cells whose words in `epoch` differ from their words in the earlier epoch `before`. A loop that
    /// skipped epochs passes the last one that it handled. `None` is the time before the first epoch. Each cell occurs
    /// at most once, in the skin's order.
    ///
    /// Work grows with the number of cells that are ever touched. No allocation.
    pub fn stimuli_between(&mut self, before: Option<u64>, epoch: u64) -> impl Iterator<Item = Stimulus> {
        let mut changed = core::mem::take(&mut self.changed);
        changed.clear();
        if self.measured.is_some() {
            self.collect_measured_stimuli(before, epoch, &mut changed);
        } else {
            changed.extend(self.perfect_sensor_stimuli(before, epoch));
        }
        self.changed = changed;
        self.changed.iter().copied()
    }

    fn collect_measured_stimuli(&mut self, before: Option<u64>, epoch: u64, changed: &mut Vec<Stimulus>) {
        let Some(mut measured) = self.measured.take() else { return };
        self.before.clear();
        if let Some(before) = before {
            self.advance_sensors_to(&mut measured, before);
            self.before.extend(measured.readings());
        } else {
            self.before.resize(self.cells.len(), SensorReadings::default());
        }
        self.advance_sensors_to(&mut measured, epoch);
        let words = self.cells.iter().zip(&self.before).zip(measured.readings());
        changed.extend(words.filter_map(|((touched, before), now)| touched.stimulus_for_change(before, now)));
        self.measured = Some(measured);
    }

    /// Computes the readings of imperfect sensors up to an epoch. If that epoch is earlier than the last computed one,
    /// the computation starts again from the first.
    fn advance_sensors_to(&mut self, measured: &mut ImperfectSensors, epoch: u64) {
        if measured.next_epoch() > epoch + 1 {
            measured.reset_sensors();
        }
        let mut there = core::mem::take(&mut self.there);
        while measured.next_epoch() <= epoch {
            let time = self.time_of(measured.next_epoch());
            there.clear();
            there.extend(self.cells.iter().map(|touched| self.true_input(touched, time)));
            measured.compute_next_epoch(time, &there);
        }
        self.there = there;
    }

    /// Returns the true input of a cell's sensors.
    fn true_input(&self, touched: &AffectedCell, time: Micros) -> TrueSensorInput {
        let mut there = TrueSensorInput::default();
        for touch in touched.touches.iter().filter_map(|&index| self.touches.get(index)) {
            let Some(level) = self.force_at(touch, time) else { continue };
            there.force_n += level;
            touch.values.apply(&mut there.readings);
            there.is_warmed |= touch.values.temperature.is_some();
        }
        for wrong in touched.faults.iter().filter(|wrong| wrong.is_active_at(time)) {
            match wrong.fault {
                SensorFault::Stuck => there.is_stuck = true,
                SensorFault::Drift { n_per_s } => {
                    there.added_n += n_per_s * seconds(time.elapsed_since(wrong.at))
                }
            }
        }
        there
    }

    fn perfect_sensor_stimuli(&mut self, before: Option<u64>, epoch: u64) -> impl Iterator<Item = Stimulus> {
        let times = [before.map(|before| self.time_of(before)), Some(self.time_of(epoch))];
        let phases = times.map(|time| time.map(|time| self.time_in_cycle(time)));
        for (levels, touch) in self.levels.iter_mut().zip(&self.touches) {
            *levels = phases.map(|phase| phase.and_then(|phase| touch.force_at(phase)));
        }
        let this = &*self;
        this.cells.iter().filter_map(move |touched| {
            let [before, now] = if touched.faults.is_empty() {
                this.readings_before_and_now(touched)?
            } else {
                times.map(|time| {
                    time.map_or_else(SensorReadings::default, |time| this.words_at(touched, time))
                })
            };
            touched.stimulus_for_change(&before, &now)
        })
    }

    /// Returns the cells that the scenario touches at any time, by index in the skin.
    pub fn touched_cells(&self) -> impl Iterator<Item = usize> + '_ {
        self.cells.iter().map(|touched| touched.cell)
    }

    /// Returns the sensor words of a cell in an epoch, to be sent again after a restart of the cell.
    #[must_use]
    pub fn sensors(&self, cell: usize, epoch: u64) -> SkinSensors {
        self.readings(cell, epoch).skin
    }

    /// Returns all pages of a cell in an epoch that touches set, for a cell that has restarted.
    pub fn pages(&self, cell: usize, epoch: u64) -> impl Iterator<Item = SensorPage> {
        let pages = self.readings(cell, epoch).simulated_pages().into_iter();
        pages.zip(self.set).filter_map(|(page, is_set)| is_set.then_some(page))
    }

    fn readings(&self, cell: usize, epoch: u64) -> SensorReadings {
        if let Some(measured) = &self.measured {
            if measured.next_epoch() == epoch + 1 {
                return measured.readings().get(cell).copied().unwrap_or_default();
            }
            let (mut this, mut again) = (self.clone(), measured.clone());
            this.advance_sensors_to(&mut again, epoch);
            return again.readings().get(cell).copied().unwrap_or_default();
        }
        match self.cells.binary_search_by_key(&cell, |touched| touched.cell) {
            Ok(at) => self
                .cells
                .get(at)
                .map_or_else(SensorReadings::default, |touched| self.words_at(touched, self.time_of(epoch))),
            Err(_) => SensorReadings::default(),
        }
    }

    /// Returns the time of an epoch.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_precision_loss,
        clippy::cast_sign_loss,
        reason = "not negative; exact for the first 2^53 us, 285 years"
    )]
    pub fn time_of(&self, epoch: u64) -> Micros {
        Micros((epoch as f64 * self.period_us).round() as u64)
    }

    /// Returns the time since the touches last began, if they repeat; else the time itself.
    fn time_in_cycle(&self, time: Micros) -> Micros {
        match self.repeat {
            Some(Span(repeat @ 1..)) => Micros(time.0 % repeat),
            Some(Span(0)) | None => time,
        }
    }

    /// Returns the force of a touch in N at a time; `None` if the touch is not active.
    fn force_at(&self, touch: &Touch, time: Micros) -> Option<f64> {
        touch.force_at(self.time_in_cycle(time))
    }

    /// Returns the words before and now, from the scratch memory; `None` if no touch of this cell changed.
    fn readings_before_and_now(&self, touched: &AffectedCell) -> Option<[SensorReadings; 2]> {
        let levels = || touched.touches.iter().filter_map(|&index| Some((index, self.levels.get(index)?)));
        if levels().all(|(_, [before, now])| before == now) {
            return None;
        }
        let before = self.combine_touches(levels().map(|(index, [before, _])| (index, *before)), 0.0);
        let now = self.combine_touches(levels().map(|(index, [_, now])| (index, *now)), 0.0);
        Some([before, now])
    }

    /// Returns the words of a cell at a time, with its faults.
    fn words_at(&self, touched: &AffectedCell, time: Micros) -> SensorReadings {
        let faults = || touched.faults.iter().filter(|wrong| wrong.is_active_at(time));
        // A stuck sensor keeps its value from the start of the fault.
        let stuck = faults().filter(|wrong| wrong.fault == SensorFault::Stuck).map(|wrong| wrong.at).min();
        let time = stuck.unwrap_or(time);
        let drift = touched.faults.iter().map(|wrong| match wrong.fault {
            SensorFault::Drift { n_per_s } if wrong.is_active_at(time) => {
                n_per_s * seconds(time.elapsed_since(wrong.at))
            }
            SensorFault::Drift { .. } | SensorFault::Stuck => 0.0,
        });
        let levels = touched
            .touches
            .iter()
            .filter_map(|&index| Some((index, self.force_at(self.touches.get(index)?, time))));
        self.combine_touches(levels, drift.sum())
    }

    /// Combines touches: forces add up, the other values as by [`super::TouchValues`].
    fn combine_touches(
        &self,
        levels: impl Iterator<Item = (usize, Option<f64>)>,
        mut force_n: f64,
    ) -> SensorReadings {
        let mut readings = SensorReadings::default();
        for (index, level) in levels {
            let (Some(touch), Some(level)) = (self.touches.get(index), level) else { continue };
            force_n += level;
            touch.values.apply(&mut readings);
        }
        readings.skin.contact = contact_words(force_n);
        readings
    }
}

impl AffectedCell {
    /// Returns the stimulus for a change of readings, if there is one.
    fn stimulus_for_change(&self, before: &SensorReadings, now: &SensorReadings) -> Option<Stimulus> {
        let &Self { cell, bus, node, .. } = self;
        (before != now).then(|| Stimulus {
            cell,
            bus,
            node,
            readings: *now,
            sent: differing_pages(before, now),
        })
    }
}

/// Returns the pages that differ, by [`SensorPage::simulated_index`].
fn differing_pages(
    before: &SensorReadings,
    now: &SensorReadings,
) -> [bool; SensorPage::SIMULATED_PAGE_NAMES.len()] {
    let mut differ = [false; SensorPage::SIMULATED_PAGE_NAMES.len()];
    for ((differ, before), now) in differ.iter_mut().zip(before.simulated_pages()).zip(now.simulated_pages())
    {
        *differ = before != now;
    }
    differ
}

impl TimedSensorFault {
    fn is_active_at(&self, time: Micros) -> bool {
        self.at <= time && time.elapsed_since(self.at) < self.length
    }
}
