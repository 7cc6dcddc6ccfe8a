use protocol::skin::Cell;

use super::*;

fn target(cells: usize, buses: usize) -> SkinRequest {
    SkinRequest { cells, buses, ..SkinRequest::default() }
}

fn skin(target: &SkinRequest) -> Skin {
    Skin::parse("generated", &generate(target).unwrap()).unwrap()
}

fn apart(one: &Cell, other: &Cell) -> f64 {
    one.position.iter().zip(other.position).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// Returns the cells that are wired to `cell` on its bus.
fn wired<'a>(skin: &'a Skin, cell: &'a Cell) -> impl Iterator<Item = &'a Cell> {
    let on_bus = move |node| skin.cells.iter().find(move |it| it.bus == cell.bus && it.node == node);
    cell.neighbors.iter().flatten().map(move |&node| on_bus(node).unwrap())
}

#[test]
fn the_example_is_what_its_first_line_makes() {
    let example = include_str!("../../../examples/ur5-253.toml");
    assert!(example.starts_with("# skinbus skin generate --cells 253\n"));
    assert!(generate(&SkinRequest::default()).unwrap() == example, "generate it again with that command");
}

#[test]
fn wires_are_symmetric_and_lead_to_hexagon_neighbours() {
    let skin = skin(&SkinRequest::default());
    let mut cables = Vec::new();
    for cell in &skin.cells {
        assert!(cell.neighbors.iter().flatten().count() >= 2, "{cell:?}");
        for other in wired(&skin, cell) {
            assert!(other.neighbors.contains(&Some(cell.node)), "{} to {}", cell.node, other.node);
            if cell.joint == other.joint {
                let apart = apart(cell, other);
                assert!((0.0275..0.0281).contains(&apart), "{} to {}: {apart}", cell.node, other.node);
            } else {
                cables.push((cell.node.get(), other.node.get()));
            }
        }
    }
    assert_eq!(cables, [(141, 142), (142, 141)], "one cable, over the elbow");
}

#[test]
fn cells_do_not_overlap_and_look_outwards() {
    let skin = skin(&SkinRequest::default());
    for (index, cell) in skin.cells.iter().enumerate() {
        for other in skin.cells.iter().take(index).filter(|other| other.joint == cell.joint) {
            assert!(apart(cell, other) > 0.0275, "{} and {}", cell.node, other.node);
        }
        // The direction from the limb's axis outwards, perpendicular to it.
        let (radius, offset) = if cell.joint == 2 { (0.066_845, 0.135_85) } else { (0.057_932, 0.016_15) };
        let [_, y, z] = cell.position;
        let [nx, ny, nz] = cell.normal;
        assert!(nx.abs() < 1e-8 && (ny * radius - y).abs() < 2e-6, "{cell:?}");
        assert!((nz * radius - (z - offset)).abs() < 2e-6, "{cell:?}");
    }
}

#[test]
fn every_bus_is_one_connected_patch_with_one_root() {
    for (cells, buses) in
        [(1, 1), (2, 1), (3, 1), (20, 1), (254, 1), (2, 2), (253, 2), (508, 2), (700, 3), (1_016, 4)]
    {
        let skin = skin(&target(cells, buses));
        assert_eq!((skin.cells.len(), skin.buses.len()), (cells, buses));
        for bus in 0..buses {
            let here: Vec<&Cell> = skin.cells_on_bus(bus).collect();
            assert!(here.iter().zip(1..).all(|(cell, node)| i64::from(cell.node.get()) == node));
            assert_eq!(here.iter().filter(|cell| cell.root).count(), 1, "{cells} {buses}");
            assert!(buses == 1 || here.iter().all(|cell| cell.joint == here[0].joint), "limbs stay together");
            let mut reached = vec![here[0].node];
            let mut next = 0;
            while let Some(&node) = reached.get(next) {
                let cell = here[usize::from(node.get()) - 1];
                for neighbor in cell.neighbors.iter().flatten() {
                    if !reached.contains(neighbor) {
                        reached.push(*neighbor);
                    }
                }
                next += 1;
            }
            assert_eq!(reached.len(), here.len(), "{cells} cells on {buses} buses, bus {bus}");
        }
    }
}

#[test]
fn few_and_many_cells_make_a_skin() {
    for cells in (1..=32).chain(250..=254) {
        assert_eq!(skin(&target(cells, 1)).cells.len(), cells);
    }
}

#[test]
fn more_cells_than_the_arm_has_room_for_lie_closer() {
    let text = generate(&target(10_000, 40)).unwrap();
    assert!(text.contains("# Hexagonal cells, 4 mm apart"), "{}", text.lines().nth(2).unwrap());
}

#[test]
fn the_reply_and_the_format_are_the_requested_ones() {
    let target = SkinRequest {
        reply: ReplyMode::Sum,
        format: Format::Classic,
        broadcast_hz: 50.0,
        buses: 2,
        cells: 300,
        robot: RobotModel::Ur5,
    };
    let text = generate(&target).unwrap();
    let first =
        "# skinbus skin generate --cells 300 --buses 2 --broadcast-hz 50 --reply sum --format classic";
    assert_eq!(text.lines().next(), Some(first));
    let skin = skin(&target);
    assert_eq!(skin.timing.ticks_per_broadcast, 10);
    for bus in &skin.buses {
        assert_eq!(bus.format, Format::Classic);
        // The slots share 15 ms; there are at most 20.
        assert!(
            matches!(bus.reply, protocol::skin::SkinReply::Sum { slot_us: 750..2_000, carry: true }),
            "{bus:?}"
        );
    }
}

#[test]
fn errors_name_what_is_allowed() {
    let says = |target: SkinRequest| generate(&target).unwrap_err().to_string();
    assert_eq!(
        says(target(255, 1)),
        "255 cells do not fit on one bus: a bus has 254 node ids; use --buses 2"
    );
    assert_eq!(
        says(target(1_000, 3)),
        "1000 cells do not fit on 3 buses: a bus has 254 node ids; use --buses 4"
    );
    assert_eq!(says(target(0, 1)), "0 cells are too few for 1 buses: every bus needs at least one cell");
    assert_eq!(
        says(target(100_000, 400)),
        "100000 cells do not fit on the arm, even at a spacing of 3 mm: use fewer cells"
    );
    assert_eq!(says(target(100_000, 1)), says(target(100_000, 400)), "more buses would not help");
    assert_eq!(
        says(SkinRequest { broadcast_hz: 60.0, ..SkinRequest::default() }),
        "generated skin:23:22: timing.joint_broadcast_hz = 60: must divide control_hz = 500 evenly"
    );
}
