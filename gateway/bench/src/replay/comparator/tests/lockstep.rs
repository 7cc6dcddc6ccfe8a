//! Tests of the replay that waits for cells.

use super::*;

#[test]
fn in_lockstep_a_cell_is_done_when_its_heartbeat_has_the_epoch() {
    let mut comparator = Comparator::new([("vcan0".to_owned(), BTreeMap::new())], 0, Some(0));
    let beat = |node, epoch| heartbeat(node, epoch, 0, Flags::TEST_MODE);
    comparator.observe_message(0, &beat(1, 0));
    comparator.observe_message(0, &heartbeat(2, 0, 0, Flags::CLAIMING_NODE_ID));
    assert!(comparator.are_joints_processed(0), "nothing was sent");
    comparator.announce_joints(0, None, Epoch(9));
    assert!(!comparator.are_joints_processed(0));
    comparator.observe_message(0, &beat(1, 8));
    assert!(!comparator.are_joints_processed(0), "sent before it took them");
    comparator.observe_message(0, &beat(1, 9));
    assert!(comparator.are_joints_processed(0), "a cell that claims its node id is not waited for");
    comparator.announce_joints(0, None, Epoch(10));
    // A cell that refuses these joints sends its old epoch: once in its periodic heartbeat, once because of the sync.
    comparator.observe_message(0, &beat(1, 9));
    assert!(!comparator.are_joints_processed(0));
    comparator.observe_message(0, &beat(1, 9));
    assert!(comparator.are_joints_processed(0));
    comparator.announce_joints(0, None, Epoch(11));
    assert_eq!(comparator.time_out_cells(0), [cell(1)]);
    assert!(comparator.are_joints_processed(0), "given up");
    comparator.observe_message(0, &beat(1, 10));
    assert!(!comparator.are_joints_processed(0), "it sends again");
    comparator.mark_down(0);
    assert!(comparator.are_joints_processed(0), "no cell is waited for on a bus that is down");
}
