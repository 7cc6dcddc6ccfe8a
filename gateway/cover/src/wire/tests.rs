use proptest::prelude::*;

use super::*;

#[test]
fn buses_share_evenly_and_end_with_a_link_where_that_is_near() {
    assert_eq!(cells_per_bus(&[], 250), [0; 0]);
    assert_eq!(cells_per_bus(&[0, 3, 0], 250), [3]);
    assert_eq!(cells_per_bus(&[100, 150], 250), [250]);
    assert_eq!(cells_per_bus(&[300], 250), [150, 150]);
    assert_eq!(cells_per_bus(&[160, 140], 250), [160, 140], "10 from the even share");
    assert_eq!(cells_per_bus(&[200, 100], 250), [150, 150], "50 from the even share");
    assert_eq!(cells_per_bus(&[240, 250], 250), [240, 250], "no room for 5 more");
    assert_eq!(cells_per_bus(&[1; 7], 3), [3, 2, 2]);
}

proptest! {
    #[test]
    fn no_bus_is_empty_or_over_its_budget(links in proptest::collection::vec(0..400_usize, 0..9), budget in 1..=250_usize) {
        let shares = cells_per_bus(&links, budget);
        let total: usize = links.iter().sum();
        prop_assert_eq!(shares.iter().sum::<usize>(), total);
        prop_assert_eq!(shares.len(), total.div_ceil(budget));
        prop_assert!(shares.iter().all(|share| (1..=budget).contains(share)));
    }
}

#[test]
fn ports_are_at_the_side_of_their_wires() {
    // Seen from above, forward is x: port 0 is at x, 1 at y, 2 at -x, 3 at -y.
    let (up, forward) = (Vector3::z(), Vector3::new(1.0, 0.0, 5.0));
    let at = |degrees: f64| Vector3::new(degrees.to_radians().cos(), degrees.to_radians().sin(), 0.1);
    let ports = |turns: &[f64]| {
        let others: Vec<_> = turns.iter().enumerate().map(|(at_wire, &turn)| (at_wire, at(turn))).collect();
        ports::assign_ports(&up, &forward, &others)
    };
    assert_eq!(ports(&[180.0, 0.0, 90.0, -90.0]), [Some(1), Some(2), Some(0), Some(3)]);
    assert_eq!(ports(&[100.0]), [None, Some(0), None, None]);
    // Three wires of a honeycomb are rotated: none is displaced more than necessary.
    assert_eq!(ports(&[350.0, 50.0, 110.0]), [Some(0), Some(1), Some(2), None]);
    assert_eq!(ports(&[]), [None; PORTS_PER_CELL]);
    // A cell that faces along the axis has no forward direction, but four ports.
    assert_eq!(ports::assign_ports(&up, &up, &[(8, at(0.0)), (9, at(90.0))]).iter().flatten().count(), 2);
}

#[test]
fn a_root_is_in_the_middle_and_one_of_each_group() {
    // The cells are a row of five, and a single one.
    let row = vec![vec![1], vec![0, 2], vec![1, 3], vec![2, 4], vec![3], vec![]];
    assert_eq!(choose_roots(&row), [2, 5]);
}

#[test]
fn a_full_cell_leaves_wires_to_others() {
    // Six cells are around cell 0, and are neighbours in a ring too; the spokes are shorter.
    let spokes = (1..7).map(|at| [0, at]);
    let ring = (1..7).map(|at| [at.min(at % 6 + 1), at.max(at % 6 + 1)]);
    let wires = wires_by_cell(7, &spokes.chain(ring).collect::<Vec<_>>());
    assert_eq!(wires[0].len(), PORTS_PER_CELL);
    assert_eq!(reachable_cells(&wires, 0).len(), 7, "all are joined");
    assert!(wires.iter().all(|others| others.len() <= PORTS_PER_CELL));
    assert_eq!(choose_roots(&wires).len(), 1);
}

#[test]
fn cells_are_reached_before_others_get_more_wires() {
    // Five cells are all near each other; a sixth is near to only one of them, and farther away.
    let all = (0..5).flat_map(|a| (a + 1..5).map(move |b| [a, b]));
    let wires = wires_by_cell(6, &all.chain([[0, 5]]).collect::<Vec<_>>());
    assert_eq!(wires[5], [0]);
    assert_eq!(reachable_cells(&wires, 5).len(), 6);
    assert_eq!(wires.iter().map(Vec::len).sum::<usize>(), 20, "the others have all wires that are left");
}
