//! The gateway's ends of the wires that connect it to the roots of a bus.

use std::time::{Duration, Instant};

use protocol::bus::{Bus, Filter};
use protocol::can::{EXTENDED, Frame, REMOTE};
use protocol::id::{CellId, Id, Kind, Node};
use protocol::packet;
use protocol::port::{LinkId, WIRE_FLAG};
use protocol::skin::{Skin, SkinReply};
use protocol::time::Micros;

use model::network::Uplinks;

/// The wires to the roots of a bus, and the protocol on them.
#[derive(Debug)]
pub struct RootWires {
    uplinks: Uplinks,
    /// Each root, the link on which the gateway sends to it, and true while its sums are for the gateway.
    roots: Vec<(CellId, LinkId, bool)>,
    began: Instant,
    /// True once the gateway sends on the wires. If it sends before all cells are present, the first cells build a tree
    /// that is deeper than necessary.
    is_sending: bool,
}

/// Returns the roots of a bus and the links on which the gateway sends to them. The list is empty if cells answer with
/// their own torques.
fn root_links(skin: &Skin, bus: usize) -> Vec<(CellId, LinkId)> {
    let sums = skin.buses.get(bus).is_some_and(|bus| bus.reply != SkinReply::Torque);
    if sums { skin.wires(bus).roots_with_link_ids().collect() } else { Vec::new() }
}

/// Selection of the frames that a gateway receives from a bus.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct ReceiveFilter {
    /// Filters of the gateway's socket.
    pub filters: Vec<Filter>,
    /// True if sums of cells other than roots pass.
    pub all_sums: bool,
}

impl ReceiveFilter {
    /// Creates the filter of a bus. It passes all frames, with two exceptions: of simulated wires, only frames to the
    /// gateway pass; of sums, only those of roots pass, unless `everything` is set.
    #[must_use]
    pub fn for_bus(skin: &Skin, bus: usize, everything: bool) -> Self {
        let roots = root_links(skin, bus);
        if roots.is_empty() {
            return Self { filters: vec![Filter::ALL], all_sums: true };
        }
        let standard = |id, mask| Filter { id, mask: mask | EXTENDED };
        let sums_of_roots = || {
            // All kinds except sums, remote frames of any kind, and each root's sums.
            let kinds = [standard(0x000, 0x700), standard(0x200, 0x600), standard(0x400, 0x400)];
            let remote = Filter { id: REMOTE, mask: EXTENDED | REMOTE };
            let roots = roots.iter().map(|(root, _)| Filter::exact(Id::new(Kind::Sum, Node::Cell(*root))));
            kinds.into_iter().chain([remote]).chain(roots).collect::<Vec<_>>()
        };
        // 29-bit identifiers that belong to no wire are foreign; they pass so that they are counted.
        let foreign = Filter { id: EXTENDED, mask: EXTENDED | WIRE_FLAG };
        let wires = roots.iter().map(|(_, link_id)| Filter::for_link(link_id.reversed()));
        let others: Vec<_> = [foreign].into_iter().chain(wires).collect();
        let few = sums_of_roots();
        let all_sums = everything || few.len() + others.len() > Filter::MAX_COUNT;
        let standard = if all_sums { vec![standard(0, 0)] } else { few };
        Self { filters: standard.into_iter().chain(others).collect(), all_sums }
    }
}

impl RootWires {
    /// The roots of a bus, or `None` if its cells answer with their own torques.
    #[must_use]
    pub fn for_bus(skin: &Skin, bus: usize) -> Option<Self> {
        let roots: Vec<_> =
            root_links(skin, bus).into_iter().map(|(root, link_id)| (root, link_id, false)).collect();
        // An earlier gateway may have used any walk number, and successive process ids are often adjacent. The factor
        // spreads the first number.
        let walk = std::process::id().wrapping_mul(37).to_le_bytes()[0];
        (!roots.is_empty()).then(|| Self {
            uplinks: Uplinks::new(roots.len(), walk, Micros(0)),
            roots,
            began: Instant::now(),
            is_sending: false,
        })
    }

    /// Filters for the wire frames that come from the roots.
    pub fn filters(&self) -> impl Iterator<Item = Filter> {
        self.roots.iter().map(|(_, link_id, _)| Filter::for_link(link_id.reversed()))
    }

    /// Starts sending on the wires.
    pub const fn start_sending(&mut self) {
        self.is_sending = true;
    }

    /// Returns the roots that have started (true) or stopped (false) sending their sums to the gateway since the last
    /// call. At first none does.
    pub fn uplink_changes(&mut self) -> impl Iterator<Item = (CellId, bool)> {
        let uplinks = &self.uplinks;
        self.roots.iter_mut().enumerate().filter_map(|(place, (root, _, feeds))| {
            let now = uplinks.is_gateway_child(place);
            (core::mem::replace(feeds, now) != now).then_some((*root, now))
        })
    }

    fn now(&self) -> Micros {
        Micros::from_elapsed(self.began.elapsed())
    }

    /// Handles a frame from the bus. Returns true if it was a wire frame, which only this type handles.
    pub fn handle_frame(&mut self, frame: &Frame) -> bool {
        let Some(link_id) = LinkId::from_raw_id(frame.raw_id()) else {
            if let Ok(Id { kind: Kind::Network, node }) = packet::data_frame_id(frame)
                && let Node::Cell(cell) = Node::from_byte(node)
            {
                self.uplinks.mark_node_id_used(cell);
            }
            return false;
        };
        let root = self.roots.iter().position(|(_, own, _)| own.reversed() == link_id);
        if let Some((root, message)) =
            root.filter(|_| self.is_sending).and_then(|root| Some((root, link_id.decode_frame(frame)?)))
        {
            let now = self.now();
            self.uplinks.handle_message(now, root, message);
        }
        true
    }

    /// Sends the messages that are due on the wires to the roots.
    pub fn send_due_messages(&mut self, bus: &Bus) {
        if !self.is_sending {
            return;
        }
        let now = self.now();
        self.uplinks.handle_time(now);
        while let Some((root, message)) = self.uplinks.poll_transmit() {
            if let Some((_, link_id, _)) = self.roots.get(root) {
                // If the bus refuses a message, the root asks for it again.
                let _ = bus.try_send_all(&[link_id.encode_frame(message)]);
            }
        }
    }

    /// Returns the time in which the next message on the wires becomes due, if no frame arrives before.
    #[must_use]
    pub fn next_message_timeout(&self) -> Duration {
        if !self.is_sending {
            return Duration::MAX;
        }
        Duration::from_micros(self.uplinks.poll_timeout().elapsed_since(self.now()).0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::Format;
    use protocol::message::{Message, VERSION};
    use protocol::packet::Epoch;
    use protocol::port::{Hello, TreeRank};

    fn skin(reply: &str) -> Skin {
        let head = model::testing::ONE_CELL_SKIN_TOML.replace("reply = \"torque\"", reply);
        let (head, cell) = head.split_at(head.find("[[cell]]").unwrap());
        let second = cell.replace("node = 1", "node = 2\nneighbors = [1, 0, 0, 0]");
        let first = cell.replace("node = 1", "node = 1\nroot = true\nneighbors = [2, 0, 0, 0]");
        Skin::parse("skin.toml", &format!("{head}{first}{second}")).unwrap()
    }

    fn passes(receive_filter: &ReceiveFilter, frame: &Frame) -> bool {
        let id = frame.raw_id();
        receive_filter.filters.iter().any(|filter| id & filter.mask == filter.id & filter.mask)
    }

    fn sum(node: i64) -> Frame {
        let message = Message::Sum {
            from: CellId::new(node).unwrap(),
            epoch: Epoch(0),
            torque: Default::default(),
            count: 1,
        };
        message.encode().frames(Format::Fd).next().unwrap()
    }

    #[test]
    fn a_gateway_takes_sums_of_roots_and_its_own_wires_and_all_that_is_no_wire() {
        let skin = skin("reply = \"sum\"\nslot_us = 1500");
        // Wire 0 connects the two cells; wire 1 connects the root to the gateway.
        let wire = |wire, back| LinkId { wire, back }.encode_frame(protocol::port::PortMessage::Join);
        for everything in [false, true] {
            let receive_filter = ReceiveFilter::for_bus(&skin, 0, everything);
            assert_eq!(receive_filter.all_sums, everything);
            assert!(passes(&receive_filter, &sum(1)) && passes(&receive_filter, &wire(1, false)));
            assert_eq!(passes(&receive_filter, &sum(2)), everything);
            for other in [wire(0, false), wire(0, true), wire(1, true)] {
                assert!(!passes(&receive_filter, &other), "{other:?}");
            }
            for kind in [0, 2, 3, 4, 5, 6, 7] {
                let frame = Frame::classic(kind << 8 | 2, &[]).unwrap();
                assert!(passes(&receive_filter, &frame), "kind {kind}");
            }
            for foreign in [EXTENDED | 0x0FFF_FFFF, REMOTE | 0x102, EXTENDED | REMOTE | 5] {
                let frame = if foreign & REMOTE == 0 {
                    Frame::classic(foreign, &[]).unwrap()
                } else {
                    Frame::remote(foreign & !REMOTE, 0).unwrap()
                };
                assert!(passes(&receive_filter, &frame), "{foreign:08X}");
            }
        }
        let torque = ReceiveFilter::for_bus(&self::skin("reply = \"torque\""), 0, false);
        assert_eq!(torque, ReceiveFilter { filters: vec![Filter::ALL], all_sums: true });
    }

    #[test]
    fn a_roots_request_is_answered_and_wire_frames_are_kept_from_the_table() {
        let skin = skin("reply = \"sum\"\nslot_us = 1500");
        let mut roots = RootWires::for_bus(&skin, 0).unwrap();
        let leave = LinkId { wire: 1, back: false }.encode_frame(protocol::port::PortMessage::Leave);
        assert!(roots.handle_frame(&leave));
        assert_eq!(roots.uplinks.poll_transmit(), None, "it does not send yet");
        roots.start_sending();
        assert!(
            roots.handle_frame(
                &LinkId { wire: 0, back: false }.encode_frame(protocol::port::PortMessage::Join)
            )
        );
        assert_eq!(roots.uplinks.poll_transmit(), None);
        assert!(
            roots.handle_frame(
                &LinkId { wire: 1, back: false }.encode_frame(protocol::port::PortMessage::Join)
            )
        );
        let answer = roots.uplinks.poll_transmit();
        assert!(matches!(answer, Some((0, protocol::port::PortMessage::Grant(_)))), "{answer:?}");
        let root = CellId::new(1).unwrap();
        assert_eq!(roots.uplink_changes().collect::<Vec<_>>(), [], "a grant may be lost");
        let hello = Hello {
            version: VERSION,
            number: 1,
            port: 4,
            receives: true,
            is_parent: true,
            unnumbered: false,
            rank: Some(TreeRank { round: 1, depth: 1 }),
        };
        assert!(roots.handle_frame(
            &LinkId { wire: 1, back: false }.encode_frame(protocol::port::PortMessage::Hello(hello))
        ));
        assert_eq!(roots.uplink_changes().collect::<Vec<_>>(), [(root, true)]);
        assert_eq!(roots.uplink_changes().collect::<Vec<_>>(), []);
        assert!(roots.handle_frame(&leave));
        assert_eq!(roots.uplink_changes().collect::<Vec<_>>(), [(root, false)]);
        assert!(!roots.handle_frame(&sum(1)));
        assert!(RootWires::for_bus(&self::skin("reply = \"torque\""), 0).is_none());
    }
}
