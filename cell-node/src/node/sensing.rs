//! Sending of measurements without a request: continuously, on events, or not at all.
//!
//! ```text
//!   Off         silence, except for a report
//!   Continuous  |s       s       s       s       s       s     a page 0 each period, phases spread by node
//!   Event       |s   s ss    s             s             s     on change, on release, with each heartbeat
//! ```
//!
//! A change is measured from the last *sent* value instead of the last measurement, so that a slow drift is also
//! reported. Touch and release have different thresholds, so that noise near one of them does not cause a stream of
//! events. The frames depend only on the sensor values and the times: the same inputs give the same frames.

use protocol::fixed::Q;
use protocol::id::CellId;
use protocol::message::{Message, SensorReadings, SkinSensors};
use protocol::parameters::{Events, Sensing as Mode};
use protocol::time::{Micros, Span};
use protocol::touch::{TouchState, contact_force};

use super::{Node, VolatileParameters};
use crate::phase;

/// Number of heartbeats per page other than the skin's; such a page shows no touch and is rarely needed.
const HEARTBEATS_PER_NON_SKIN_PAGE: u8 = 4;

/// The sensor pages that are to be sent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(super) struct DuePages {
    skin: bool,
    acceleration: bool,
    /// All further pages.
    others: bool,
}

impl DuePages {
    const NONE: Self = Self { skin: false, acceleration: false, others: false };
    pub(super) const ALL: Self = Self { skin: true, acceleration: true, others: true };

    /// Returns true if they contain the page with this index in [`SensorReadings::simulated_pages`].
    const fn contains_page(self, index: usize) -> bool {
        match index {
            0 => self.skin,
            1 => self.acceleration,
            _ => self.others,
        }
    }
}

/// The values that were sent last, and the time of the next page.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SensorPageState {
    mode: Mode,
    /// The time of the next page in continuous mode.
    due: Option<Micros>,
    /// The last sent values, requested or not.
    sent: SensorReadings,
    /// The time of the last page 0 sent without a request.
    last_sent_at: Option<Micros>,
    contact: TouchState,
    proximity: TouchState,
    /// Number of heartbeats since the last page with the acceleration.
    beats: u8,
}

impl SensorPageState {
    /// Returns true if changed sensor values or a changed mode can require pages.
    fn follows_changes(&self, mode: Mode) -> bool {
        mode != self.mode || mode == Mode::Event
    }

    /// Returns the pages to send after sensor values or the mode may have changed, if it [follows
    /// changes](Self::follows_changes).
    fn update_due_pages(
        &mut self,
        now: Micros,
        switches: &VolatileParameters,
        cell: CellId,
        sensed: &SensorReadings,
    ) -> DuePages {
        let VolatileParameters { sensing, events, .. } = switches;
        if *sensing != self.mode {
            return self.switch_mode(now, switches, cell, sensed);
        }
        let SensorReadings { skin, acceleration, .. } = sensed;
        let turned = self.update_touch_states(skin, events);
        let pages = DuePages {
            skin: *skin != self.sent.skin && (turned || have_sensors_changed(skin, &self.sent.skin, events)),
            acceleration: differs_by_threshold(acceleration, &self.sent.acceleration, events.acceleration),
            others: false,
        };
        self.mark_pages_sent(now, pages)
    }

    /// Switches to another mode, which starts with the present contact state.
    fn switch_mode(
        &mut self,
        now: Micros,
        switches: &VolatileParameters,
        cell: CellId,
        sensed: &SensorReadings,
    ) -> DuePages {
        let mode = switches.sensing;
        *self = Self { mode, sent: self.sent, ..Self::default() };
        match mode {
            Mode::Off => return DuePages::NONE,
            Mode::Continuous { period_ms } => {
                let period = Span::from_millis(period_ms.into());
                self.due = Some(now + period + phase::send_offset_by_node_id(period, cell));
            }
            Mode::Event => {
                self.update_touch_states(&sensed.skin, &switches.events);
            }
        }
        self.mark_pages_sent(now, DuePages::ALL)
    }

    /// Updates the touch states of contact and proximity. Returns true if one of them was touched or released.
    fn update_touch_states(&mut self, skin: &SkinSensors, events: &Events) -> bool {
        let contact = self.contact.next(contact_force(skin), events.contact.to_bits(), events.hysteresis);
        let proximity = i32::from(skin.proximity.to_bits());
        let proximity = self.proximity.next(proximity, events.proximity.to_bits(), events.hysteresis);
        let before = (self.contact, self.proximity);
        (self.contact, self.proximity) = (contact, proximity);
        before != (contact, proximity)
    }

    /// Returns the pages to send with a regular heartbeat. A page that was already sent at this time is not repeated.
    pub(super) fn heartbeat_pages(&mut self, now: Micros) -> DuePages {
        if self.mode == Mode::Off {
            return DuePages::NONE;
        }
        self.beats = (self.beats + 1) % HEARTBEATS_PER_NON_SKIN_PAGE;
        let skin = self.mode == Mode::Event && self.last_sent_at != Some(now);
        let is_due = self.beats == 0;
        self.mark_pages_sent(now, DuePages { skin, acceleration: is_due, others: is_due })
    }

    /// Returns the page that is due before `until` in continuous mode. Periods that have passed are skipped; the phase
    /// remains.
    fn due_pages(&mut self, now: Micros, until: Micros) -> DuePages {
        let (Mode::Continuous { period_ms }, Some(due)) = (self.mode, self.due) else {
            return DuePages::NONE;
        };
        if due >= until {
            return DuePages::NONE;
        }
        let period = Span::from_millis(period_ms.into());
        self.due = Some(phase::next_send_time(due, period, now));
        self.mark_pages_sent(now, DuePages { skin: true, ..DuePages::NONE })
    }

    const fn mark_pages_sent(&mut self, now: Micros, pages: DuePages) -> DuePages {
        if pages.skin {
            self.last_sent_at = Some(now);
        }
        pages
    }
}

fn have_sensors_changed(now: &SkinSensors, sent: &SkinSensors, events: &Events) -> bool {
    differs_by_threshold(&now.contact, &sent.contact, events.contact)
        || differs_by_threshold(&now.temperature, &sent.temperature, events.temperature)
        || differs_by_threshold(&[now.proximity], &[sent.proximity], events.proximity)
}

/// Returns true if a value differs from the sent one by at least the threshold. With a threshold of 0, any difference
/// counts.
fn differs_by_threshold<const F: u32>(now: &[Q<F>], sent: &[Q<F>], threshold: Q<F>) -> bool {
    let threshold = u32::from(threshold.to_bits().unsigned_abs().max(1));
    let far = |(now, sent): (&Q<F>, &Q<F>)| i32::from(now.to_bits()).abs_diff(sent.to_bits().into());
    now.iter().zip(sent).any(|pair| far(pair) >= threshold)
}

impl Node {
    /// Sends the pages that changed sensor values or a changed mode require.
    pub(super) fn send_changed_pages(&mut self, now: Micros) {
        // Pages are sent only once the cell owns its node id. The comparison with the last sent values
        // ensures that no change is lost.
        let Some(cell) = self.identity.cell.filter(|_| self.claim.owns_node_id()) else { return };
        if !self.sensing.follows_changes(self.switches.sensing) {
            return;
        }
        let pages = self.sensing.update_due_pages(now, &self.switches, cell, &self.net_readings());
        self.push_sensor_pages(pages);
    }

    /// Returns the time of the next page in continuous mode; `None` until the cell owns its node id.
    pub(super) fn next_sensor_page_time(&self) -> Option<Micros> {
        self.sensing.due.filter(|_| self.claim.owns_node_id())
    }

    /// Sends the page of continuous mode if it is due.
    pub(super) fn send_due_pages(&mut self, now: Micros) {
        if self.next_sensor_page_time().is_some() {
            let pages = self.sensing.due_pages(now, now + Span(1));
            self.push_sensor_pages(pages);
        }
    }

    /// Sends a page now if it is due before the next joints, so that the cell need not wake up again. Does nothing if
    /// the period is not longer than that of joints: otherwise all cells would send at the same time in each epoch.
    pub(super) fn send_pages_before_next_joints(&mut self, now: Micros) {
        let Some(in_use) = self.configuration.active_parameters() else { return };
        let joints = in_use.broadcast_period();
        if let Mode::Continuous { period_ms } = self.switches.sensing
            && Span::from_millis(period_ms.into()) > joints
        {
            let pages = self.sensing.due_pages(now, now + joints);
            self.push_sensor_pages(pages);
        }
    }

    /// Sends pages with the present contact state.
    pub(super) fn push_sensor_pages(&mut self, pages: DuePages) {
        if pages == DuePages::NONE {
            return;
        }
        let Some(from) = self.identity.cell else { return };
        for (_, page) in self
            .net_readings()
            .simulated_pages()
            .into_iter()
            .enumerate()
            .filter(|(index, _)| pages.contains_page(*index))
        {
            self.sensing.sent.set_page(&page);
            self.queue_message(Message::Sensors { from, epoch: self.epoch.unwrap_or_default(), page });
        }
    }
}

#[cfg(test)]
mod tests;
