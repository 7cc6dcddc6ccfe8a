use super::*;
use protocol::id::Node;
use protocol::message::{Message, NetworkPage};

#[test]
fn a_heartbeat_from_before_a_halt_does_not_end_it() {
    let skin = crate::testing::one_cell_skin();
    let described = skin.cells.first().unwrap();
    let switched = SwitchStates::new(skin.events, Default::default(), Default::default());
    let mut cell = CellState::new(described, &skin.parameters(described), false, switched);
    let says = |cell: &mut CellState, sent, state: State| {
        let heartbeat = Heartbeat { sent, state, ..Heartbeat::default() };
        let page = NetworkPage::Heartbeat(heartbeat);
        let message = Message::Network { from: Node::Cell(cell.node), epoch: Epoch(0), page };
        let update = cell.tracked.record_packet(Micros(0), &message, None);
        cell.apply_heartbeat(&update, &heartbeat, Epoch(0));
    };
    says(&mut cell, 1, State::CONFIGURED);
    assert!(cell.is_ready());
    cell.halt();
    says(&mut cell, 2, State::CONFIGURED);
    assert!(!cell.is_ready(), "sent before the halt");
    says(&mut cell, 3, State::CONFIGURED);
    assert!(cell.is_ready(), "it did not receive the halt");
    cell.resume();
    says(&mut cell, 4, State::CONFIGURED.with_flags(State::HALTED, true));
    assert!(cell.is_ready(), "sent before the resume");
    says(&mut cell, 5, State::CONFIGURED.with_flags(State::HALTED, true));
    assert!(!cell.is_ready(), "it did not receive the resume");
}
