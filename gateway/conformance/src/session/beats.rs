//! Regular heartbeats: none is left out, and none is too many.

use protocol::time::Span;

use super::Session;
use super::ledger::BEAT;
use crate::bus::Stop;

/// Around a regular heartbeat nothing is asked for so long.
const EDGE: Span = Span::from_millis(25);

impl Session<'_> {
    /// Waits for a heartbeat that nothing asked for. Since the last such one every 250 ms one had to come, and one to each sync
    /// and claim.
    pub(crate) fn regular_beat(&mut self) -> Result<(), Stop> {
        // Answers to what was asked before have come.
        self.settle()?;
        let until = self.now() + BEAT + EDGE + EDGE;
        let came = self.wait(until, |heard| heard.iter().any(|it| it.beat().is_some()))?;
        let at = self.answers().iter().find(|it| it.beat().is_some()).map(|it| it.at);
        self.check("BEAT-1", came, || "no heartbeat came for 300 ms".to_owned());
        self.clock.regular = at;
        if let Some((came, least, most)) = at.and_then(|at| self.ledger.regular(at)) {
            self.check("BEAT-1", (least..=most).contains(&came), || {
                let due = if least == most { least.to_string() } else { format!("{least} to {most}") };
                format!("{came} heartbeats came; {due} were due, every 250 ms and to each sync and claim")
            });
        }
        self.idle(EDGE)?;
        self.consume();
        Ok(())
    }

    /// No regular heartbeat comes for so long, less than 200 ms.
    pub(crate) fn quiet(&mut self, span: Span) -> Result<(), Stop> {
        let now = self.now();
        let is_free = self.clock.regular.is_some_and(|at| {
            let since = now.since(at);
            since > EDGE && since.0 + span.0 + EDGE.0 < BEAT.0
        });
        if is_free { Ok(()) } else { self.regular_beat() }
    }
}
