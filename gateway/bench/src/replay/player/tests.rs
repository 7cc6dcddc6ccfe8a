use std::time::Duration;

use super::*;
use proptest::prelude::*;
use protocol::message::Joints;

/// A stage whose clock and buses are variables.
#[derive(Debug, Default)]
struct Fake {
    clock: u64,
    /// Duration of each send in ns.
    takes: u64,
    /// Results of the next sends; after these, all sends succeed.
    outcomes: Vec<Result<(), SendError>>,
    /// Sent frames with their time and bus.
    sent: Vec<(u64, usize, Vec<Frame>)>,
    announced: Vec<(usize, Option<u64>)>,
    unsent: Vec<(usize, u64)>,
    /// Positions in `sent` at which answers were awaited, with the bus.
    waited: Vec<(usize, usize)>,
    restored: usize,
    stops_at: Option<u64>,
}

impl PlayerBackend for Fake {
    fn now_ns(&self) -> u64 {
        self.clock
    }
    fn wait_until(&mut self, at: u64) {
        self.clock = self.clock.max(at);
    }
    fn pause(&mut self) {
        panic!("everything is there");
    }
    fn is_over(&self) -> bool {
        self.stops_at.is_some_and(|at| self.clock >= at)
    }
    fn announce_joints(&mut self, bus_link: usize, round: Option<u64>, _: Epoch) {
        self.announced.push((bus_link, round));
    }
    fn send(&mut self, bus_link: usize, frames: &[Frame]) -> Result<(), SendError> {
        self.sent.push((self.clock, bus_link, frames.to_vec()));
        self.clock += self.takes;
        if self.outcomes.is_empty() { Ok(()) } else { self.outcomes.remove(0) }
    }
    fn mark_round_unsent(&mut self, bus_link: usize, round: u64) {
        self.unsent.push((bus_link, round));
    }
    fn wait_for_answers(&mut self, bus_link: usize, _: &AwaitedJoints) {
        self.waited.push((self.sent.len(), bus_link));
    }
    fn restore_latched_state(&mut self, _: &[(usize, Vec<Message>)]) -> Result<(), ReplayError> {
        self.restored += 1;
        self.clock += 1_000_000_000;
        Ok(())
    }
    fn show_position(&mut self, _: u64) {}
}

/// The error of a bus that stayed full after `sent` frames.
fn full(sent: usize) -> Result<(), SendError> {
    let cause = BusError::Full { name: "vcan0".to_owned(), waited: Duration::from_millis(100) };
    Err(SendError { sent, total: sent, cause })
}

/// The error of a bus that went down after `sent` frames.
fn down(sent: usize) -> Result<(), SendError> {
    Err(SendError { sent, total: sent, cause: BusError::Down("vcan0".to_owned()) })
}

fn frame(id: u32) -> Frame {
    Frame::classic(id, &[]).unwrap()
}

fn plain(at_us: u64, bus_link: usize, id: u32) -> PlayerStep {
    PlayerStep::Frame(DueFrame {
        at: at_us * 1_000,
        bus_index: bus_link,
        frame: frame(id),
        role: FrameRole::Plain,
        is_late: false,
    })
}

fn joints(at_us: u64, bus_link: usize, round: u64) -> PlayerStep {
    let role =
        FrameRole::Joints(AwaitedJoints { epoch: Epoch(7), joints: Joints::default(), round: Some(round) });
    PlayerStep::Frame(DueFrame {
        at: at_us * 1_000,
        bus_index: bus_link,
        frame: frame(1),
        role,
        is_late: false,
    })
}

fn play(player: Player, stage: &mut Fake, steps: impl IntoIterator<Item = PlayerStep>) -> PlayerResult {
    let (mut all, mut queue) = rtrb::RingBuffer::new(1_024);
    steps.into_iter().for_each(|step| all.push(step).unwrap());
    drop(all);
    player.play(&mut queue, stage)
}

fn identifiers(stage: &Fake) -> Vec<Vec<u32>> {
    stage.sent.iter().map(|(_, _, frames)| frames.iter().map(Frame::id).collect()).collect()
}

#[test]
fn frames_come_at_their_times_and_those_of_the_same_time_together() {
    for (speed, last) in [(1.0, 5_000), (0.1, 50_000), (100.0, 50)] {
        let mut stage = Fake { clock: 42, ..Fake::default() };
        let steps = [plain(100, 0, 1), plain(100, 0, 2), plain(5_100, 0, 3)];
        let played = play(Player::new(1, ReplaySpeed::Timed(speed), None), &mut stage, steps);
        assert_eq!(identifiers(&stage), [vec![1, 2], vec![3]]);
        assert_eq!(stage.sent[1].0 - stage.sent[0].0, last * 1_000);
        assert_eq!((played.late.len(), played.late.max(), played.bus_links[0].sent), (3, 0, 3));
    }
}

#[test]
fn a_bus_that_is_slow_delays_what_is_due_and_not_what_comes_after() {
    let mut stage = Fake { takes: 3_000_000, ..Fake::default() };
    let steps = (0..4).map(|n| plain(n * 2_000, 0, u32::try_from(n).unwrap()));
    let played = play(Player::new(1, ReplaySpeed::Timed(1.0), None), &mut stage, steps);
    // The second frame waits 1 ms for the first; the third and the fourth go together.
    assert_eq!(identifiers(&stage), [vec![0], vec![1], vec![2, 3]]);
    assert_eq!(played.late.max() / 1_000, 2_000, "the third one, within three digits");
}

#[test]
fn buses_are_served_in_turn_and_no_batch_is_larger_than_the_kernel_takes() {
    let mut stage = Fake::default();
    let many = (0..100).map(|id| plain(0, 0, id));
    let steps = many.chain([plain(0, 1, 0x100), plain(0, 0, 0x200)]);
    play(Player::new(2, ReplaySpeed::Max, None), &mut stage, steps);
    let sizes: Vec<_> = stage.sent.iter().map(|(_, bus_link, frames)| (*bus_link, frames.len())).collect();
    assert_eq!(sizes, [(0, 64), (0, 36), (1, 1), (0, 1)]);
}

#[test]
fn in_lockstep_joints_wait_for_the_answers_to_those_before_on_their_bus() {
    let sync = vec![vec![frame(2)], vec![frame(2)]];
    let mut stage = Fake::default();
    let steps = [
        plain(0, 0, 0x70C),
        joints(0, 0, 0),
        joints(0, 1, 0),
        plain(0, 0, 0x70D),
        plain(0, 0, 0x70E),
        joints(0, 0, 1),
        joints(0, 1, 1),
    ];
    play(Player::new(2, ReplaySpeed::Max, Some(sync)), &mut stage, steps);
    // A sync follows each joint packet; later frames do not wait, but the next joints do, on their own bus.
    let expected = [vec![0x70C, 1, 2], vec![1, 2], vec![0x70D, 0x70E], vec![1, 2], vec![1, 2]];
    assert_eq!(identifiers(&stage), expected);
    assert_eq!(stage.waited, [(3, 0), (4, 1), (5, 0), (5, 1)]);
    assert_eq!(stage.announced, [(0, Some(0)), (1, Some(0)), (0, Some(1)), (1, Some(1))]);
}

#[test]
fn the_first_segment_of_joints_waits_too() {
    let segment = PlayerStep::Frame(DueFrame {
        at: 0,
        bus_index: 0,
        frame: frame(1),
        role: FrameRole::SegmentOfJoints,
        is_late: false,
    });
    let sync = vec![vec![frame(2), frame(2)]];
    let mut stage = Fake::default();
    play(
        Player::new(1, ReplaySpeed::Max, Some(sync)),
        &mut stage,
        [segment.clone(), joints(0, 0, 0), segment, joints(0, 0, 1)],
    );
    assert_eq!(identifiers(&stage), [vec![1, 1, 2, 2], vec![1, 1, 2, 2]]);
    assert_eq!(stage.waited, [(1, 0), (2, 0)]);
}

#[test]
fn what_a_bus_does_not_take_is_counted_by_its_reason() {
    let gone = Err(SendError { sent: 0, total: 1, cause: BusError::Gone("vcan0".to_owned()) });
    let outcomes = vec![full(1), down(0), down(0), Ok(()), gone];
    let mut stage = Fake { outcomes, ..Fake::default() };
    let steps = [
        plain(0, 0, 1),
        joints(0, 0, 0),
        joints(1_000, 0, 1),
        plain(2_000, 0, 4),
        plain(3_000, 0, 5),
        plain(4_000, 0, 6),
        plain(5_000, 0, 7),
    ];
    let played = play(Player::new(1, ReplaySpeed::Timed(1.0), None), &mut stage, steps);
    assert_eq!(played.bus_links, [BusTally { sent: 2, refused: 1, lost: 3, outages: 2 }]);
    assert_eq!(stage.unsent, [(0, 0), (0, 1)]);
    assert_eq!(
        played.failure.map(|why| why.to_string()).as_deref(),
        Some("vcan0 was removed while it was in use: create it again, then open it again")
    );
    assert_eq!(stage.sent.len(), 5, "nothing is sent after the end");
}

#[test]
fn a_state_that_is_restored_takes_its_time_and_the_clock_begins_after_it() {
    let mut stage = Fake::default();
    let steps = [
        PlayerStep::Restore(Vec::new()),
        plain(0, 0, 1),
        plain(500, 0, 2),
        PlayerStep::Restore(Vec::new()),
        plain(1_000, 0, 3),
    ];
    let played = play(Player::new(1, ReplaySpeed::Timed(1.0), None), &mut stage, steps);
    assert_eq!((stage.restored, played.late.max()), (2, 0));
    assert!(stage.sent[2].0 - stage.sent[1].0 > 1_000_000_000);
}

#[test]
fn frames_older_than_the_last_one_are_sent_at_once_and_are_not_late() {
    let late =
        DueFrame { at: 9_000_000, bus_index: 0, frame: frame(9), role: FrameRole::Plain, is_late: true };
    let mut stage = Fake::default();
    let played = play(
        Player::new(1, ReplaySpeed::Timed(1.0), None),
        &mut stage,
        [plain(0, 0, 1), PlayerStep::Frame(late)],
    );
    assert_eq!((identifiers(&stage), played.late.len()), (vec![vec![1, 9]], 1));
}

#[test]
fn a_replay_can_be_stopped() {
    let mut stage = Fake { stops_at: Some(5_000_000), ..Fake::default() };
    let played = play(
        Player::new(1, ReplaySpeed::Timed(1.0), None),
        &mut stage,
        (0..100).map(|n| plain(n * 1_000, 0, 1)),
    );
    assert!(played.was_stopped && played.bus_links[0].sent < 10, "{played:?}");
}

proptest! {
    #[test]
    fn every_frame_is_sent_once_in_order_never_early_and_the_counts_add_up(
        steps in proptest::collection::vec((0_u64..3_000, 0_usize..3, any::<bool>()), 0..150),
        takes in 0_u64..2_000_000,
        outcomes in proptest::collection::vec((0_usize..70, 0_u8..3), 0..20),
        lockstep: bool,
    ) {
        let mut at = 0;
        let mut rounds = [0; 3];
        let steps: Vec<_> = (0_u32..).zip(steps).map(|(id, (step, bus_link, is_joints))| {
            at += step;
            let mut due = if is_joints { joints(at, bus_link, rounds[bus_link]) } else { plain(at, bus_link, 0) };
            rounds[bus_link] += u64::from(is_joints);
            if let PlayerStep::Frame(due) = &mut due {
                due.frame = frame(id);
            }
            due
        }).collect();
        let syncs = lockstep.then(|| vec![vec![frame(0x7FF)]; 3]);
        let outcomes = outcomes.into_iter().map(|(sent, outcome)| match outcome {
            0 => Ok(()),
            1 => full(sent),
            _ => down(sent),
        });
        let mut stage = Fake { takes, outcomes: outcomes.collect(), ..Fake::default() };
        let played = play(Player::new(3, ReplaySpeed::Timed(1.0), syncs), &mut stage, steps.clone());
        let tried: Vec<_> = stage.sent.iter()
            .flat_map(|(at, bus_link, frames)| frames.iter().map(move |frame| (*at, *bus_link, *frame)))
            .filter(|(_, _, frame)| frame.id() != 0x7FF).collect();
        prop_assert_eq!(tried.len(), steps.len());
        let first = match &steps.first() { Some(PlayerStep::Frame(due)) => due.at, _ => 0 };
        for ((at, bus_link, frame), step) in tried.iter().zip(&steps) {
            let PlayerStep::Frame(due) = step else { unreachable!() };
            prop_assert_eq!((*bus_link, *frame), (due.bus_index, due.frame));
            prop_assert!(*at >= due.at - first + START_DELAY_NS, "early");
        }
        let total: u64 = played.bus_links.iter().map(|bus_link| bus_link.sent + bus_link.refused + bus_link.lost).sum();
        prop_assert_eq!(total, steps.len() as u64);
    }
}
