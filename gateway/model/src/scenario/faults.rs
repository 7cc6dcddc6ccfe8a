//! Checks the faults of a scenario's file.

use protocol::document::{Checked, KeyPath};
use protocol::time::Span;

use super::names::{CellSelection, NameTable};
use super::times::{ScenarioDuration, check_duration};
use super::{BusFault, Fault, FaultKind, ProcessAction, SensorFault, raw};

pub(super) const FAULT_KINDS: &str = "must be a fault of processes: \"kill\", \"stop\", \"continue\", \"restart\"; \
     of wires: \"link_down\", \"link_up\"; of sensors: \"stuck\", \"drift\"; or of buses: \"drop\", \"delay\", \
     \"duplicate\", \"corrupt\", \"reorder\", \"babble\"";

/// Checks the faults and sorts them by time.
pub(super) fn faults(
    raw: &[raw::Fault],
    end: ScenarioDuration,
    names: &NameTable<'_>,
) -> Checked<Vec<Fault>> {
    let mut faults = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let entry = FaultEntry { at: KeyPath::top_level_key("fault").with_index(index), raw, names };
        let fault = entry.fault(end)?;
        faults.extend(entry.wire_repair(&fault)?);
        faults.push(fault);
    }
    faults.sort_by_key(|fault| fault.at);
    Ok(faults)
}

/// One entry of `[[fault]]` in a scenario's file.
struct FaultEntry<'a> {
    at: KeyPath,
    raw: &'a raw::Fault,
    names: &'a NameTable<'a>,
}

impl FaultEntry<'_> {
    fn fault(&self, end: ScenarioDuration) -> Checked<Fault> {
        let raw = self.raw;
        let at = end.check_time_before_end(&self.at.with_key("at_s"), raw.at_s)?;
        let kind = match raw.kind.as_str() {
            "kill" => self.process_fault(ProcessAction::Kill)?,
            "stop" => self.process_fault(ProcessAction::Stop)?,
            "continue" => self.process_fault(ProcessAction::Continue)?,
            "restart" => self.process_fault(ProcessAction::Restart)?,
            // The second names are former ones.
            "link_down" | "cut" => self.wire_fault(true, &["for_s", "one_way"])?,
            "link_up" | "mend" => self.wire_fault(false, &["one_way"])?,
            "stuck" => self.sensor_fault(SensorFault::Stuck, &["for_s"])?,
            "drift" => {
                let n_per_s =
                    self.required_number("n_per_s", raw.n_per_s, f64::NEG_INFINITY, f64::INFINITY)?;
                self.sensor_fault(SensorFault::Drift { n_per_s }, &["for_s", "n_per_s"])?
            }
            "drop" => self.random_bus_fault(|probability| BusFault::Drop { probability })?,
            "duplicate" => self.random_bus_fault(|probability| BusFault::Duplicate { probability })?,
            "corrupt" => self.random_bus_fault(|probability| BusFault::Corrupt { probability })?,
            "reorder" => self.random_bus_fault(|probability| BusFault::Reorder { probability })?,
            "delay" => {
                let probability = self.required_number("probability", raw.probability, 0.0, 1.0)?;
                let delay = self.delay()?;
                let keys = &["for_s", "probability", "delay_us"];
                self.bus_fault(BusFault::Delay { probability, delay }, keys)?
            }
            "babble" => {
                let frames_per_s = self.required_number("frames_per_s", raw.frames_per_s, 1.0, 100_000.0)?;
                let got = raw.id.unwrap_or(0);
                let id = u16::try_from(got).ok().filter(|&id| id < 0x800);
                let id =
                    id.ok_or_else(|| self.at.with_key("id").fault(got, "an identifier must be 0 to 0x7FF"))?;
                self.bus_fault(BusFault::Babble { frames_per_s, id }, &["for_s", "frames_per_s", "id"])?
            }
            got => return Err(self.at.with_key("kind").fault(format_args!("{got:?}"), FAULT_KINDS)),
        };
        Ok(Fault { at, kind })
    }

    fn process_fault(&self, action: ProcessAction) -> Checked<FaultKind> {
        self.refuse_other_keys(&[])?;
        Ok(FaultKind::Process { action, cells: self.cells()? })
    }

    fn wire_fault(&self, link_down: bool, keys: &[&str]) -> Checked<FaultKind> {
        self.refuse_other_keys(keys)?;
        if self.raw.all {
            let why = "use the key cells to name the two cells that the wire connects";
            return Err(self.at.with_key("all").fault(true, why));
        }
        let (from, to) = self.names.wired_pair(self.selection())?;
        Ok(FaultKind::Wire { link_down, from, to, both_ways: !self.raw.one_way.unwrap_or(false) })
    }

    /// Returns the repair that follows a wire fault of limited duration.
    fn wire_repair(&self, fault: &Fault) -> Checked<Option<Fault>> {
        let FaultKind::Wire { link_down: true, from, to, both_ways } = fault.kind else { return Ok(None) };
        if self.raw.for_s.is_none() {
            return Ok(None);
        }
        let kind = FaultKind::Wire { link_down: false, from, to, both_ways };
        Ok(Some(Fault { at: fault.at + self.duration()?, kind }))
    }

    fn sensor_fault(&self, fault: SensorFault, keys: &[&str]) -> Checked<FaultKind> {
        self.refuse_other_keys(keys)?;
        Ok(FaultKind::Sensor { fault, length: self.duration()?, cells: self.cells()? })
    }

    fn random_bus_fault(&self, make: impl FnOnce(f64) -> BusFault) -> Checked<FaultKind> {
        let probability = self.required_number("probability", self.raw.probability, 0.0, 1.0)?;
        self.bus_fault(make(probability), &["for_s", "probability"])
    }

    fn bus_fault(&self, fault: BusFault, keys: &[&str]) -> Checked<FaultKind> {
        self.refuse_other_keys(keys)?;
        let bus = self.names.bus(self.selection())?;
        let is_filtered = self.raw.cells.is_some();
        let cells =
            if is_filtered { self.names.listed_cells_on_bus(self.selection(), bus)? } else { Vec::new() };
        Ok(FaultKind::Bus { fault, length: self.duration()?, bus, cells })
    }

    fn cells(&self) -> Checked<Vec<usize>> {
        self.names.cells(self.selection())
    }

    fn selection(&self) -> CellSelection<'_> {
        let Self { at, raw, .. } = self;
        CellSelection { at, bus: raw.bus.as_deref(), cells: raw.cells.as_deref(), all: raw.all }
    }

    /// Returns the duration of the fault; without `for_s` it lasts to the end.
    fn duration(&self) -> Checked<Span> {
        self.raw
            .for_s
            .map_or(Ok(Span(u64::MAX)), |seconds| check_duration(&self.at.with_key("for_s"), seconds))
    }

    fn delay(&self) -> Checked<Span> {
        let wrong = |got: String| {
            self.at.with_key("delay_us").fault(got, "must be 1 to 1000000 us with kind = \"delay\"")
        };
        let got = self.raw.delay_us.ok_or_else(|| wrong(String::new()))?;
        let delay = u64::try_from(got).ok().filter(|delay| (1..=1_000_000).contains(delay));
        delay.map(Span).ok_or_else(|| wrong(got.to_string()))
    }

    /// Returns a number that this kind of fault requires; it must be from `min` to `max`.
    fn required_number(&self, key: &'static str, value: Option<f64>, min: f64, max: f64) -> Checked<f64> {
        let why = || match (min, max) {
            (f64::NEG_INFINITY, _) => format!("must be a finite number with kind = {:?}", self.raw.kind),
            _ => format!("must be {min} to {max} with kind = {:?}", self.raw.kind),
        };
        let given = value.filter(|value| value.is_finite() && (min..=max).contains(value));
        given.ok_or_else(|| {
            self.at.with_key(key).fault(value.map_or_else(String::new, |it| it.to_string()), why())
        })
    }

    /// Refuses keys that have no meaning for this kind of fault.
    fn refuse_other_keys(&self, keys: &[&str]) -> Checked<()> {
        let raw = self.raw;
        let given = [
            ("for_s", raw.for_s.is_some()),
            ("one_way", raw.one_way.is_some()),
            ("probability", raw.probability.is_some()),
            ("delay_us", raw.delay_us.is_some()),
            ("n_per_s", raw.n_per_s.is_some()),
            ("frames_per_s", raw.frames_per_s.is_some()),
            ("id", raw.id.is_some()),
        ];
        let senseless = given.into_iter().find(|(key, given)| *given && !keys.contains(key));
        senseless.map_or(Ok(()), |(key, _)| {
            Err(self.at.with_key(key).fault("", format_args!("is not allowed with kind = {:?}", raw.kind)))
        })
    }
}
