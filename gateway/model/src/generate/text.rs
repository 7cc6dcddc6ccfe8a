//! The text of a `skin.toml`.

use protocol::skin::DenavitHartenberg;

use super::arm::{self, Covered, Place};
use super::{Format, Reply, Target};

/// How much of the broadcast period the slots of sums may take.
const SLOTS_SHARE: f64 = 0.75;

pub(super) fn toml(target: &Target, arm: &Covered) -> String {
    let Target { robot: _, cells, buses, broadcast_hz, reply, format } = target;
    let usual = Target::default();
    let robot = arm.name.to_lowercase();
    let [(upper, on_upper), (lower, on_lower)] = arm.limbs;
    let options = [
        (*buses != usual.buses, format!(" --buses {buses}")),
        (broadcast_hz.to_bits() != usual.broadcast_hz.to_bits(), format!(" --broadcast-hz {broadcast_hz}")),
        (*reply == Reply::Sum, " --reply sum".to_owned()),
        (*format == Format::Classic, " --format classic".to_owned()),
    ];
    let options: String =
        options.into_iter().filter_map(|(is_unusual, option)| is_unusual.then_some(option)).collect();
    let is_joined = arm.buses.len() == 1 && on_upper > 0 && on_lower > 0;
    let cable = format!("# A cable leads from node {on_upper} over the elbow to node {}.\n", on_upper + 1);
    let cable = if is_joined { &cable } else { "" };
    let joints = arm.joints.map(|DenavitHartenberg { a, alpha, d, theta_offset }| {
        format!("  {{ a = {a:?}, alpha = {alpha:?}, d = {d:?}, theta_offset = {theta_offset:?} }},\n")
    });
    let format = format.name();
    let places = || arm.buses.iter().enumerate();
    let buses = places().map(|(bus, places)| {
        let reply = match reply {
            Reply::Torque => "\"torque\"".to_owned(),
            Reply::Sum => format!("\"sum\"\nslot_us = {}", slot_us(places, *broadcast_hz)),
        };
        format!("[[bus]]\nname = \"vcan{bus}\"\nreply = {reply}\nformat = \"{format}\"\n\n")
    });
    let described = places().flat_map(|(bus, places)| places.iter().zip(1..).map(move |it| cell(bus, it)));
    format!(
        "# skinbus skin generate --cells {cells}{options}\n#\n\
         # Hexagonal cells, {pitch} mm apart, in rings that are turned by half a cell\n\
         # against each other: {on_upper} around the {upper}, {on_lower} around the {lower}.\n\
         # Ports: 0 and 1 along the ring, 2 to the ring before, 3 to the ring after.\n{cable}\
         version = 1\nname = \"{robot}-{cells}\"\n\n\
         [robot]\nname = \"{name}\"\n\
         joints = [   # standard Denavit-Hartenberg, base to tip; m, rad\n{joints}]\n\n\
         [timing]\ncontrol_hz = 500.0\njoint_broadcast_hz = {broadcast_hz:?}\n\n\
         [contact]   # the paper's Algorithm 1\nalpha_c = 1.0\nalpha_p = 0.0\ncontact_threshold_n = 0.1\n\
         proximity_threshold = 0.05\nforce_threshold_n = 0.1\n\n{buses}\
         [controller]   # M q'' + D q' = tau, joint by joint\nkind = \"kinesthetic\"\n\
         inertia = [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]           # kg m2\n\
         damping = [4.0, 4.0, 4.0, 2.0, 2.0, 2.0]           # Nm s/rad\n\
         max_speed_rad_s = [2.0, 2.0, 2.0, 3.0, 3.0, 3.0]\n{described}",
        pitch = arm.pitch_mm,
        name = arm.name,
        joints = joints.concat(),
        buses = buses.collect::<String>(),
        described = described.collect::<String>(),
    )
}

/// A cell of a bus with its node there.
fn cell(bus: usize, (place, node): (&Place, usize)) -> String {
    let [x, y, z] = place.position.map(|value| round(value, 1e6));
    // Turned about x, the limb's own direction: the cell's z axis points away from the limb.
    let (sin, cos) = (-place.turn / 2.0).sin_cos();
    let [qx, qw] = [sin, cos].map(|value| round(value, 1e9));
    let wires = place.wires.map(|wire| wire.map_or(0, |at| at + 1));
    let (serial, joint) = (100_000 * (bus + 1) + node, place.joint);
    let root = if place.root { "root = true\n" } else { "" };
    format!(
        "\n[[cell]]\nbus = \"vcan{bus}\"\nnode = {node}\nserial = {serial}\njoint = {joint}\n\
         position = [{x:?}, {y:?}, {z:?}]\norientation = [{qx:?}, 0.0, 0.0, {qw:?}]\nneighbors = {wires:?}\n{root}"
    )
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
