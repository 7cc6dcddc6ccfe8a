//! Another cell claims the node id of a present cell.

use super::*;

/// Heartbeat of another cell that claims cell 1's node id.
fn claim() -> Message {
    let intruder = Heartbeat { serial: 99, state: Flags::CLAIMING_NODE_ID, ..Heartbeat::default() };
    Message::Network { from: Node::Cell(cell(1)), epoch: Epoch(0), page: NetworkPage::Heartbeat(intruder) }
}

#[test]
fn a_claim_of_a_taken_node_id_explains_nothing_and_leaves_the_cell_there() {
    let with_claim = |at| {
        let mut said = run();
        said.insert(at, claim());
        said
    };
    for at in 1..run().len() {
        // An extra reply stays extra.
        let mut now = run();
        now.insert(9, torque(1, 4, 9));
        let extra = |recorded: &[Message]| rated(&[recorded, &[joints(5)]].concat(), &now).tally;
        assert_eq!(extra(&with_claim(at)), extra(&run()), "recorded after {at}");
        let comparator = rated(&run(), &with_claim(at));
        assert_eq!(counts(&comparator), [3, 0, 0, 0], "heard after {at}");
        assert!(
            comparator.present_cells(0).all(|(_, present)| present.claim.is_settled()),
            "heard after {at}"
        );
    }
}

#[test]
fn a_claim_of_a_taken_node_id_leaves_the_tree_as_it_is() {
    let owner = heartbeat(1, 0, 10, Flags::TEST_MODE);
    let said = [
        owner,
        joints(0),
        tree(1, 0, Some(0)),
        joints(1),
        sum(1, 1, 5, 1),
        joints(2),
        sum(1, 2, 6, 1),
        joints(3),
    ];
    let with = [&said[..4], &[claim()], &said[4..]].concat();
    let tally = rated(&said, &said).tally;
    assert_eq!((tally.equal, tally.sums), (2, 2));
    assert_eq!(rated(&with, &said).tally, tally, "recorded");
    assert_eq!(rated(&said, &with).tally, tally, "now");
}

#[test]
fn a_claim_of_a_taken_node_id_is_no_packet_and_no_silence_of_its_owner() {
    let surveyed = |said: &[Message]| {
        let mut survey = Survey::new(TimeRange::default());
        for (at, message) in (1_u64..).zip(said) {
            let time = Timestamp::with_six_digits(at * MS);
            for frame in message.encode().frames(Format::Fd) {
                survey.add_frame(&Record { time, interface: "vcan0", frame, direction: None });
            }
        }
        survey.finish();
        let cell = &survey.buses[0].cells[&cell(1)];
        let silent = (1..20).filter(|at| cell.is_silent_at(at * MS)).count();
        (cell.hash, cell.measured, cell.unrecorded, cell.untaken, silent)
    };
    // Two of the cell's packets are missing.
    let mut said = run();
    said[9] = heartbeat(1, 4, 16, Flags::TEST_MODE);
    let without = surveyed(&said);
    assert_eq!(without.2, 2);
    for at in 1..=said.len() {
        let (before, after) = said.split_at(at);
        assert_eq!(surveyed(&[before, &[claim()], after].concat()), without, "after {at}");
    }
}

#[test]
fn another_sender_of_joints_is_another_gateway() {
    let mut comparator =
        Comparator::new([("a".to_owned(), BTreeMap::new()), ("b".to_owned(), BTreeMap::new())], 0, None);
    comparator.observe_message(1, &Message::Resume);
    assert_eq!(comparator.other_gateway_bus(), None, "anybody may resume");
    comparator.observe_message(1, &joints(0));
    assert_eq!(comparator.other_gateway_bus(), Some(1));
}
