//! Formats a generated skin as the text of a `skin.toml`.

use protocol::skin::DenavitHartenberg;
use protocol::skin::file::{CellFacing, DraftBus, DraftCell, SkinDraft, Value};

use super::arm::{self, CoveredArm, PlacedCell};
use super::{Format, ReplyMode, SkinRequest};

/// Maximum share of the broadcast period that the slots of sums may take.
const MAX_SLOT_PERIOD_SHARE: f64 = 0.75;

pub(super) fn skin_toml(target: &SkinRequest, arm: &CoveredArm) -> String {
    let SkinRequest { robot: _, cells, buses, broadcast_hz, reply, format } = target;
    let usual = SkinRequest::default();
    let [(upper, on_upper), (lower, on_lower)] = arm.limbs;
    let options = [
        (*buses != usual.buses, format!(" --buses {buses}")),
        (broadcast_hz.to_bits() != usual.broadcast_hz.to_bits(), format!(" --broadcast-hz {broadcast_hz}")),
        (*reply == ReplyMode::Sum, " --reply sum".to_owned()),
        (*format == Format::Classic, " --format classic".to_owned()),
    ];
    let options: String =
        options.into_iter().filter_map(|(is_unusual, option)| is_unusual.then_some(option)).collect();
    let mut draft = SkinDraft::default();
    draft.add_comment(&format!("skinbus skin generate --cells {cells}{options}"));
    draft.add_comment("");
    draft.add_comment(&format!(
        "Hexagonal cells, {} mm apart, in rings that are turned by half a cell",
        arm.pitch_mm
    ));
    draft.add_comment(&format!(
        "against each other: {on_upper} around the {upper}, {on_lower} around the {lower}."
    ));
    draft.add_comment("Ports: 0 and 1 along the ring, 2 to the ring before, 3 to the ring after.");
    if arm.buses.len() == 1 && on_upper > 0 && on_lower > 0 {
        draft.add_comment(&format!(
            "A cable leads from node {on_upper} over the elbow to node {}.",
            on_upper + 1
        ));
    }
    draft.set("version", Value::Integer(1));
    draft.set("name", Value::Text(&format!("{}-{cells}", arm.name.to_lowercase())));
    draft.add_table_header("[robot]", None);
    draft.set("name", Value::Text(arm.name));
    let rows = arm.joints.iter().map(|&DenavitHartenberg { a, alpha, d, theta_offset }| {
        let values = [("a", a), ("alpha", alpha), ("d", d), ("theta_offset", theta_offset)];
        values.map(|(key, value)| (key, Value::Number(value))).to_vec()
    });
    draft.set_table_rows("joints", Some("standard Denavit-Hartenberg, base to tip; m, rad"), rows);
    draft.add_paper_settings(*broadcast_hz);
    for (bus, places) in arm.buses.iter().enumerate() {
        let slot_us = (*reply == ReplyMode::Sum).then(|| slot_duration_us(places, *broadcast_hz));
        draft.add_bus(&DraftBus { name: &bus_name(bus), chain: None, slot_us, format: *format });
    }
    draft.add_table_header("[controller]", Some("M q'' + D q' = tau, joint by joint"));
    draft.set("kind", Value::Text("kinesthetic"));
    draft.set_with_comment("inertia", Value::Numbers(&[1.0, 1.0, 1.0, 0.5, 0.5, 0.5]), 11, "kg m2");
    draft.set_with_comment("damping", Value::Numbers(&[4.0, 4.0, 4.0, 2.0, 2.0, 2.0]), 11, "Nm s/rad");
    draft.set("max_speed", Value::Numbers(&[2.0, 2.0, 2.0, 3.0, 3.0, 3.0]));
    for (bus, places) in arm.buses.iter().enumerate() {
        places.iter().zip(1..).for_each(|(place, node)| add_cell(&mut draft, bus, place, node));
    }
    draft.into_text()
}

fn bus_name(bus: usize) -> String {
    format!("vcan{bus}")
}

/// Adds a cell to the draft, on a bus and with a node id.
fn add_cell(draft: &mut SkinDraft, bus: usize, place: &PlacedCell, node: usize) {
    // A rotation about x, the limb's direction: the cell's z axis points away from the limb.
    let (sin, cos) = (-place.turn / 2.0).sin_cos();
    let [qx, qw] = [sin, cos].map(|value| round_to_step(value, 1e9));
    draft.add_cell(&DraftCell {
        remark: None,
        bus: &bus_name(bus),
        node,
        serial: Some(100_000 * (bus + 1) + node),
        joint: place.joint.into(),
        row: None,
        position: place.position.map(|value| round_to_step(value, 1e6)),
        facing: CellFacing::Orientation([qx, 0.0, 0.0, qw]),
        neighbors: Some(place.wires.map(|wire| wire.map_or(0, |at| u8::try_from(at + 1).unwrap_or(u8::MAX)))),
        root: place.root,
    });
}

/// Returns the slot duration in µs, a multiple of 10. The slots of all levels of the tree together take at most
/// [`MAX_SLOT_PERIOD_SHARE`] of the broadcast period.
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "small and positive; the skin's check refuses what is not"
)]
fn slot_duration_us(places: &[PlacedCell], broadcast_hz: f64) -> u64 {
    let root = places.iter().position(|place| place.root).unwrap_or_default();
    let slots = arm::tree_depth_from(places, root) + 1;
    (1e5 * MAX_SLOT_PERIOD_SHARE / broadcast_hz / slots as f64).floor().max(1.0) as u64 * 10
}

/// Rounds to a step of `1 / steps`; never returns minus zero.
fn round_to_step(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps + 0.0
}
