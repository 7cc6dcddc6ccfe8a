use super::*;

const AGAIN: HeartbeatKind = HeartbeatKind::Started { again: true };

/// Returns the meanings of heartbeats that are 100 ms apart.
fn words(said: &[(u32, u16, State)]) -> Vec<HeartbeatKind> {
    words_at(said.iter().zip(0..).map(|(&(serial, sent, state), at)| (at * 100, serial, sent, state)))
}

/// Returns the meanings of heartbeats at times in ms.
fn words_at(said: impl IntoIterator<Item = (u64, u32, u16, State)>) -> Vec<HeartbeatKind> {
    let mut claim = AddressClaim::default();
    let hear = |(ms, serial, sent, state)| {
        claim.receive(Micros(ms * 1_000), &Heartbeat { serial, sent, state, ..Heartbeat::default() })
    };
    said.into_iter().map(hear).collect()
}

#[test]
fn two_old_heartbeats_in_order_are_no_life() {
    let heard = [
        (0, 1032),
        (252, 1049),
        (375, 883),  // an old one
        (400, 1049), // another one
        (508, 1066),
        (720, 1049),
        (756, 1083),
        (964, 883),
        (1006, 1100),
    ];
    let words = |more: u16| {
        let of = |&(ms, sent): &(u64, u16)| (ms, 7, sent + more, State::default());
        words_at(heard.iter().map(of))
    };
    let known = HeartbeatKind::Continued;
    let (old, outsider) = (HeartbeatKind::Overtaken, HeartbeatKind::Outsider);
    assert_eq!(
        words(0),
        [HeartbeatKind::First, known, AGAIN, old, HeartbeatKind::Shared, old, known, outsider, known]
    );
    // A cell that had started since could not have sent 2883 packets.
    assert_eq!(words(2000), [HeartbeatKind::First, known, outsider, old, known, old, known, outsider, known]);
}

#[test]
fn old_heartbeats_in_order_do_not_take_the_id_of_a_cell_that_hangs() {
    let old = [15_611, 15_860, 15_611, 15_611, 15_727, 15_860, 15_860, 15_611, 15_727, 15_860];
    let burst = old.iter().zip(1_703..).map(|(&sent, ms)| (ms, sent));
    let own = [(0, 15_993), (1, 15_860), (2, 15_993 + 3), (227, 16_010), (686, 16_016), (995, 16_059)];
    let heard = own.into_iter().chain(burst).chain([(1_718, 16_063), (1_975, 16_123)]);
    let words = words_at(heard.map(|(ms, sent)| (ms, 7, sent, State::default())));
    let count = |of: HeartbeatKind| words.iter().filter(|word| **word == of).count();
    assert_eq!(
        (count(HeartbeatKind::First), count(HeartbeatKind::Continued), count(HeartbeatKind::Outsider)),
        (1, 6, 11),
        "{words:?}"
    );
}

#[test]
fn a_restart_is_a_claim_or_a_counter_that_falls_back() {
    let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
    let life = [(7, 0, claims), (7, 1, settled), (7, 65_535, settled), (7, 2, settled)];
    let started = HeartbeatKind::Started { again: false };
    assert_eq!(
        words(&life),
        [started, HeartbeatKind::Continued, HeartbeatKind::Overtaken, HeartbeatKind::Continued]
    );
    assert_eq!(words(&[(7, 900, settled), (7, 0, claims)]), [HeartbeatKind::First, AGAIN]);
    assert_eq!(
        words(&[(7, 900, settled), (7, 1, settled)]),
        [HeartbeatKind::First, AGAIN],
        "its claim was lost"
    );
    assert_eq!(words(&[(7, 900, settled), (7, 771, settled)]), [HeartbeatKind::First, AGAIN]);
    assert_eq!(
        words(&[(7, 900, settled), (7, 772, settled)]),
        [HeartbeatKind::First, HeartbeatKind::Overtaken]
    );
    // A cell that wins against another claimant sends a heartbeat while still claiming.
    assert_eq!(words(&[(7, 0, claims), (7, 1, claims)]), [started, HeartbeatKind::Continued]);
}

#[test]
fn a_claimed_id_keeps_its_owner_until_the_claimant_settles() {
    let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
    let said = [(7, 9, settled), (8, 0, claims), (7, 10, settled), (8, 1, settled), (8, 2, settled)];
    assert_eq!(
        words(&said),
        [
            HeartbeatKind::First,
            HeartbeatKind::Claimant,
            HeartbeatKind::Continued,
            AGAIN,
            HeartbeatKind::Continued
        ]
    );
    let said = [(8, 0, claims), (7, 10, settled), (7, 11, settled)];
    assert_eq!(
        words(&said),
        [HeartbeatKind::Started { again: false }, HeartbeatKind::First, HeartbeatKind::Continued],
        "it gave up the claim"
    );
}

#[test]
fn two_cells_that_use_one_id_in_turn_do_not_restart_each_time() {
    let settled = State::default();
    let said = [(7, 90, settled), (9, 40, settled), (7, 91, settled), (9, 41, settled), (9, 42, settled)];
    assert_eq!(
        words(&said),
        [
            HeartbeatKind::First,
            AGAIN,
            HeartbeatKind::Shared,
            HeartbeatKind::Outsider,
            HeartbeatKind::Outsider
        ]
    );
}

#[test]
fn old_heartbeats_that_are_sent_again_take_a_living_cells_id_once_at_most() {
    let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
    let (shared, outsider, known) =
        (HeartbeatKind::Shared, HeartbeatKind::Outsider, HeartbeatKind::Continued);
    // Its own counter is at 900, an old one at 100.
    let said = [(0, 7, 900, settled), (50, 7, 100, settled), (250, 7, 916, settled), (300, 7, 116, settled)];
    assert_eq!(words_at(said), [HeartbeatKind::First, AGAIN, shared, outsider]);
    // Two old heartbeats before its next one, then a start.
    let said = [
        (0, 7, 900, settled),
        (10, 7, 100, settled),
        (200, 7, 116, settled),
        (250, 7, 916, settled),
        (260, 7, 0, claims),
        (490, 7, 1, settled),
        (500, 7, 932, settled),
    ];
    let expected = [HeartbeatKind::First, AGAIN, known, shared, outsider, outsider, known];
    assert_eq!(words_at(said), expected);
    // A claim of a cell that has hardly sent anything: its next heartbeat arrives before the claim can end.
    let said = [(0, 7, 9, settled), (60, 7, 0, claims), (250, 7, 12, settled)];
    assert_eq!(words_at(said), [HeartbeatKind::First, AGAIN, shared]);
    // A counter that is ahead.
    let said =
        [(0, 7, 900, settled), (10, 7, 9_000, settled), (250, 7, 916, settled), (260, 7, 9_020, settled)];
    assert_eq!(words_at(said), [HeartbeatKind::First, outsider, known, outsider]);
    // The cell is gone; the next cell with its id is accepted.
    let said = [(0, 7, 900, settled), (10, 7, 100, settled), (250, 7, 916, settled), (900, 7, 0, claims)];
    assert_eq!(words_at(said), [HeartbeatKind::First, AGAIN, shared, AGAIN]);
}

#[test]
fn a_cell_whose_bus_was_lost_goes_on_whatever_is_sent_again_meanwhile() {
    let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
    let (shared, outsider, known) =
        (HeartbeatKind::Shared, HeartbeatKind::Outsider, HeartbeatKind::Continued);
    // The id was shared before the bus was lost, or was not.
    let said = [(0, 7, 916, settled), (10, 7, 100, settled), (250, 7, 932, settled)];
    let meanwhile = [(1_200, 7, 100, settled), (1_250, 7, 116, settled), (1_300, 7, 100, settled)];
    let after = [(1_750, 7, 940, settled), (2_000, 7, 956, settled)];
    let expected = [HeartbeatKind::First, AGAIN, shared, outsider, outsider, outsider, known, known];
    assert_eq!(words_at(said.into_iter().chain(meanwhile).chain(after)), expected);
    let expected = [HeartbeatKind::First, AGAIN, known, HeartbeatKind::Overtaken, shared, known];
    assert_eq!(words_at([said[0]].into_iter().chain(meanwhile).chain(after)), expected);
    // A cell restarts with a shared id: its claim is received while the owner seems alive, or later, or never.
    let starts = [(400, 7, 0, claims), (660, 7, 1, settled), (910, 7, 4, settled), (1_160, 7, 8, settled)];
    let expected = [HeartbeatKind::First, AGAIN, shared, outsider, outsider, AGAIN, known];
    assert_eq!(words_at(said.into_iter().chain(starts)), expected);
    let later = [(900, 7, 0, claims), (1_160, 7, 1, settled)];
    assert_eq!(words_at(said.into_iter().chain(later)), [HeartbeatKind::First, AGAIN, shared, AGAIN, known]);
}

#[test]
fn a_quick_restart_is_not_taken_for_an_old_heartbeat() {
    let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
    for sent in [1, 2, 9, 300] {
        let said =
            [(0, 7, sent, settled), (100, 7, 0, claims), (360, 7, 1, settled), (610, 7, sent + 1, settled)];
        assert_eq!(
            words_at(said),
            [HeartbeatKind::First, AGAIN, HeartbeatKind::Continued, HeartbeatKind::Continued],
            "{sent}"
        );
    }
    // A cell that has been away for a long time.
    assert_eq!(
        words_at([(0, 7, 900, settled), (60_000, 7, 30_000, settled)]),
        [HeartbeatKind::First, HeartbeatKind::Continued]
    );
}

#[test]
fn the_cell_that_had_the_id_before_is_remembered() {
    let mut claim = AddressClaim::default();
    let mut sent = 0;
    let mut hear = |serial, state| {
        claim.receive(Micros(0), &Heartbeat { serial, state, sent, ..Heartbeat::default() });
        sent += 1;
        (claim.serial(), claim.previous(), claim.is_settled())
    };
    let (claims, settled) = (State::CLAIMING_NODE_ID, State::default());
    assert_eq!(hear(7, claims), (Some(7), None, false));
    assert_eq!(hear(7, settled), (Some(7), None, true));
    assert_eq!(hear(8, claims), (Some(7), None, true));
    assert_eq!(hear(8, settled), (Some(8), Some(7), true));
    assert_eq!(hear(8, settled), (Some(8), Some(7), true));
    assert_eq!(hear(7, settled), (Some(7), Some(8), true));
}
