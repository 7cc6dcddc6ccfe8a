//! Accounts that must add up: what cells sent against what arrived, and replies due against replies
//! that came.

/// Packets of one cell: sent by its own count = delivered + rejected + unheard + lost, as of its last heartbeat.
///
/// A heartbeat says how many packets the cell sent before it. A bus keeps each sender's order, so what
/// has not arrived by then never will.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Uplink {
    /// Sent, by the cell's own count.
    pub sent: u64,
    /// Arrived and understood.
    pub delivered: u64,
    /// Arrived and refused.
    pub rejected: u64,
    /// Sent and never arrived.
    pub lost: u64,
    /// Of the lost ones, those of a time in which the bus was lost.
    pub outage: u64,
    /// Arrived more often than sent: repeated on the way, or sent by somebody else under this name.
    pub surplus: u64,
    /// Arrived with nothing to compare it with: before a cell's first heartbeat, and between its last one
    /// and a restart. How many more it sent then, nobody knows.
    pub in_doubt: u64,
    /// Times that the cell started anew.
    pub restarts: u32,
    /// Of those that never arrived, sums for another cell, which the gateway did not listen to.
    pub unheard: u64,
    said: Option<u16>,
    arrived_since: u64,
    rejected_since: u64,
    sums: Option<Sums>,
    /// The bus was lost since the last heartbeat.
    interrupted: bool,
}

/// Sums that a cell sends to another one and the gateway does not take, by the cell's own count.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
struct Sums {
    /// By its last page, modulo 2^16.
    said: Option<u16>,
    /// Since the account began.
    count: u64,
    /// Of these, found missing.
    found: u64,
    /// The joints of its last page, and of its last heartbeat: what it has said in between nobody has counted.
    page_at: Option<u64>,
    heartbeat_at: Option<u64>,
}

impl Uplink {
    /// The bus is lost: what the cell sends until it is heard again does not arrive.
    pub(super) const fn interrupt(&mut self) {
        self.interrupted = true;
    }

    /// Whether the bus was lost since the cell's last heartbeat: nobody knows whether it is back on it.
    pub(super) const fn is_interrupted(&self) -> bool {
        self.interrupted
    }

    /// A packet arrived.
    pub(super) const fn arrive(&mut self) {
        self.arrived_since += 1;
    }

    /// A frame with this cell's identifier arrived that cannot be used.
    pub(super) const fn reject(&mut self) {
        self.rejected_since += 1;
    }

    /// The gateway does not take this cell's sums.
    pub(super) fn without_sums(&mut self) {
        self.sums.get_or_insert_default();
    }

    /// The cell says how many sums it has sent, modulo 2^16; `joints` is the number of the newest.
    pub(super) fn sums_sent(&mut self, said: u16, joints: Option<u64>) {
        let Some(sums) = &mut self.sums else { return };
        let before = sums.said.replace(said).unwrap_or(said);
        sums.count += u64::from(said.wrapping_sub(before));
        sums.page_at = joints;
    }

    /// Its heartbeat was said after the joints of this number; the account is settled already.
    pub(super) const fn heartbeat_at(&mut self, joints: Option<u64>) {
        if let Some(sums) = &mut self.sums {
            sums.heartbeat_at = joints;
        }
    }

    /// What is missing and was a sum that the gateway does not take.
    fn explain_sums(&mut self) {
        let Some(sums) = &mut self.sums else { return };
        // With joints between its page and its heartbeat, it may have said more of them than the page counts.
        let at_most = if sums.page_at == sums.heartbeat_at { sums.count - sums.found } else { u64::MAX };
        let found = (self.lost - self.outage).min(at_most);
        self.lost -= found;
        self.unheard += found;
        sums.found += found;
        sums.count = sums.count.max(sums.found);
    }

    /// No more comes.
    pub(super) fn finish(&mut self) {
        self.explain_sums();
    }

    /// A heartbeat, which has arrived, says that the cell had sent `said` packets before it, modulo 2^16.
    pub(super) fn settle(&mut self, said: u16, restarted: bool) {
        let said = said.wrapping_add(1);
        let before = self.said.replace(said);
        if restarted && before.is_some() {
            self.restarts += 1;
        }
        let (arrived, rejected) = (self.arrived_since, self.rejected_since);
        (self.arrived_since, self.rejected_since) = (0, 0);
        if restarted {
            self.explain_sums();
            if let Some(sums) = &mut self.sums {
                // It counts from zero.
                *sums = Sums { said: Some(0), ..Sums::default() };
            }
        }
        let interrupted = core::mem::take(&mut self.interrupted);
        let Some(before) = before.filter(|_| !restarted) else {
            // The account begins with this heartbeat.
            self.sent += 1;
            self.delivered += 1;
            self.in_doubt += (arrived + rejected).saturating_sub(1);
            return;
        };
        let sent = u64::from(said.wrapping_sub(before));
        self.sent += sent;
        self.delivered += arrived;
        self.rejected += rejected;
        let lost = sent.saturating_sub(arrived + rejected);
        self.lost += lost;
        self.outage += if interrupted { lost } else { 0 };
        self.surplus += (arrived + rejected).saturating_sub(sent);
    }

    /// Packets that arrived since the last heartbeat: of a dead cell, all that is known of its end.
    #[must_use]
    pub const fn unsettled(&self) -> u64 {
        self.arrived_since + self.rejected_since
    }

    /// The account of several cells together.
    #[must_use]
    pub fn total(all: impl Iterator<Item = Self>) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            sent: sum.sent + one.sent,
            delivered: sum.delivered + one.delivered,
            rejected: sum.rejected + one.rejected,
            lost: sum.lost + one.lost,
            outage: sum.outage + one.outage,
            surplus: sum.surplus + one.surplus,
            in_doubt: sum.in_doubt + one.in_doubt,
            restarts: sum.restarts + one.restarts,
            unheard: sum.unheard + one.unheard,
            said: None,
            arrived_since: sum.arrived_since + one.arrived_since,
            rejected_since: sum.rejected_since + one.rejected_since,
            sums: None,
            interrupted: false,
        })
    }
}

/// Replies of one cell: due = in time + late + missing.
///
/// A reply is due when the cell is configured, awake, and feels a force by Algorithm 1.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Replies {
    /// Epochs that the cell had to answer.
    pub due: u64,
    /// Answered before the next broadcast.
    pub in_time: u64,
    /// Answered after it.
    pub late: u64,
    /// Not answered.
    pub missing: u64,
    /// Of the missing ones, those of a cell that was dead or started anew, or whose bus was lost.
    pub in_doubt: u64,
    /// Torques that nobody was waiting for: ends of contacts, and cells whose sensors are unknown.
    pub unasked: u64,
    /// Torques that came when their epoch, or a later one of the same cell, was over, and were dropped.
    pub too_late: u64,
}

impl Replies {
    /// The account of several cells together.
    #[must_use]
    pub fn total(all: impl Iterator<Item = Self>) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            due: sum.due + one.due,
            in_time: sum.in_time + one.in_time,
            late: sum.late + one.late,
            missing: sum.missing + one.missing,
            in_doubt: sum.in_doubt + one.in_doubt,
            unasked: sum.unasked + one.unasked,
            too_late: sum.too_late + one.too_late,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_did_not_arrive_by_the_next_heartbeat_is_lost() {
        let mut uplink = Uplink::default();
        uplink.settle(65_534, false);
        uplink.arrive();
        uplink.reject();
        uplink.arrive(); // the heartbeat itself
        uplink.settle(3, false); // four were sent in between, and this one
        assert_eq!((uplink.sent, uplink.delivered, uplink.rejected, uplink.lost), (6, 3, 1, 2));
        uplink.arrive(); // a last word
        uplink.arrive(); // the claim of its next life
        uplink.settle(0, true);
        assert_eq!((uplink.sent, uplink.lost, uplink.in_doubt), (7, 2, 1));
        assert_eq!((uplink.restarts, uplink.unsettled()), (1, 0));
    }

    #[test]
    fn what_did_not_arrive_while_the_bus_was_lost_is_known_to_be_so() {
        let mut uplink = Uplink::default();
        uplink.settle(0, false);
        uplink.interrupt();
        uplink.arrive();
        uplink.settle(5, false);
        assert_eq!((uplink.sent, uplink.lost, uplink.outage), (6, 4, 4));
        uplink.arrive();
        uplink.settle(8, false);
        assert_eq!((uplink.sent, uplink.lost, uplink.outage), (9, 6, 4), "the bus is back");
        uplink.interrupt();
        uplink.settle(0, true);
        uplink.arrive();
        uplink.settle(2, false);
        assert_eq!((uplink.lost, uplink.outage), (7, 4), "a new life has an account of its own");
    }

    proptest! {
        #[test]
        fn an_account_always_adds_up(said in proptest::collection::vec((any::<u16>(), 0_u64..9, 0_u64..9, any::<bool>(), any::<Option<(u16, Option<u64>)>>()), 0..20), takes_sums: bool) {
            let mut uplink = Uplink::default();
            if !takes_sums { uplink.without_sums(); }
            for (said, arrived, rejected, restarted, sums) in said {
                for _ in 0..arrived { uplink.arrive(); }
                for _ in 0..rejected { uplink.reject(); }
                uplink.settle(said, restarted);
                if let Some((sums, at)) = sums { uplink.sums_sent(sums, at); }
            }
            uplink.finish();
            let there = uplink.delivered + uplink.rejected + uplink.unheard;
            prop_assert_eq!(uplink.sent + uplink.surplus, there + uplink.lost);
        }
    }
}
