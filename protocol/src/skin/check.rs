//! From what a file says to what it means.

use std::collections::{HashMap, HashSet};

use super::{
    Bus, Cell, Controller, ControllerKind, DenavitHartenberg, LostBus, Reply, Robot, Safety, Skin, Timing,
    raw, sensing,
};
use crate::can::Format;
use crate::document::Fault;
use crate::document::Step::{self, Index, Key};
use crate::fixed::{OutOfRange, Q, Q1_14};
use crate::id::CellId;
use crate::parameters::{Contact, MAX_JOINTS};

type Checked<T> = Result<T, Fault>;

/// How far a quaternion's length may be from one.
const UNIT_TOLERANCE: f64 = 1e-3;
/// Buses of a skin.
const BUSES: usize = 64;
/// Metres that words in Q1.14 can hold, less some steps for what a chain of roundings adds.
const REACH: f64 = 2.0 - 1e-3;

pub(super) fn skin(raw: raw::Skin) -> Checked<Skin> {
    if raw.version != 1 {
        return Err(Fault::new(&[Key("version")], raw.version, "this program reads version 1"));
    }
    let robot = robot(raw.robot)?;
    let timing = timing(&raw.timing)?;
    let contact = contact(&[Key("contact")], raw.contact, plain_contact())?;
    let events = sensing::events(raw.events)?;
    let buses = buses(&raw.bus)?;
    let controller = controller(raw.controller, robot.joints.len())?;
    let safety = safety(&raw.safety)?;
    let cells = cells(&raw.cell, &robot, &buses, contact)?;
    let skin = Skin { name: raw.name, robot, timing, events, buses, controller, safety, cells };
    let Some(period_us) = skin.period_us() else {
        let path = [Key("timing"), Key("joint_broadcast_hz")];
        return Err(Fault::new(&path, raw.timing.joint_broadcast_hz, "at least 15.3 Hz are possible"));
    };
    for (index, bus) in skin.buses.iter().enumerate() {
        match bus.reply {
            Reply::Torque => {}
            Reply::Sum { slot_us, .. } => tree(&skin, index, slot_us, period_us)?,
        }
    }
    Ok(skin)
}

/// Sums need a way from every cell to the gateway's side, and a slot for each depth of the tree in one period.
fn tree(skin: &Skin, index: usize, slot_us: u32, period_us: u16) -> Checked<()> {
    let at = |key| [Key("bus"), Index(index), Key(key)];
    if !skin.cells_of(index).any(|cell| cell.root) {
        let why = "sums need a way to the gateway, and no cell of this bus has root = true: give it to one";
        return Err(Fault::new(&at("reply"), "\"sum\"", why));
    }
    let depths = skin.wires(index).depths();
    let depth = |cell: &Cell| depths.get(cell.node.index()).copied().flatten();
    let is_cut_off = |cell: &Cell| cell.bus == index && depth(cell).is_none();
    if let Some(first) = skin.cells.iter().position(is_cut_off) {
        let node = skin.cells.get(first).map_or(0, |cell| cell.node.get());
        let others = match skin.cells.iter().filter(|cell| is_cut_off(cell)).count() - 1 {
            0 => String::new(),
            1 => " (nor does another cell)".to_owned(),
            count => format!(" (nor do {count} other cells)"),
        };
        let why = format!(
            "no wire leads from here to a root of its bus{others}, which sums need: name neighbors on both ends, or \
             set root = true"
        );
        return Err(Fault::new(&[Key("cell"), Index(first), Key("node")], node, why));
    }
    let slots = 1 + skin.cells_of(index).filter_map(depth).max().map_or(0, u32::from);
    if u64::from(slots) * u64::from(slot_us) <= u64::from(period_us) {
        return Ok(());
    }
    let greatest = u32::from(period_us).checked_div(slots).unwrap_or(0);
    let remedy = if greatest > 0 {
        format!("at most {greatest} us fit")
    } else {
        "no slots fit: send joints less often, or use more roots or buses".to_owned()
    };
    let why =
        format!("the tree needs {slots} slots within the {period_us} us from joints to joints: {remedy}");
    Err(Fault::new(&at("slot_us"), slot_us, why))
}

fn finite(path: &[Step], value: f64) -> Checked<f64> {
    if value.is_finite() { Ok(value) } else { Err(Fault::new(path, value, "a finite number is needed")) }
}

fn positive(path: &[Step], value: f64) -> Checked<f64> {
    if value.is_finite() && value > 0.0 { Ok(value) } else { Err(Fault::new(path, value, "must be above 0")) }
}

fn word<const F: u32>(path: &[Step], value: f64, fit: fn(f64) -> Result<Q<F>, OutOfRange>) -> Checked<Q<F>> {
    fit(value).map_err(|error| {
        Fault::new(path, value, format_args!("its word holds [{}, {})", error.least, error.bound))
    })
}

fn robot(raw: raw::Robot) -> Checked<Robot> {
    let count = raw.joints.len();
    if count == 0 || count > MAX_JOINTS {
        let why = "a robot has 1 to 6 revolute joints";
        return Err(Fault::new(&[Key("robot"), Key("joints")], format_args!("{count} joints"), why));
    }
    let mut joints = Vec::with_capacity(count);
    for (index, joint) in raw.joints.iter().enumerate() {
        let at = |key| [Key("robot"), Key("joints"), Index(index), Key(key)];
        word(&at("a"), joint.a, Q1_14::try_nearest)?;
        word(&at("d"), joint.d, Q1_14::try_nearest)?;
        joints.push(DenavitHartenberg {
            a: joint.a,
            d: joint.d,
            alpha: finite(&at("alpha"), joint.alpha)?,
            theta_offset: finite(&at("theta_offset"), joint.theta_offset)?,
        });
    }
    let limits_rad =
        raw.limits_rad.unwrap_or_else(|| vec![[-core::f64::consts::TAU, core::f64::consts::TAU]; count]);
    let path = [Key("robot"), Key("limits_rad")];
    same_length(&path, limits_rad.len(), count)?;
    for (index, [least, greatest]) in limits_rad.iter().enumerate() {
        // Written so that NaN is refused too.
        if !(least.is_finite() && greatest.is_finite() && least < greatest) {
            let path = [Key("robot"), Key("limits_rad"), Index(index)];
            return Err(Fault::new(
                &path,
                format_args!("[{least}, {greatest}]"),
                "the least position comes first",
            ));
        }
    }
    Ok(Robot { name: raw.name, joints, limits_rad })
}

fn same_length(path: &[Step], got: usize, joints: usize) -> Checked<()> {
    if got == joints {
        return Ok(());
    }
    Err(Fault::new(
        path,
        format_args!("{got} values"),
        format_args!("one for each of the robot's {joints} joints is needed"),
    ))
}

fn timing(raw: &raw::Timing) -> Checked<Timing> {
    let path = [Key("timing"), Key("control_hz")];
    let control_hz = raw.control_hz;
    if !(1.0..=10_000.0).contains(&control_hz) {
        return Err(Fault::new(&path, control_hz, "1 to 10000 Hz are possible"));
    }
    let path = [Key("timing"), Key("joint_broadcast_hz")];
    let broadcast_hz = positive(&path, raw.joint_broadcast_hz)?;
    let ratio = (control_hz / broadcast_hz).round();
    if ratio < 1.0 || (ratio * broadcast_hz - control_hz).abs() > 1e-6 * control_hz {
        return Err(Fault::new(
            &path,
            broadcast_hz,
            format_args!("must divide control_hz = {control_hz} evenly"),
        ));
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a positive whole number; absurd ones saturate"
    )]
    let ticks_per_broadcast = ratio as u32;
    Ok(Timing { control_hz, ticks_per_broadcast })
}

/// What a skin has that says nothing of contacts: the force is the sum of the three words.
fn plain_contact() -> Contact {
    Contact { alpha_c: Q::nearest(1.0), ..Contact::default() }
}

/// Takes what is given, and the rest from `base`.
fn contact(at: &[Step], raw: raw::Contact, base: Contact) -> Checked<Contact> {
    fn gain<const F: u32>(
        at: &[Step],
        key: &'static str,
        given: Option<f64>,
        base: Q<F>,
        fit: fn(f64) -> Result<Q<F>, OutOfRange>,
    ) -> Checked<Q<F>> {
        let Some(value) = given else { return Ok(base) };
        let path = [at, &[Key(key)]].concat();
        if value < 0.0 {
            return Err(Fault::new(&path, value, "must not be negative"));
        }
        word(&path, value, fit)
    }
    Ok(Contact {
        alpha_c: gain(at, "alpha_c", raw.alpha_c, base.alpha_c, Q::try_nearest)?,
        alpha_p: gain(at, "alpha_p", raw.alpha_p, base.alpha_p, Q::try_nearest)?,
        contact_threshold: gain(
            at,
            "contact_threshold_n",
            raw.contact_threshold_n,
            base.contact_threshold,
            Q::try_at_least,
        )?,
        proximity_threshold: gain(
            at,
            "proximity_threshold",
            raw.proximity_threshold,
            base.proximity_threshold,
            Q::try_at_least,
        )?,
        force_threshold: gain(
            at,
            "force_threshold_n",
            raw.force_threshold_n,
            base.force_threshold,
            Q::try_at_least,
        )?,
    })
}

fn buses(raw: &[raw::Bus]) -> Checked<Vec<Bus>> {
    if raw.is_empty() {
        return Err(Fault::new(&[Key("bus")], "[]", "at least one bus is needed"));
    }
    if raw.len() > BUSES {
        let why = format!("a skin has at most {BUSES} buses");
        return Err(Fault::new(&[Key("bus")], format!("{} buses", raw.len()), why));
    }
    let mut seen = HashSet::new();
    raw.iter()
        .enumerate()
        .map(|(index, bus)| {
            let at = |key| [Key("bus"), Index(index), Key(key)];
            let quoted = format!("{:?}", bus.name);
            let odd = |c: char| !(c.is_ascii_alphanumeric() || "-_.".contains(c));
            if bus.name.is_empty()
                || bus.name.len() > 15
                || bus.name.starts_with('.')
                || bus.name.contains(odd)
            {
                let why = "an interface's name has 1 to 15 letters, digits, `-`, `_` or `.`";
                return Err(Fault::new(&at("name"), quoted, why));
            }
            if !seen.insert(bus.name.as_str()) {
                return Err(Fault::new(&at("name"), quoted, "this bus is named twice"));
            }
            let reply = reply(index, bus)?;
            let format = match bus.format.as_str() {
                "fd" => Format::Fd,
                "classic" => Format::Classic,
                got => return Err(Fault::new(&at("format"), format!("{got:?}"), "\"fd\" or \"classic\"")),
            };
            let (bitrate, data_bitrate) = bit_rates(index, bus, format)?;
            let sensing = sensing::of_bus(index, bus)?;
            Ok(Bus { name: bus.name.clone(), reply, format, bitrate, data_bitrate, sensing })
        })
        .collect()
}

/// What the cells of a bus answer with.
fn reply(index: usize, bus: &raw::Bus) -> Checked<Reply> {
    let at = |key| [Key("bus"), Index(index), Key(key)];
    let only_sum = "only with reply = \"sum\"";
    match (bus.reply.as_str(), bus.slot_us, bus.carry) {
        ("torque", None, None) => Ok(Reply::Torque),
        ("torque", Some(got), _) => Err(Fault::new(&at("slot_us"), got, only_sum)),
        ("torque", None, Some(got)) => Err(Fault::new(&at("carry"), got, only_sum)),
        ("sum", Some(got), carry) => match u32::try_from(got) {
            Ok(slot_us) if slot_us > 0 => Ok(Reply::Sum { slot_us, carry: carry.unwrap_or(true) }),
            _ => Err(Fault::new(&at("slot_us"), got, "must be above 0")),
        },
        ("sum", None, _) => Err(Fault::new(&at("reply"), "\"sum\"", "slot_us is needed with it")),
        (got, ..) => Err(Fault::new(&at("reply"), format!("{got:?}"), "\"torque\" or \"sum\"")),
    }
}

/// The bit rates of hardware, which need not be said.
fn bit_rates(index: usize, bus: &raw::Bus, format: Format) -> Checked<(Option<u32>, Option<u32>)> {
    let at = |key| [Key("bus"), Index(index), Key(key)];
    let within = |key, got: i64, least: u32, greatest: u32| match u32::try_from(got) {
        Ok(rate) if (least..=greatest).contains(&rate) => Ok(rate),
        _ => Err(Fault::new(&at(key), got, format_args!("{least} to {greatest} bit/s are possible"))),
    };
    let bitrate = bus.bitrate.map(|got| within("bitrate", got, 10_000, 1_000_000)).transpose()?;
    let data_bitrate = match (bus.data_bitrate, format, bitrate) {
        (None, _, _) => None,
        (Some(got), Format::Classic, _) => {
            return Err(Fault::new(&at("data_bitrate"), got, "only with format = \"fd\""));
        }
        (Some(got), Format::Fd, None) => {
            return Err(Fault::new(&at("data_bitrate"), got, "only together with bitrate"));
        }
        (Some(got), Format::Fd, Some(least)) => Some(within("data_bitrate", got, least, 8_000_000)?),
    };
    Ok((bitrate, data_bitrate))
}

fn controller(raw: raw::Controller, joints: usize) -> Checked<Controller> {
    let at = |key| [Key("controller"), Key(key)];
    let each_positive = |key, values: Vec<f64>| {
        same_length(&at(key), values.len(), joints)?;
        for (index, &value) in values.iter().enumerate() {
            positive(&[Key("controller"), Key(key), Index(index)], value)?;
        }
        Ok(values)
    };
    let needed = |key, values: Option<Vec<f64>>| {
        let why = "needed with kind = \"kinesthetic\"";
        each_positive(key, values.ok_or_else(|| Fault::new(&at(key), "", why))?)
    };
    let kind = match raw.kind.as_str() {
        "kinesthetic" if raw.socket.is_some() => {
            return Err(Fault::new(&at("socket"), "", "only with kind = \"external\""));
        }
        "kinesthetic" => ControllerKind::Kinesthetic {
            inertia: needed("inertia", raw.inertia)?,
            damping: needed("damping", raw.damping)?,
        },
        "external" if raw.inertia.is_some() || raw.damping.is_some() => {
            return Err(Fault::new(
                &at("kind"),
                "\"external\"",
                "inertia and damping are only for \"kinesthetic\"",
            ));
        }
        "external" => {
            let missing = || {
                Fault::new(&at("socket"), "", "the path of a Unix socket is needed with kind = \"external\"")
            };
            ControllerKind::External { socket: raw.socket.ok_or_else(missing)? }
        }
        got => return Err(Fault::new(&at("kind"), format!("{got:?}"), "\"kinesthetic\" or \"external\"")),
    };
    Ok(Controller { kind, max_speed_rad_s: each_positive("max_speed_rad_s", raw.max_speed_rad_s)? })
}

fn safety(raw: &raw::Safety) -> Checked<Safety> {
    let bounded = |key, got: i64, least: u32| match u32::try_from(got) {
        Ok(value) if (least..=10_000).contains(&value) => Ok(value),
        _ => Err(Fault::new(&[Key("safety"), Key(key)], got, format_args!("{least} to 10000 are possible"))),
    };
    let lost_bus = match raw.lost_bus.as_str() {
        "go-on" => LostBus::GoOn,
        "halt" => LostBus::Halt,
        got => {
            let path = [Key("safety"), Key("lost_bus")];
            return Err(Fault::new(&path, format!("{got:?}"), "\"go-on\" or \"halt\""));
        }
    };
    Ok(Safety {
        hold_epochs: bounded("hold_epochs", raw.hold_epochs, 0)?,
        decay_epochs: bounded("decay_epochs", raw.decay_epochs, 0)?,
        bad_cycles: bounded("bad_cycles", raw.bad_cycles, 1)?,
        lost_bus,
    })
}

fn cells(raw: &[raw::Cell], robot: &Robot, buses: &[Bus], base: Contact) -> Checked<Vec<Cell>> {
    let mut taken = HashMap::new();
    let mut serials = HashMap::new();
    let mut cells = Vec::with_capacity(raw.len());
    for (index, raw) in raw.iter().enumerate() {
        let cell = cell(index, raw, robot, buses, base)?;
        if let Some(first) = taken.insert((cell.bus, cell.node), index) {
            let why = format!("cell[{first}] has this node on {:?} already", raw.bus);
            return Err(Fault::new(&[Key("cell"), Index(index), Key("node")], raw.node, why));
        }
        if let Some(first) = serials.insert(cell.serial, index) {
            let why = format!("cell[{first}] has this serial number already");
            return Err(Fault::new(&[Key("cell"), Index(index), Key("serial")], cell.serial, why));
        }
        cells.push(cell);
    }
    for (index, cell) in cells.iter().enumerate() {
        for (port, neighbor) in cell.neighbors.iter().enumerate() {
            let Some(neighbor) = *neighbor else { continue };
            if neighbor == cell.node || !taken.contains_key(&(cell.bus, neighbor)) {
                let path = [Key("cell"), Index(index), Key("neighbors"), Index(port)];
                return Err(Fault::new(
                    &path,
                    neighbor,
                    "must be the node of another cell on the same bus, or 0",
                ));
            }
        }
    }
    contradictions(&cells)?;
    Ok(cells)
}

/// Every wire has two ends: whom a cell names so often must name it as often.
fn contradictions(cells: &[Cell]) -> Checked<()> {
    let mut mentions = HashMap::new();
    for cell in cells {
        for &neighbor in cell.neighbors.iter().flatten() {
            *mentions.entry((cell.bus, cell.node, neighbor)).or_insert(0) += 1;
        }
    }
    for (index, cell) in cells.iter().enumerate() {
        let node = cell.node;
        let mut named = HashMap::new();
        for (port, neighbor) in cell.neighbors.iter().enumerate() {
            let Some(neighbor) = *neighbor else { continue };
            let so_far = named.entry(neighbor).or_insert(0);
            *so_far += 1;
            let back = mentions.get(&(cell.bus, neighbor, node)).copied().unwrap_or(0);
            if *so_far > back {
                let path = [Key("cell"), Index(index), Key("neighbors"), Index(port)];
                let why = format!(
                    "this wire has no other end: name node {node} in a further one of the neighbors of node {neighbor}, \
                     or put 0 here"
                );
                return Err(Fault::new(&path, neighbor, why));
            }
        }
    }
    Ok(())
}

fn cell(index: usize, raw: &raw::Cell, robot: &Robot, buses: &[Bus], base: Contact) -> Checked<Cell> {
    let at = |key| [Key("cell"), Index(index), Key(key)];
    let bus = buses.iter().position(|bus| bus.name == raw.bus).ok_or_else(|| {
        let names = buses.iter().map(|bus| format!("{:?}", bus.name)).collect::<Vec<_>>().join(", ");
        Fault::new(&at("bus"), format_args!("{:?}", raw.bus), format_args!("no such bus; there is {names}"))
    })?;
    let node = CellId::new(raw.node).map_err(|_| {
        Fault::new(&at("node"), raw.node, "a cell's node is 1 to 254; further cells need another bus")
    })?;
    let joint = u8::try_from(raw.joint).ok().filter(|&k| k > 0 && usize::from(k) <= robot.joints.len());
    let joint = joint.ok_or_else(|| {
        Fault::new(&at("joint"), raw.joint, format_args!("the robot has joints 1 to {}", robot.joints.len()))
    })?;
    for (axis, &value) in raw.position.iter().enumerate() {
        finite(&[Key("cell"), Index(index), Key("position"), Index(axis)], value)?;
    }
    let reach = reach(robot, joint, raw.position);
    if reach >= REACH {
        let [x, y, z] = raw.position;
        let why = format!(
            "node {node} can come {reach:.3} m from a joint, {:.3} m more than the {REACH} m that Q1.14 holds",
            reach - REACH
        );
        return Err(Fault::new(&at("position"), format_args!("[{x}, {y}, {z}]"), why));
    }
    let length = raw.orientation.iter().map(|part| part * part).sum::<f64>().sqrt();
    if length.is_nan() || (length - 1.0).abs() > UNIT_TOLERANCE {
        let [x, y, z, w] = raw.orientation;
        let why = format!("this quaternion has length {length:.6}; it must be 1 within {UNIT_TOLERANCE}");
        return Err(Fault::new(&at("orientation"), format_args!("[{x}, {y}, {z}, {w}]"), why));
    }
    let orientation = raw.orientation.map(|part| part / length);
    let mut neighbors = [None; 4];
    for (port, (neighbor, &got)) in neighbors.iter_mut().zip(&raw.neighbors).enumerate() {
        if got != 0 {
            let path = [Key("cell"), Index(index), Key("neighbors"), Index(port)];
            *neighbor = Some(
                CellId::new(got).map_err(|_| Fault::new(&path, got, "a node is 1 to 254, or 0 for none"))?,
            );
        }
    }
    let serial = raw.serial.unwrap_or_else(|| default_serial(bus, node));
    let serial = u32::try_from(serial)
        .map_err(|_| Fault::new(&at("serial"), serial, "0 to 4294967295 are possible"))?;
    Ok(Cell {
        bus,
        node,
        serial,
        joint,
        position: raw.position,
        orientation,
        normal: normal(orientation),
        neighbors,
        root: raw.root,
        contact: contact(&[Key("cell"), Index(index)], raw.contact(), base)?,
    })
}

/// A cell that is given no serial number gets one that no other such cell gets.
fn default_serial(bus: usize, node: CellId) -> i64 {
    i64::try_from(bus).unwrap_or(0) * 1_000 + i64::from(node.get())
}

/// The z axis of an orientation.
fn normal([x, y, z, w]: [f64; 4]) -> [f64; 3] {
    [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)]
}

/// The farthest that a cell can come from the origin of any frame below it (of the base: from its
/// axis), whatever the joints do: the lengths of the links, added up. No moment of a unit force that a
/// kernel meets on its way is greater.
fn reach(robot: &Robot, joint: u8, position: [f64; 3]) -> f64 {
    let mut reach = position.iter().map(|x| x * x).sum::<f64>().sqrt();
    for (index, row) in robot.joints.iter().enumerate().take(usize::from(joint)).rev() {
        // The first joint's offset lies along its own axis, to which it adds no distance.
        reach += if index == 0 { row.a.abs() } else { row.a.hypot(row.d) };
    }
    reach
}
