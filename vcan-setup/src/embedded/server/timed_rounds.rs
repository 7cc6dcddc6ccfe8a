//! The rounds of a timed bus: in each, the server reads all requests, advances the bus to the present, and sends the
//! frames that have ended.

use std::time::Duration;

use protocol::bus::batch::{Datagram, send_one};
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::io::Errno;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create, timerfd_settime,
};

use super::{ROUND_END, Server, TimedRounds};
use crate::embedded::parcel::FrameDatagram;
use crate::embedded::routing::ClientId;
use crate::embedded::timed::{BusClock, RoundEffects, TimedBus, TimedBusOptions};

/// The sender of frames whose client has disconnected. No client has this number.
const NOBODY: ClientId = ClientId(usize::MAX);

impl Server {
    /// Lets frames take time on the bus.
    ///
    /// # Errors
    /// Returns the reason if the bit-error rate is out of range.
    pub fn with_time(mut self, options: TimedBusOptions) -> Result<Self, bus_model::BitErrorsError> {
        self.timed = Some(Box::new(TimedRounds {
            bus: TimedBus::new(options)?,
            clock: BusClock::start(),
            timer: None,
            wall_offset: 0,
            effects: RoundEffects::default(),
        }));
        Ok(self)
    }

    /// Creates the timer for the ends of rounds, if the bus is timed.
    pub(super) fn create_round_timer(&mut self) -> Result<(), Errno> {
        let Some(timed) = &mut self.timed else { return Ok(()) };
        let timer =
            timerfd_create(TimerfdClockId::Monotonic, TimerfdFlags::CLOEXEC | TimerfdFlags::NONBLOCK)?;
        epoll::add(&self.post.epoll, &timer, EventData::new_u64(ROUND_END), EventFlags::IN)?;
        timed.timer = Some(timer);
        Ok(())
    }

    /// Sets the timer to the time at which a round must end, or stops it if no frame waits. Either way it is no longer
    /// readable.
    pub(super) fn set_round_timer(&self) -> Result<(), Errno> {
        let Some(timed) = &self.timed else { return Ok(()) };
        let Some(timer) = &timed.timer else { return Ok(()) };
        // A time of 0 would stop the timer.
        let nanos = timed.bus.wake_time().map_or(0, |at| at.saturating_sub(timed.clock.now()).max(1));
        let wait = Timespec::try_from(Duration::from_nanos(nanos)).map_err(|_| Errno::RANGE)?;
        let never = Timespec { tv_sec: 0, tv_nsec: 0 };
        timerfd_settime(
            timer,
            TimerfdTimerFlags::empty(),
            &Itimerspec { it_interval: never, it_value: wait },
        )?;
        Ok(())
    }

    pub(super) fn begin_timed_round(&mut self) {
        if let Some(timed) = &mut self.timed {
            timed.wall_offset = timed.clock.wall_offset();
        }
    }

    /// Advances a timed bus to the present, and queues what it has sent for the clients.
    pub(super) fn end_timed_round(&mut self) {
        let Some(timed) = &mut self.timed else { return };
        let mut effects = std::mem::take(&mut timed.effects);
        effects.deliveries.clear();
        effects.refusals.clear();
        timed.bus.end_round(timed.clock.now(), &mut effects);
        for delivery in &effects.deliveries {
            self.route(delivery.from.unwrap_or(NOBODY), delivery.parcel, Some(delivery.stamp));
        }
        for refusal in &effects.refusals {
            let is_dirty = self.client(refusal.from).is_some_and(|it| it.enqueue_refusal(refusal.raw_id));
            if is_dirty {
                self.dirty.push_back(refusal.from);
            }
        }
        if let Some(timed) = &mut self.timed {
            timed.effects = effects;
        }
    }

    /// Notes that the frames of a round were sent to all clients.
    pub(super) fn note_delivered(&mut self) {
        if let Some(timed) = &mut self.timed
            && !timed.effects.deliveries.is_empty()
        {
            timed.bus.note_delivered(timed.clock.now(), &timed.effects.deliveries);
        }
    }

    /// Answers a request for the figures of a timed bus. Answers nothing if frames take no time on the bus.
    pub(super) fn answer_figures_request(&mut self, id: ClientId) {
        let figures = self.timed.as_mut().map(|timed| timed.bus.report().to_json());
        if let (Some(figures), Some(client)) = (figures, self.client(id)) {
            // A program that does not wait for the answer needs none.
            let _ = send_one(&client.socket, &figures);
        }
    }
}

impl TimedRounds {
    /// Collects a frame of a client, with the time at which the client sent it.
    pub(super) fn collect(&mut self, from: ClientId, parcel: FrameDatagram, datagram: Datagram<'_>) {
        let sent = datagram.info().at_nanos.map(|at| at.wrapping_add_signed(self.wall_offset));
        self.bus.collect(sent.unwrap_or_else(|| self.clock.now()), from, parcel);
    }
}
