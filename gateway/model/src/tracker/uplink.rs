//! Counts the packets that a cell sent, by its own counter, and those that arrived.

use derive_more::{Add, Sum};

/// Counts of one cell's packets as of its last heartbeat: sent = delivered + rejected + unheard + lost - surplus.
#[derive(Add, Clone, Copy, Debug, Default, Eq, PartialEq, Sum)]
pub struct UplinkCounts {
    /// Packets sent, by the cell's own count.
    pub sent: u64,
    /// Packets that arrived and were decoded.
    pub delivered: u64,
    /// Packets that arrived and were refused as damaged or unknown.
    pub rejected: u64,
    /// Packets that were sent and never arrived.
    pub lost: u64,
    /// Lost packets from the time in which the bus was lost; `lost` includes them.
    pub outage: u64,
    /// Packets that arrived in excess of those sent: repeated on the way, or sent by another cell with this node id.
    pub surplus: u64,
    /// Heartbeats from other senders, included in `surplus`: from a cell that claims this node id, or repeated old
    /// ones.
    pub outsiders: u64,
    /// Packets that no count of the cell covers: before its first heartbeat, and between its last heartbeat and a
    /// restart. The cell may have sent more packets then.
    pub in_doubt: u64,
    /// Restarts of the cell.
    pub restarts: u32,
    /// Sums for another cell, which the cell sent and the gateway does not receive.
    pub unheard: u64,
    /// Packets that arrived since the last heartbeat; for a dead cell, the last that arrived from it.
    pub unsettled: u64,
}

/// Computes a cell's [`UplinkCounts`].
///
/// A heartbeat contains the number of packets that the cell sent before it. A bus keeps the order of each sender, so
/// packets that are missing by then are lost.
#[derive(Clone, Copy, Debug, Default)]
pub struct UplinkAccount {
    now: CountsSinceStart,
    /// The counts before the cell's last start; [`UplinkAccount::revoke_start`] restores them.
    before: Option<CountsSinceStart>,
}

/// The counts of a cell since its last start, and what its next heartbeat is compared with.
#[derive(Clone, Copy, Debug, Default)]
struct CountsSinceStart {
    total: UplinkCounts,
    /// The cell's counter of sent packets in its last heartbeat, modulo 2^16.
    reported: Option<u16>,
    /// Number of packets that arrived since the last heartbeat, and of those refused among them.
    arrived: u64,
    rejected: u64,
    sums: Option<UnreceivedSums>,
    /// True if the bus was lost since the last heartbeat.
    interrupted: bool,
}

/// The sums that a cell sends to another cell, by its own count. The gateway does not receive them.
#[derive(Clone, Copy, Debug, Default)]
struct UnreceivedSums {
    /// The count in the cell's last page, modulo 2^16.
    reported: Option<u16>,
    /// Number of sums since the account began.
    count: u64,
    /// Number of these sums that explain packets missing at the gateway.
    found: u64,
    /// The number of the newest joints at the cell's last page, and in the next field at its last heartbeat. Sums sent
    /// between the two are not counted yet.
    page_at: Option<u64>,
    heartbeat_at: Option<u64>,
}

impl UplinkAccount {
    /// Returns the counts so far.
    #[must_use]
    pub const fn uplink(&self) -> UplinkCounts {
        UplinkCounts { unsettled: self.now.arrived, ..self.now.total }
    }

    /// Records that the bus was lost: packets of the cell do not arrive until its next heartbeat.
    pub fn handle_connection_loss(&mut self) {
        self.change_counts(|counts| counts.interrupted = true);
    }

    /// Returns true if the bus was lost since the cell's last heartbeat, so that the cell may still be disconnected.
    #[must_use]
    pub const fn is_interrupted(&self) -> bool {
        self.now.interrupted
    }

    /// Counts a packet that arrived.
    pub(super) fn count_packet(&mut self) {
        self.change_counts(|counts| counts.arrived += 1);
    }

    /// Counts an unusable frame with this cell's identifier.
    pub fn count_rejected(&mut self) {
        self.change_counts(|counts| {
            counts.arrived += 1;
            counts.rejected += 1;
        });
    }

    /// Declares that the gateway does not receive this cell's sums.
    pub fn exclude_unreceived_sums(&mut self) {
        self.change_counts(|counts| _ = counts.sums.get_or_insert_default());
    }

    /// Records the number of sums that the cell reports as sent, modulo 2^16; `joints` is the number of the newest
    /// joints.
    pub(super) fn record_sums_sent(&mut self, reported: u16, joints: Option<u64>) {
        self.now.record_sums_sent(reported, joints);
    }

    /// Records the number of the newest joints at its heartbeat, after the account is settled.
    pub(super) const fn set_joints_at_heartbeat(&mut self, joints: Option<u64>) {
        if let Some(sums) = &mut self.now.sums {
            sums.heartbeat_at = joints;
        }
    }

    /// Ends the counting: missing packets are attributed to sums that the gateway does not receive.
    pub fn finish(&mut self) {
        self.now.finish();
    }

    /// Records the first heartbeat since a start. The cell had sent `sent` packets before it, modulo 2^16; `again` is
    /// true if the cell was present before the start.
    pub(super) fn record_start(&mut self, sent: u16, again: bool) {
        if again {
            self.before.get_or_insert(self.now);
        }
        self.before.iter_mut().for_each(CountsSinceStart::count_foreign_heartbeat);
        self.now.record_start(sent, again);
    }

    /// Records a further heartbeat; the cell had sent `sent` packets before it, modulo 2^16.
    pub(super) fn record_heartbeat(&mut self, sent: u16) {
        self.before.iter_mut().for_each(CountsSinceStart::count_foreign_heartbeat);
        self.now.record_heartbeat(sent);
    }

    /// Records a heartbeat that is older than the last one, since the cell's last start.
    pub(super) fn count_overtaken_heartbeat(&mut self) {
        self.before.iter_mut().for_each(CountsSinceStart::count_foreign_heartbeat);
    }

    /// Confirms the last start, which can no longer be taken back.
    pub(super) const fn confirm_start(&mut self) {
        self.before = None;
    }

    /// Records a heartbeat that continues the counts from before the last start, and so disproves that start. Returns
    /// true if the earlier counts are known.
    pub(super) fn revoke_start(&mut self, sent: u16) -> bool {
        let before = self.before.take();
        match before {
            Some(before) => {
                self.now = before;
                self.now.record_heartbeat(sent);
            }
            None => self.now.record_start(sent, false),
        }
        before.is_some()
    }

    /// Returns true if the last start may still be taken back.
    #[must_use]
    pub const fn is_start_in_doubt(&self) -> bool {
        self.before.is_some()
    }

    /// Records that the last heartbeat is from another sender with this node id.
    pub(super) fn count_foreign_heartbeat(&mut self) {
        self.change_counts(CountsSinceStart::count_foreign_heartbeat);
    }

    fn change_counts(&mut self, change: impl Fn(&mut CountsSinceStart)) {
        change(&mut self.now);
        self.before.iter_mut().for_each(change);
    }
}

impl CountsSinceStart {
    fn record_sums_sent(&mut self, reported: u16, joints: Option<u64>) {
        let Some(sums) = &mut self.sums else { return };
        let before = sums.reported.replace(reported).unwrap_or(reported);
        sums.count += u64::from(reported.wrapping_sub(before));
        sums.page_at = joints;
    }

    fn finish(&mut self) {
        let Some(sums) = &mut self.sums else { return };
        // With joints between its page and its heartbeat, it may have sent more sums than the page counts.
        let at_most = if sums.page_at == sums.heartbeat_at { sums.count - sums.found } else { u64::MAX };
        let found = (self.total.lost - self.total.outage).min(at_most);
        self.total.lost -= found;
        self.total.unheard += found;
        sums.found += found;
        sums.count = sums.count.max(sums.found);
    }

    fn record_start(&mut self, sent: u16, again: bool) {
        if again {
            self.total.restarts += 1;
            self.finish();
            if let Some(sums) = &mut self.sums {
                // The cell counts from zero.
                *sums = UnreceivedSums { reported: Some(0), ..UnreceivedSums::default() };
            }
        }
        self.reported = Some(sent.wrapping_add(1));
        self.interrupted = false;
        self.total.sent += 1;
        self.total.delivered += 1;
        self.total.in_doubt += core::mem::take(&mut self.arrived).saturating_sub(1);
        self.rejected = 0;
    }

    fn record_heartbeat(&mut self, sent: u16) {
        let Some(before) = self.reported else { return self.record_start(sent, false) };
        let reported = sent.wrapping_add(1);
        let (arrived, rejected) = (core::mem::take(&mut self.arrived), core::mem::take(&mut self.rejected));
        let sent = u64::from(reported.wrapping_sub(before));
        let lost = sent.saturating_sub(arrived);
        let total = &mut self.total;
        total.sent += sent;
        total.delivered += arrived - rejected;
        total.rejected += rejected;
        total.lost += lost;
        total.outage += if core::mem::take(&mut self.interrupted) { lost } else { 0 };
        total.surplus += arrived.saturating_sub(sent);
        self.reported = Some(reported);
    }

    fn count_foreign_heartbeat(&mut self) {
        self.arrived -= 1;
        self.total.delivered += 1;
        self.total.surplus += 1;
        self.total.outsiders += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn packets_that_did_not_arrive_by_the_next_heartbeat_are_lost() {
        let mut account = UplinkAccount::default();
        account.count_packet();
        account.record_start(65_534, false);
        account.count_packet();
        account.count_rejected();
        account.count_packet();
        account.count_foreign_heartbeat();
        account.count_packet(); // the heartbeat itself
        account.record_heartbeat(3); // four were sent in between, and this one
        let uplink = account.uplink();
        assert_eq!((uplink.sent, uplink.delivered, uplink.rejected, uplink.lost), (6, 4, 1, 2));
        assert_eq!(uplink.surplus, 1, "the claim of another cell");
        account.count_packet(); // a last packet
        account.count_packet(); // the claim after its restart
        account.record_start(0, true);
        let uplink = account.uplink();
        assert_eq!((uplink.sent, uplink.lost, uplink.in_doubt), (7, 2, 1));
        assert_eq!((uplink.restarts, uplink.unsettled), (1, 0));
    }

    #[test]
    fn packets_lost_in_an_outage_are_counted_as_such() {
        let mut account = UplinkAccount::default();
        account.record_start(0, false);
        account.handle_connection_loss();
        account.count_packet();
        account.record_heartbeat(5);
        let lost =
            |account: &UplinkAccount| (account.uplink().sent, account.uplink().lost, account.uplink().outage);
        assert_eq!(lost(&account), (6, 4, 4));
        account.count_packet();
        account.record_heartbeat(8);
        assert_eq!(lost(&account), (9, 6, 4), "the bus is back");
        account.handle_connection_loss();
        account.count_packet();
        account.record_start(0, true);
        account.count_packet();
        account.record_heartbeat(2);
        assert_eq!(lost(&account), (12, 7, 4), "a restart begins a new account");
    }

    #[test]
    fn a_start_that_was_none_is_taken_back_with_all_that_came_since() {
        let mut account = UplinkAccount::default();
        account.count_packet();
        account.record_start(900, false);
        account.count_packet(); // a torque
        account.count_packet();
        account.record_start(100, true); // an old heartbeat again
        account.count_packet(); // a torque
        account.count_packet();
        account.record_heartbeat(104); // another old one
        assert_eq!(account.uplink().restarts, 1);
        account.count_packet();
        account.revoke_start(904); // the cell's own: it sent three torques before it
        let uplink = account.uplink();
        assert_eq!((uplink.restarts, uplink.in_doubt, uplink.unsettled), (0, 0, 0));
        assert_eq!((uplink.sent, uplink.lost), (5, 1), "{uplink:?}");
        assert_eq!((uplink.delivered, uplink.surplus, uplink.outsiders), (6, 2, 2), "{uplink:?}");
    }

    proptest! {
        #[test]
        fn an_account_always_adds_up(said in proptest::collection::vec((any::<u16>(), 0_u64..9, 0_u64..9, 0_u8..3, any::<Option<(u16, Option<u64>)>>()), 0..20), takes_sums: bool) {
            let mut account = UplinkAccount::default();
            if !takes_sums { account.exclude_unreceived_sums(); }
            for (said, arrived, rejected, what, sums) in said {
                for _ in 0..arrived { account.count_packet(); }
                for _ in 0..rejected { account.count_rejected(); }
                account.count_packet();
                match what {
                    0 => account.record_start(said, true),
                    1 => account.record_heartbeat(said),
                    _ => _ = account.revoke_start(said),
                }
                if let Some((sums, at)) = sums { account.record_sums_sent(sums, at); }
            }
            account.finish();
            let uplink = account.uplink();
            let there = uplink.delivered + uplink.rejected + uplink.unheard;
            prop_assert_eq!(uplink.sent + uplink.surplus, there + uplink.lost);
        }
    }
}
