//! When a cell sends its contact state without a request: continuously, on events, or not at all.
//!
//! ```text
//!   Off         silence, except for a report
//!   Continuous  |s       s       s       s       s       s     a page 0 each period, phases spread by node
//!   Event       |s   s ss    s             s             s     on change, on release, with each heartbeat
//! ```
//!
//! A change is measured against what was *sent* last and not against the last measurement, so that a slow drift
//! is reported. Touch and release have two thresholds, so that noise at one of them is no stream of events. What is
//! sent depends on the contact state and the times alone: the same inputs, the same frames.

use protocol::fixed::Q;
use protocol::id::CellId;
use protocol::message::{Message, SensorPage, SkinSensors};
use protocol::parameters::{Events, Sensing as Mode};
use protocol::time::{Micros, Span};
use protocol::touch::{Touch, contact};

use super::stimuli::Sensed;
use super::{Node, Switches};
use crate::phase;

/// Every so many heartbeats carry the acceleration too: it shows no touch and is rarely needed.
const BEATS_PER_ACCELERATION: u8 = 4;

/// Which pages are to be sent.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(super) struct Pages {
    skin: bool,
    acceleration: bool,
}

impl Pages {
    const NONE: Self = Self { skin: false, acceleration: false };
    pub(super) const BOTH: Self = Self { skin: true, acceleration: true };
}

/// What was sent, and when the next is due.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sensing {
    mode: Mode,
    /// When the next one is due; in continuous mode only.
    due: Option<Micros>,
    /// What was sent last, requested or not.
    sent: Sensed,
    /// When page 0 was sent last without a request.
    said: Option<Micros>,
    contact: Touch,
    proximity: Touch,
    /// Heartbeats since the acceleration went with one.
    beats: u8,
}

impl Sensing {
    /// Something may have been latched, measured or switched.
    fn look(&mut self, now: Micros, switches: &Switches, cell: CellId, sensed: &Sensed) -> Pages {
        let Switches { sensing, events, .. } = switches;
        if *sensing != self.mode {
            return self.switch(now, switches, cell, sensed);
        }
        if *sensing != Mode::Event {
            return Pages::NONE;
        }
        let Sensed { skin, acceleration } = sensed;
        let turned = self.follow(skin, events);
        let pages = Pages {
            skin: *skin != self.sent.skin && (turned || has_moved(skin, &self.sent.skin, events)),
            acceleration: is_far(acceleration, &self.sent.acceleration, events.acceleration),
        };
        self.says(now, pages)
    }

    /// Another mode, which starts with the present contact state.
    fn switch(&mut self, now: Micros, switches: &Switches, cell: CellId, sensed: &Sensed) -> Pages {
        let mode = switches.sensing;
        *self = Self { mode, sent: self.sent, ..Self::default() };
        match mode {
            Mode::Off => return Pages::NONE,
            Mode::Continuous { period_ms } => {
                let period = Span::from_millis(period_ms.into());
                self.due = Some(now + period + phase::by_number(period, cell));
            }
            Mode::Event => {
                self.follow(&sensed.skin, &switches.events);
            }
        }
        self.says(now, Pages::BOTH)
    }

    /// Tracks contact and proximity; whether there is an event: a touch or a release.
    fn follow(&mut self, skin: &SkinSensors, events: &Events) -> bool {
        let contact = self.contact.next(contact(skin), events.contact.to_bits(), events.hysteresis);
        let proximity = i32::from(skin.proximity.to_bits());
        let proximity = self.proximity.next(proximity, events.proximity.to_bits(), events.hysteresis);
        let before = (self.contact, self.proximity);
        (self.contact, self.proximity) = (contact, proximity);
        before != (contact, proximity)
    }

    /// A regular heartbeat goes out. What was sent at this very moment is not resent.
    pub(super) fn beat(&mut self, now: Micros) -> Pages {
        if self.mode == Mode::Off {
            return Pages::NONE;
        }
        self.beats = (self.beats + 1) % BEATS_PER_ACCELERATION;
        let skin = self.mode == Mode::Event && self.said != Some(now);
        self.says(now, Pages { skin, acceleration: self.beats == 0 })
    }

    /// Time has passed: what is due before `until` is sent, overdue periods are skipped; the phase is kept.
    fn pass(&mut self, now: Micros, until: Micros) -> Pages {
        let (Mode::Continuous { period_ms }, Some(due)) = (self.mode, self.due) else { return Pages::NONE };
        if due >= until {
            return Pages::NONE;
        }
        let period = Span::from_millis(period_ms.into());
        self.due = Some(phase::next(due, period, now));
        self.says(now, Pages { skin: true, acceleration: false })
    }

    const fn says(&mut self, now: Micros, pages: Pages) -> Pages {
        if pages.skin {
            self.said = Some(now);
        }
        pages
    }
}

fn has_moved(now: &SkinSensors, sent: &SkinSensors, events: &Events) -> bool {
    is_far(&now.contact, &sent.contact, events.contact)
        || is_far(&now.temperature, &sent.temperature, events.temperature)
        || is_far(&[now.proximity], &[sent.proximity], events.proximity)
}

/// Whether one of them is by a threshold or more; a threshold of 0 means every change.
fn is_far<const F: u32>(now: &[Q<F>], sent: &[Q<F>], threshold: Q<F>) -> bool {
    let threshold = u32::from(threshold.to_bits().unsigned_abs().max(1));
    let far = |(now, sent): (&Q<F>, &Q<F>)| i32::from(now.to_bits()).abs_diff(sent.to_bits().into());
    now.iter().zip(sent).any(|pair| far(pair) >= threshold)
}

impl Node {
    /// Sends what is due after something was latched, measured or switched.
    pub(super) fn sense(&mut self, now: Micros) {
        // Nothing is sent until the cell owns its node id; the contact state is compared with what was sent, so that
        // nothing is lost.
        let Some(cell) = self.identity.cell.filter(|_| self.claim.is_settled()) else { return };
        let pages = self.sensing.look(now, &self.switches, cell, &self.net());
        self.push_sensors(pages);
    }

    /// When it has something to send by itself; not until it owns its node id.
    pub(super) fn sensing_due(&self) -> Option<Micros> {
        self.sensing.due.filter(|_| self.claim.is_settled())
    }

    /// Sends what is due.
    pub(super) fn sense_in_time(&mut self, now: Micros) {
        if self.sensing_due().is_some() {
            let pages = self.sensing.pass(now, now + Span(1));
            self.push_sensors(pages);
        }
    }

    /// What is due before the next joints is sent now, while the cell is awake. Not where the period is that of
    /// the joints or shorter: all cells would send at once, each time.
    pub(super) fn sense_before_the_next_joints(&mut self, now: Micros) {
        let Some(in_use) = self.configuration.in_use() else { return };
        let joints = in_use.period();
        if let Mode::Continuous { period_ms } = self.switches.sensing
            && Span::from_millis(period_ms.into()) > joints
        {
            let pages = self.sensing.pass(now, now + joints);
            self.push_sensors(pages);
        }
    }

    /// Sends the present contact state.
    pub(super) fn push_sensors(&mut self, Pages { skin, acceleration }: Pages) {
        let Some(from) = self.identity.cell else { return };
        let net = self.net();
        let skin = skin.then_some(SensorPage::Skin(net.skin));
        let acceleration = acceleration.then_some(SensorPage::Acceleration(net.acceleration));
        for page in skin.into_iter().chain(acceleration) {
            self.sensing.sent.set(&page);
            self.push(Message::Sensors { from, epoch: self.epoch.unwrap_or_default(), page });
        }
    }
}

#[cfg(test)]
mod tests;
