//! Complete benches on which another sender sends unexpected frames: the accounts stay exact, and no cell's torque
//! changes.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use model::table::Replies;
use protocol::can::{ERROR, EXTENDED, Format, Frame};
use protocol::id::{CellId, Id, Kind, Node};
use protocol::message::{
    Answer, Heartbeat, Message, NetworkPage, PortsPage, ReceivedCounts, RejectedCounts, Request, SensorPage,
    State, TreePage,
};
use protocol::packet::{Epoch, Packet};
use protocol::parameters::Parameter;
use protocol::time::Span;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench, touch};
use skinbus_tests::gateway::epoch_of;
use skinbus_tests::skins;

const CELLS: u8 = 4;
const FRAMES: u32 = 400;

/// The kinds of unexpected frames.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum HostileFrame {
    /// Frames of other protocols.
    Foreign,
    Extended,
    Remote,
    ErrorFrame,
    /// Under a cell's identifier, but not a packet.
    WrongChecksum,
    WrongLength,
    HalfPacket,
    /// Under a cell's node id.
    OldHeartbeat,
    HeartbeatAhead,
    LastHeartbeatAgain,
    HeartbeatOfAnother,
    Claim,
    ClaimOfAnother,
    StaleTorque,
    Sensors,
    Counters,
    Place,
    Answer,
    Sum,
    /// From nodes that the skin does not have.
    UnknownNode,
    /// From a gateway or a command line.
    Requests,
    GatewaysHeartbeat,
}

const ALL: [HostileFrame; 22] = [
    HostileFrame::Foreign,
    HostileFrame::Extended,
    HostileFrame::Remote,
    HostileFrame::ErrorFrame,
    HostileFrame::WrongChecksum,
    HostileFrame::WrongLength,
    HostileFrame::HalfPacket,
    HostileFrame::OldHeartbeat,
    HostileFrame::HeartbeatAhead,
    HostileFrame::LastHeartbeatAgain,
    HostileFrame::HeartbeatOfAnother,
    HostileFrame::Claim,
    HostileFrame::ClaimOfAnother,
    HostileFrame::StaleTorque,
    HostileFrame::Sensors,
    HostileFrame::Counters,
    HostileFrame::Place,
    HostileFrame::Answer,
    HostileFrame::Sum,
    HostileFrame::UnknownNode,
    HostileFrame::Requests,
    HostileFrame::GatewaysHeartbeat,
];

impl HostileFrame {
    /// Returns true if the gateway counts it as a packet of the cell whose node id it has.
    fn is_of_a_cell(self) -> bool {
        use HostileFrame::*;
        let none = [Foreign, Extended, Remote, ErrorFrame, UnknownNode, Requests, GatewaysHeartbeat];
        !none.contains(&self)
    }

    /// Returns true for a heartbeat that is not the cell's own.
    fn is_an_outsider(self) -> bool {
        use HostileFrame::*;
        [OldHeartbeat, HeartbeatAhead, HeartbeatOfAnother, Claim, ClaimOfAnother].contains(&self)
    }

    fn act(self, bench: &Bench, dice: &mut Pcg64Mcg, place: usize) -> Act {
        let cell = &bench.gateway.table.cells()[place];
        let (from, own) = (cell.node, cell.heartbeat().unwrap());
        let epoch = epoch_of(bench.gateway.broadcasts() - 1);
        let network = |page| Act::Inject(Message::Network { from: Node::Cell(from), epoch, page });
        let beat = |heartbeat| network(NetworkPage::Heartbeat(heartbeat));
        let settled = Heartbeat { state: own.state, ..own };
        let words: [i16; 6] = dice.random();
        let frame = |kind: Kind, node: u8, format| {
            let packet = Packet { id: Id { kind, node }, words: [3; 6].into(), epoch, count: 6 };
            packet.frames(format).next().unwrap()
        };
        match self {
            Self::Foreign => Act::InjectFrame(Frame::classic(0x0F1, &dice.random::<[u8; 8]>()).unwrap()),
            Self::Extended => Act::InjectFrame(Frame::classic(0x18F0_0400 | EXTENDED, &[1, 2, 3]).unwrap()),
            Self::Remote => {
                Act::InjectFrame(Frame::remote(frame(Kind::Torque, from.get(), Format::Fd).id(), 8).unwrap())
            }
            Self::ErrorFrame => {
                Act::InjectFrame(Frame::classic(0x4 | ERROR, &[0, 0x20, 0, 0, 0, 0, 96, 0]).unwrap())
            }
            Self::WrongChecksum => {
                let torque = frame(Kind::Torque, from.get(), Format::Fd);
                let mut data = [0; 16];
                data.copy_from_slice(torque.data());
                data[3] ^= 0x10;
                Act::InjectFrame(Frame::fd(torque.id(), 0, &data).unwrap())
            }
            Self::WrongLength => Act::InjectFrame(
                Frame::fd(frame(Kind::Torque, from.get(), Format::Fd).id(), 0, &[7; 12]).unwrap(),
            ),
            Self::HalfPacket => Act::InjectFrame(frame(Kind::Torque, from.get(), Format::Classic)),
            Self::OldHeartbeat => beat(Heartbeat { sent: own.sent.wrapping_sub(1_000), ..settled }),
            Self::HeartbeatAhead => beat(Heartbeat { sent: own.sent.wrapping_add(9_000), ..settled }),
            Self::LastHeartbeatAgain => beat(settled),
            Self::HeartbeatOfAnother => {
                beat(Heartbeat { serial: bench.cell_slots[place].identity.serial ^ 0x5A5A, ..settled })
            }
            Self::Claim => beat(Heartbeat { sent: 0, state: State::CLAIMING_NODE_ID, ..own }),
            Self::ClaimOfAnother => {
                beat(Heartbeat { serial: own.serial - 1, sent: 0, state: State::CLAIMING_NODE_ID, ..own })
            }
            Self::StaleTorque => Act::Inject(Message::Torque {
                from,
                epoch: Epoch(epoch.0.wrapping_sub(9)),
                torque: words.into(),
            }),
            Self::Sensors => {
                Act::Inject(Message::Sensors { from, epoch, page: SensorPage::Skin(touch(3.0)) })
            }
            Self::Counters if dice.random() => network(NetworkPage::Received(ReceivedCounts::default())),
            Self::Counters => {
                network(NetworkPage::Rejected(RejectedCounts { crc: 9, ..RejectedCounts::default() }))
            }
            Self::Place if dice.random() => network(NetworkPage::Tree(TreePage::default())),
            Self::Place => network(NetworkPage::Ports(PortsPage::default())),
            Self::Answer => {
                let answer = Answer::Value { number: Parameter::Reply.number(), written: true, words };
                Act::Inject(Message::Configured { from, tag: 3, answer })
            }
            Self::Sum => Act::Inject(Message::Sum { from, epoch, torque: words.into(), count: 3 }),
            Self::UnknownNode => {
                let from = Node::Cell(CellId::new(200).unwrap());
                Act::Inject(Message::Network { from, epoch, page: NetworkPage::Heartbeat(settled) })
            }
            Self::Requests if dice.random() => Act::Inject(Message::Sync),
            Self::Requests if dice.random() => Act::Inject(Message::Report),
            Self::Requests => {
                let request = Request::Read { number: Parameter::Identity.number() };
                Act::Inject(Message::Configure { to: Node::Cell(from), tag: 7, request })
            }
            Self::GatewaysHeartbeat => {
                let page = NetworkPage::Heartbeat(Heartbeat::default());
                Act::Inject(Message::Network { from: Node::Gateway, epoch, page })
            }
        }
    }
}

#[test]
fn no_frame_that_somebody_sends_changes_an_account_or_a_torque() {
    for (seed, what) in (0..).zip(ALL) {
        let mut bench = Bench::new(&skins::arm(CELLS, Format::Fd), seed).started();
        (0..CELLS).for_each(|place| bench.press(place.into(), 1.0 + 0.2 * f64::from(place)));
        bench.run_epochs(20);
        bench.oracle.compares = false;
        let mut dice = Pcg64Mcg::seed_from_u64(seed);
        let mut sent = [0; CELLS as usize];
        for _ in 0..FRAMES {
            let place = dice.random_range(0..usize::from(CELLS));
            sent[place] += 1;
            let act = what.act(&bench, &mut dice, place);
            bench.act(act);
            bench.run(Span(dice.random_range(0..20_000)));
        }
        // The next heartbeat of each cell comes.
        bench.run_epochs(30);
        bench.finish();
        accounts::check(&bench);
        let table = &bench.gateway.table;
        for (cell, sent) in table.cells().iter().zip(sent) {
            let uplink = cell.uplink();
            assert_eq!((uplink.lost, uplink.restarts, uplink.in_doubt), (0, 0, 0), "{what:?}: {uplink:?}");
            let forged = if what.is_of_a_cell() { sent } else { 0 };
            assert_eq!(uplink.surplus, forged, "{what:?}: {uplink:?}");
            let outsiders = if what.is_an_outsider() { sent } else { 0 };
            assert_eq!(uplink.outsiders, outsiders, "{what:?}: {uplink:?}");
            let Replies { due, in_time, missing, in_doubt, .. } = cell.replies;
            assert_eq!(missing, in_doubt, "{what:?}: {:?}", cell.replies);
            // Few replies are due of a cell whose contact became unknown by a second owner of its node id.
            assert!(due - in_time <= (due / 100).max(1), "{what:?}: {:?}", cell.replies);
        }
        assert!(table.accuracy().single.max() < 1e-3, "{what:?}: {:?}", table.accuracy());
    }
}
