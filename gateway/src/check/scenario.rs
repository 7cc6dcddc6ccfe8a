//! Output of `skinbus check` for a scenario.

use std::path::Path;

use bench::processes::group_consecutive;
use bench::run::RunError;
use model::scenario::{
    BusFault, FaultKind, ForceErrors, ForceProfile, MotionKind, Scenario as Description, SensorFault,
};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use protocol::usage::{Failure, printable};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::print::{
    comma_separated, count_with_noun, format_decimals, or_else_text, space_separated, table,
    to_pretty_json as pretty,
};

const MAX_LISTED_VALUES: usize = 8;

/// Checks the text of a scenario file against a skin, and describes the scenario.
///
/// Also returns the reason if a run would refuse the scenario; a bench in virtual time may accept it.
pub(super) fn describe_scenario(
    file: &Path,
    text: &str,
    skin: &Skin,
    as_json: bool,
) -> Result<(String, Option<Failure>), Failure> {
    let scenario =
        Description::parse(&file.display().to_string(), text, skin).map_err(Failure::usage_error)?;
    let refused = RunError::bus_fault(&scenario, skin).map(Failure::usage_error);
    let plan = ScenarioPlan::from_scenario(&scenario, skin);
    let text = if as_json { pretty(&plan)? } else { plan.to_text(&file.display().to_string()) };
    Ok((text, refused))
}

/// Content of a scenario, as printed.
#[derive(Serialize)]
struct ScenarioPlan {
    skin: String,
    duration_s: f64,
    /// Period after which the touches repeat.
    #[serde(skip_serializing_if = "Option::is_none")]
    touches_repeat_s: Option<f64>,
    seed: u64,
    motion: PlannedMotion,
    events: Vec<PlannedEvent>,
    /// Simulated errors of the sensors, by the file's keys.
    #[serde(skip_serializing_if = "Map::is_empty")]
    sensors: Map<String, Value>,
    /// Remarks on parts of the scenario that have no effect.
    remarks: Vec<String>,
}

#[derive(Serialize)]
struct PlannedMotion {
    kind: &'static str,
    /// Start position of each joint, in rad or m.
    start: Vec<f64>,
    /// Unit of each joint: rad, or m for prismatic joints.
    units: Vec<&'static str>,
    #[serde(flatten)]
    how: Map<String, Value>,
}

#[derive(Serialize)]
struct PlannedEvent {
    at_s: f64,
    /// Duration of the event in s; null for instantaneous and permanent events.
    for_s: Option<f64>,
    what: &'static str,
    bus: Option<String>,
    /// Node ids of the cells; empty for an event of a whole bus.
    cells: Vec<u8>,
    #[serde(flatten)]
    how: Map<String, Value>,
}

impl ScenarioPlan {
    fn from_scenario(scenario: &Description, skin: &Skin) -> Self {
        let joints = skin.robot.joints.len();
        let each = |values: &[f64]| values.iter().take(joints).copied().collect::<Vec<_>>();
        let how = match scenario.motion.kind {
            MotionKind::Hold | MotionKind::Kinesthetic => Map::new(),
            MotionKind::Sine { amplitude, period_s } => {
                to_map([("amplitude", json!(each(&amplitude))), ("period_s", json!(period_s))])
            }
        };
        let mut events = Vec::new();
        for change in &scenario.modes {
            events.push(PlannedEvent {
                at_s: seconds(change.at),
                for_s: None,
                what: change.mode.name(),
                bus: None,
                cells: vec![],
                how: Map::new(),
            });
        }
        for touch in &scenario.touches {
            let profile = match &touch.profile {
                ForceProfile::Points(points) => {
                    json!(points.iter().map(|(at, force_n)| (at.seconds(), force_n)).collect::<Vec<_>>())
                }
                named @ (ForceProfile::HalfSine | ForceProfile::Step | ForceProfile::Ramp) => {
                    json!(named.name())
                }
            };
            let mut how = to_map([("force_n", json!(touch.force_n)), ("profile", profile)]);
            how.extend(touch.values.key_values().map(|(key, value)| (key.to_owned(), value)));
            events.extend(cell_events(
                skin,
                touch.at,
                finite_seconds(touch.length),
                "touch",
                &touch.cells,
                &how,
            ));
        }
        for fault in &scenario.faults {
            events.extend(fault_events(skin, fault.at, &fault.kind));
        }
        events.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
        let units = skin.robot.joints.iter().map(|joint| joint.kind.unit()).collect();
        let motion = PlannedMotion {
            kind: scenario.motion.kind.name(),
            start: each(&scenario.motion.start),
            units,
            how,
        };
        let (duration_s, seed) = (scenario.duration.seconds(), scenario.seed);
        let remarks = scenario.warnings(skin);
        let errors =
            named_force_errors(&scenario.sensors.force).into_iter().filter(|(_, error)| *error > 0.0);
        let mut sensors: Map<_, _> = errors.map(|(key, error)| (key.to_owned(), json!(error))).collect();
        let temperature = scenario.sensors.temperature.iter().map(|(at, degrees)| [seconds(*at), *degrees]);
        let temperature: Vec<_> = temperature.collect();
        if !temperature.is_empty() {
            sensors.insert("temperature_c".to_owned(), json!(temperature));
        }
        if let Some(sheet) = scenario.sensors.acceleration {
            sensors.insert("acceleration".to_owned(), json!(sheet));
        }
        let touches_repeat_s = scenario.touches_repeat.map(Span::seconds);
        let skin = skin.name.clone();
        Self { skin, duration_s, touches_repeat_s, seed, motion, events, sensors, remarks }
    }

    fn to_text(&self, file: &str) -> String {
        let Self { skin, duration_s, touches_repeat_s, seed, motion, events, sensors, remarks } = self;
        let moves = match motion.kind {
            "hold" => "the robot stays at",
            "sine" => "every joint swings about",
            _ => "the skin's controller moves the robot from",
        };
        let how = if motion.how.is_empty() {
            String::new()
        } else {
            format!(" ({})", parameters_text(&motion.how))
        };
        let is_mixed = motion.units.iter().any(|unit| *unit != "rad");
        let start = if is_mixed {
            let each = motion.start.iter().zip(&motion.units).map(|(start, unit)| format!("{start} {unit}"));
            comma_separated(each)
        } else {
            format!("{} rad", space_separated(&motion.start))
        };
        let (file, skin) = (printable(file), printable(skin));
        let head = format!(
            "{file} on {skin}: {duration_s} s, {}, seed {seed}\nmotion: {moves} {start}{how}\n{}{}",
            count_with_noun(events.len(), "event"),
            or_else_text(touches_repeat_s.map(|period| format!("the touches repeat every {period} s\n")), ""),
            if sensors.is_empty() {
                String::new()
            } else {
                format!("sensors: {}\n", parameters_text(sensors))
            }
        );
        let remarks: String =
            remarks.iter().map(|remark| format!("remark: {}\n", printable(remark))).collect();
        if events.is_empty() {
            return head + "no touches and no faults\n" + &remarks;
        }
        let rows = events.iter().map(PlannedEvent::table_row);
        head + &format!(
            "{}\n{remarks}",
            table(["start, s", "length, s", "event", "bus", "cells", "details"], rows, |column| column < 2)
        )
    }
}

impl PlannedEvent {
    fn table_row(&self) -> Vec<String> {
        let mut nodes = self.cells.clone();
        nodes.sort_unstable();
        let runs =
            group_consecutive(&nodes, nodes.len()).into_iter().map(|(first, last)| match first == last {
                true => first.to_string(),
                false => format!("{first}-{last}"),
            });
        vec![
            format_decimals(Some(self.at_s), 3, ""),
            format_decimals(self.for_s, 3, ""),
            self.what.to_owned(),
            or_else_text(self.bus.as_ref(), ""),
            space_separated(runs),
            parameters_text(&self.how),
        ]
    }
}

/// Creates the events of some cells: one event for each bus that has any of them.
fn cell_events(
    skin: &Skin,
    at: Micros,
    for_s: Option<f64>,
    what: &'static str,
    cells: &[usize],
    how: &Map<String, Value>,
) -> Vec<PlannedEvent> {
    let of_bus = |(index, bus): (usize, &protocol::skin::SkinBus)| {
        let cells = cells.iter().filter_map(|&cell| skin.cells.get(cell)).filter(|cell| cell.bus == index);
        let cells: Vec<u8> = cells.map(|cell| cell.node.get()).collect();
        let bus = Some(bus.name.clone());
        (!cells.is_empty()).then(|| PlannedEvent {
            at_s: seconds(at),
            for_s,
            what,
            bus,
            cells,
            how: how.clone(),
        })
    };
    skin.buses.iter().enumerate().filter_map(of_bus).collect()
}

/// Returns the errors of the force sensors, by the file's keys.
const fn named_force_errors(errors: &ForceErrors) -> [(&'static str, f64); 9] {
    [
        ("offset_n", errors.offset_n),
        ("gain", errors.gain),
        ("hysteresis", errors.hysteresis),
        ("creep", errors.creep),
        ("drift_n", errors.drift_n),
        ("temperature_n_per_c", errors.temperature_n_per_c),
        ("temperature_gain_per_c", errors.temperature_gain_per_c),
        ("crosstalk", errors.crosstalk),
        ("noise_n", errors.noise_n),
    ]
}

/// Creates the events of a fault.
fn fault_events(skin: &Skin, at: Micros, kind: &FaultKind) -> Vec<PlannedEvent> {
    let what = kind.name();
    match kind {
        FaultKind::Process { cells, .. } => cell_events(skin, at, None, what, cells, &Map::new()),
        FaultKind::Sensor { fault, length: span, cells } => {
            let how = match fault {
                SensorFault::Stuck => Map::new(),
                SensorFault::Drift { n_per_s } => to_map([("n_per_s", json!(n_per_s))]),
            };
            cell_events(skin, at, finite_seconds(*span), what, cells, &how)
        }
        FaultKind::Wire { from, to, both_ways, .. } => {
            cell_events(skin, at, None, what, &[*from, *to], &to_map([("one_way", json!(!both_ways))]))
        }
        FaultKind::Bus { fault, length: span, bus, cells } => {
            let nodes = cells.iter().filter_map(|&cell| skin.cells.get(cell));
            let cells = nodes.map(|cell| cell.node.get()).collect();
            let bus = skin.buses.get(*bus).map(|bus| bus.name.clone());
            vec![PlannedEvent {
                at_s: seconds(at),
                for_s: finite_seconds(*span),
                what,
                bus,
                cells,
                how: parameters(fault),
            }]
        }
    }
}

/// Returns the parameters of a bus fault, by the file's keys.
fn parameters(fault: &BusFault) -> Map<String, Value> {
    match *fault {
        BusFault::Drop { probability }
        | BusFault::Duplicate { probability }
        | BusFault::Corrupt { probability }
        | BusFault::Reorder { probability } => to_map([("probability", json!(probability))]),
        BusFault::Delay { probability, delay } => {
            to_map([("probability", json!(probability)), ("delay_us", json!(delay.0))])
        }
        BusFault::Babble { frames_per_s, id } => {
            to_map([("frames_per_s", json!(frames_per_s)), ("id", json!(id))])
        }
    }
}

/// Formats keys of the file with their values.
fn parameters_text(how: &Map<String, Value>) -> String {
    let words_of = |value: &Value| match value {
        Value::String(text) => text.clone(),
        Value::Array(values) => match values.as_slice() {
            [first, second, .., last] if values.len() > MAX_LISTED_VALUES => {
                format!("{first} {second} ... {last} ({} in all)", values.len())
            }
            few => space_separated(few),
        },
        Value::Object(values) => format!("({})", parameters_text(values)),
        Value::Null | Value::Bool(_) | Value::Number(_) => value.to_string(),
    };
    comma_separated(how.iter().map(|(key, it)| format!("{key} {}", words_of(it))))
}

fn to_map<const N: usize>(pairs: [(&str, Value); N]) -> Map<String, Value> {
    pairs.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

/// Returns a duration in s, or `None` if it has no end.
fn finite_seconds(span: Span) -> Option<f64> {
    (span != Span(u64::MAX)).then(|| span.seconds())
}

fn seconds(at: Micros) -> f64 {
    Span(at.0).seconds()
}
