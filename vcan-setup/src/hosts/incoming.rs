//! Frames from other hosts to the local bus: counts of the frames of each host, and the queue to the bus.

use std::collections::{BTreeMap, VecDeque};

use protocol::can::Frame;
use protocol::id::{CellId, Id};
use serde::{Deserialize, Serialize};

use super::message::{MessageError, MessageHeader, StampedFrame, decode};

/// The maximum number of frames in the queue to the bus.
pub const MAX_WAITING_FRAMES: usize = 8_192;
/// The maximum number of hosts. Without a limit, a host that changes its name again and again would use up the memory.
pub const MAX_SOURCES: usize = 256;

/// Counts of the frames that were received from one other host, the source.
/// `numbered` equals `before + dropped_there + lost + taken`.
/// `taken` equals `sent + copies + dropped_here + refused` plus the frames in the queue.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize)]
pub struct SourceAccount {
    /// Frames that the source has numbered since its first start that this host knows of.
    pub numbered: u64,
    /// Frames that the source numbered before this link first received from it, or before it restarted.
    pub before: u64,
    /// Frames dropped by the source because its queue was full.
    pub dropped_there: u64,
    /// Frames lost between the hosts.
    pub lost: u64,
    /// Frames received here.
    pub taken: u64,
    /// Frames that were sent to the local bus.
    pub sent: u64,
    /// Frames that were not sent to the bus, because they had gone around a circle of joined buses.
    #[serde(default)]
    pub copies: u64,
    /// Frames that were dropped here, because the queue to the bus was full.
    pub dropped_here: u64,
    /// Frames that the bus refused.
    pub refused: u64,
    /// Frames that were received a second time, and ignored.
    pub repeated: u64,
    /// Frames that the source's bus dropped before the source read them; they have no numbers.
    pub missed_there: u64,
    /// Messages from the source that could not be decoded.
    pub garbage: u64,
    /// The number of starts of the source that were observed.
    pub lives: u64,
    /// The number of these starts that returned to the previous one: two hosts then have the same name.
    pub shared: u64,
}

impl SourceAccount {
    /// Returns the number of frames that were not sent to the local bus, wherever they were lost.
    #[must_use]
    pub fn missing_frame_count(&self) -> u64 {
        [self.dropped_there, self.lost, self.missed_there, self.dropped_here, self.refused]
            .into_iter()
            .fold(0, u64::saturating_add)
    }
}

/// A set of node ids: the cells whose frames came from a host.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct NodeSet([u64; 4]);

impl NodeSet {
    fn add_sender(&mut self, frame: &Frame) {
        let id = u16::try_from(frame.id()).ok().filter(|_| !frame.is_extended() && !frame.is_error());
        let Some(cell) = id.and_then(|id| Id::from_bits(id).sender()) else { return };
        let (word, bit) = (cell.get() / 64, cell.get() % 64);
        if let Some(word) = self.0.get_mut(usize::from(word)) {
            *word |= 1 << bit;
        }
    }

    /// Returns the node ids in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = CellId> {
        let is_in = |cell: &CellId| {
            self.0.get(usize::from(cell.get() / 64)).is_some_and(|word| word >> (cell.get() % 64) & 1 == 1)
        };
        CellId::all().filter(is_in)
    }
}

/// Adds to a counter without overflow. The number comes from another host and may have any value.
const fn add_saturating(counter: &mut u64, more: u64) {
    *counter = counter.saturating_add(more);
}

#[derive(Debug, Default)]
struct SourceState {
    head: MessageHeader,
    /// The number that the source's next frame should have.
    next: u64,
    /// The random number of the source's previous start.
    before: Option<u64>,
    account: SourceAccount,
    nodes: NodeSet,
}

impl SourceState {
    /// Counts the frames of a message with this header. Returns how many of its first frames were received before.
    fn count_message(&mut self, head: &MessageHeader, count: u64) -> u64 {
        let account = &mut self.account;
        if account.lives == 0 || self.head.life != head.life {
            account.lives += 1;
            add_saturating(&mut account.numbered, head.first);
            add_saturating(&mut account.before, head.first);
            account.shared += u64::from(self.before == Some(head.life));
            self.before = (account.lives > 1).then_some(self.head.life);
            (self.head, self.next) = (*head, head.first);
        }
        let end = head.first + count;
        let again = self.next.saturating_sub(head.first).min(count);
        account.repeated += again;
        if end <= self.next {
            return again;
        }
        let missing = head.first.saturating_sub(self.next);
        let there = head.dropped.saturating_sub(self.head.dropped).min(missing);
        add_saturating(&mut account.dropped_there, there);
        add_saturating(&mut account.lost, missing - there);
        add_saturating(&mut account.missed_there, head.missed.saturating_sub(self.head.missed));
        account.taken += count - again;
        add_saturating(&mut account.numbered, end - self.next);
        (self.head, self.next) = (*head, end);
        again
    }
}

/// Counts and queued frames of all other hosts.
#[derive(Debug, Default)]
pub struct HostsToBusQueue {
    /// The counts of each host, by its name.
    sources: BTreeMap<String, SourceState>,
    waiting: VecDeque<Frame>,
    /// The hosts that the queued frames came from: each entry is a host and the number of consecutive frames.
    runs: VecDeque<(String, usize)>,
    /// The number of messages from hosts beyond [`MAX_SOURCES`].
    unknown_hosts: u64,
    frames: Vec<StampedFrame>,
}

impl HostsToBusQueue {
    /// Decodes a message of a host, counts its frames, and queues them for the bus.
    ///
    /// # Errors
    /// Returns [`MessageError`] if the message is invalid; it is counted.
    pub fn receive_message(&mut self, host: &str, bytes: &[u8]) -> Result<(), MessageError> {
        if !self.sources.contains_key(host) {
            if self.sources.len() >= MAX_SOURCES {
                self.unknown_hosts += 1;
                return Ok(());
            }
            self.sources.insert(host.to_owned(), SourceState::default());
        }
        let Some(source) = self.sources.get_mut(host) else { return Ok(()) };
        self.frames.clear();
        let head = decode(bytes, &mut self.frames).inspect_err(|_| source.account.garbage += 1)?;
        let again = source.count_message(&head, self.frames.len() as u64);
        let new = self.frames.iter().skip(usize::try_from(again).unwrap_or(usize::MAX));
        new.clone().for_each(|stamped| source.nodes.add_sender(&stamped.frame));
        let room = MAX_WAITING_FRAMES.saturating_sub(self.waiting.len());
        let before = self.waiting.len();
        self.waiting.extend(new.clone().take(room).map(|stamped| stamped.frame));
        let added = self.waiting.len() - before;
        source.account.dropped_here += (new.len() - added) as u64;
        match self.runs.back_mut() {
            Some((last, count)) if last == host => *count += added,
            _ if added > 0 => self.runs.push_back((host.to_owned(), added)),
            _ => {}
        }
        Ok(())
    }

    /// Returns the oldest frames in the queue. The queue is a ring buffer, so these may not be all frames.
    #[must_use]
    pub fn waiting_frames(&self) -> &[Frame] {
        self.waiting.as_slices().0
    }

    /// Removes the first `count` frames, which were sent to the bus.
    pub fn remove_sent(&mut self, count: usize) {
        self.remove_first(count, |account, count| account.sent += count);
    }

    /// Removes the first `count` frames. They are copies that went around a circle, and are not sent.
    pub fn remove_copies(&mut self, count: usize) {
        self.remove_first(count, |account, count| account.copies += count);
    }

    /// Removes the first `count` frames, which the bus refused.
    pub fn remove_refused(&mut self, count: usize) {
        self.remove_first(count, |account, count| account.refused += count);
    }

    fn remove_first(&mut self, count: usize, note: impl Fn(&mut SourceAccount, u64)) {
        let mut left = count.min(self.waiting.len());
        self.waiting.drain(..left);
        while left > 0 {
            let Some((host, waiting)) = self.runs.front_mut() else { return };
            let of_it = left.min(*waiting);
            (*waiting, left) = (*waiting - of_it, left - of_it);
            if let Some(source) = self.sources.get_mut(host.as_str()) {
                note(&mut source.account, of_it as u64);
            }
            if *waiting == 0 {
                self.runs.pop_front();
            }
        }
    }

    /// Returns for each host its name, the counts of its frames, and the cells that sent them.
    pub fn accounts(&self) -> impl Iterator<Item = (&str, SourceAccount, NodeSet)> {
        self.sources.iter().map(|(host, source)| (host.as_str(), source.account, source.nodes))
    }

    /// Returns the names that several hosts use at the same time.
    pub fn shared_host_names(&self) -> impl Iterator<Item = &str> {
        self.sources.iter().filter(|(_, source)| source.account.shared > 0).map(|(host, _)| host.as_str())
    }

    /// Returns the number of messages from hosts beyond [`MAX_SOURCES`].
    #[must_use]
    pub const fn unknown_hosts(&self) -> u64 {
        self.unknown_hosts
    }
}

#[cfg(test)]
mod tests {
    use super::super::message::encode;
    use super::*;
    use proptest::prelude::*;
    use protocol::id::{Kind, Node};

    fn message(head: MessageHeader, count: u64) -> Vec<u8> {
        let frame = |at: u64| Frame::classic(0x201, &(head.first + at).to_le_bytes()).unwrap();
        let frames: Vec<_> = (0..count).map(|at| StampedFrame { at_nanos: at, frame: frame(at) }).collect();
        let mut bytes = Vec::new();
        encode(&head, &frames, &mut bytes);
        bytes
    }

    fn heard(incoming: &HostsToBusQueue) -> SourceAccount {
        incoming.accounts().next().unwrap().1
    }

    #[test]
    fn each_missing_frame_has_its_place() {
        let mut incoming = HostsToBusQueue::default();
        let mut take = |life, first, dropped, missed, count| {
            incoming
                .receive_message("b", &message(MessageHeader { life, first, dropped, missed }, count))
                .unwrap();
        };
        take(1, 100, 3, 9, 10); // 100 were before
        take(1, 110, 3, 9, 10);
        take(1, 125, 5, 11, 10); // two dropped there, three lost
        take(1, 125, 5, 11, 10); // again
        take(1, 130, 5, 11, 10); // half of it again
        take(2, 4, 0, 0, 1); // it has restarted
        let account = heard(&incoming);
        let expected = SourceAccount {
            numbered: 145,
            before: 104,
            dropped_there: 2,
            lost: 3,
            taken: 36,
            repeated: 15,
            missed_there: 2,
            lives: 2,
            ..SourceAccount::default()
        };
        assert_eq!(account, expected);
        assert_eq!(incoming.waiting_frames().len(), 36);
        incoming.remove_sent(30);
        incoming.remove_refused(4);
        let account = heard(&incoming);
        assert_eq!((account.sent, account.refused, incoming.waiting_frames().len()), (30, 4, 2));
    }

    #[test]
    fn two_hosts_of_one_name_are_noticed() {
        let mut incoming = HostsToBusQueue::default();
        for life in [1, 2, 3, 2, 3] {
            incoming
                .receive_message("b", &message(MessageHeader { life, ..MessageHeader::default() }, 1))
                .unwrap();
        }
        assert_eq!((heard(&incoming).lives, heard(&incoming).shared), (5, 2));
    }

    #[test]
    fn what_the_bus_does_not_take_is_counted_for_its_host() {
        let mut incoming = HostsToBusQueue::default();
        let head = |first| MessageHeader { life: 1, first, ..MessageHeader::default() };
        for first in (0..MAX_WAITING_FRAMES as u64).step_by(256) {
            incoming
                .receive_message(if first % 512 == 0 { "b" } else { "c" }, &message(head(first), 256))
                .unwrap();
        }
        incoming.receive_message("d", &message(head(0), 5)).unwrap();
        let of: Vec<_> = incoming.accounts().map(|(host, it, _)| (host, it.taken, it.dropped_here)).collect();
        let half = MAX_WAITING_FRAMES as u64 / 2;
        assert_eq!(of, [("b", half, 0), ("c", half, 0), ("d", 5, 5)]);
        incoming.remove_sent(300);
        let sent: Vec<_> = incoming.accounts().map(|(_, it, _)| it.sent).collect();
        assert_eq!(sent, [256, 44, 0]);
        assert!(incoming.receive_message("b", &[9]).is_err());
        assert_eq!(heard(&incoming).garbage, 1);
    }

    #[test]
    fn it_is_known_which_cells_are_behind_a_host() {
        let mut incoming = HostsToBusQueue::default();
        let sent = |id| StampedFrame { at_nanos: 0, frame: Frame::classic(id, &[]).unwrap() };
        let mut bytes = Vec::new();
        let of = |kind, node| u32::from(Id::new(kind, Node::Cell(CellId::new(node).unwrap())).to_bits());
        let frames = [
            sent(of(Kind::Torque, 7)),
            sent(of(Kind::Network, 126)),
            sent(of(Kind::Stimulus, 9)),
            sent(of(Kind::Torque, 7) | protocol::can::EXTENDED),
        ];
        encode(&MessageHeader::default(), &frames, &mut bytes);
        incoming.receive_message("b", &bytes).unwrap();
        let nodes: Vec<_> = incoming.accounts().next().unwrap().2.iter().map(CellId::get).collect();
        assert_eq!(nodes, [7, 126]);
    }

    #[test]
    fn hosts_without_end_fill_nothing() {
        let mut incoming = HostsToBusQueue::default();
        for host in 0..MAX_SOURCES + 3 {
            incoming.receive_message(&host.to_string(), &message(MessageHeader::default(), 1)).unwrap();
        }
        assert_eq!((incoming.accounts().count(), incoming.unknown_hosts()), (MAX_SOURCES, 3));
    }

    #[test]
    fn a_host_that_says_impossible_numbers_is_counted_up_to_the_end() {
        let mut incoming = HostsToBusQueue::default();
        for life in 0..4 {
            let head = MessageHeader { life, first: u64::MAX / 2, dropped: u64::MAX / 2, missed: u64::MAX };
            incoming.receive_message("b", &message(head, 1)).unwrap();
            let head = MessageHeader { first: u64::MAX - 5_000, dropped: u64::MAX - 5_000, ..head };
            incoming.receive_message("b", &message(head, 1)).unwrap();
        }
        let [(_, heard, _)] = incoming.accounts().collect::<Vec<_>>()[..] else { panic!("one host") };
        assert_eq!((heard.numbered, heard.taken, heard.missing_frame_count()), (u64::MAX, 8, u64::MAX));
    }

    proptest! {
        #[test]
        fn accounts_add_up_whatever_comes(messages in proptest::collection::vec((0..3_u64, 0..400_u64, 0..30_u64, 0..9_u64, 0..20_u64, 0..30_usize), 0..60)) {
            let mut incoming = HostsToBusQueue::default();
            for (life, first, dropped, missed, count, gone) in messages {
                let head = MessageHeader { life, first, dropped: dropped.min(first), missed };
                incoming.receive_message("b", &message(head, count)).unwrap();
                match gone % 3 {
                    0 => incoming.remove_sent(gone),
                    1 => incoming.remove_copies(gone),
                    _ => incoming.remove_refused(gone),
                }
            }
            for (_, it, _) in incoming.accounts() {
                prop_assert_eq!(it.numbered, it.before + it.dropped_there + it.lost + it.taken);
                let waiting = incoming.waiting.len() as u64;
                prop_assert_eq!(it.taken, it.sent + it.copies + it.dropped_here + it.refused + waiting);
            }
        }
    }
}
