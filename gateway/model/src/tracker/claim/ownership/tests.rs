//! Tests of the rows of the table, and of heartbeats with each kind of evidence.

use protocol::message::{Heartbeat, State};
use protocol::time::Micros;

use super::{HeartbeatEvidence as E, HeartbeatKind, Incarnation, Ownership};
use Sample::{Doubted, DoubtedLong, Free, Inherited, InheritedLong, Shared, Sole};

const AGAIN: HeartbeatKind = HeartbeatKind::Started { again: true };

/// A sample of each state. The two states with a former life occur twice: that life may continue, or may not any more.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Sample {
    Free,
    Sole,
    Doubted,
    DoubtedLong,
    Shared,
    Inherited,
    InheritedLong,
}

const SAMPLES: [Sample; 7] = [Free, Sole, Doubted, DoubtedLong, Shared, Inherited, InheritedLong];
const OWNED: [Sample; 6] = [Sole, Doubted, DoubtedLong, Shared, Inherited, InheritedLong];

const EVIDENCE: [E; 11] = [
    E::Claims,
    E::Settles,
    E::FormerContinues,
    E::Intrudes,
    E::Starts,
    E::Repeats,
    E::Continues,
    E::Returns,
    E::Exceeds,
    E::Jumps,
    E::Succeeds,
];

/// Returns the samples of a state, and the index of a kind of evidence in the list above. A new variant without an arm
/// does not compile.
const fn places(ownership: &Ownership, evidence: E) -> (&[Sample], usize) {
    let samples: &[Sample] = match ownership {
        Ownership::Free => &[Free],
        Ownership::Sole { .. } => &[Sole],
        Ownership::Doubted { .. } => &[Doubted, DoubtedLong],
        Ownership::Shared { .. } => &[Shared],
        Ownership::Inherited { .. } => &[Inherited, InheritedLong],
    };
    let place = match evidence {
        E::Claims => 0,
        E::Settles => 1,
        E::FormerContinues => 2,
        E::Intrudes => 3,
        E::Starts => 4,
        E::Repeats => 5,
        E::Continues => 6,
        E::Returns => 7,
        E::Exceeds => 8,
        E::Jumps => 9,
        E::Succeeds => 10,
    };
    (samples, place)
}

/// The life that the owner or the former has in the next state.
#[derive(Clone, Copy, Debug)]
enum Whose {
    Nobody,
    /// The life that it had before.
    Same,
    /// The previous owner's life, extended by the new heartbeat.
    Longer,
    /// The life that begins with the new heartbeat.
    New,
    /// The previous owner's life.
    Owner,
}
use Whose::{Longer, New, Nobody, Owner, Same};

/// Name, states and evidence, next state (`None` if it stays), meaning, and the origins of the next owner's and
/// former's lives.
type Row = (&'static str, &'static [Sample], &'static [E], Option<Sample>, HeartbeatKind, [Whose; 2]);

const START: &[E] = &[E::Intrudes, E::Starts, E::Jumps, E::Succeeds];
const OUTSIDE: &[E] = &[E::Intrudes, E::Starts, E::Jumps, E::Returns, E::Exceeds];
const COMPARED: &[E] = EVIDENCE.split_at(2).1;

#[rustfmt::skip]
const ROWS: [Row; 18] = [
    ("first_claim", &[Free], &[E::Claims], Some(Sole), HeartbeatKind::Started { again: false }, [New, Nobody]),
    ("found", &[Free], &[E::Settles], Some(Sole), HeartbeatKind::First, [New, Nobody]),
    ("other_claim", &OWNED, &[E::Claims], None, HeartbeatKind::Claimant, [Same, Same]),
    ("claimant_lost", &OWNED, &[E::Settles], None, HeartbeatKind::First, [New, Same]),
    ("old", &OWNED, &[E::Repeats], None, HeartbeatKind::Overtaken, [Same, Same]),
    ("next", &OWNED, &[E::Continues], None, HeartbeatKind::Continued, [Longer, Same]),
    ("away", &[Sole, Doubted, DoubtedLong], &[E::Returns], None, HeartbeatKind::Continued, [Longer, Same]),
    ("start", &[Sole], START, Some(Doubted), AGAIN, [New, Owner]),
    ("further_start", &[Doubted], START, Some(Doubted), AGAIN, [New, Same]),
    ("start_after_former", &[DoubtedLong], START, Some(Doubted), AGAIN, [New, Owner]),
    ("impossible", &[Sole, Doubted, DoubtedLong], &[E::Exceeds], None, HeartbeatKind::Outsider, [Same, Same]),
    ("taken_back", &[Doubted, DoubtedLong, Inherited, InheritedLong], &[E::FormerContinues], Some(Shared), HeartbeatKind::Shared, [New, Nobody]),
    ("outsider", &[Shared, Inherited, InheritedLong], OUTSIDE, None, HeartbeatKind::Outsider, [Same, Same]),
    ("successor", &[Shared], &[E::Succeeds], Some(Inherited), AGAIN, [New, Owner]),
    ("further_successor", &[Inherited], &[E::Succeeds], Some(Inherited), AGAIN, [New, Same]),
    ("successor_after_former", &[InheritedLong], &[E::Succeeds], Some(Inherited), AGAIN, [New, Owner]),
    ("incomparable", &[Free], COMPARED, None, HeartbeatKind::Overtaken, [Same, Same]),
    ("incomparable", &[Sole, Shared], &[E::FormerContinues], None, HeartbeatKind::Overtaken, [Same, Same]),
];

fn life(ms: u64, serial: u32, sent: u16, state: State) -> Incarnation {
    Incarnation::new(Micros(ms * 1_000), &Heartbeat { serial, sent, state, ..Heartbeat::default() })
}

const SETTLED: State = State(0);

fn sample(sample: Sample) -> Ownership {
    // An owner whose claim was received, 20 s after a first life and 2 s after a second one.
    let owner = Incarnation { claimed: Some(Micros(19_000_000)), ..life(20_000, 7, 50, SETTLED) };
    let [former, gone] = [18_000, 0].map(|ms| life(ms, 7, 9_000, SETTLED));
    match sample {
        Free => Ownership::Free,
        Sole => Ownership::Sole { owner },
        Doubted => Ownership::Doubted { owner, former },
        DoubtedLong => Ownership::Doubted { owner, former: gone },
        Shared => Ownership::Shared { owner },
        Inherited => Ownership::Inherited { owner, former },
        InheritedLong => Ownership::Inherited { owner, former: gone },
    }
}

#[test]
fn each_state_does_with_each_evidence_what_its_row_says() {
    let new = life(20_250, 8, 60, SETTLED);
    for from in SAMPLES {
        let ownership = sample(from);
        assert!(places(&ownership, E::Claims).0.contains(&from), "{from:?}");
        for (place, evidence) in EVIDENCE.into_iter().enumerate() {
            assert_eq!(places(&ownership, evidence).1, place);
            let is_of = |(_, states, shows, ..): &&Row| states.contains(&from) && shows.contains(&evidence);
            let rows: Vec<_> = ROWS.iter().filter(is_of).collect();
            assert_eq!(rows.len(), 1, "rows of {from:?} and {evidence:?}: {rows:?}");
            let (name, _, _, to, word, whose) = *rows[0];
            let lives =
                [ownership.owner(), ownership.former_incarnation()].map(Option::<&Incarnation>::copied);
            let [owner, former] = [0, 1].map(|place| match whose[place] {
                Nobody => None,
                Same => lives[place],
                Longer => lives[place].map(|life| Incarnation { claimed: life.claimed, ..new }),
                New => Some(new),
                Owner => lives[0],
            });
            let (next, means) = ownership.after_heartbeat(evidence, new);
            assert_eq!(means, word, "{name}: {from:?}, {evidence:?}");
            assert!(places(&next, evidence).0.contains(&to.unwrap_or(from)), "{name}: {next:?}");
            let lives = [next.owner(), next.former_incarnation()].map(Option::<&Incarnation>::copied);
            assert_eq!(lives, [owner, former], "{name}: {from:?}, {evidence:?}");
        }
    }
}

#[test]
fn each_evidence_is_shown_by_heartbeats() {
    let claims = State::CLAIMING_NODE_ID;
    let shown = |ownership: Ownership, ms: u64, serial, sent, state| {
        ownership.evidence(&life(20_000 + ms, serial, sent, state))
    };
    assert_eq!(shown(sample(Free), 0, 7, 9, claims), E::Claims);
    assert_eq!(shown(sample(Free), 0, 7, 9, SETTLED), E::Settles);
    // Milliseconds after the owner's last heartbeat, with which it had sent 50 packets; the former's was 2 s earlier,
    // at 9000.
    let common = [
        (250, 8, 9, claims, E::Claims),
        (250, 8, 9, SETTLED, E::Intrudes),
        (250, 7, 0, claims, E::Starts),
        (250, 7, 50, SETTLED, E::Repeats),
        (250, 7, 2, SETTLED, E::Repeats),
        (250, 7, 1, SETTLED, E::Jumps),
        (250, 7, 51, SETTLED, E::Continues),
        (250, 7, 51, claims, E::Continues),
        (250, 7, 50 + 2_048, SETTLED, E::Continues),
        (250, 7, 50 + 2_049, SETTLED, E::Exceeds),
        (600, 7, 50 + 4_096, SETTLED, E::Continues),
        (10_001, 7, 51, SETTLED, E::Returns),
        (10_001, 7, 50 + 32_768, SETTLED, E::Returns),
        (10_001, 7, 50 + 32_769, SETTLED, E::Jumps),
    ];
    for from in OWNED {
        for (ms, serial, sent, state, evidence) in common {
            let is = shown(sample(from), ms, serial, sent, state);
            assert_eq!(is, evidence, "{from:?}: {serial} at {sent} after {ms} ms");
        }
        let only_claims = sample(from).with_owner(life(20_000, 7, 50, claims));
        assert_eq!(shown(only_claims, 250, 8, 9, SETTLED), E::Settles, "{from:?}");
        assert_eq!(shown(only_claims, 250, 8, 9, claims), E::Claims, "{from:?}");
    }
    for from in [Sole, Shared, DoubtedLong, InheritedLong] {
        assert_eq!(shown(sample(from), 250, 7, 9_001, SETTLED), E::Exceeds, "{from:?}: no former goes on");
    }
    for from in [Doubted, Inherited] {
        let goes_on = sample(from);
        assert_eq!(shown(goes_on, 250, 7, 9_001, SETTLED), E::FormerContinues);
        assert_eq!(shown(goes_on, 250, 7, 9_000, SETTLED), E::Exceeds, "it is the former's last one again");
        assert_eq!(shown(goes_on, 8_001, 7, 9_001, SETTLED), E::Continues, "10 s after the former");
        let of_another = goes_on.with_owner(life(20_000, 6, 50, SETTLED));
        assert_eq!(shown(of_another, 250, 7, 9_001, SETTLED), E::FormerContinues);
        assert_eq!(shown(of_another, 250, 7, 9_000, SETTLED), E::Intrudes);
    }
}

/// A counter that continues both lives.
#[test]
fn of_two_lives_the_one_whose_counter_is_nearer_continues() {
    let doubted = |claimed: Option<u64>, own: u16, its: u16, ago: u64| {
        let claimed = claimed.map(|ms| Micros(ms * 1_000));
        let state = if claimed.is_some() { State::CLAIMING_NODE_ID } else { SETTLED };
        let owner = Incarnation { claimed, ..life(20_000, 7, 10_000 - own, state) };
        Ownership::Doubted { owner, former: life(20_250 - ago, 7, 10_000 - its, SETTLED) }
    };
    let shown = |ownership: Ownership| ownership.evidence(&life(20_250, 7, 10_000, SETTLED));
    // The owner's claim was received: the time of its end decides.
    assert_eq!(shown(doubted(Some(20_011), 9, 99, 5_000)), E::FormerContinues);
    assert_eq!(shown(doubted(Some(20_010), 9, 99, 5_000)), E::Continues);
    assert_eq!(shown(doubted(Some(20_010), 99, 9, 300)), E::Continues, "its claim was heard and is over");
    // It was not received: the nearer counter wins, if the former is alive or the owner would have leapt.
    assert_eq!(shown(doubted(None, 10, 9, 600)), E::FormerContinues);
    assert_eq!(shown(doubted(None, 9, 9, 600)), E::Continues);
    assert_eq!(shown(doubted(None, 10, 9, 601)), E::Continues);
    assert_eq!(shown(doubted(None, 257, 31, 601)), E::FormerContinues);
    assert_eq!(shown(doubted(None, 257, 32, 601)), E::Continues);
    assert_eq!(shown(doubted(None, 256, 9, 601)), E::Continues);
}

/// An old heartbeat of the former, while the former is alive.
#[test]
fn an_owner_whose_claim_was_heard_has_no_old_heartbeats_of_the_former() {
    let doubted = |claimed: Option<u64>, ago: u64| Ownership::Doubted {
        owner: Incarnation { claimed: claimed.map(|ms| Micros(ms * 1_000)), ..life(20_000, 7, 100, SETTLED) },
        former: life(20_250 - ago, 7, 900, SETTLED),
    };
    let shown = |ownership: Ownership, sent| ownership.evidence(&life(20_250, 7, sent, SETTLED));
    for (sent, old) in [(900, E::Repeats), (772, E::Repeats), (771, E::Continues), (901, E::FormerContinues)]
    {
        assert_eq!(shown(doubted(None, 600), sent), old, "{sent}");
    }
    assert_eq!(shown(doubted(None, 601), 900), E::Continues, "the former is silent");
    assert_eq!(shown(doubted(Some(19_000), 600), 900), E::Continues, "the claim was heard");
}
