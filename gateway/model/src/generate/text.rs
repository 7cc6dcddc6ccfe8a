//! The text of a `skin.toml`.

use core::fmt::{self, Write};

use super::arm::{self, Covered, Place};
use super::{Format, Reply, Wanted};

/// How much of the broadcast period the slots of sums may take.
const SLOTS_SHARE: f64 = 0.75;

pub(super) fn toml(wanted: &Wanted, arm: &Covered) -> String {
    let mut text = String::new();
    write(&mut text, wanted, arm).expect("a string takes whatever is written");
    text
}

fn write(out: &mut impl Write, wanted: &Wanted, arm: &Covered) -> fmt::Result {
    let Wanted { robot: _, cells, buses, broadcast_hz, reply, format } = wanted;
    let robot = arm.name.to_lowercase();
    let [(upper, on_upper), (lower, on_lower)] = arm.limbs;
    write!(out, "# gateway skin generate --robot {robot} --cells {cells}")?;
    let usual = Wanted::default();
    if *buses != usual.buses {
        write!(out, " --buses {buses}")?;
    }
    if broadcast_hz.to_bits() != usual.broadcast_hz.to_bits() {
        write!(out, " --broadcast-hz {broadcast_hz}")?;
    }
    if *reply == Reply::Sum {
        write!(out, " --reply sum")?;
    }
    if *format == Format::Classic {
        write!(out, " --format classic")?;
    }
    writeln!(out, "\n#")?;
    writeln!(out, "# Hexagonal cells, {} mm apart, in rings that are turned by half a cell", arm.pitch_mm)?;
    writeln!(out, "# against each other: {on_upper} around the {upper}, {on_lower} around the {lower}.")?;
    writeln!(out, "# Ports: 0 and 1 along the ring, 2 to the ring before, 3 to the ring after.")?;
    if arm.buses.len() == 1 && on_upper > 0 && on_lower > 0 {
        writeln!(out, "# A cable leads from node {on_upper} over the elbow to node {}.", on_upper + 1)?;
    }
    writeln!(out, "version = 1\nname = \"{robot}-{cells}\"\n")?;

    writeln!(out, "[robot]\nname = \"{}\"", arm.name)?;
    writeln!(out, "joints = [   # standard Denavit-Hartenberg, base to tip; m, rad")?;
    for row in &arm.joints {
        let (a, alpha, d, theta_offset) = (row.a, row.alpha, row.d, row.theta_offset);
        writeln!(out, "  {{ a = {a:?}, alpha = {alpha:?}, d = {d:?}, theta_offset = {theta_offset:?} }},")?;
    }
    writeln!(out, "]\n\n[timing]\ncontrol_hz = 500.0\njoint_broadcast_hz = {broadcast_hz:?}\n")?;
    writeln!(out, "[contact]   # the paper's Algorithm 1")?;
    writeln!(out, "alpha_c = 1.0\nalpha_p = 0.0\ncontact_threshold_n = 0.1")?;
    writeln!(out, "proximity_threshold = 0.05\nforce_threshold_n = 0.1\n")?;

    for (bus, places) in arm.buses.iter().enumerate() {
        let format = match format {
            Format::Fd => "fd",
            Format::Classic => "classic",
        };
        match reply {
            Reply::Torque => writeln!(out, "[[bus]]\nname = \"vcan{bus}\"\nreply = \"torque\"")?,
            Reply::Sum => {
                let slot_us = slot_us(places, *broadcast_hz);
                writeln!(out, "[[bus]]\nname = \"vcan{bus}\"\nreply = \"sum\"\nslot_us = {slot_us}")?;
            }
        }
        writeln!(out, "format = \"{format}\"\n")?;
    }

    writeln!(out, "[controller]   # M q'' + D q' = tau, joint by joint\nkind = \"kinesthetic\"")?;
    writeln!(out, "inertia = [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]           # kg m2")?;
    writeln!(out, "damping = [4.0, 4.0, 4.0, 2.0, 2.0, 2.0]           # Nm s/rad")?;
    writeln!(out, "max_speed_rad_s = [2.0, 2.0, 2.0, 3.0, 3.0, 3.0]")?;

    for (bus, places) in arm.buses.iter().enumerate() {
        for (at, place) in places.iter().enumerate() {
            cell(out, bus, at, place)?;
        }
    }
    Ok(())
}

fn cell(out: &mut impl Write, bus: usize, at: usize, place: &Place) -> fmt::Result {
    let node = at + 1;
    let [x, y, z] = place.position.map(|value| round(value, 1e6));
    // Turned about x, the limb's own direction: the cell's z axis points away from the limb.
    let (sin, cos) = (-place.turn / 2.0).sin_cos();
    let [qx, qw] = [sin, cos].map(|value| round(value, 1e9));
    let wires = place.wires.map(|wire| wire.map_or(0, |at| at + 1));
    writeln!(out, "\n[[cell]]\nbus = \"vcan{bus}\"\nnode = {node}")?;
    writeln!(out, "serial = {}\njoint = {}", 100_000 * (bus + 1) + node, place.joint)?;
    writeln!(out, "position = [{x:?}, {y:?}, {z:?}]\norientation = [{qx:?}, 0.0, 0.0, {qw:?}]")?;
    writeln!(out, "neighbors = {wires:?}")?;
    if place.root {
        writeln!(out, "root = true")?;
    }
    Ok(())
}

/// Slots for every depth of the tree, within a part of the period, in whole 10 µs.
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "small and positive; the skin's check refuses what is not"
)]
fn slot_us(places: &[Place], broadcast_hz: f64) -> u64 {
    let root = places.iter().position(|place| place.root).unwrap_or_default();
    let slots = arm::depth(places, root) + 1;
    (1e5 * SLOTS_SHARE / broadcast_hz / slots as f64).floor().max(1.0) as u64 * 10
}

/// To a step of `1 / steps`; never minus zero.
fn round(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps + 0.0
}
