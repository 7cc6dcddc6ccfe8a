//! A model of event mode (SENSE-7, SENSE-8 and SENSE-9), which predicts the sensors pages that a cell must send.

use protocol::fixed::{Q, Q3_12};
use protocol::message::{SensorPage, SensorReadings, SkinSensors};
use protocol::parameters::Events;

/// The state of contact or of proximity in event mode.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
enum ModelTouchState {
    #[default]
    Free,
    Touched,
    Fading,
}

impl ModelTouchState {
    /// Returns the state after a value `v`, by the table of SENSE-9. The hysteresis is in steps of 2^-14 of the
    /// threshold.
    const fn next(self, v: i64, threshold: i64, hysteresis: i64) -> Self {
        // A threshold of 0 counts as one step.
        let threshold = if threshold < 1 { 1 } else { threshold };
        if v >= threshold {
            return Self::Touched;
        }
        if v == 0 {
            return Self::Free;
        }
        if v > 0 && v << 14 >= threshold * ((1 << 14) - hysteresis) {
            return self;
        }
        match self {
            Self::Free => Self::Free,
            Self::Touched | Self::Fading => Self::Fading,
        }
    }
}

/// The state of a cell in event mode: its latched values, the last values that it sent, and its contact and proximity.
#[derive(Clone, Debug)]
pub(super) struct EventModel {
    events: Events,
    latched: SensorReadings,
    sent: SensorReadings,
    contact: ModelTouchState,
    proximity: ModelTouchState,
}

impl EventModel {
    /// Creates the state at a switch to event mode, if all latched values are 0.
    pub(super) fn new(events: Events) -> Self {
        let nothing = SensorReadings::default();
        let mut model = Self {
            events,
            latched: nothing,
            sent: nothing,
            contact: ModelTouchState::Free,
            proximity: ModelTouchState::Free,
        };
        model.update_touch_states();
        model
    }

    pub(super) const fn sent_skin(&self) -> SkinSensors {
        self.sent.skin
    }

    pub(super) const fn sent_acceleration(&self) -> [Q3_12; 3] {
        self.sent.acceleration
    }

    /// Returns a description of the states of contact and proximity, for a message.
    pub(super) fn state_text(&self) -> String {
        let name = |touch| match touch {
            ModelTouchState::Free => "free",
            ModelTouchState::Touched => "touched",
            ModelTouchState::Fading => "fading",
        };
        format!("contact {}, proximity {}", name(self.contact), name(self.proximity))
    }

    /// Takes the values of a page that the cell sent as its last sent ones.
    pub(super) const fn mark_page_sent(&mut self, page: &SensorPage) {
        self.sent.set_page(page);
    }

    /// Returns true if a page equals the latched values.
    pub(super) fn equals_latched(&self, page: &SensorPage) -> bool {
        // The model has no baseline.
        self.latched.simulated_pages().contains(page)
    }

    /// Updates the states of contact and proximity from the latched values, and returns true if one has changed.
    fn update_touch_states(&mut self) -> bool {
        let before = (self.contact, self.proximity);
        let hysteresis = i64::from(self.events.hysteresis.to_bits());
        let skin = self.latched.skin;
        let sum: i64 = skin.contact.iter().map(|word| i64::from(word.to_bits())).sum();
        self.contact = self.contact.next(sum, self.events.contact.to_bits().into(), hysteresis);
        let proximity = skin.proximity.to_bits().into();
        self.proximity = self.proximity.next(proximity, self.events.proximity.to_bits().into(), hysteresis);
        before != (self.contact, self.proximity)
    }

    /// Latches values, and returns the pages that must follow and the requirement that demands them.
    pub(super) fn latch_values(
        &mut self,
        skin: SkinSensors,
        acceleration: Option<[Q3_12; 3]>,
    ) -> (Vec<u8>, &'static str) {
        let before = self.latched;
        self.latched.skin = skin;
        self.latched.acceleration = acceleration.unwrap_or(self.latched.acceleration);
        let turned = self.update_touch_states();
        let (now, sent, events) = (self.latched.skin, self.sent.skin, self.events);
        let has_moved = |from: &SkinSensors| {
            differs_by_threshold(&now.contact, &from.contact, events.contact)
                || differs_by_threshold(&now.temperature, &from.temperature, events.temperature)
                || differs_by_threshold(&[now.proximity], &[from.proximity], events.proximity)
        };
        let moved = has_moved(&sent);
        let mut pages = Vec::new();
        if now != sent && (turned || moved) {
            pages.push(0);
        }
        if differs_by_threshold(&self.latched.acceleration, &self.sent.acceleration, events.acceleration) {
            pages.push(1);
        }
        let far =
            |from: &[Q3_12; 3]| differs_by_threshold(&self.latched.acceleration, from, events.acceleration);
        // The difference to the last latched values is not the difference to the last sent ones.
        let by_sent =
            moved != has_moved(&before.skin) || far(&before.acceleration) != far(&self.sent.acceleration);
        let id = match (by_sent, turned && !moved) {
            (true, _) => "SENSE-8",
            (false, true) => "SENSE-9",
            (false, false) => "SENSE-7",
        };
        (pages, id)
    }
}

/// Returns true if a value differs from the last sent one by the threshold or more; a threshold of 0 counts as one
/// step.
fn differs_by_threshold<const F: u32>(now: &[Q<F>], sent: &[Q<F>], threshold: Q<F>) -> bool {
    let threshold = i32::from(threshold.to_bits()).max(1);
    now.iter()
        .zip(sent)
        .any(|(now, sent)| (i32::from(now.to_bits()) - i32::from(sent.to_bits())).abs() >= threshold)
}
