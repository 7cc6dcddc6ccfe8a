//! Following of a bus: waits, receives, counts dropped frames, notices a loss, reopens the bus, and keeps the gateway's
//! ends of the wires to the roots.
//!
//! | state | event | next state | returned |
//! |---|---|---|---|
//! | `Working`, `Lost` | frames arrive | `Working` | [`FollowStep::Frames`] |
//! | `Working`, `Lost` | timeout | unchanged | [`FollowStep::Nothing`] |
//! | `Working` | the bus goes down | `Draining` | [`FollowStep::Down`], once |
//! | `Lost` | the bus is still down | unchanged, after a pause | [`FollowStep::Nothing`] |
//! | `Draining` | frames from before the loss | unchanged | [`FollowStep::Leftover`] |
//! | `Draining` | all leftover frames are read | `Lost` | [`FollowStep::Drained`] |
//! | any but `Gone` | the bus is removed | `Gone` | [`FollowStep::Gone`], once |
//! | `Gone` | the bus opens | `Working` | [`FollowStep::Nothing`] |
//! | `Gone` | the bus is still absent | unchanged | [`FollowStep::Nothing`] |
//! | `Gone` | the bus exists but does not open | unchanged | [`FollowStep::Refused`], once per reason |

use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::batch::MAX_BATCH_DATAGRAMS;
use protocol::bus::{Bus, BusError, Inbox, ReceivedFrame};
use protocol::id::CellId;

use super::roots::RootWires;

/// Pause while an interface is down.
const INTERFACE_DOWN_PAUSE: Duration = Duration::from_millis(50);
/// Interval between attempts to reopen a bus that is gone.
const REOPEN_INTERVAL: Duration = Duration::from_millis(100);

/// Provides the open bus to a [`Follower`], and opens the bus again after a loss.
pub trait BusSource {
    /// The open bus, or `None` before it was opened for the first time.
    fn bus(&self) -> Option<&Bus>;

    /// Reopens the bus after it has gone.
    ///
    /// # Errors
    /// Returns the [`BusError`] that keeps the bus from opening.
    fn reopen(&mut self) -> Result<(), BusError>;
}

/// A source that never reopens its bus: its follower ends when the bus is gone.
#[derive(Debug)]
pub struct NeverReopenedBus<'a>(pub &'a Bus);

impl BusSource for NeverReopenedBus<'_> {
    fn bus(&self) -> Option<&Bus> {
        Some(self.0)
    }

    fn reopen(&mut self) -> Result<(), BusError> {
        Err(BusError::Gone(self.0.name().to_owned()))
    }
}

/// The outcome of one [`Follower::step`].
#[derive(Debug)]
pub enum FollowStep {
    /// Frames arrived; holds the number of received frames.
    Frames(usize),
    /// No frame arrived before the timeout.
    Nothing,
    /// The bus is down for now.
    Down(BusError),
    /// Frames from before the loss of the bus arrived; holds their number.
    Leftover(usize),
    /// All frames from before the loss are read. A frame that arrives later shows that the bus works again.
    Drained,
    /// The bus is gone and must be reopened.
    Gone(BusError),
    /// The bus exists but does not open.
    Refused(BusError),
}

/// An item received in a step: a frame, or a change of a root.
#[derive(Debug)]
pub enum FollowedItem {
    /// A frame from a cell, from the gateway or from another program.
    Frame(ReceivedFrame),
    /// A root starts (true) or stops (false) feeding its sum to the gateway.
    Feeds(CellId, bool),
}

#[derive(Debug, Default)]
enum FollowState {
    #[default]
    Working,
    Draining,
    Lost,
    Gone {
        retry: Option<Instant>,
    },
}

/// State of following a bus, with the frames received last.
#[derive(Debug, Default)]
pub struct Follower {
    /// The gateway's ends of the wires to the roots, on buses where cells reply with sums.
    pub roots: Option<RootWires>,
    /// Time to wait for more frames after the first ones arrived, so that one wake-up reads many.
    gather: Duration,
    inbox: Inbox,
    state: FollowState,
    /// Number of frames dropped on earlier sockets of this bus.
    dropped_before: u64,
    /// Last reported reason why the bus does not open.
    last_refusal: String,
}

/// Waits up to `wait` for frames and reads one batch into `inbox`, whose former frames are discarded. Returns the
/// number of frames.
///
/// # Errors
/// Returns [`BusError`] if the bus is down, gone or closed.
pub fn receive_batch(bus: &Bus, inbox: &mut Inbox, wait: Duration) -> Result<usize, BusError> {
    inbox.clear();
    if bus.wait(Some(wait))? { bus.receive(inbox) } else { Ok(0) }
}

impl Follower {
    /// Creates the follower of a bus. `roots` holds the gateway's ends of the wires to the roots, if the cells answer
    /// with sums. `gather` is the time to wait for more frames after some have arrived.
    #[must_use]
    pub fn new(roots: Option<RootWires>, gather: Duration) -> Self {
        Self { roots, gather, ..Self::default() }
    }

    /// Sends the messages that are due on the wires to the roots, then receives frames or handles a loss. Returns after
    /// about `wait` plus the time to gather frames, or earlier.
    pub fn step(&mut self, source: &mut impl BusSource, wait: Duration) -> FollowStep {
        let bus = match source.bus() {
            Some(bus) if !matches!(self.state, FollowState::Gone { .. }) => bus,
            Some(_) | None => return self.reopen(source, wait),
        };
        let mut timeout = wait;
        if let Some(roots) = &mut self.roots {
            roots.send_due_messages(bus);
            timeout = wait.min(roots.next_message_timeout());
        }
        if matches!(self.state, FollowState::Draining) {
            return self.drain_frames(|inbox| bus.receive(inbox));
        }
        // A full inbox has more frames behind it: do not wait.
        if (1..MAX_BATCH_DATAGRAMS).contains(&self.inbox.frames().len()) {
            thread::sleep(self.gather);
        }
        self.receive(|inbox| receive_batch(bus, inbox, timeout))
    }

    /// Passes each item of the last step to `each`, in order of arrival. Frames on the wires to the roots are not
    /// passed on: the follower handles them.
    pub fn for_each_item(&mut self, mut each: impl FnMut(FollowedItem)) {
        for received in self.inbox.frames() {
            if let Some(roots) = &mut self.roots
                && roots.handle_frame(&received.frame)
            {
                roots.uplink_changes().for_each(|(root, feeds)| each(FollowedItem::Feeds(root, feeds)));
                continue;
            }
            each(FollowedItem::Frame(received));
        }
    }

    /// Frames received in the last step, including those on the wires to the roots.
    pub fn frames(&self) -> impl ExactSizeIterator<Item = ReceivedFrame> + '_ {
        self.inbox.frames()
    }

    /// Number of frames that all sockets of this bus dropped because they were not read in time.
    #[must_use]
    pub fn dropped_frames(&self) -> u64 {
        self.dropped_before + u64::from(self.inbox.dropped_count())
    }

    /// Returns true if the bus has failed and has neither been reopened nor delivered a frame since.
    #[must_use]
    pub const fn is_lost(&self) -> bool {
        !matches!(self.state, FollowState::Working)
    }

    fn receive(&mut self, receive_batch: impl FnOnce(&mut Inbox) -> Result<usize, BusError>) -> FollowStep {
        match receive_batch(&mut self.inbox) {
            Ok(0) => FollowStep::Nothing,
            Ok(count) => {
                self.state = FollowState::Working;
                FollowStep::Frames(count)
            }
            Err(error) if !error.is_temporary() => self.enter_gone_state(error),
            Err(_) if matches!(self.state, FollowState::Lost) => {
                thread::sleep(INTERFACE_DOWN_PAUSE);
                FollowStep::Nothing
            }
            Err(error) => {
                self.inbox.clear();
                self.state = FollowState::Draining;
                FollowStep::Down(error)
            }
        }
    }

    /// Reads frames that were received before the loss of the bus. They do not show that the bus works again.
    fn drain_frames(&mut self, receive: impl FnOnce(&mut Inbox) -> Result<usize, BusError>) -> FollowStep {
        // Pause before the first read, so that frames that are under way arrive.
        if self.inbox.frames().len() == 0 {
            thread::sleep(INTERFACE_DOWN_PAUSE);
        }
        self.inbox.clear();
        match receive(&mut self.inbox) {
            Ok(count @ 1..) => FollowStep::Leftover(count),
            // An interface goes down before it is removed; both events are reported once.
            Err(error) if !error.is_temporary() => self.enter_gone_state(error),
            Ok(0) | Err(_) => {
                self.state = FollowState::Lost;
                FollowStep::Drained
            }
        }
    }

    fn enter_gone_state(&mut self, error: BusError) -> FollowStep {
        self.inbox.clear();
        self.last_refusal.clear();
        self.state = FollowState::Gone { retry: None };
        FollowStep::Gone(error)
    }

    fn reopen(&mut self, source: &mut impl BusSource, wait: Duration) -> FollowStep {
        self.inbox.clear();
        let now = Instant::now();
        if let FollowState::Gone { retry: Some(retry) } = self.state
            && now < retry
        {
            thread::sleep(wait.min(retry - now));
            return FollowStep::Nothing;
        }
        match source.reopen() {
            Ok(()) => {
                self.dropped_before += u64::from(self.inbox.dropped_count());
                self.inbox = Inbox::new();
                self.state = FollowState::Working;
                FollowStep::Nothing
            }
            Err(error) => {
                self.state = FollowState::Gone { retry: Some(now + REOPEN_INTERVAL) };
                let why = error.to_string();
                let is_new = !is_bus_absent(&error) && self.last_refusal != why;
                self.last_refusal = why;
                if is_new { FollowStep::Refused(error) } else { FollowStep::Nothing }
            }
        }
    }
}

/// Returns true if the error means that the bus does not exist, false if it exists and does not open.
const fn is_bus_absent(error: &BusError) -> bool {
    matches!(
        error,
        BusError::NoInterface { .. }
            | BusError::Down { .. }
            | BusError::Gone { .. }
            | BusError::NotServed { .. }
            | BusError::Absent { .. }
            | BusError::Closed { .. }
            | BusError::HungUp { .. }
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn down() -> BusError {
        BusError::Down("vcan0".to_owned())
    }

    fn gone() -> BusError {
        BusError::Gone("vcan0".to_owned())
    }

    /// A source whose `reopen` returns these results, last one first.
    struct Scripted(Vec<Result<(), BusError>>);

    impl BusSource for Scripted {
        fn bus(&self) -> Option<&Bus> {
            None
        }

        fn reopen(&mut self) -> Result<(), BusError> {
            self.0.pop().unwrap_or_else(|| Err(gone()))
        }
    }

    #[test]
    fn a_loss_is_reported_once_and_frames_from_before_do_not_end_it() {
        let mut follower = Follower::default();
        assert!(matches!(follower.receive(|_| Ok(0)), FollowStep::Nothing));
        assert!(matches!(follower.receive(|_| Ok(3)), FollowStep::Frames(3)));
        assert!(!follower.is_lost());
        assert!(matches!(follower.receive(|_| Err(down())), FollowStep::Down(_)));
        assert!(matches!(follower.drain_frames(|_| Ok(2)), FollowStep::Leftover(2)));
        assert!(follower.is_lost());
        assert!(matches!(follower.drain_frames(|_| Ok(0)), FollowStep::Drained));
        assert!(matches!(follower.receive(|_| Err(down())), FollowStep::Nothing), "it was reported");
        assert!(matches!(follower.receive(|_| Ok(0)), FollowStep::Nothing));
        assert!(follower.is_lost(), "silence is no sign that it works");
        assert!(matches!(follower.receive(|_| Ok(1)), FollowStep::Frames(1)));
        assert!(!follower.is_lost());
        assert!(matches!(follower.receive(|_| Err(down())), FollowStep::Down(_)), "another loss");
    }

    #[test]
    fn an_interface_that_is_removed_goes_down_before() {
        let mut follower = Follower::default();
        assert!(matches!(follower.receive(|_| Err(down())), FollowStep::Down(_)));
        assert!(matches!(follower.drain_frames(|_| Err(gone())), FollowStep::Gone(_)));
        let mut follower = Follower::default();
        assert!(matches!(follower.receive(|_| Err(down())), FollowStep::Down(_)));
        assert!(matches!(follower.drain_frames(|_| Err(down())), FollowStep::Drained));
        assert!(matches!(follower.receive(|_| Err(gone())), FollowStep::Gone(_)), "after it is down as well");
    }

    #[test]
    fn a_bus_that_is_gone_is_opened_again_and_each_reason_against_it_reported_once() {
        let refused = || Err(BusError::Name("a reason".to_owned()));
        let other = || Err(BusError::Name("another".to_owned()));
        // From the last to the first.
        let mut source =
            Scripted(vec![Ok(()), other(), refused(), Err(gone()), refused(), refused(), Err(gone())]);
        let mut follower = Follower::default();
        let mut steps = Vec::new();
        let began = Instant::now();
        assert!(matches!(follower.receive(|_| Err(gone())), FollowStep::Gone(_)));
        while follower.is_lost() {
            match follower.step(&mut source, Duration::from_millis(30)) {
                FollowStep::Nothing => {}
                FollowStep::Refused(error) => steps.push(error.to_string()),
                FollowStep::Frames(_)
                | FollowStep::Down(_)
                | FollowStep::Leftover(_)
                | FollowStep::Drained
                | FollowStep::Gone(_) => {
                    panic!("a bus that is gone has neither frames nor a loss")
                }
            }
        }
        assert!(began.elapsed() >= 6 * REOPEN_INTERVAL, "it is not tried all the time");
        let reasons: Vec<_> = steps.iter().map(|step| step.contains("another")).collect();
        assert_eq!(reasons, [false, false, true], "an absence in between makes a reason new");
        assert_eq!(source.0.len(), 0);
        assert!(matches!(follower.receive(|_| Err(gone())), FollowStep::Gone(_)), "it may be lost again");
    }
}
