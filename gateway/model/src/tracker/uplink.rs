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
        Uplink { unsettled: self.arrived, ..self.total }
    }

    /// The bus is lost: packets of the cell do not arrive until its next heartbeat.
    pub const fn interrupt(&mut self) {
        self.interrupted = true;
    }

    /// Whether the bus was lost since the cell's last heartbeat: it is not known whether the cell is back on it.
    #[must_use]
    pub const fn is_interrupted(&self) -> bool {
        self.interrupted
    }

    /// A packet arrived.
    pub(super) const fn arrive(&mut self) {
        self.arrived += 1;
    }

    /// A frame with this cell's identifier arrived that cannot be used.
    pub const fn reject(&mut self) {
        self.arrived += 1;
        self.rejected += 1;
    }

    /// The gateway does not take this cell's sums.
    pub fn without_sums(&mut self) {
        self.sums.get_or_insert_default();
    }

    /// The cell reports how many sums it has sent, modulo 2^16; `joints` is the number of the newest.
    pub(super) fn sums_sent(&mut self, reported: u16, joints: Option<u64>) {
        let Some(sums) = &mut self.sums else { return };
        let before = sums.reported.replace(reported).unwrap_or(reported);
        sums.count += u64::from(reported.wrapping_sub(before));
        sums.page_at = joints;
    }

    /// Its heartbeat came after the joints of this number; the account is settled already.
    pub(super) const fn heartbeat_at(&mut self, joints: Option<u64>) {
        if let Some(sums) = &mut self.sums {
            sums.heartbeat_at = joints;
        }
    }

    /// No more comes: accounts for missing packets that were sums which the gateway does not take.
    pub fn finish(&mut self) {
        let Some(sums) = &mut self.sums else { return };
        // With joints between its page and its heartbeat, it may have sent more sums than the page counts.
        let at_most = if sums.page_at == sums.heartbeat_at { sums.count - sums.found } else { u64::MAX };
        let found = (self.total.lost - self.total.outage).min(at_most);
        self.total.lost -= found;
        self.total.unheard += found;
        sums.found += found;
        sums.count = sums.count.max(sums.found);
    }

    /// The first heartbeat of a cell since it started has arrived; the cell had sent `sent` packets before it, modulo
    /// 2^16. `again` if the cell was there before.
    pub(super) fn begin(&mut self, sent: u16, again: bool) {
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

    /// A further heartbeat has arrived; the cell had sent `sent` packets before it, modulo 2^16.
    pub(super) fn settle(&mut self, sent: u16) {
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

    /// The packet that has just arrived is of another cell, which claims this one's node id.
    pub(super) const fn intrude(&mut self) {
        self.arrived -= 1;
        self.total.delivered += 1;
        self.total.surplus += 1;
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
        account.begin(0, true);
        account.arrive();
        account.settle(2);
        assert_eq!(lost(&account), (12, 7, 4), "a restart begins a new account");
    }

    proptest! {
        #[test]
        fn an_account_always_adds_up(said in proptest::collection::vec((any::<u16>(), 0_u64..9, 0_u64..9, any::<bool>(), any::<Option<(u16, Option<u64>)>>()), 0..20), takes_sums: bool) {
            let mut account = Account::default();
            if !takes_sums { account.without_sums(); }
            for (said, arrived, rejected, restarted, sums) in said {
                for _ in 0..arrived { account.arrive(); }
                for _ in 0..rejected { account.reject(); }
                if restarted { account.begin(said, true); } else { account.settle(said); }
                if let Some((sums, at)) = sums { account.sums_sent(sums, at); }
            }
            account.finish();
            let uplink = account.uplink();
            let there = uplink.delivered + uplink.rejected + uplink.unheard;
            prop_assert_eq!(uplink.sent + uplink.surplus, there + uplink.lost);
        }
    }
}
