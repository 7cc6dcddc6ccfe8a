//! Reports of the zero of the force sensor (sensor page 3), which are sent when its state changes and once a second.

use protocol::message::{Message, SensorPage, SensorReadings};

use super::Node;
use crate::baseline::BaselineStatus;

const HEARTBEATS_PER_ZERO_REPORT: u8 = 4;

/// The state of the zero in the last report.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ReportedBaseline {
    status: BaselineStatus,
    beats: u8,
}

impl Node {
    /// Returns the sensor values with the zero subtracted.
    pub(super) fn net_readings(&self) -> SensorReadings {
        let sensed = self.stimuli.sensed;
        SensorReadings { skin: self.baseline.subtract_zero(&sensed.skin), ..sensed }
    }

    /// Reports the zero if its state has changed since the last report, and the cell owns its node id.
    pub(super) fn report_zero_if_changed(&mut self) {
        if self.claim.owns_node_id() && self.reported.status != self.baseline.status() {
            self.push_zero_page();
        }
    }

    /// Reports the zero with every fourth regular heartbeat.
    pub(super) fn report_zero_with_heartbeat(&mut self) {
        self.reported.beats = (self.reported.beats + 1) % HEARTBEATS_PER_ZERO_REPORT;
        if self.reported.beats == 0 {
            self.push_zero_page();
        }
    }

    /// Reports the zero, unless the baseline is off.
    #[inline(never)]
    pub(super) fn push_zero_page(&mut self) {
        self.reported.status = self.baseline.status();
        let (Some(from), Some(page)) = (self.identity.cell, self.baseline.page()) else { return };
        let page = SensorPage::Baseline(page);
        self.queue_message(Message::Sensors { from, epoch: self.epoch.unwrap_or_default(), page });
    }
}
