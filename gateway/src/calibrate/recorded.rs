//! Comparison of a skin with the skin of a recording.

use protocol::skin::Skin;
use protocol::usage::Failure;

/// Checks that a recording belongs to this skin: the cells, buses, robot and rate are the same. Poses of cells and zero
/// offsets of joints may differ, because a calibration finds them.
pub(super) fn check_same_skin(name: &str, skin: &Skin, recorded: &Skin) -> Result<(), Failure> {
    let Some((what, is, was)) = recorded_skin_difference(skin, recorded) else { return Ok(()) };
    Err(Failure::usage_error(format!(
        "{name} was recorded with a different skin: {what}: {is} in the given skin, but {was} in the \
         recording; give the skin with which the recording was made"
    )))
}

/// Returns the name of the first difference between two skins, with the two values.
fn recorded_skin_difference(skin: &Skin, recorded: &Skin) -> Option<(&'static str, String, String)> {
    type SkinProperty = fn(&Skin) -> String;
    let all: [(&str, SkinProperty); 6] = [
        ("buses", |skin| comma_separated_list(skin.buses.iter().map(|bus| bus.name.clone()))),
        ("joints", |skin| comma_separated_list(skin.robot.joints.iter().map(|joint| joint.name.clone()))),
        ("number of cells", |skin| skin.cells.len().to_string()),
        ("nodes", |skin| {
            sorted_cell_texts(skin, |skin, cell| format!("{} {}", bus(skin, cell.bus), cell.node))
        }),
        ("serial numbers", |skin| sorted_cell_texts(skin, |_, cell| cell.serial.to_string())),
        ("joint_broadcast_hz", |skin| skin.timing.broadcast_hz().to_string()),
    ];
    let differing = |(what, pick): &(&'static str, SkinProperty)| {
        let (is, was) = (pick(skin), pick(recorded));
        (is != was).then(|| first_differing_items(what, &is, &was))
    };
    all.iter().find_map(differing).or_else(|| row_difference(skin, recorded))
}

/// Returns the first items in which two lists differ, under the name `what`.
fn first_differing_items(what: &'static str, is: &str, was: &str) -> (&'static str, String, String) {
    let [mut left, mut right] = [is.split(", "), was.split(", ")];
    loop {
        match (left.next(), right.next()) {
            (Some(one), Some(other)) if one == other => {}
            (one, other) => {
                let text = |it: Option<&str>| it.filter(|it| !it.is_empty()).unwrap_or("none").to_owned();
                return (what, text(one), text(other));
            }
        }
    }
}

/// Returns the first row of the robot's table that differs, apart from the zero offsets of joints.
fn row_difference(skin: &Skin, recorded: &Skin) -> Option<(&'static str, String, String)> {
    let all = |skin: &Skin| -> Vec<_> {
        let chains = skin.robot.chains.iter();
        chains
            .flat_map(|chain| &chain.rows)
            .map(|row| (row.kind, row.table.a, row.table.alpha, row.table.d))
            .collect()
    };
    let (is, was) = (all(skin), all(recorded));
    if is.len() != was.len() {
        return Some(("number of rows", is.len().to_string(), was.len().to_string()));
    }
    let differing = is.iter().zip(&was).enumerate().find(|(_, (one, other))| one != other);
    let row = |(_, a, alpha, d): &(_, f64, f64, f64)| format!("a = {a}, alpha = {alpha}, d = {d}");
    differing.map(|(_, (one, other))| ("row of the robot's table", row(one), row(other)))
}

fn bus(skin: &Skin, bus: usize) -> &str {
    skin.buses.get(bus).map_or("", |bus| &bus.name)
}

fn sorted_cell_texts(skin: &Skin, text: fn(&Skin, &protocol::skin::Cell) -> String) -> String {
    let mut all: Vec<_> = skin.cells.iter().map(|cell| text(skin, cell)).collect();
    all.sort_unstable();
    all.join(", ")
}

fn comma_separated_list(all: impl Iterator<Item = String>) -> String {
    all.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_skin_is_named_and_other_poses_are_the_same_skin() {
        let skin = model::testing::one_cell_skin();
        let mut found = skin.clone();
        found.cells[0].position = [0.1, 0.2, 0.3];
        found.robot.chains[0].rows[1].table.theta_offset += 0.01;
        assert_eq!(recorded_skin_difference(&found, &skin), None);
        let mut other = skin.clone();
        other.cells[0].serial += 1;
        let (what, ..) = recorded_skin_difference(&other, &skin).unwrap();
        assert_eq!(what, "serial numbers");
        let mut other = skin.clone();
        other.robot.chains[0].rows[1].table.a = -0.612;
        let said = check_same_skin("run.mcap", &other, &skin).unwrap_err().to_string();
        assert!(
            said.contains(
                "run.mcap was recorded with a different skin: row of the robot's table: a = -0.612"
            ),
            "{said}"
        );
        other.cells.clear();
        let (what, is, was) = recorded_skin_difference(&other, &skin).unwrap();
        assert_eq!((what, is.as_str(), was.as_str()), ("number of cells", "0", "1"));
    }
}
