//! Conversion of a skin file from raw values to checked types.

use super::chains::{self, check_joint_count};
use super::{
    Cell, Controller, ControllerKind, LostBusReaction, SafetyLimits, Skin, SkinBus, SkinReply, SkinTiming,
};
use super::{baseline, buses, cells, names, raw, sensing};
use crate::document::{Checked, KeyPath, span_from_seconds};
use crate::fixed::Q;
use crate::parameters::Contact;

pub(super) fn check_whole_skin(raw: raw::RawSkin) -> Checked<Skin> {
    names::check_names(&raw)?;
    check_skin(raw, |_| true)
}

/// Checks a whole skin from a recording. Unprintable characters in names are escaped instead of rejected.
pub(super) fn check_recorded_skin(mut raw: raw::RawSkin) -> Checked<Skin> {
    names::escape_names(&mut raw);
    check_skin(raw, |_| true)
}

/// Checks a skin that contains the cells of one bus only.
pub(super) fn check_skin_of_bus(raw: raw::RawSkin, bus: &str) -> Checked<Skin> {
    let skin = check_skin(raw, |of| of.name == bus)?;
    let is_other = |cell: &Cell| skin.buses.get(cell.bus).is_some_and(|of| of.name != bus);
    match skin.cells.iter().position(is_other) {
        None => Ok(skin),
        Some(index) => Err(KeyPath::top_level_key("cell")
            .with_index(index)
            .with_key("bus")
            .fault("", "this cell is on another bus")),
    }
}

/// Checks all values of a skin. `has_cells` returns true for each bus whose cells are part of `raw`.
fn check_skin(raw: raw::RawSkin, has_cells: impl Fn(&SkinBus) -> bool) -> Checked<Skin> {
    if raw.version != 1 {
        return Err(KeyPath::top_level_key("version").fault(raw.version, "this program reads version 1"));
    }
    let robot = chains::check_robot(raw.robot)?;
    let timing = check_timing(&raw.timing)?;
    // The default of a skin without `[contact]`: the force is the sum of the three words.
    let plain = Contact { alpha_c: Q::nearest(1.0), ..Contact::default() };
    let contact = cells::contact_with_overrides(&KeyPath::top_level_key("contact"), raw.contact, plain)?;
    let events = sensing::check_events(raw.events)?;
    let buses = buses::check_buses(&raw.bus, &robot)?;
    let controller = check_controller(raw.controller, robot.joints.len())?;
    let safety = check_safety_limits(&raw.safety)?;
    let base = cells::CellDefaults { contact, baseline: baseline::skin_baseline(raw.baseline)? };
    let cells = cells::check_cells(&raw.cell, &robot, &buses, base)?;
    let skin = Skin { name: raw.name, robot, timing, events, buses, controller, safety, cells };
    let Some(period_us) = skin.broadcast_period_us() else {
        let why = "must be at least 15.3 Hz";
        return Err(KeyPath::top_level_key("timing")
            .with_key("joint_broadcast_hz")
            .fault(raw.timing.joint_broadcast_hz, why));
    };
    for (index, bus) in skin.buses.iter().enumerate() {
        match bus.reply {
            SkinReply::Sum { slot_us, .. } if has_cells(bus) => {
                check_sum_tree(&skin, index, slot_us, period_us)?
            }
            SkinReply::Torque | SkinReply::Sum { .. } => {}
        }
    }
    Ok(skin)
}

/// Checks the tree of a bus whose cells reply with sums. Every cell must have a path to the gateway's side, and the
/// slots of all depths must fit into one broadcast period.
fn check_sum_tree(skin: &Skin, index: usize, slot_us: u32, period_us: u16) -> Checked<()> {
    let at = KeyPath::top_level_key("bus").with_index(index);
    if !skin.cells_on_bus(index).any(|cell| cell.root) {
        let why =
            "sums need a path to the gateway, but no cell of this bus has root = true: set it for one cell";
        return Err(at.with_key("reply").fault("\"sum\"", why));
    }
    let depths = skin.wires(index).cell_depths();
    let depth = |cell: &Cell| depths.get(cell.node.index()).copied().flatten();
    let is_truncated = |cell: &Cell| cell.bus == index && depth(cell).is_none();
    if let Some(first) = skin.cells.iter().position(is_truncated) {
        let node = skin.cells.get(first).map_or(0, |cell| cell.node.get());
        let others = match skin.cells.iter().filter(|cell| is_truncated(cell)).count() - 1 {
            0 => String::new(),
            1 => " (and none to 1 other cell)".to_owned(),
            count => format!(" (and none to {count} other cells)"),
        };
        let why = format!(
            "no path of wires leads from a root of its bus to this cell{others}, but sums need one: name the \
             neighbors at both ends of each wire, or set root = true for a cell"
        );
        return Err(KeyPath::top_level_key("cell").with_index(first).with_key("node").fault(node, why));
    }
    let slots = 1 + skin.cells_on_bus(index).filter_map(depth).max().map_or(0, u32::from);
    if u64::from(slots) * u64::from(slot_us) <= u64::from(period_us) {
        return Ok(());
    }
    let max = u32::from(period_us).checked_div(slots).unwrap_or(0);
    let hint = if max > 0 {
        format!("use at most {max} us")
    } else {
        "no slots fit: send joints messages less often, or use more roots or buses".to_owned()
    };
    let why = format!(
        "the tree needs {slots} slots within the {period_us} us between two joint broadcasts: {hint}"
    );
    Err(at.with_key("slot_us").fault(slot_us, why))
}

fn check_timing(raw: &raw::RawTiming) -> Checked<SkinTiming> {
    let at = KeyPath::top_level_key("timing");
    let control_hz = raw.control_hz;
    if !(1.0..=10_000.0).contains(&control_hz) {
        return Err(at.with_key("control_hz").fault(control_hz, "must be 1 to 10000 Hz"));
    }
    let broadcast_hz = at.with_key("joint_broadcast_hz").check_positive(raw.joint_broadcast_hz)?;
    let ratio = (control_hz / broadcast_hz).round();
    if ratio < 1.0 || (ratio * broadcast_hz - control_hz).abs() > 1e-6 * control_hz {
        let why = format!("must divide control_hz = {control_hz} evenly");
        return Err(at.with_key("joint_broadcast_hz").fault(broadcast_hz, why));
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a positive whole number; absurd ones saturate"
    )]
    let ticks_per_broadcast = ratio as u32;
    Ok(SkinTiming { control_hz, ticks_per_broadcast })
}

fn check_controller(raw: raw::RawController, joints: usize) -> Checked<Controller> {
    let at = KeyPath::top_level_key("controller");
    let each_positive = |key, values: Vec<f64>| {
        let at = at.with_key(key);
        check_joint_count(&at, values.len(), joints)?;
        for (index, &value) in values.iter().enumerate() {
            at.with_index(index).check_positive(value)?;
        }
        Ok(values)
    };
    let each_or = |key, values: Option<Vec<f64>>, usual| {
        values.map_or_else(|| Ok(vec![usual; joints]), |values| each_positive(key, values))
    };
    let kind =
        if at.with_key("kind").parse_choice(&raw.kind, &[("kinesthetic", true), ("external", false)])? {
            let external = [("socket", raw.socket.is_some()), ("start_s", raw.start_s.is_some())];
            if let Some((key, _)) = external.into_iter().find(|(_, is_there)| *is_there) {
                return Err(at.with_key(key).fault("", "allowed only with kind = \"external\""));
            }
            ControllerKind::Kinesthetic {
                inertia: each_or("inertia", raw.inertia, 1.0)?,
                damping: each_or("damping", raw.damping, 4.0)?,
            }
        } else {
            if raw.inertia.is_some() || raw.damping.is_some() {
                let why = "inertia and damping are allowed only with kind = \"kinesthetic\"";
                return Err(at.with_key("kind").fault("\"external\"", why));
            }
            let why = "missing: kind = \"external\" needs the path of a Unix socket";
            let start_s = raw.start_s.unwrap_or(5.0);
            if !(0.0..=3_600.0).contains(&start_s) {
                return Err(at.with_key("start_s").fault(start_s, "must be 0 to 3600 s"));
            }
            ControllerKind::External {
                socket: raw.socket.ok_or_else(|| at.with_key("socket").fault("", why))?,
                start: span_from_seconds(start_s),
            }
        };
    let max_speed = match (raw.max_speed, raw.max_speed_rad_s) {
        (Some(_), Some(_)) => {
            let why = "this is the old name of the key max_speed: give only one of the two";
            return Err(at.with_key("max_speed_rad_s").fault("", why));
        }
        (None, Some(former)) => each_positive("max_speed_rad_s", former)?,
        (given, None) => each_or("max_speed", given, 2.0)?,
    };
    Ok(Controller { kind, max_speed })
}

fn check_safety_limits(raw: &raw::RawSafety) -> Checked<SafetyLimits> {
    let at = KeyPath::top_level_key("safety");
    let lost_bus =
        [LostBusReaction::Continue, LostBusReaction::Halt].map(|lost_bus| (lost_bus.name(), lost_bus));
    let lost_bus = at.with_key("lost_bus").parse_choice(&raw.lost_bus, &lost_bus)?;
    Ok(SafetyLimits {
        hold_epochs: at.with_key("hold_epochs").check_range(raw.hold_epochs, 0..=10_000, "")?,
        decay_epochs: at.with_key("decay_epochs").check_range(raw.decay_epochs, 0..=10_000, "")?,
        bad_cycles: at.with_key("bad_cycles").check_range(raw.bad_cycles, 1..=10_000, "")?,
        lost_bus,
    })
}
