//! Complete benches in virtual time, explained from the frames on the wire: the cells' own code against the central
//! computation, word by word.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use analysis::explain::{
    ContactOrigin, JointsWatcher, RequestedJoints, TorqueExplanation, WordVerdict, explain,
};
use model::decode::{Decoded, Decoder};
use protocol::can::Format;
use protocol::id::Kind;
use protocol::message::StimulusStart;
use protocol::packet::{Epoch, WORDS};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::bench::{Act, Bench, WireFrame};
use skinbus_tests::fault::{Fault, Harm};
use skinbus_tests::skins;

/// The number of epochs of a bench.
const EPOCHS: u64 = 60;

/// Explains an epoch from a capture of these frames.
fn explained(bench: &Bench, wire: &[WireFrame], epoch: u8) -> TorqueExplanation {
    let requested = RequestedJoints { epoch: Epoch(epoch), from_ns: 0, occurrence: 1 };
    let bus = &bench.skin.buses[0].name;
    let (mut watch, mut decoder) = (JointsWatcher::new(&bench.skin, requested), Decoder::new(None));
    for sent in wire {
        let decoded = decoder.decode(sent.at, bus, &sent.frame);
        let message = if let Decoded::Message(message) = &decoded { Some(message) } else { None };
        if watch.receive(sent.at.0 * 1_000, bus, message) {
            break;
        }
    }
    explain(&bench.skin, &watch.into_joints().unwrap())
}

/// Returns a bench whose cells are pressed and released all the time, some so hard that they saturate.
fn pressed(seed: u64, format: Format) -> Bench {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut bench = Bench::new(&skins::arm(8, format), seed).started();
    for _ in 1..EPOCHS {
        let (place, newtons) =
            (rng.random_range(0..8), [0.0, 0.05, 1.5, 4.0, 8.0, 90.0][rng.random_range(0..6)]);
        // From the next joints on; or ahead, or late.
        let ahead = rng.random_range(0..u8::try_from(EPOCHS).unwrap());
        let from = if rng.random_range(0..3) == 0 {
            StimulusStart::Next
        } else {
            StimulusStart::Epoch(Epoch(ahead))
        };
        bench.press_from(place, newtons, from);
        bench.run_epochs(1);
    }
    bench.run_epochs(6);
    bench
}

#[test]
fn every_word_of_every_cell_is_explained() {
    for (seed, format) in [(1, Format::Fd), (2, Format::Fd), (3, Format::Classic)] {
        let bench = pressed(seed, format);
        let (mut compared, mut rounded, mut saturated) = (0, 0, 0);
        for epoch in 0..u8::try_from(EPOCHS).unwrap() {
            let explanation = explained(&bench, &bench.wire, epoch);
            assert_eq!(explanation.missing, Vec::<String>::new(), "epoch {epoch}");
            let mut sums = [0; WORDS];
            for (place, cell) in bench.skin.cells.iter().enumerate() {
                let torques = bench.torques(place);
                let said = torques.iter().find(|(of, _)| *of == epoch).map(|(_, words)| *words);
                let found = explanation.cells.iter().find(|it| it.node == cell.node.get());
                // Every cell that answers is explained, and every cell that should have answered has.
                assert_eq!(found.is_some(), said.is_some(), "epoch {epoch}, cell {}", cell.node);
                let (Some(found), Some(said)) = (found, said) else { continue };
                let words: Vec<_> = found.rows.iter().map(|row| row.word.unwrap()).collect();
                assert_eq!(words, said[..words.len()], "epoch {epoch}, cell {}", cell.node);
                for row in &found.rows {
                    compared += 1;
                    sums[usize::from(row.joint) - 1] += i64::from(row.word.unwrap());
                    match row.verdict {
                        WordVerdict::Nearest => assert_eq!(row.difference_steps, Some(0)),
                        WordVerdict::Rounded { jacobian_steps, .. } => {
                            assert!(jacobian_steps.abs() <= 8.0, "{row:?}");
                            rounded += 1;
                        }
                        WordVerdict::Saturated => saturated += 1,
                        WordVerdict::Unexplained | WordVerdict::Open => {
                            unreachable!("epoch {epoch}, cell {}: {row:?}", cell.node)
                        }
                    }
                }
            }
            for total in &explanation.total {
                assert_eq!(total.word_steps, sums[usize::from(total.joint) - 1], "epoch {epoch}: {total:?}");
                if total.saturated == 0 {
                    assert!((total.products_nm - total.central_nm).abs() < 1e-9, "{total:?}");
                }
            }
        }
        assert!(compared > 500 && rounded > 20 && saturated > 5, "{compared} words, {rounded}, {saturated}");
    }
}

#[test]
fn the_sum_is_the_one_that_the_gateway_has() {
    let mut bench = Bench::new(&skins::arm(8, Format::Fd), 5).started();
    (0..8).for_each(|place| bench.press(place, 1.0 + f64::from(u8::try_from(place).unwrap())));
    bench.run_epochs(10);
    // All of them have answered the last joints by now, and the arm moves on only with the next.
    let sums = bench.gateway.table.snapshot().sums;
    assert_eq!((sums.contributing, bench.skin.cells.len()), (8, 8));
    let last = bench.torques(0).last().unwrap().0;
    let explanation = explained(&bench, &bench.wire, last);
    for (total, sum) in explanation.total.iter().zip(sums.torque) {
        assert_eq!(total.words_nm.to_bits(), sum.to_bits(), "{total:?}");
    }
}

#[test]
fn unknown_causes_are_named_and_not_guessed() {
    let mut bench = Bench::new(&skins::arm(4, Format::Fd), 7).started();
    bench.press(0, 2.0);
    bench.run_epochs(4);
    let began = bench.now();
    bench.press(1, 3.0);
    bench.run_epochs(4);
    let epoch = bench.torques(0).last().unwrap().0;
    let [zero, one] = [0, 1].map(|place| bench.skin.cells[place].node.get());

    // Without the frames before, the first cell's stimulus is unknown, and so is the reason of its torque.
    let late: Vec<_> = bench.wire.iter().filter(|sent| sent.at >= began).copied().collect();
    bench.run_epochs(1);
    let explanation = explained(&bench, &late, epoch);
    let cell = |node: u8| explanation.cells.iter().find(|cell| cell.node == node).unwrap();
    assert!(cell(zero).force.is_none() && cell(zero).rows.iter().all(|row| row.verdict == WordVerdict::Open));
    assert!(matches!(cell(one).force.unwrap().origin, ContactOrigin::Stimulus { from_epoch: None, .. }));
    let said = explanation.missing.join("\n");
    let unknown = format!(
        "vcan0 {zero}: its contact state is not in the capture: the capture has no earlier start, stimulus or sensors page of this cell"
    );
    assert!(said.contains(&unknown), "{said}");
    assert!(
        said.contains("vcan0: 2 cells sent nothing, and their contact state is not in the capture"),
        "{said}"
    );

    // Without the torque, the sum does not include it.
    let node = u32::from(one);
    let torque =
        |sent: &WireFrame| sent.frame.id() >> 8 == Kind::Torque as u32 && sent.frame.id() & 0xFF == node;
    let without: Vec<_> = bench.wire.iter().filter(|sent| !torque(sent)).copied().collect();
    let explanation = explained(&bench, &without, epoch);
    let cell = explanation.cells.iter().find(|cell| cell.node == one).unwrap();
    assert!(cell.force.is_some() && cell.answered_after_ns.is_none());
    let said = explanation.missing.join("\n");
    assert!(
        said.contains(&format!("vcan0 {one}: no torque of this epoch arrived in time: the frame was lost")),
        "{said}"
    );
    assert_eq!(explanation.total[0].open, 1);
}

#[test]
fn a_cell_that_has_just_started_sends_nothing_and_one_that_releases_sends_zeros() {
    let mut bench = Bench::new(&skins::arm(4, Format::Fd), 9).started();
    (0..4).for_each(|place| bench.press(place, 2.0));
    bench.run_epochs(5);
    bench.act(Act::Start(2));
    // Its first packet comes within 64 ms.
    bench.run_epochs(5);
    bench.press(3, 0.0);
    bench.run_epochs(2);
    let epoch = bench.torques(3).last().unwrap().0;
    let explanation = explained(&bench, &bench.wire, epoch);
    let node = |place: usize| bench.skin.cells[place].node.get();
    let cell = |place: usize| explanation.cells.iter().find(|cell| cell.node == node(place));
    // Its stimulus was sent again, and it answers nothing during its address claim.
    assert!(cell(0).unwrap().answered_after_ns.is_some() && cell(2).unwrap().answered_after_ns.is_none());
    let why = format!(
        "vcan0 {}: no torque of this epoch arrived in time: the cell had just started and was claiming its node id; \
         the sum of received words does not include it",
        node(2)
    );
    assert_eq!(explanation.missing, [why]);
    let released = cell(3).unwrap();
    assert_eq!(released.force.unwrap().force_steps, 0);
    assert!(released.rows.iter().all(|row| row.word == Some(0) && row.verdict == WordVerdict::Nearest));
}

#[test]
fn a_lossy_bus_loses_no_explanation_of_what_came() {
    let mut bench = Bench::new(&skins::arm(8, Format::Fd), 11);
    // Before the wire: frames lost there are in no capture either.
    bench.fault(Fault::new(Harm::Lose, 0.02).on_the_wire());
    let mut bench = bench.started();
    for round in 0..10 {
        (0..8).for_each(|place| bench.press(place, f64::from(round) / 2.0));
        bench.run_epochs(3);
    }
    let mut explained_words = 0;
    for epoch in 0..28 {
        let explanation = explained(&bench, &bench.wire, epoch);
        for row in explanation.cells.iter().flat_map(|cell| &cell.rows) {
            assert_ne!(row.verdict, WordVerdict::Unexplained, "epoch {epoch}: {row:?}");
            explained_words += u32::from(row.verdict != WordVerdict::Open);
        }
    }
    assert!(explained_words > 500, "{explained_words}");
}
