//! Checks of the number of regular heartbeats, which must match exactly.

use protocol::time::Span;

use super::Session;
use super::accounts::HEARTBEAT_INTERVAL;
use crate::bus::StopReason;

/// The time before and after a regular heartbeat in which no request is sent.
const HEARTBEAT_QUIET_MARGIN: Span = Span::from_millis(25);

impl Session<'_> {
    /// Waits for a regular heartbeat, and checks the number of heartbeats since the last one: one every 250 ms, and one
    /// for each sync and claim.
    pub(crate) fn check_regular_heartbeat(&mut self) -> Result<(), StopReason> {
        // Lets the answers to earlier requests arrive.
        self.wait_for_late_packets()?;
        let until = self.now() + HEARTBEAT_INTERVAL + HEARTBEAT_QUIET_MARGIN + HEARTBEAT_QUIET_MARGIN;
        let came =
            self.wait_for_packets(until, |heard| heard.iter().any(|it| it.heartbeat_and_epoch().is_some()))?;
        let at = self.answers().iter().find(|it| it.heartbeat_and_epoch().is_some()).map(|it| it.at);
        self.check("BEAT-1", came, || {
            "the cell must send a heartbeat every 250 ms, but it sent none for 300 ms".to_owned()
        });
        self.life.regular = at;
        if let Some((came, min, max)) = at.and_then(|at| self.life.accounts.note_regular_heartbeat(at)) {
            self.check("BEAT-1", (min..=max).contains(&came), || {
                let due = if min == max { min.to_string() } else { format!("{min} to {max}") };
                format!(
                    "the cell sent {came} heartbeats, but {due} were due: one every 250 ms, and one for each \
                     sync and claim"
                )
            });
        }
        self.receive_for(HEARTBEAT_QUIET_MARGIN)?;
        self.mark_packets_expected();
        Ok(())
    }

    /// Checks the total number of heartbeats in the test, unless the bench was late by 250 ms: a shorter delay makes
    /// the cell omit no heartbeat.
    pub(crate) fn check_heartbeat_total(&mut self) {
        let surplus = self.life.accounts.surplus_heartbeats();
        if self.clock.longest < HEARTBEAT_INTERVAL {
            self.begin_expected_exchange();
            self.check("BEAT-1", surplus == 0, || {
                let many = if surplus > 0 { "more" } else { "fewer" };
                format!("over the whole test the cell sent {} heartbeats {many} than are due", surplus.abs())
            });
        }
    }

    /// Waits until no regular heartbeat is due during the next `span`, which must be less than 200 ms.
    pub(crate) fn wait_for_heartbeat_gap(&mut self, span: Span) -> Result<(), StopReason> {
        let now = self.now();
        let is_free = self.life.regular.is_some_and(|at| {
            let since = now.elapsed_since(at);
            since > HEARTBEAT_QUIET_MARGIN
                && since.0 + span.0 + HEARTBEAT_QUIET_MARGIN.0 < HEARTBEAT_INTERVAL.0
        });
        if is_free { Ok(()) } else { self.check_regular_heartbeat() }
    }
}
