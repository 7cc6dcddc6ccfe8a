//! Checks a scenario's file against one skin.

use core::f64::consts::TAU;
use std::collections::HashMap;

use protocol::document::{Fault as Wrong, Place, span};
use protocol::fixed::{Q, Q1_14};
use protocol::skin::{MAX_ROBOT_JOINTS, Reply, Skin};
use protocol::time::{Micros, Span};
use protocol::wire::PORTS;

use super::touches::MAX_FORCE_N;
use super::{Mode, ModeChange, Motion, MotionKind, Profile, Scenario, Touch, faults, raw, sensors};

pub(super) type Checked<T> = Result<T, Wrong>;

pub(super) fn scenario(raw: raw::Scenario, skin: &Skin) -> Checked<Scenario> {
    if raw.version != 1 {
        return Err(Place::named("version").fault(raw.version, "this program reads version 1"));
    }
    let end = EndS(raw.duration_s());
    let duration = length(&Place::named("duration_s"), end.0)?;
    let negative = |_| Place::named("seed").fault(raw.seed, "must not be negative");
    let seed = u64::try_from(raw.seed).map_err(negative)?;
    let motion = motion(&raw.motion, skin)?;
    let modes = modes(&raw.mode, end)?;
    let names = Names::of(skin);
    let touches = touches(&raw.touch, end, &names)?;
    let touches_repeat = raw.touches_repeat_s.map(|seconds| repeat(&raw.touch, seconds)).transpose()?;
    let faults = faults::faults(&raw.fault, end, &names)?;
    let sensors = sensors::sensors(&raw.sensors, end)?;
    Ok(Scenario { duration, seed, motion, modes, touches, touches_repeat, faults, sensors })
}

/// The scenario's duration in s.
#[derive(Clone, Copy)]
pub(super) struct EndS(f64);

impl EndS {
    /// A moment within the scenario.
    pub(super) fn moment(self, at: &Place, seconds: f64) -> Checked<Micros> {
        if (0.0..self.0).contains(&seconds) {
            return Ok(Micros(span(seconds).0));
        }
        self.outside(at, seconds)
    }

    /// A moment within the scenario, or its end.
    pub(super) fn moment_or_end(self, at: &Place, seconds: f64) -> Checked<Micros> {
        if (0.0..=self.0).contains(&seconds) {
            return Ok(Micros(span(seconds).0));
        }
        self.outside(at, seconds)
    }

    fn outside(self, at: &Place, seconds: f64) -> Checked<Micros> {
        let why = format_args!("the scenario goes from 0 to duration_s = {}", self.0);
        Err(at.fault(seconds, why))
    }
}

/// A year.
pub(super) const LONGEST_S: f64 = 3.2e7;

/// A length of time.
pub(super) fn length(at: &Place, seconds: f64) -> Checked<Span> {
    if (1e-6..=LONGEST_S).contains(&seconds) {
        return Ok(span(seconds));
    }
    Err(at.fault(seconds, "must be above 0, and at most 3.2e7"))
}

fn motion(raw: &raw::Motion, skin: &Skin) -> Checked<Motion> {
    let at = Place::named("motion");
    let robot = &skin.robot;
    let joints = |key, values: &[f64]| {
        if values.len() != robot.joints.len() {
            let why = format!("one for each of the robot's {} joints is needed", robot.joints.len());
            return Err(at.key(key).fault(format_args!("{} values", values.len()), why));
        }
        Ok(core::array::from_fn(|joint| values.get(joint).copied().unwrap_or(0.0)))
    };
    let (start_key, start) = either(&at, ("start", &raw.start), ("start_rad", &raw.start_rad))?;
    // What is nearest to zero.
    let mut nearest = [0.0; MAX_ROBOT_JOINTS];
    for (start, joint) in nearest.iter_mut().zip(&robot.joints) {
        *start = f64::clamp(0.0, joint.limits[0], joint.limits[1]);
    }
    let start = start.map_or(Ok(nearest), |it| joints(start_key, it))?;
    let (key, amplitude) = either(&at, ("amplitude", &raw.amplitude), ("amplitude_rad", &raw.amplitude_rad))?;
    let kinds =
        [("hold", Some(MotionKind::Hold)), ("sine", None), ("kinesthetic", Some(MotionKind::Kinesthetic))];
    let needed = "needed with kind = \"sine\"";
    let only = "only with kind = \"sine\"";
    let (kind, reach) = match (at.key("kind").word(&raw.kind, &kinds)?, amplitude, raw.period_s) {
        (Some(kind), None, None) => (kind, [0.0; MAX_ROBOT_JOINTS]),
        (Some(_), Some(_), _) => return Err(at.key(key).fault("", only)),
        (Some(_), None, Some(got)) => return Err(at.key("period_s").fault(got, only)),
        (None, None, _) => return Err(at.key(key).fault("", needed)),
        (None, Some(_), None) => return Err(at.key("period_s").fault("", needed)),
        (None, Some(amplitude), Some(period_s)) => {
            let amplitude = joints(key, amplitude)?;
            length(&at.key("period_s"), period_s)?;
            speeds(&at.key(key), skin, &amplitude, period_s)?;
            (MotionKind::Sine { amplitude, period_s }, amplitude.map(f64::abs))
        }
    };
    for (index, ((start, reach), joint)) in start.iter().zip(reach).zip(&robot.joints).enumerate() {
        let ([min, max], unit) = (joint.limits, joint.kind.unit());
        // Written so that NaN is refused too.
        if !(start - reach >= min && start + reach <= max) {
            let swings =
                if reach > 0.0 { format!(", and it swings by {reach} {unit}") } else { String::new() };
            let why = format!("{} may go from {min:.4} to {max:.4} {unit}{swings}", joint.name);
            return Err(at.key(start_key).nth(index).fault(format_args!("{start} {unit}"), why));
        }
    }
    Ok(Motion { start, kind })
}

/// A value under its key or under the former one, and the key.
fn either<'a, T>(
    at: &Place,
    (key, value): (&'static str, &'a Option<T>),
    (former, given): (&'static str, &'a Option<T>),
) -> Checked<(&'static str, Option<&'a T>)> {
    match (value, given) {
        (Some(_), Some(_)) => {
            Err(at.key(former).fault("", format_args!("the former name of {key}: give one of them")))
        }
        (None, Some(given)) => Ok((former, Some(given))),
        (value, None) => Ok((key, value.as_ref())),
    }
}

/// Whether every joint may be as quick as its swing is at the start.
fn speeds(at: &Place, skin: &Skin, amplitude: &[f64; MAX_ROBOT_JOINTS], period_s: f64) -> Checked<()> {
    let limits = skin.controller.max_speed.iter().zip(&skin.robot.joints);
    for (index, (amplitude, (&max, joint))) in amplitude.iter().zip(limits).enumerate() {
        let (speed, unit) = (TAU * amplitude.abs() / period_s, joint.kind.unit());
        if speed.is_nan() || speed > max {
            let why = format!(
                "in {period_s} s this takes {speed:.3} {unit}/s, and joint {} may make {max}",
                index + 1
            );
            return Err(at.nth(index).fault(amplitude, why));
        }
    }
    Ok(())
}

fn modes(raw: &[raw::Mode], end: EndS) -> Checked<Vec<ModeChange>> {
    let mut modes: Vec<ModeChange> = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let path = Place::named("mode").nth(index);
        let at = end.moment(&path.key("at_s"), raw.at_s)?;
        if modes.last().is_some_and(|last| last.at >= at) {
            return Err(path.key("at_s").fault(raw.at_s, "modes come in the order of time"));
        }
        let kinds = [Mode::Compare, Mode::Distributed].map(|mode| (mode.name(), mode));
        modes.push(ModeChange { at, mode: path.key("kind").word(&raw.kind, &kinds)? });
    }
    Ok(modes)
}

fn touches(raw: &[raw::Touch], end: EndS, names: &Names<'_>) -> Checked<Vec<Touch>> {
    let mut touches = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let at = Place::named("touch").nth(index);
        touches.push(touch(&at, raw, end, names)?);
        together(&at.key("force_n"), &touches, names)?;
    }
    Ok(touches)
}

/// The period of the touches: each of them ends before all begin again.
fn repeat(touches: &[raw::Touch], seconds: f64) -> Checked<Span> {
    let period = length(&Place::named("touches_repeat_s"), seconds)?;
    for (index, touch) in touches.iter().enumerate() {
        let ends = span(touch.at_s).0.saturating_add(span(touch.for_s.unwrap_or(0.0)).0);
        // A touch without a length begins before.
        if ends > period.0 || span(touch.at_s) >= period {
            let key = if touch.for_s.is_some() { "for_s" } else { "at_s" };
            let got = touch.for_s.unwrap_or(touch.at_s);
            let why =
                format_args!("the touch must end before touches_repeat_s = {seconds}, when all begin again");
            return Err(Place::named("touch").nth(index).key(key).fault(got, why));
        }
    }
    Ok(period)
}

fn touch(at: &Place, raw: &raw::Touch, end: EndS, names: &Names<'_>) -> Checked<Touch> {
    if !(0.0..=MAX_FORCE_N).contains(&raw.force_n) {
        let why = format!("0 to {MAX_FORCE_N:.3} N are possible, the range of three contact words");
        return Err(at.key("force_n").fault(raw.force_n, why));
    }
    if !(0.0..=1.0).contains(&raw.proximity) {
        return Err(at.key("proximity").fault(raw.proximity, "0 (nothing near) to 1 are possible"));
    }
    let degrees = |got| at.key("temperature_c").fit(got, Q::try_nearest);
    let temperature = match raw.temperature_c {
        Some([first, second]) => Some([degrees(first)?, degrees(second)?]),
        None => None,
    };
    let profiles = [Profile::HalfSine, Profile::Step, Profile::Ramp].map(|profile| (profile.name(), profile));
    let profile = at.key("profile").word(&raw.profile, &profiles)?;
    let length = match (raw.for_s, profile) {
        (Some(seconds), _) => length(&at.key("for_s"), seconds)?,
        (None, Profile::Step) => Span(u64::MAX),
        (None, Profile::HalfSine | Profile::Ramp) => {
            return Err(at.key("for_s").fault("", format_args!("needed with profile = {:?}", raw.profile)));
        }
    };
    Ok(Touch {
        at: end.moment(&at.key("at_s"), raw.at_s)?,
        length,
        cells: names.cells(at, raw.bus.as_deref(), raw.cells.as_deref(), raw.all)?,
        force_n: raw.force_n,
        profile,
        proximity: Q1_14::nearest(raw.proximity),
        temperature,
    })
}

/// Whether the last of these touches, with those before it in the file, presses no cell with more than
/// its words can hold. The force is largest when one of the touches begins.
fn together(at: &Place, touches: &[Touch], names: &Names<'_>) -> Checked<()> {
    let Some((last, before)) = touches.split_last() else { return Ok(()) };
    for start in touches.iter().map(|touch| touch.at).filter(|&at| last.holds_at(at)) {
        let at_once: Vec<&Touch> = before.iter().filter(|touch| touch.holds_at(start)).collect();
        if at_once.is_empty() {
            continue;
        }
        for cell in &last.cells {
            let others = at_once.iter().filter(|touch| touch.cells.binary_search(cell).is_ok());
            let force = last.force_n + others.map(|touch| touch.force_n).sum::<f64>();
            if force > MAX_FORCE_N {
                let why = format!(
                    "with the touches before it that makes {force} N on {}, more than the \
                     {MAX_FORCE_N:.3} N of three contact words",
                    names.name(*cell)
                );
                return Err(at.fault(last.force_n, why));
            }
        }
    }
    Ok(())
}

/// How the file names buses and cells.
pub(super) struct Names<'a> {
    skin: &'a Skin,
    index: HashMap<(usize, i64), usize>,
}

impl<'a> Names<'a> {
    fn of(skin: &'a Skin) -> Self {
        let cells = skin.cells.iter().enumerate();
        let index = cells.map(|(index, cell)| ((cell.bus, cell.node.get().into()), index)).collect();
        Self { skin, index }
    }

    fn name(&self, cell: usize) -> String {
        let found = self.skin.cells.get(cell).and_then(|cell| Some((cell, self.skin.buses.get(cell.bus)?)));
        found.map_or_else(String::new, |(cell, bus)| format!("cell {} of {:?}", cell.node, bus.name))
    }

    /// The bus of this name; it need not be named when there is only one.
    pub(super) fn bus(&self, at: &Place, name: Option<&str>) -> Checked<usize> {
        let names =
            || self.skin.buses.iter().map(|bus| format!("{:?}", bus.name)).collect::<Vec<_>>().join(", ");
        match name {
            Some(name) => self.skin.bus_named(name).ok_or_else(|| {
                let why = format_args!("no such bus; there is {}", names());
                at.key("bus").fault(format_args!("{name:?}"), why)
            }),
            None if self.skin.buses.len() == 1 => Ok(0),
            None => Err(at.key("bus").fault("", format_args!("which bus? there is {}", names()))),
        }
    }

    /// The two cells of one bus that the keys `bus` and `cells` of the table at `at` name, in the file's order; wires
    /// lead from one to the other.
    pub(super) fn wired(
        &self,
        at: &Place,
        bus: Option<&str>,
        nodes: Option<&[i64]>,
    ) -> Checked<(usize, usize)> {
        let path = at.key("cells");
        self.cells(at, bus, nodes, false)?;
        let &[from, to] = nodes.unwrap_or_default() else {
            let got = format!("{} cells", nodes.unwrap_or_default().len());
            return Err(path.fault(got, "a wire is between two"));
        };
        let bus = self.bus(at, bus)?;
        let described = self.skin.buses.get(bus);
        if described.is_some_and(|bus| bus.reply == Reply::Torque) {
            return Err(path.fault("", "wires are used on a bus with reply = \"sum\" only"));
        }
        let find = |node: i64| self.index.get(&(bus, node)).copied();
        let wires = self.skin.wires(bus);
        let node = |cell: usize| self.skin.cells.get(cell).map(|cell| cell.node);
        let leads = |&(from, to): &(usize, usize)| {
            let (Some(from), Some(to)) = (node(from), node(to)) else { return false };
            (0..PORTS).any(|port| wires.other_end(from, port).is_some_and(|(other, _)| other == to))
        };
        let pair = find(from).zip(find(to)).filter(leads);
        pair.ok_or_else(|| path.fault(format_args!("[{from}, {to}]"), "no wire is between them"))
    }

    /// The cells that the keys `bus` and `cells` of the table at `at` name, or all of them; sorted.
    pub(super) fn cells(
        &self,
        at: &Place,
        bus: Option<&str>,
        nodes: Option<&[i64]>,
        all: bool,
    ) -> Checked<Vec<usize>> {
        let path = at.key("cells");
        let nodes = match nodes {
            Some(_) if all => return Err(path.fault("", "either some cells, or all = true")),
            None if !all => return Err(path.fault("", "which cells? give their nodes, or all = true")),
            None => {
                let bus = bus.map(|name| self.bus(at, Some(name))).transpose()?;
                let cells = self.skin.cells.iter().enumerate();
                let target = cells.filter(|(_, cell)| bus.is_none_or(|bus| cell.bus == bus));
                return Ok(target.map(|(index, _)| index).collect());
            }
            Some([]) => return Err(path.fault("[]", "at least one cell is needed")),
            Some(nodes) => nodes,
        };
        let bus = self.bus(at, bus)?;
        let mut cells = Vec::with_capacity(nodes.len());
        for (index, &node) in nodes.iter().enumerate() {
            let wrong = |why| Err(path.nth(index).fault(node, why));
            let name = self.skin.buses.get(bus).map_or("", |bus| &bus.name);
            let Some(&cell) = self.index.get(&(bus, node)) else {
                return wrong(format!("no cell of {name:?} has this node"));
            };
            if let Some(first) = cells.iter().position(|&before| before == cell) {
                return wrong(format!("cells[{first}] names it already"));
            }
            cells.push(cell);
        }
        cells.sort_unstable();
        Ok(cells)
    }
}
