//! The owner of a node id as a state machine: states, evidence of heartbeats, and the transition table.
//!
//! ```text
//!            Claims,               Intrudes, Starts,
//!   ┌──────┐ Settles ┌──────┐      Jumps, Succeeds      ┌─────────┐
//!   │ Free │ ──────> │ Sole │ ────────────────────────> │ Doubted │
//!   └──────┘         └──────┘                           └────┬────┘
//!                                                            │ FormerContinues
//!                    ┌───────────┐       Succeeds       ┌────▼───┐
//!                    │ Inherited │ <─────────────────── │ Shared │
//!                    └─────┬─────┘                      └────▲───┘
//!                          └───────── FormerContinues ───────┘
//! ```
//!
//! Each row is a row of the tests, which go through all states and all evidence. *Former* is the life before a start
//! that may be taken back; it *may go on* for 10 s after its last heartbeat.
//!
//! | row | state | evidence | next | word | why |
//! |---|---|---|---|---|---|
//! | `first_claim` | `Free` | `Claims` | `Sole` | `Started`, not again | a cell claims its id for half a second after a start, and at no other time |
//! | `found` | `Free` | `Settles` | `Sole` | `First` | it started before the reader |
//! | `other_claim` | all others | `Claims` | the same | `Claimant` | a claimant yields to the owner, or to an earlier claimant |
//! | `claimant_lost` | all others | `Settles` | the same, new owner | `First` | the owner only claimed the id, and lost the claim |
//! | `old` | all others | `Repeats` | the same | `Overtaken` | it adds nothing to its successor |
//! | `next` | all others | `Continues` | the same, newer owner | `Known` | the counter fits the owner at least as well as the former |
//! | `away` | `Sole`, `Doubted` | `Returns` | the same, newer owner | `Known` | after 10 s its counter cannot be predicted; its serial number is the owner's |
//! | `start` | `Sole` | `Intrudes`, `Starts`, `Jumps`, `Succeeds` | `Doubted`, former: the owner | `Started` again | a start is accepted at once |
//! | `further_start` | `Doubted`, former may go on | `Intrudes`, `Starts`, `Jumps`, `Succeeds` | `Doubted`, former: as before | `Started` again | two old heartbeats in turn must not hide a cell that goes on |
//! | `start_after_former` | `Doubted`, former may not | `Intrudes`, `Starts`, `Jumps`, `Succeeds` | `Doubted`, former: the owner | `Started` again | only the owner can still go on |
//! | `impossible` | `Sole`, `Doubted` | `Exceeds` | the same | `Outsider` | neither the owner nor a cell that started since can have sent so much |
//! | `taken_back` | `Doubted`, `Inherited` | `FormerContinues` | `Shared` | `Shared` | the apparent start was an old heartbeat, or that of another cell with this id |
//! | `outsider` | `Shared`, `Inherited` | `Intrudes`, `Starts`, `Jumps`, `Returns`, `Exceeds` | the same | `Outsider` | after one false start, no start is accepted while the owner is alive |
//! | `successor` | `Shared` | `Succeeds` | `Inherited`, former: the owner | `Started` again | the owner is silent, and the candidate is alive |
//! | `further_successor` | `Inherited`, former may go on | `Succeeds` | `Inherited`, former: as before | `Started` again | as `further_start` |
//! | `successor_after_former` | `Inherited`, former may not | `Succeeds` | `Inherited`, former: the owner | `Started` again | as `start_after_former` |
//! | `incomparable` | `Free`; `Sole`, `Shared` | all but `Claims`, `Settles`; `FormerContinues` | the same | `Overtaken` | impossible: the state has no owner or former to compare with |
//!
//! A shared id stays shared: `Shared` and `Inherited` never become `Sole` again. The owner's last heartbeat shows
//! whether it has settled; this needs no state.

use super::HeartbeatKind;
use super::life::{Incarnation, MAX_PACKETS_PER_HEARTBEAT};

/// The owner of a node id, and how certain its ownership is.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(super) enum Ownership {
    /// No heartbeat has arrived.
    #[default]
    Free,
    /// One cell owns the id, or is the first one to claim it.
    Sole { owner: Incarnation },
    /// The owner seems to have started. If a heartbeat continues the `former` life, the cell did not start.
    Doubted { owner: Incarnation, former: Incarnation },
    /// Two senders have used the id in turn: only a successor of a silent owner is accepted.
    Shared { owner: Incarnation },
    /// A candidate succeeded the silent owner of a shared node id. The `former` life may still continue.
    Inherited { owner: Incarnation, former: Incarnation },
}

/// A fact about the sender that a heartbeat proves. If several hold, [`Ownership::evidence`] returns the first in this
/// order.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum HeartbeatEvidence {
    /// The heartbeat has CLAIMING, and a serial number other than the owner's, if there is an owner.
    Claims,
    /// The heartbeat does not have CLAIMING, and the node id has no owner, or an owner with another serial number that
    /// still claims it.
    Settles,
    /// The heartbeat continues the counter of the former life, and either its serial number differs from a settled
    /// owner's, or it does not continue the owner's counter. If it continues both counters, it counts as the former's
    /// in two cases: the owner's claim was received and cannot be over yet; or the claim was not received, and the
    /// former's counter is nearer.
    FormerContinues,
    /// The heartbeat is from another settled cell, while the owner is settled.
    Intrudes,
    /// The heartbeat is the owner's first packet after a start.
    Starts,
    /// The heartbeat is a copy of the owner's last one, or an older one. If the owner's claim was not received, it may
    /// also be an old one of the former life.
    Repeats,
    /// The heartbeat continues the owner's counter.
    Continues,
    /// The owner was silent for more than 10 s, and the counter in the heartbeat is ahead of its last one.
    Returns,
    /// The counter in the heartbeat is larger than that of any cell that started since the owner's last heartbeat.
    Exceeds,
    /// The counter in the heartbeat continues neither the owner's nor the former's: the sender is a cell whose claim
    /// was lost, or repeats an old heartbeat.
    Jumps,
    /// The sender of the heartbeat succeeds the silent owner, by the rules of [`super::candidate`]. A single heartbeat
    /// cannot prove this.
    Succeeds,
}

impl Ownership {
    /// Returns the life of the cell that owns the node id, or claims it.
    pub(super) const fn owner(&self) -> Option<&Incarnation> {
        match self {
            Self::Free => None,
            Self::Sole { owner }
            | Self::Doubted { owner, .. }
            | Self::Shared { owner }
            | Self::Inherited { owner, .. } => Some(owner),
        }
    }

    /// Returns the life before the owner's start, if it may still disprove that start.
    pub(super) const fn former_incarnation(&self) -> Option<&Incarnation> {
        match self {
            Self::Doubted { former, .. } | Self::Inherited { former, .. } => Some(former),
            Self::Free | Self::Sole { .. } | Self::Shared { .. } => None,
        }
    }

    /// Returns the state with another owner.
    const fn with_owner(self, owner: Incarnation) -> Self {
        match self {
            Self::Free => Self::Free,
            Self::Sole { .. } => Self::Sole { owner },
            Self::Doubted { former, .. } => Self::Doubted { owner, former },
            Self::Shared { .. } => Self::Shared { owner },
            Self::Inherited { former, .. } => Self::Inherited { owner, former },
        }
    }

    /// Returns the state after the owner's next heartbeat.
    fn with_last_heartbeat(self, last: Incarnation) -> Self {
        self.owner().map_or(self, |owner| self.with_owner(owner.with_heartbeat_of(last)))
    }

    /// Returns the fact that a heartbeat proves; `new` is the life that would begin with it.
    pub(super) fn evidence(&self, new: &Incarnation) -> HeartbeatEvidence {
        let Some(owner) = self.owner() else {
            return if new.owns_node_id() { HeartbeatEvidence::Settles } else { HeartbeatEvidence::Claims };
        };
        let of_former = self.former_incarnation().and_then(|former| former.packets_until(new));
        if !owner.is_same_cell(new) {
            return match (owner.owns_node_id(), new.owns_node_id()) {
                (_, false) => HeartbeatEvidence::Claims,
                (false, true) => HeartbeatEvidence::Settles,
                (true, true) if of_former.is_some() => HeartbeatEvidence::FormerContinues,
                (true, true) => HeartbeatEvidence::Intrudes,
            };
        }
        if new.has_just_started() {
            return HeartbeatEvidence::Starts;
        }
        let is_old_of_former = || {
            self.former_incarnation()
                .is_some_and(|former| former.is_alive(new.at) && former.is_own_old_heartbeat(new))
        };
        if owner.is_own_old_heartbeat(new) || owner.claimed.is_none() && is_old_of_former() {
            return HeartbeatEvidence::Repeats;
        }
        match (owner.packets_until(new), of_former) {
            (Some(_), Some(_)) if owner.is_still_claiming_at(new) => HeartbeatEvidence::FormerContinues,
            (Some(own), Some(its))
                if owner.claimed.is_none() && self.fits_former_incarnation(new, own, its) =>
            {
                HeartbeatEvidence::FormerContinues
            }
            (Some(_), _) => HeartbeatEvidence::Continues,
            (None, Some(_)) => HeartbeatEvidence::FormerContinues,
            (None, None)
                if owner.packets_ahead_of(new).cast_signed() < 0 && !owner.may_still_be_alive(new.at) =>
            {
                HeartbeatEvidence::Returns
            }
            (None, None) if !owner.can_have_sent(new.at, new.heartbeat.sent) => HeartbeatEvidence::Exceeds,
            (None, None) => HeartbeatEvidence::Jumps,
        }
    }

    /// Returns true if a heartbeat that continues both counters more likely belongs to the former life. Its counter is
    /// `own` ahead of the owner's and `its` ahead of the former's.
    fn fits_former_incarnation(&self, new: &Incarnation, own: u16, its: u16) -> bool {
        let is_alive = self.former_incarnation().is_some_and(|former| former.is_alive(new.at));
        its < own && (is_alive || own > MAX_PACKETS_PER_HEARTBEAT && its < own / 8)
    }

    /// Returns the state after a heartbeat with this evidence, and the meaning of the heartbeat; `new` is the life that
    /// would begin with it. Each arm names its rows of the table.
    pub(super) fn after_heartbeat(
        self,
        evidence: HeartbeatEvidence,
        new: Incarnation,
    ) -> (Self, HeartbeatKind) {
        use HeartbeatEvidence as E;
        const RESTARTED: HeartbeatKind = HeartbeatKind::Started { again: true };
        let left_of = |former: Incarnation, owner: Incarnation| {
            if former.may_still_be_alive(new.at) { former } else { owner }
        };
        match (self, evidence) {
            // first_claim
            (Self::Free, E::Claims) => (Self::Sole { owner: new }, HeartbeatKind::Started { again: false }),
            // found
            (Self::Free, E::Settles) => (Self::Sole { owner: new }, HeartbeatKind::First),
            // other_claim
            (
                Self::Sole { .. } | Self::Doubted { .. } | Self::Shared { .. } | Self::Inherited { .. },
                E::Claims,
            ) => (self, HeartbeatKind::Claimant),
            // claimant_lost
            (
                Self::Sole { .. } | Self::Doubted { .. } | Self::Shared { .. } | Self::Inherited { .. },
                E::Settles,
            ) => (self.with_owner(new), HeartbeatKind::First),
            // old
            (
                Self::Sole { .. } | Self::Doubted { .. } | Self::Shared { .. } | Self::Inherited { .. },
                E::Repeats,
            ) => (self, HeartbeatKind::Overtaken),
            // next, away
            (
                Self::Sole { .. } | Self::Doubted { .. } | Self::Shared { .. } | Self::Inherited { .. },
                E::Continues,
            )
            | (Self::Sole { .. } | Self::Doubted { .. }, E::Returns) => {
                (self.with_last_heartbeat(new), HeartbeatKind::Continued)
            }
            // start
            (Self::Sole { owner }, E::Intrudes | E::Starts | E::Jumps | E::Succeeds) => {
                (Self::Doubted { owner: new, former: owner }, RESTARTED)
            }
            // further_start, start_after_former
            (Self::Doubted { owner, former }, E::Intrudes | E::Starts | E::Jumps | E::Succeeds) => {
                (Self::Doubted { owner: new, former: left_of(former, owner) }, RESTARTED)
            }
            // taken_back
            (Self::Doubted { .. } | Self::Inherited { .. }, E::FormerContinues) => {
                (Self::Shared { owner: new }, HeartbeatKind::Shared)
            }
            // impossible, outsider
            (Self::Sole { .. } | Self::Doubted { .. }, E::Exceeds)
            | (
                Self::Shared { .. } | Self::Inherited { .. },
                E::Intrudes | E::Starts | E::Jumps | E::Returns | E::Exceeds,
            ) => (self, HeartbeatKind::Outsider),
            // successor
            (Self::Shared { owner }, E::Succeeds) => {
                (Self::Inherited { owner: new, former: owner }, RESTARTED)
            }
            // further_successor, successor_after_former
            (Self::Inherited { owner, former }, E::Succeeds) => {
                (Self::Inherited { owner: new, former: left_of(former, owner) }, RESTARTED)
            }
            // incomparable
            (
                Self::Free,
                E::FormerContinues
                | E::Intrudes
                | E::Starts
                | E::Repeats
                | E::Continues
                | E::Returns
                | E::Exceeds
                | E::Jumps
                | E::Succeeds,
            )
            | (Self::Sole { .. } | Self::Shared { .. }, E::FormerContinues) => {
                (self, HeartbeatKind::Overtaken)
            }
        }
    }
}

#[cfg(test)]
mod tests;
