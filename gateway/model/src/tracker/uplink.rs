//! Packets that a cell sent, by its own counter, compared with packets that arrived.

use derive_more::{Add, Sum};

/// Packets of one cell: sent by its own count = delivered + rejected + unheard + lost - surplus, as of its last heartbeat.
#[derive(Add, Clone, Copy, Debug, Default, Eq, PartialEq, Sum)]
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
    /// Arrived more often than sent: repeated on the way, or sent by another cell with this node id.
    pub surplus: u64,
    /// Of the surplus, heartbeats of other senders under this node id: of a cell that claims it, or older ones again.
    pub outsiders: u64,
    /// Arrived with nothing to compare it with: before a cell's first heartbeat, and between its last one
    /// and a restart. How many more it sent then is not known.
    pub in_doubt: u64,
    /// Restarts of the cell.
    pub restarts: u32,
    /// Of those that never arrived, sums for another cell, which the gateway did not receive.
    pub unheard: u64,
    /// Arrived since the last heartbeat: of a dead cell, all that is known of its end.
    pub unsettled: u64,
}

/// Works out a cell's [`Uplink`].
///
/// A heartbeat has the number of packets that the cell sent before it. A bus keeps each sender's order, so what
/// has not arrived by then never will.
#[derive(Clone, Copy, Debug, Default)]
pub struct Account {
    now: Counts,
    /// As if the last start had been none; for [`Account::take_back`].
    before: Option<Counts>,
}

/// An account, and what its next heartbeat is compared with.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    total: Uplink,
    /// What the cell had sent with its last heartbeat, modulo 2^16.
    reported: Option<u16>,
    /// Arrived since then, and of these refused.
    arrived: u64,
    rejected: u64,
    sums: Option<Sums>,
    /// The bus was lost since the last heartbeat.
    interrupted: bool,
}

/// Sums that a cell sends to another one and the gateway does not take, by the cell's own count.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    /// By its last page, modulo 2^16.
    reported: Option<u16>,
    /// Since the account began.
    count: u64,
    /// Of these, found missing.
    found: u64,
    /// The joints of its last page, and of its last heartbeat: sums in between are not counted yet.
    page_at: Option<u64>,
    heartbeat_at: Option<u64>,
}

impl Account {
    /// What it comes to so far.
    #[must_use]
    pub const fn uplink(&self) -> Uplink {
        Uplink { unsettled: self.now.arrived, ..self.now.total }
    }

    /// The bus is lost: packets of the cell do not arrive until its next heartbeat.
    pub fn interrupt(&mut self) {
        self.each(|counts| counts.interrupted = true);
    }

    /// Whether the bus was lost since the cell's last heartbeat: it is not known whether the cell is back on it.
    #[must_use]
    pub const fn is_interrupted(&self) -> bool {
        self.now.interrupted
    }

    /// A packet arrived.
    pub(super) fn arrive(&mut self) {
        self.each(|counts| counts.arrived += 1);
    }

    /// A frame with this cell's identifier arrived that cannot be used.
    pub fn reject(&mut self) {
        self.each(|counts| {
            counts.arrived += 1;
            counts.rejected += 1;
        });
    }

    /// The gateway does not take this cell's sums.
    pub fn without_sums(&mut self) {
        self.each(|counts| _ = counts.sums.get_or_insert_default());
    }

    /// The cell reports how many sums it has sent, modulo 2^16; `joints` is the number of the newest.
    pub(super) fn sums_sent(&mut self, reported: u16, joints: Option<u64>) {
        self.now.sums_sent(reported, joints);
    }

    /// Its heartbeat came after the joints of this number; the account is settled already.
    pub(super) const fn heartbeat_at(&mut self, joints: Option<u64>) {
        if let Some(sums) = &mut self.now.sums {
            sums.heartbeat_at = joints;
        }
    }

    /// No more comes: accounts for missing packets that were sums which the gateway does not take.
    pub fn finish(&mut self) {
        self.now.finish();
    }

    /// The first heartbeat of a cell since it started has arrived; the cell had sent `sent` packets before it, modulo
    /// 2^16. `again` if the cell was there before.
    pub(super) fn begin(&mut self, sent: u16, again: bool) {
        if again {
            self.before.get_or_insert(self.now);
        }
        self.before.iter_mut().for_each(Counts::intrude);
        self.now.begin(sent, again);
    }

    /// A further heartbeat has arrived; the cell had sent `sent` packets before it, modulo 2^16.
    pub(super) fn settle(&mut self, sent: u16) {
        self.before.iter_mut().for_each(Counts::intrude);
        self.now.settle(sent);
    }

    /// An old heartbeat of the cell since its last start has arrived.
    pub(super) fn pass_over(&mut self) {
        self.before.iter_mut().for_each(Counts::intrude);
    }

    /// The last start was one, and is not taken back.
    pub(super) const fn confirm(&mut self) {
        self.before = None;
    }

    /// A heartbeat has arrived that goes on where the account was before the last start: that was none. Whether it is known
    /// what there was before.
    pub(super) fn take_back(&mut self, sent: u16) -> bool {
        let before = self.before.take();
        match before {
            Some(before) => {
                self.now = before;
                self.now.settle(sent);
            }
            None => self.now.begin(sent, false),
        }
        before.is_some()
    }

    /// Whether the last start may still be taken back.
    #[must_use]
    pub const fn is_in_question(&self) -> bool {
        self.before.is_some()
    }

    /// The heartbeat that has just arrived is of another sender under this node id.
    pub(super) fn intrude(&mut self) {
        self.each(Counts::intrude);
    }

    fn each(&mut self, change: impl Fn(&mut Counts)) {
        change(&mut self.now);
        self.before.iter_mut().for_each(change);
    }
}

impl Counts {
    fn sums_sent(&mut self, reported: u16, joints: Option<u64>) {
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

    fn begin(&mut self, sent: u16, again: bool) {
        if again {
            self.total.restarts += 1;
            self.finish();
            if let Some(sums) = &mut self.sums {
                // It counts from zero.
                *sums = Sums { reported: Some(0), ..Sums::default() };
            }
        }
        self.reported = Some(sent.wrapping_add(1));
        self.interrupted = false;
        self.total.sent += 1;
        self.total.delivered += 1;
        self.total.in_doubt += core::mem::take(&mut self.arrived).saturating_sub(1);
        self.rejected = 0;
    }

    fn settle(&mut self, sent: u16) {
        let Some(before) = self.reported else { return self.begin(sent, false) };
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

    fn intrude(&mut self) {
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
        let mut account = Account::default();
        account.arrive();
        account.begin(65_534, false);
        account.arrive();
        account.reject();
        account.arrive();
        account.intrude();
        account.arrive(); // the heartbeat itself
        account.settle(3); // four were sent in between, and this one
        let uplink = account.uplink();
        assert_eq!((uplink.sent, uplink.delivered, uplink.rejected, uplink.lost), (6, 4, 1, 2));
        assert_eq!(uplink.surplus, 1, "the claim of another cell");
        account.arrive(); // a last packet
        account.arrive(); // the claim after its restart
        account.begin(0, true);
        let uplink = account.uplink();
        assert_eq!((uplink.sent, uplink.lost, uplink.in_doubt), (7, 2, 1));
        assert_eq!((uplink.restarts, uplink.unsettled), (1, 0));
    }

    #[test]
    fn packets_lost_in_an_outage_are_counted_as_such() {
        let mut account = Account::default();
        account.begin(0, false);
        account.interrupt();
        account.arrive();
        account.settle(5);
        let lost =
            |account: &Account| (account.uplink().sent, account.uplink().lost, account.uplink().outage);
        assert_eq!(lost(&account), (6, 4, 4));
        account.arrive();
        account.settle(8);
        assert_eq!(lost(&account), (9, 6, 4), "the bus is back");
        account.interrupt();
        account.arrive();
        account.begin(0, true);
        account.arrive();
        account.settle(2);
        assert_eq!(lost(&account), (12, 7, 4), "a restart begins a new account");
    }

    #[test]
    fn a_start_that_was_none_is_taken_back_with_all_that_came_since() {
        let mut account = Account::default();
        account.arrive();
        account.begin(900, false);
        account.arrive(); // a torque
        account.arrive();
        account.begin(100, true); // an old heartbeat again
        account.arrive(); // a torque
        account.arrive();
        account.settle(104); // another old one
        assert_eq!(account.uplink().restarts, 1);
        account.arrive();
        account.take_back(904); // the cell's own: it sent three torques before it
        let uplink = account.uplink();
        assert_eq!((uplink.restarts, uplink.in_doubt, uplink.unsettled), (0, 0, 0));
        assert_eq!((uplink.sent, uplink.lost), (5, 1), "{uplink:?}");
        assert_eq!((uplink.delivered, uplink.surplus, uplink.outsiders), (6, 2, 2), "{uplink:?}");
    }

    proptest! {
        #[test]
        fn an_account_always_adds_up(said in proptest::collection::vec((any::<u16>(), 0_u64..9, 0_u64..9, 0_u8..3, any::<Option<(u16, Option<u64>)>>()), 0..20), takes_sums: bool) {
            let mut account = Account::default();
            if !takes_sums { account.without_sums(); }
            for (said, arrived, rejected, what, sums) in said {
                for _ in 0..arrived { account.arrive(); }
                for _ in 0..rejected { account.reject(); }
                account.arrive();
                match what {
                    0 => account.begin(said, true),
                    1 => account.settle(said),
                    _ => _ = account.take_back(said),
                }
                if let Some((sums, at)) = sums { account.sums_sent(sums, at); }
            }
            account.finish();
            let uplink = account.uplink();
            let there = uplink.delivered + uplink.rejected + uplink.unheard;
            prop_assert_eq!(uplink.sent + uplink.surplus, there + uplink.lost);
        }
    }
}
