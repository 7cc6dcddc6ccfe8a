use super::*;
use protocol::port::NodeIdWalk;

const MS: u64 = 1_000;

/// Returns the network part of a cell with a node id and wires at the ports in this mask.
fn network(wired: u8) -> Network {
    let mut network = Network::new(Micros(0));
    network.set_wired_ports(wired, CellId::new(12).ok(), 0);
    network
}

fn said(network: &mut Network) -> Vec<(usize, PortMessage)> {
    core::iter::from_fn(|| network.poll_transmit()).collect()
}

/// Returns the messages that were sent, except hellos.
fn asked(network: &mut Network) -> Vec<(usize, PortMessage)> {
    let mut messages = said(network);
    messages.retain(|(_, message)| !matches!(message, PortMessage::Hello(_)));
    messages
}

const fn rank(round: u8, depth: u8) -> TreeRank {
    TreeRank { round, depth }
}

fn neighbour(number: u8, rank: Option<TreeRank>) -> Hello {
    Hello { version: VERSION, number, port: 3, receives: true, is_parent: false, unnumbered: false, rank }
}

/// Returns a cell that has joined a parent of this rank at port 0, at a time in ms.
fn below(at: u64, parent: TreeRank) -> Network {
    let mut network = network(0b1111);
    network.handle_message(Micros(at * MS), 0, PortMessage::Hello(neighbour(1, Some(parent))));
    assert_eq!(asked(&mut network), [(0, PortMessage::Join)]);
    network.handle_message(Micros(at * MS), 0, PortMessage::Grant(parent));
    assert_eq!((asked(&mut network), network.parent_port()), (vec![], Some(0)));
    network
}

/// Makes the cell at this port a child of the tested cell.
fn adopt(network: &mut Network, now: Micros, port: usize, number: u8) {
    network.handle_message(now, port, PortMessage::Hello(neighbour(number, None)));
    network.handle_message(now, port, PortMessage::Join);
    assert!(network.is_child(port));
    said(network);
}

// LINK-1
#[test]
fn a_port_receives_when_it_is_wired_and_its_link_is_not_down() {
    let mut network = network(0b0011);
    network.ignored_ports = 0b0110;
    assert_eq!([0, 1, 2, 3].map(|port| network.is_receiving_port(port)), [true, false, false, false]);
}

// HELLO-3
#[test]
fn a_port_leads_to_the_cell_whose_hellos_come_there() {
    let mut network = network(0b1111);
    let hello = Hello { port: 2, receives: false, ..neighbour(7, None) };
    network.handle_message(Micros(0), 1, PortMessage::Hello(hello));
    let there = PortState { number: 7, port: 2, receives: true, works: false, other_version: false };
    let nothing = PortState::default();
    assert_eq!(network.port_states(Micros(600 * MS)), [nothing, there, nothing, nothing]);
    assert_eq!(network.port_states(Micros(600 * MS + 1)), [nothing; PORTS]);
}

// LOSS-1, NODE-2
#[test]
fn only_the_parent_refuses_a_child_and_begins_a_walk() {
    let now = Micros(100 * MS);
    let mut network = below(100, rank(1, 1));
    let walk = NodeIdWalk { walk: 1, first: 20, last: 30 };
    network.handle_message(now, 1, PortMessage::Refuse);
    network.handle_message(now, 1, PortMessage::NodeId(walk));
    assert_eq!((said(&mut network), network.parent_port()), (vec![], Some(0)));
    network.handle_message(now, 0, PortMessage::NodeId(walk));
    assert_eq!(said(&mut network), [(0, PortMessage::Return(walk))]);
    network.handle_message(now, 0, PortMessage::Refuse);
    assert_eq!((asked(&mut network).first(), network.parent_port()), (Some(&(0, PortMessage::Leave)), None));
}

// JOIN-1, LOSS-1
#[test]
fn a_lost_parent_is_asked_again_after_a_later_hello() {
    let now = Micros(100 * MS);
    let mut network = below(100, rank(1, 1));
    network.handle_message(now, 0, PortMessage::Refuse);
    assert!(!asked(&mut network).contains(&(0, PortMessage::Join)), "its hello is from before");
    network.handle_message(Micros(now.0 + 1), 0, PortMessage::Hello(neighbour(1, Some(rank(1, 1)))));
    assert_eq!(asked(&mut network), [(0, PortMessage::Join)]);
}

// JOIN-1
#[test]
fn a_port_that_does_not_answer_a_join_is_left_for_the_next() {
    let mut network = network(0b1111);
    for (port, depth) in [(2, 3), (1, 2), (3, 4)] {
        network.handle_message(Micros(MS), port, PortMessage::Hello(neighbour(1, Some(rank(1, depth)))));
    }
    assert_eq!(asked(&mut network), [(2, PortMessage::Join)], "the first that was heard");
    for (now, joins) in [(5_999, None), (6_000, Some(1)), (10_999, None), (11_000, Some(3))] {
        network.handle_timeout(Micros(now));
        let expected: Vec<_> = joins.into_iter().map(|port| (port, PortMessage::Join)).collect();
        assert_eq!(asked(&mut network), expected, "{now} us");
    }
}

// JOIN-2
#[test]
fn of_a_cell_that_is_wired_twice_the_latest_wire_counts() {
    let now = Micros(100 * MS);
    let mut network = below(100, rank(1, 1));
    adopt(&mut network, now, 1, 7);
    adopt(&mut network, now, 2, 8);
    assert_eq!(network.child_mask(), 0b0110);
    adopt(&mut network, now, 3, 7);
    assert_eq!(network.child_mask(), 0b1100);
    // Cells without a node id count as different cells.
    let mut network = below(100, rank(1, 1));
    adopt(&mut network, now, 1, 0);
    adopt(&mut network, now, 2, 0);
    assert_eq!(network.child_mask(), 0b0110);
}

// JOIN-4
#[test]
fn a_grant_is_taken_while_it_is_good_enough_and_no_sums_are_sent() {
    let now = Micros(100 * MS);
    let after = |busy, granted| {
        let mut network = below(100, rank(1, 3));
        network.busy = busy;
        network.handle_message(now, 1, PortMessage::Grant(granted));
        (asked(&mut network), network.parent_port())
    };
    assert_eq!(after(false, rank(1, 2)), (vec![(0, PortMessage::Leave)], Some(1)), "nearer");
    assert_eq!(after(true, rank(1, 2)), (vec![(1, PortMessage::Leave)], Some(0)), "sums are sent");
    assert_eq!(after(false, rank(1, 3)), (vec![(1, PortMessage::Leave)], Some(0)), "as far");
    // Without a parent, the rank must be better than the cell's own.
    for (granted, up) in [(rank(1, 4), None), (rank(1, 3), Some(1))] {
        let mut network = below(100, rank(1, 3));
        network.handle_message(now, 0, PortMessage::Refuse);
        said(&mut network);
        network.handle_message(now, 1, PortMessage::Grant(granted));
        assert_eq!(network.parent_port(), up);
    }
}

// JOIN-6
#[test]
fn the_tree_changes_with_the_node_id_of_the_parent_or_a_child() {
    let now = Micros(100 * MS);
    let mut network = below(100, rank(1, 1));
    adopt(&mut network, now, 1, 7);
    let mut changes = |port, number, up| {
        network.tree_changed = false;
        let rank = Some(rank(1, 1)).filter(|_| port == 0);
        network.handle_message(
            now,
            port,
            PortMessage::Hello(Hello { is_parent: up, ..neighbour(number, rank) }),
        );
        network.tree_changed
    };
    assert_eq!([changes(0, 1, false), changes(1, 7, true)], [false; 2], "they are the same");
    assert_eq!([changes(0, 2, false), changes(1, 8, true)], [true; 2]);
    assert!(!changes(2, 9, false), "it is neither");
}

// LOSS-3
#[test]
fn a_leave_is_repeated_every_quarter_of_a_second_until_it_is_acknowledged() {
    let mut network = below(100, rank(1, 1));
    let deaf = Hello { receives: false, ..neighbour(1, Some(rank(1, 1))) };
    network.handle_message(Micros(100 * MS), 0, PortMessage::Hello(deaf));
    let mut leaves = |now| {
        network.handle_timeout(Micros(now * MS));
        let leaves = said(&mut network).into_iter().filter(|said| *said == (0, PortMessage::Leave)).count();
        if now == 600 {
            network.handle_message(Micros(now * MS), 0, PortMessage::LeaveAck);
        }
        leaves
    };
    let times = [100, 101, 349, 350, 351, 599, 600, 601, 850, 1_100];
    assert_eq!(times.map(&mut leaves), [1, 0, 0, 1, 0, 0, 1, 0, 0, 0]);
}

// REPAIR-1
#[test]
fn a_repair_goes_where_a_rank_is_and_else_to_all_ports_that_work() {
    let repairs = |with_rank: bool| {
        let now = Micros(100 * MS);
        let mut network = below(100, rank(1, 1));
        adopt(&mut network, now, 1, 7);
        if with_rank {
            network.handle_message(now, 2, PortMessage::Hello(neighbour(8, Some(rank(1, 9)))));
        }
        network.handle_message(now, 0, PortMessage::Refuse);
        [100, 119, 120, 159, 160].map(|at| {
            network.handle_timeout(Micros(at * MS));
            let mut ports = asked(&mut network);
            ports.retain(|(_, message)| *message == PortMessage::Repair(1));
            ports.into_iter().map(|(port, _)| port).collect::<Vec<_>>()
        })
    };
    assert_eq!(repairs(false), [vec![0, 1], vec![], vec![0, 1], vec![], vec![0, 1]]);
    assert_eq!(repairs(true), [vec![2], vec![], vec![0, 1, 2], vec![], vec![0, 1, 2]]);
}

// REPAIR-2, REPAIR-3, REPAIR-4
#[test]
fn a_repair_is_forwarded_to_the_parent_and_one_of_the_parent_to_all_others() {
    let mut network = below(100, rank(1, 1));
    adopt(&mut network, Micros(100 * MS), 1, 7);
    let mut forwarded = |now, port, round| {
        network.handle_message(Micros(now), port, PortMessage::Repair(round));
        said(&mut network)
    };
    let answer = forwarded(100_000, 1, 0);
    assert!(matches!(answer[..], [(1, PortMessage::Hello(_))]), "there is a later round: {answer:?}");
    let to_parent = [(0, PortMessage::Repair(1))];
    assert_eq!(forwarded(100_000, 1, 1), to_parent);
    assert_eq!(forwarded(119_999, 1, 1), []);
    assert_eq!(forwarded(120_000, 1, 1), to_parent);
    // The parent has no route either.
    assert_eq!(forwarded(120_001, 0, 1), [(1, PortMessage::Repair(1))]);
    assert_eq!(forwarded(140_000, 0, 1), []);
    assert_eq!(forwarded(140_001, 0, 1), [(1, PortMessage::Repair(1))]);
}

// NODE-1, NODE-2
#[test]
fn a_walk_goes_to_the_children_below_which_a_cell_has_no_node_id() {
    let now = Micros(100 * MS);
    let mut network = below(100, rank(1, 1));
    adopt(&mut network, now, 1, 7);
    adopt(&mut network, now, 2, 8);
    let unnumbered = |network: &mut Network, port, unnumbered| {
        network.handle_message(
            now,
            port,
            PortMessage::Hello(Hello { is_parent: true, unnumbered, ..neighbour(8, None) }),
        );
        let announced = said(network).into_iter().find_map(|said| {
            let (0, PortMessage::Hello(hello)) = said else { return None };
            Some(hello.unnumbered)
        });
        (network.lacks_node_ids(), announced)
    };
    assert_eq!(unnumbered(&mut network, 2, false), (false, None));
    assert_eq!(unnumbered(&mut network, 3, true), (false, None), "no child");
    assert_eq!(unnumbered(&mut network, 2, true), (true, Some(true)));
    let walk = NodeIdWalk { walk: 1, first: 20, last: 30 };
    network.handle_message(now, 0, PortMessage::NodeId(walk));
    assert_eq!(said(&mut network), [(2, PortMessage::NodeId(walk))]);
    let rest = NodeIdWalk { first: 21, ..walk };
    network.handle_message(now, 2, PortMessage::Return(rest));
    assert_eq!(said(&mut network), [(0, PortMessage::Return(rest))]);
    assert_eq!(unnumbered(&mut network, 2, false), (false, Some(false)));
}
