//! Separates the traffic on a bench's bus: frames that a real bus carries, too, and frames of the bench only.
//!
//! A real bus carries joints, answers, sensors, heartbeats, the tree's messages, commands and configuration. Only a
//! bench sends stimuli, sync and report with their answers, and simulated wires between cells.

use protocol::can::{Format, Frame};
use protocol::id::{CellId, Node};
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::Epoch;
use protocol::packets::{NoPacketReason, PacketReader};
use protocol::port::wire_message;
use protocol::time::Micros;
use serde::Serialize;

/// The kinds of frames that only a bench sends, and a real robot does not.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum BenchFrame {
    /// Stimuli.
    Stimulus,
    /// Sync, and the heartbeats that answer it.
    Sync,
    /// Report, and the pages that answer it.
    Report,
    /// A message over a simulated wire between cells.
    Wire,
}

/// Counts of frames that only a bench sends.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq, Serialize)]
pub struct BenchFrames {
    /// Stimuli.
    pub stimuli: u64,
    /// Sync and its answers.
    pub syncs: u64,
    /// Report and its answers.
    pub reports: u64,
    /// Simulated wires.
    pub wires: u64,
}

impl BenchFrames {
    /// Adds a number of frames of one kind.
    pub const fn count_frames(&mut self, what: BenchFrame, frames: u64) {
        match what {
            BenchFrame::Stimulus => self.stimuli += frames,
            BenchFrame::Sync => self.syncs += frames,
            BenchFrame::Report => self.reports += frames,
            BenchFrame::Wire => self.wires += frames,
        }
    }

    /// Returns the total.
    #[must_use]
    pub const fn total(&self) -> u64 {
        self.stimuli + self.syncs + self.reports + self.wires
    }
}

/// The role of a frame in the course of a run.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum RunEvent {
    /// The frame has no effect on the course of the run.
    Other,
    /// Joints with this epoch.
    Joints(Epoch),
    /// A torque or a sum that answers the joints of this epoch.
    Answer(Epoch),
    /// A command by which cells stop answering.
    Halt,
    /// A command by which cells answer again.
    Resume,
    /// A frame from before the first joints: address claims, parameter writes and reads, report commands.
    Preparation,
}

/// A frame, sorted into bench traffic and the traffic of a real bus.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct ClassifiedFrame {
    /// The role of the frame in the run.
    pub says: RunEvent,
    /// The kind of bench frame; `None` if a real bus carries the frame, too.
    pub bench: Option<BenchFrame>,
    /// The sending cell, if the frame ends a packet.
    pub from: Option<CellId>,
    /// True if the frame ends a packet of two classic frames: the previous frame with its identifier belongs to the
    /// same class.
    pub ends_pair: bool,
}

impl ClassifiedFrame {
    const OTHER_FRAME: Self = Self { says: RunEvent::Other, bench: None, from: None, ends_pair: false };
}

/// Classifies the frames of one bus in order, with bounded memory.
#[derive(Debug, Default)]
pub struct TrafficClassifier {
    /// Number of frames in valid packets, and of 11-bit data frames that are not packets.
    ours: u64,
    others: u64,
    packets: PacketReader,
    /// Answers that each cell still owes to the bench's sync and report commands.
    owed: Vec<PendingReplies>,
}

/// The outstanding replies of a cell to sync and report. The cell also sends messages of these kinds unrequested.
#[derive(Clone, Copy, Debug, Default)]
struct PendingReplies {
    heartbeat: bool,
    tree: bool,
    /// Bit n is set for page n of the sensors.
    sensors: u8,
}

impl TrafficClassifier {
    /// Returns true if most of the frames that may be packets are packets of this protocol; a random frame is one with
    /// probability 1/65 536.
    #[must_use]
    pub const fn is_skin_traffic(&self) -> bool {
        self.ours > self.others
    }

    /// Classifies the next frame. On a bus of another protocol no frame counts as the bench's. Never panics.
    pub fn classify(&mut self, nanos: u64, frame: &Frame) -> ClassifiedFrame {
        let received = self.packets.read(Micros(nanos / 1_000), frame);
        let packet = match received.packet {
            Ok((packet, _)) => packet,
            Err(NoPacketReason::NotData) => {
                let bench = wire_message(frame).map(|_| BenchFrame::Wire);
                return ClassifiedFrame { bench, ..ClassifiedFrame::OTHER_FRAME };
            }
            Err(NoPacketReason::Segment(_)) => return ClassifiedFrame::OTHER_FRAME,
            Err(NoPacketReason::AfterLost(_) | NoPacketReason::Damaged(..)) => {
                self.others += 1;
                return ClassifiedFrame::OTHER_FRAME;
            }
        };
        let is_classic = frame.format() == Format::Classic;
        self.ours += if is_classic { packet.words.length().segments() as u64 } else { 1 };
        match received.message() {
            Some(message) if self.is_skin_traffic() => ClassifiedFrame {
                ends_pair: is_classic,
                from: packet.id.sender(),
                ..self.classify_message(message)
            },
            _ => ClassifiedFrame::OTHER_FRAME,
        }
    }

    fn classify_message(&mut self, message: &Message) -> ClassifiedFrame {
        let says = |says| ClassifiedFrame { says, ..ClassifiedFrame::OTHER_FRAME };
        let bench = |bench| ClassifiedFrame { bench: Some(bench), ..ClassifiedFrame::OTHER_FRAME };
        match message {
            Message::Joints { epoch, .. } => says(RunEvent::Joints(*epoch)),
            Message::Torque { epoch, .. } | Message::Sum { epoch, .. } => says(RunEvent::Answer(*epoch)),
            Message::Halt => says(RunEvent::Halt),
            Message::Resume => says(RunEvent::Resume),
            Message::Configure { .. } | Message::Configured { .. } => says(RunEvent::Preparation),
            Message::Stimulus { .. } => bench(BenchFrame::Stimulus),
            Message::Sync => {
                self.pending_by_cell().iter_mut().for_each(|owed| owed.heartbeat = true);
                bench(BenchFrame::Sync)
            }
            Message::Report => ClassifiedFrame { says: RunEvent::Preparation, ..bench(BenchFrame::Report) },
            Message::Sensors { from, page, .. } if page.simulated_index().is_some() => {
                self.classify_page(*from, |owed| {
                    let bit = 1 << page.number();
                    let is_owed = owed.sensors & bit != 0;
                    owed.sensors &= !bit;
                    is_owed
                })
            }
            Message::Sensors { .. } => ClassifiedFrame::OTHER_FRAME,
            Message::Network { from, page, .. } => {
                let Node::Cell(from) = *from else { return ClassifiedFrame::OTHER_FRAME };
                if let NetworkPage::Heartbeat(heartbeat) = page {
                    let owed = self.take_pending_replies(from);
                    // A starting cell leaves sync and report unanswered.
                    if heartbeat.state.has(State::CLAIMING_NODE_ID) {
                        says(RunEvent::Preparation)
                    } else if owed.heartbeat {
                        bench(BenchFrame::Sync)
                    } else {
                        ClassifiedFrame::OTHER_FRAME
                    }
                } else if page.is_sent_only_on_request() {
                    // The pages that are also sent at other times follow the counters.
                    if let (NetworkPage::Received(_) | NetworkPage::Rejected(_), Some(owed)) =
                        (page, self.pending_by_cell().get_mut(from.index()))
                    {
                        (owed.sensors, owed.tree) = (u8::MAX, true);
                    }
                    bench(BenchFrame::Report)
                } else {
                    self.classify_page(from, |owed| std::mem::take(&mut owed.tree))
                }
            }
        }
    }

    /// Classifies a page that a cell sends on a report command and also at other times.
    fn classify_page(
        &mut self,
        from: CellId,
        take: impl FnOnce(&mut PendingReplies) -> bool,
    ) -> ClassifiedFrame {
        let is_owed = self.pending_by_cell().get_mut(from.index()).is_some_and(take);
        ClassifiedFrame { bench: is_owed.then_some(BenchFrame::Report), ..ClassifiedFrame::OTHER_FRAME }
    }

    /// Returns the answers that a cell still owes, and clears them.
    fn take_pending_replies(&mut self, from: CellId) -> PendingReplies {
        self.pending_by_cell().get_mut(from.index()).map(std::mem::take).unwrap_or_default()
    }

    fn pending_by_cell(&mut self) -> &mut [PendingReplies] {
        self.owed.resize(CellId::COUNT, PendingReplies::default());
        &mut self.owed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::message::{Heartbeat, ReceivedCounts, RejectedCounts, SensorPage, SkinSensors, TreePage};

    fn said(traffic: &mut TrafficClassifier, format: Format, message: &Message) -> Vec<Option<BenchFrame>> {
        message.encode().frames(format).map(|frame| traffic.classify(0, &frame).bench).collect()
    }

    fn page(from: i64, page: NetworkPage) -> Message {
        Message::Network { from: Node::Cell(CellId::new(from).unwrap()), epoch: Epoch(0), page }
    }

    fn heartbeat(from: i64, state: State) -> Message {
        page(from, NetworkPage::Heartbeat(Heartbeat { state, ..Heartbeat::default() }))
    }

    fn skin(from: i64) -> Message {
        let page = SensorPage::Skin(SkinSensors::default());
        Message::Sensors { from: CellId::new(from).unwrap(), epoch: Epoch(0), page }
    }

    #[test]
    fn what_answers_a_sync_or_a_report_is_the_benchs_once_and_what_comes_by_itself_is_not() {
        for format in [Format::Fd, Format::Classic] {
            let mut traffic = TrafficClassifier::default();
            let mut last = |message: &Message| *said(&mut traffic, format, message).last().unwrap();
            let (alive, tree) =
                (heartbeat(1, State::CONFIGURED), page(1, NetworkPage::Tree(TreePage::default())));
            assert_eq!([last(&alive), last(&skin(1)), last(&tree)], [None; 3]);
            assert_eq!(last(&Message::Sync), Some(BenchFrame::Sync));
            assert_eq!(last(&heartbeat(2, State::CLAIMING_NODE_ID)), None, "it leaves sync unanswered");
            assert_eq!([last(&alive), last(&alive)], [Some(BenchFrame::Sync), None]);
            assert_eq!(last(&heartbeat(2, State::CONFIGURED)), None);
            assert_eq!(last(&Message::Report), Some(BenchFrame::Report));
            assert_eq!(last(&skin(1)), None, "before the answers begin");
            for page_of_one in [
                NetworkPage::Received(ReceivedCounts::default()),
                NetworkPage::Rejected(RejectedCounts::default()),
            ] {
                assert_eq!(last(&page(1, page_of_one)), Some(BenchFrame::Report));
            }
            assert_eq!(
                [last(&skin(1)), last(&skin(1)), last(&skin(2))],
                [Some(BenchFrame::Report), None, None]
            );
            assert_eq!([last(&tree), last(&tree)], [Some(BenchFrame::Report), None]);
            // A cell without ports sends no tree; its next one is unrequested.
            last(&page(1, NetworkPage::Rejected(RejectedCounts::default())));
            assert_eq!([last(&alive), last(&tree)], [None; 2]);
        }
    }

    #[test]
    fn a_first_segment_says_nothing_and_the_second_one_all_of_it() {
        let mut traffic = TrafficClassifier::default();
        let stimulus = Message::Stimulus {
            to: Node::Everyone,
            from: protocol::message::StimulusStart::Next,
            page: SensorPage::Skin(SkinSensors::default()),
        };
        assert_eq!(said(&mut traffic, Format::Classic, &stimulus), [None, Some(BenchFrame::Stimulus)]);
        let torque = skin(9).encode();
        let sorted: Vec<_> =
            torque.frames(Format::Classic).map(|frame| traffic.classify(0, &frame)).collect();
        assert_eq!((sorted[0].from, sorted[0].ends_pair), (None, false));
        assert_eq!((sorted[1].from, sorted[1].ends_pair), (CellId::new(9).ok(), true));
    }

    proptest! {
        #[test]
        fn chance_makes_no_bench(frames in proptest::collection::vec((0..0x800_u32, any::<[u8; 16]>(), any::<bool>()), 0..400)) {
            let mut traffic = TrafficClassifier::default();
            // The first frame alone would be accepted with probability 1/65 536.
            let unknown_node = Frame::classic(0x700, &[1]).unwrap();
            (0..4).for_each(|_| assert_eq!(traffic.classify(0, &unknown_node), ClassifiedFrame::OTHER_FRAME));
            for (id, data, is_fd) in frames {
                let frame = if is_fd {
                    Frame::with_data(id, Format::Fd, protocol::can::FD_FORMAT, &data)
                } else {
                    Frame::classic(id, data.get(..8).unwrap())
                };
                prop_assert_eq!(traffic.classify(0, &frame.unwrap()).bench, None);
            }
        }
    }
}
