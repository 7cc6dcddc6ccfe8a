//! Commissioning in virtual time: real cells, seeded loss, kills and restarts at any moment. It always ends, names the
//! cells that differ from the skin, and every cell has either its old parameters or its new ones.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use model::commission::{AbortReason, CommissionOptions, FailureReason, Outcome, Report};
use protocol::can::Format;
use protocol::fixed::{Q1_14, Q3_12};
use protocol::id::{Kind, Node};
use protocol::message::{Answer, Joints, Message, NetworkPage, Request, State};
use protocol::packet::{Epoch, Packet, WORDS};
use protocol::parameters::{Parameter, Parameters};
use protocol::skin::Skin;
use protocol::time::Span;
use skinbus_tests::skins::arm;
use skinbus_tests::workshop::{Workshop, cell};

const CELLS: u8 = 12;
const WISH: CommissionOptions = CommissionOptions { dry_run: false, verify: false };
const VERIFY: CommissionOptions = CommissionOptions { dry_run: false, verify: true };

/// Returns the skin, and the old and the new parameters of its cells.
fn skin() -> (Skin, impl Fn(usize) -> Parameters, impl Fn(usize) -> Parameters) {
    skin_of(CELLS, Format::Fd)
}

fn skin_of(cells: u8, format: Format) -> (Skin, impl Fn(usize) -> Parameters, impl Fn(usize) -> Parameters) {
    let skin = arm(cells, format);
    let new: Vec<_> = skin.cells.iter().map(|cell| skin.parameters(cell)).collect();
    let old = new.clone().into_iter().map(|mut old| {
        old.period_us += 7;
        old.rows[2].a = Q1_14::nearest(0.2);
        old.pose.position[1] = Q1_14::nearest(0.125);
        old.contact.alpha_c = Q3_12::nearest(0.5);
        old
    });
    let old: Vec<_> = old.collect();
    (skin, move |place| old[place], move |place| new[place])
}

fn outcomes(report: &Report) -> Vec<Outcome> {
    report.cells.iter().map(|cell| cell.outcome).collect()
}

fn all(report: &Report, expected: Outcome) {
    assert_eq!(outcomes(report), vec![expected; report.cells.len()], "{report:#?}");
    assert_eq!(report.trouble, None);
}

/// Checks that the flash of a cell only ever had its old configuration or its new one.
fn nothing_is_mixed(
    workshop: &Workshop,
    old: impl Fn(usize) -> FlashState,
    new: impl Fn(usize) -> Parameters,
) {
    for (place, piece) in workshop.pieces.iter().enumerate() {
        for flash in &piece.history {
            assert!(
                *flash == old(place) || *flash == FlashState::Valid(new(place)),
                "cell {place}: {flash:?}"
            );
        }
    }
}

#[test]
fn cells_with_other_parameters_without_any_and_with_damaged_flash_all_get_the_skins() {
    for format in [Format::Fd, Format::Classic] {
        let (skin, old, new) = skin_of(CELLS, format);
        let flash = |place| match place % 3 {
            0 => FlashState::Valid(old(place)),
            1 => FlashState::Empty,
            _ => FlashState::Damaged,
        };
        let mut workshop = Workshop::with_cells(&skin, 1, flash);
        let report = workshop.commission(&skin, WISH, None);
        all(&report, Outcome::Written);
        assert_eq!(workshop.holding(&new), usize::from(CELLS));
        // The robot's table, gains and the period were sent once, to everyone, and all cells read them back.
        let common = 8 + 10;
        assert_eq!((report.requests, report.repeated), (common + u64::from(CELLS) * 3, 0), "{format:?}");
        nothing_is_mixed(&workshop, flash, new);
    }
}

#[test]
fn a_configured_cell_is_left_alone_and_read_back_only_if_requested() {
    let (skin, old, new) = skin();
    let mut workshop = Workshop::with_cells(&skin, 2, |place| {
        FlashState::Valid(if place == 3 { old(place) } else { new(place) })
    });
    let report = workshop.commission(&skin, WISH, None);
    let mut expected = vec![Outcome::AlreadySo; CELLS.into()];
    expected[3] = Outcome::Written;
    assert_eq!(outcomes(&report), expected);
    // Ten parameters, a commit and ten reads, all of one cell.
    assert_eq!(report.requests, 21);
    let again = workshop.commission(&skin, WISH, None);
    all(&again, Outcome::AlreadySo);
    assert_eq!(again.requests, 0, "a repeat asks for nothing");
    let verified = workshop.commission(&skin, VERIFY, None);
    all(&verified, Outcome::Verified);
    assert_eq!(verified.requests, 10, "each parameter is read by everyone at once");
    assert!(
        workshop
            .pieces
            .iter()
            .enumerate()
            .all(|(place, piece)| { piece.history.len() == if place == 3 { 2 } else { 1 } })
    );
}

#[test]
fn a_dry_run_writes_nothing_and_reports_what_would_be_written() {
    let (skin, old, new) = skin();
    let flash = |place| FlashState::Valid(if place < 5 { new(place) } else { old(place) });
    let mut workshop = Workshop::with_cells(&skin, 3, flash);
    workshop.rest(Span::from_millis(1_000));
    let said = workshop.messages_sent;
    let report = workshop.commission(&skin, CommissionOptions { dry_run: true, verify: false }, None);
    let expected = |place| if place < 5 { Outcome::AlreadySo } else { Outcome::WouldWrite };
    assert_eq!(outcomes(&report), (0..CELLS.into()).map(expected).collect::<Vec<_>>());
    assert_eq!(report.requests, 0);
    // Two heartbeats of each cell, and no packet of the commissioning.
    assert!(workshop.messages_sent - said <= 3 * u64::from(CELLS), "{}", workshop.messages_sent - said);
    assert!(workshop.pieces.iter().all(|piece| piece.history.len() == 1));
}

/// The number of runs with many faults.
const SEEDS: u64 = 100;

#[test]
fn loss_and_repetition_and_damage_cost_time_and_nothing_else() {
    for seed in 0..SEEDS {
        let (skin, old, new) = skin_of(CELLS, if seed % 2 == 0 { Format::Fd } else { Format::Classic });
        let flash = |place| if place % 2 == 0 { FlashState::Valid(old(place)) } else { FlashState::Empty };
        let mut workshop = Workshop::with_cells(&skin, seed, flash);
        (workshop.loss, workshop.duplication, workshop.damage) = (0.05, 0.05, 0.05);
        let mut report = workshop.commission(&skin, WISH, None);
        nothing_is_mixed(&workshop, flash, &new);
        // A cell with six failures in a row is named, and commissioned in the next run.
        for _ in 0..5 {
            for cell in &report.cells {
                let silent = matches!(
                    cell.outcome,
                    Outcome::Failed(FailureReason::Silent { .. } | FailureReason::Gone)
                );
                let well = matches!(cell.outcome, Outcome::Written | Outcome::AlreadySo);
                assert!(well || silent, "seed {seed}: {cell:?}");
            }
            report = workshop.commission(&skin, WISH, None);
        }
        assert_eq!(workshop.holding(&new), usize::from(CELLS), "seed {seed}: {report:#?}");
        assert!(report.repeated < 100, "{report:?}");
    }
}

#[test]
fn killed_at_any_moment_and_run_again_it_is_complete_and_nothing_is_mixed() {
    // More cells than are asked at the same time.
    const MANY: u8 = 50;
    let mut halfway = 0;
    for seed in 0..SEEDS / 4 {
        let (skin, old, new) = skin_of(MANY, if seed % 2 == 0 { Format::Fd } else { Format::Classic });
        let flash = |place| if place % 4 == 3 { FlashState::Empty } else { FlashState::Valid(old(place)) };
        let mut workshop = Workshop::with_cells(&skin, seed, flash);
        // With lost frames, most of the time is spent waiting for them.
        workshop.loss = if seed % 4 == 0 { 0.02 } else { 0.0 };
        workshop.rest(Span::from_millis(700));
        for _ in 0..3 {
            // It listens for 500 ms; a run without loss takes some 15 ms more.
            let moment = Span(500_000 + workshop.chance(14_000));
            let report = workshop.commission(&skin, WISH, Some(moment));
            nothing_is_mixed(&workshop, flash, &new);
            let done = workshop.holding(&new);
            halfway += usize::from(0 < done && done < usize::from(MANY));
            assert_eq!(report.cells.len(), usize::from(MANY));
        }
        let report = workshop.commission(&skin, WISH, None);
        assert_eq!(workshop.holding(&new), usize::from(MANY), "seed {seed}: {report:#?}");
        nothing_is_mixed(&workshop, flash, new);
    }
    assert!(halfway > 4, "some of the runs must end in the middle of the cells: {halfway}");
}

#[test]
fn cells_that_are_switched_off_and_on_in_the_middle_are_rewritten_or_named() {
    let mut restarted = 0;
    for seed in 0..SEEDS {
        let (skin, old, new) = skin();
        let flash = |place| FlashState::Valid(old(place));
        let mut workshop = Workshop::with_cells(&skin, seed, flash);
        workshop.rest(Span::from_millis(700));
        let mut lost = Vec::new();
        for place in 0..usize::from(CELLS) {
            let moment = Span(490_000 + workshop.chance(30_000));
            match workshop.chance(4) {
                0 => workshop.switch_on_in(moment, place),
                1 => {
                    workshop.switch_off_in(moment, place);
                    lost.push(place);
                }
                _ => {}
            }
        }
        let report = workshop.commission(&skin, WISH, None);
        nothing_is_mixed(&workshop, flash, &new);
        for (place, cell) in report.cells.iter().enumerate() {
            match cell.outcome {
                Outcome::Written => {
                    assert_eq!(workshop.pieces[place].flash, FlashState::Valid(new(place)), "seed {seed}");
                    restarted += usize::from(!lost.contains(&place));
                }
                Outcome::Failed(
                    FailureReason::Silent { .. } | FailureReason::Gone | FailureReason::Hash { .. },
                ) => {
                    assert!(lost.contains(&place), "seed {seed}: {cell:?} was never lost");
                }
                Outcome::AlreadySo | Outcome::Verified | Outcome::WouldWrite | Outcome::Failed(_) => {
                    panic!("seed {seed}: {cell:?}")
                }
            }
        }
        for place in lost {
            workshop.switch_on_in(Span(0), place);
        }
        workshop.rest(Span::from_millis(700));
        workshop.commission(&skin, WISH, None);
        assert_eq!(workshop.holding(&new), usize::from(CELLS), "seed {seed}");
    }
    assert!(restarted > 0);
}

/// Drops the first packets of cells that were switched on.
fn nobody_claims(packet: Packet) -> Packet {
    match Message::decode(&packet) {
        Ok(Message::Network { page: NetworkPage::Heartbeat(beat), .. })
            if beat.state.has(State::CLAIMING_NODE_ID) =>
        {
            Message::Sync.encode()
        }
        _ => packet,
    }
}

#[test]
fn an_undetected_restart_is_found_at_the_commit() {
    for seed in 0..SEEDS / 2 {
        let (skin, old, new) = skin();
        let flash = |place| FlashState::Valid(old(place));
        let mut workshop = Workshop::with_cells(&skin, seed, flash);
        workshop.rest(Span::from_millis(700));
        workshop.forgers = Some((|packet| packet, nobody_claims));
        for place in 0..usize::from(CELLS) {
            let moment = Span(500_000 + workshop.chance(12_000));
            workshop.switch_on_in(moment, place);
        }
        let report = workshop.commission(&skin, WISH, None);
        all(&report, Outcome::Written);
        assert_eq!(workshop.holding(&new), usize::from(CELLS), "seed {seed}");
        nothing_is_mixed(&workshop, flash, new);
    }
}

#[test]
fn cells_are_identified_by_serial_number_with_any_node_id() {
    let (skin, old, new) = skin();
    let mut workshop = Workshop::new(Format::Fd, 4);
    for (place, described) in skin.cells.iter().enumerate() {
        // Numbers in the reverse order.
        let number = cell(CELLS + 1 - described.node.get());
        workshop
            .add(Identity { cell: Some(number), serial: described.serial }, FlashState::Valid(old(place)));
    }
    let report = workshop.commission(&skin, WISH, None);
    all(&report, Outcome::Written);
    assert_eq!(workshop.holding(new), usize::from(CELLS));
    for found in &report.cells {
        assert_eq!(found.number.unwrap().get(), CELLS + 1 - found.described.get());
    }
}

#[test]
fn missing_cells_are_named_and_unknown_ones_left_alone() {
    let (skin, old, _) = skin();
    let mut workshop = Workshop::with_cells(&skin, 5, |place| FlashState::Valid(old(place)));
    workshop.switch_off_in(Span(0), 4);
    let unknown_node = workshop.add(Identity { cell: Some(cell(77)), serial: 9 }, FlashState::Valid(old(0)));
    let report = workshop.commission(&skin, WISH, None);
    let mut expected = vec![Outcome::Written; CELLS.into()];
    expected[4] = Outcome::Failed(FailureReason::Missing);
    assert_eq!(outcomes(&report), expected);
    assert_eq!(
        report.unknown_nodes.iter().map(|it| (it.number.get(), it.serial)).collect::<Vec<_>>(),
        [(77, 9)]
    );
    // Nothing is even staged: the cell may commit its present parameters.
    let mut words = [0; WORDS];
    words[0] = old(0).hash().cast_signed();
    let request = Request::Write { number: Parameter::Commit.number(), words };
    workshop.send(&Message::Configure { to: Node::Cell(cell(77)), tag: 1, request });
    workshop.rest(Span::from_millis(10));
    assert_eq!(workshop.pieces[unknown_node].history, [FlashState::Valid(old(0)); 2]);
}

#[test]
fn a_late_cell_is_commissioned_too() {
    let (skin, old, new) = skin();
    let mut workshop = Workshop::with_cells(&skin, 6, |place| FlashState::Valid(old(place)));
    for place in 0..3 {
        workshop.switch_off_in(Span(0), place);
        workshop.switch_on_in(Span::from_millis(1_500), place);
    }
    let report = workshop.commission(&skin, WISH, None);
    all(&report, Outcome::Written);
    assert_eq!(workshop.holding(new), usize::from(CELLS));
}

#[test]
fn two_cells_with_one_serial_number_are_named_and_neither_is_written() {
    let (skin, old, _) = skin();
    let mut workshop = Workshop::with_cells(&skin, 7, |place| FlashState::Valid(old(place)));
    let serial = skin.cells[2].serial;
    let twin = workshop.add(Identity { cell: Some(cell(90)), serial }, FlashState::Valid(old(2)));
    workshop.rest(Span::from_millis(700));
    let report = workshop.commission(&skin, WISH, None);
    let mut expected = vec![Outcome::Written; CELLS.into()];
    expected[2] = Outcome::Failed(FailureReason::Twins(cell(3), cell(90)));
    assert_eq!(outcomes(&report), expected);
    for place in [2, twin] {
        assert_eq!(workshop.pieces[place].history.len(), 1);
    }
}

#[test]
fn joints_or_another_configuration_on_the_bus_end_it_before_it_sends() {
    let (skin, old, _) = skin();
    let joints = Joints { in_use: 6, ..Joints::default() };
    let write = Request::Write { number: Parameter::Pose.number(), words: [1; WORDS] };
    for (message, trouble) in [
        (Message::Joints { epoch: Epoch(3), joints }, AbortReason::OtherGateway),
        (Message::Configure { to: Node::Cell(cell(3)), tag: 0, request: write }, AbortReason::OtherWriter),
    ] {
        let mut workshop = Workshop::with_cells(&skin, 8, |place| FlashState::Valid(old(place)));
        workshop.rest(Span::from_millis(700));
        workshop.send_from_other(&message);
        let report = workshop.commission(&skin, WISH, None);
        assert_eq!((report.trouble, report.requests), (Some(trouble), 0));
        assert!(workshop.pieces.iter().all(|piece| piece.history.len() == 1));
    }
}

#[test]
fn flash_that_cannot_be_written_is_named_and_the_old_remains() {
    let (skin, old, new) = skin();
    let mut workshop = Workshop::with_cells(&skin, 9, |place| FlashState::Valid(old(place)));
    workshop.pieces[6].worn = true;
    let report = workshop.commission(&skin, WISH, None);
    let Outcome::Failed(reason) = report.cells[6].outcome else { panic!("{report:#?}") };
    assert_eq!(reason.to_string(), "refused a commit: flash could not be written");
    assert_eq!(
        (workshop.pieces[6].flash, workshop.holding(new)),
        (FlashState::Valid(old(6)), usize::from(CELLS) - 1)
    );
}

/// Changes a pose on its way, x by one step: a flipped bit that no CRC detects.
fn other_pose(packet: Packet) -> Packet {
    let is_pose = packet.id.kind == Kind::Configure && packet.count & 0x7F == Parameter::Pose.number();
    let mut packet = packet;
    packet.words = packet.words.with_word(0, packet.words.first_six()[0].wrapping_add(i16::from(is_pose)));
    packet
}

/// Changes it back on the return, so that the answer to the write looks right.
fn pose_back(packet: Packet) -> Packet {
    let is_pose = packet.id.kind == Kind::Configured && packet.count == Parameter::Pose.number() | 0x80;
    let mut packet = packet;
    packet.words = packet.words.with_word(0, packet.words.first_six()[0].wrapping_sub(i16::from(is_pose)));
    packet
}

#[test]
fn a_pose_that_came_wrong_is_refused_at_the_commit_and_the_old_one_stays() {
    let (skin, old, new) = skin();
    let mut workshop = Workshop::with_cells(&skin, 10, |place| FlashState::Valid(old(place)));
    workshop.forgers = Some((other_pose, pose_back));
    let report = workshop.commission(&skin, WISH, None);
    for cell in &report.cells {
        let Outcome::Failed(reason) = cell.outcome else { panic!("{cell:?}") };
        assert_eq!(reason.to_string(), "refused a commit: the hash is not that of the staged copy");
    }
    assert!(
        workshop
            .pieces
            .iter()
            .enumerate()
            .all(|(place, piece)| piece.history == [FlashState::Valid(old(place))])
    );
    workshop.forgers = None;
    all(&workshop.commission(&skin, WISH, None), Outcome::Written);
    assert_eq!(workshop.holding(new), usize::from(CELLS));
}

#[test]
fn a_pose_whose_crc_is_wrong_is_not_taken_and_the_old_one_stays() {
    let (skin, old, _) = skin();
    let mut workshop = Workshop::with_cells(&skin, 11, |place| FlashState::Valid(old(place)));
    workshop.rest(Span::from_millis(700));
    let refused = |workshop: &Workshop| {
        let node = workshop.pieces[0].node().unwrap();
        format!("{node:?}").split("crc: ").nth(1).unwrap().chars().next().unwrap()
    };
    assert_eq!(refused(&workshop), '0');
    workshop.damage = 1.0;
    let words = skin.parameters(&skin.cells[0]).words(Parameter::Pose);
    let request = Request::Write { number: Parameter::Pose.number(), words };
    workshop.send(&Message::Configure { to: Node::Cell(cell(1)), tag: 1, request });
    workshop.rest(Span::from_millis(5));
    assert_eq!(refused(&workshop), '1');
    workshop.damage = 0.0;
    // Had it been staged, the hash of the old parameters with the new pose would be committed.
    let mixed = Parameters { pose: skin.parameters(&skin.cells[0]).pose, ..old(0) };
    let words = [mixed.hash().cast_signed(), 0, 0, 0, 0, 0];
    let commit = Request::Write { number: Parameter::Commit.number(), words };
    workshop.send(&Message::Configure { to: Node::Cell(cell(1)), tag: 2, request: commit });
    workshop.rest(Span::from_millis(5));
    assert_eq!(workshop.pieces[0].history, [FlashState::Valid(old(0))]);
}

/// Makes a cell report another period than the one that was written.
fn liar(packet: Packet) -> Packet {
    let is_period = packet.id.kind == Kind::Configured && packet.count == Parameter::Timing.number();
    let mut packet = packet;
    packet.words = packet
        .words
        .with_word(0, packet.words.first_six()[0].wrapping_add(i16::from(is_period && packet.id.node == 5)));
    packet
}

#[test]
fn wrong_words_are_written_again_and_named_in_the_end() {
    let (skin, old, _) = skin();
    let mut workshop = Workshop::with_cells(&skin, 12, |place| FlashState::Valid(old(place)));
    workshop.forgers = Some((|packet| packet, liar));
    let report = workshop.commission(&skin, WISH, None);
    let Outcome::Failed(reason) = report.cells[4].outcome else { panic!("{report:#?}") };
    assert_eq!(
        reason.to_string(),
        "answered a read of timing with period 16001 us instead of period 16000 us"
    );
    assert_eq!(outcomes(&report).iter().filter(|outcome| **outcome == Outcome::Written).count(), 11);
}

#[test]
fn a_refusal_is_named_in_words() {
    fn refuses(packet: Packet) -> Packet {
        match Message::decode(&packet) {
            Ok(Message::Configured { from, tag, answer: Answer::Value { number: 2, written: true, .. } })
                if from == cell(5) =>
            {
                Message::Configured { from, tag, answer: Answer::Refused { number: 2, reason: 18 } }.encode()
            }
            _ => packet,
        }
    }
    let (skin, old, _) = skin();
    let mut workshop = Workshop::with_cells(&skin, 13, |place| FlashState::Valid(old(place)));
    workshop.forgers = Some((|packet| packet, refuses));
    let report = workshop.commission(&skin, WISH, None);
    let Outcome::Failed(reason) = report.cells[4].outcome else { panic!("{report:#?}") };
    assert_eq!(reason.to_string(), "refused a write of pose: there is no such parameter");
}
