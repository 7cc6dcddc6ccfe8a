//! Complete benches whose force sensors drift, and whose cells subtract a zero that they find and track.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::print_stdout,
    reason = "a test may stop, and tells its figures"
)]

use model::scenario::Scenario;
use protocol::can::Format;
use protocol::fixed::{Q1_14, Q5_10};
use protocol::id::Node;
use protocol::message::{Answer, BaselinePage, Message, Request, SensorPage};
use protocol::packet::{Packet, padded_words};
use protocol::parameters::{Baseline, BaselineSettings, Parameter};
use protocol::skin::{Skin, SkinTiming};
use protocol::time::{Micros, Span};
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench};
use skinbus_tests::skins;

/// Returns a skin of six cells in a row, wired one to the next.
fn skin() -> Skin {
    let mut skin = skins::arm(6, Format::Fd);
    // The loop has nothing to do between joints.
    skin.timing = SkinTiming { control_hz: 62.5, ticks_per_broadcast: 1 };
    let nodes: Vec<_> = skin.cells.iter().map(|cell| cell.node).collect();
    for (index, cell) in skin.cells.iter_mut().enumerate() {
        let beside = [index.checked_sub(1), Some(index + 1)];
        for (neighbor, beside) in cell.neighbors.iter_mut().zip(beside) {
            *neighbor = beside.and_then(|index| nodes.get(index)).copied();
        }
    }
    skin
}

fn rule() -> BaselineSettings {
    BaselineSettings {
        threshold: Q5_10::nearest(0.1),
        hysteresis: Q1_14::nearest(0.5),
        rate_un_per_s: 2_000,
        limit: Q5_10::nearest(2.0),
        n_per_c: Q1_14::ZERO,
    }
}

fn write(to: Node, parameter: Parameter, words: [i16; 6]) -> Act {
    let request = Request::Write { number: parameter.number(), words };
    Act::SendFromGateway(Message::Configure { to, tag: 1, request })
}

/// Returns a bench with this scenario, whose cells have this baseline before the first joints.
fn bench(scenario: &str, baseline: Baseline) -> Bench {
    let skin = skin();
    let text = format!("{scenario}\n[motion]\nkind = \"hold\"\nstart = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n");
    let scenario = Scenario::parse("drift.toml", &text, &skin).unwrap();
    let mut bench = Bench::with(&skin, &scenario, 1, |_| Micros(0));
    bench.settle();
    bench.act(write(Node::Everyone, Parameter::Baseline, baseline.words()));
    bench.run(Span::from_millis(20));
    bench.begin();
    bench
}

fn messages(bench: &Bench) -> impl Iterator<Item = Message> {
    bench.wire.iter().filter_map(|it| Message::decode(&Packet::from_fd(&it.frame).ok()?).ok())
}

/// Returns the zeros that a cell reported, by its index in the skin.
fn zeros(bench: &Bench, place: usize) -> Vec<BaselinePage> {
    let node = bench.skin.cells[place].node;
    let page = |message| {
        let Message::Sensors { from, page: SensorPage::Baseline(page), .. } = message else { return None };
        (from == node).then_some(page)
    };
    messages(bench).filter_map(page).collect()
}

/// Returns the relative loss of a torque from its first second to its weakest one.
fn lost(torques: &[(u8, [i16; 6])]) -> f64 {
    let size = |(_, words): &(u8, [i16; 6])| words.iter().map(|word| f64::from(*word).abs()).sum::<f64>();
    let seconds: Vec<f64> = torques.chunks_exact(62).map(|part| part.iter().map(size).sum::<f64>()).collect();
    let weakest = seconds.iter().copied().fold(f64::INFINITY, f64::min);
    1.0 - weakest / seconds[0]
}

/// Sensors whose zero shifts eight times as much as the data sheet's, and drifts.
const DRIFTING: &str = "[sensors.force]\nkind = \"piezoresistive\"\ntemperature_n_per_c = 0.02\ndrift_n = 0.02\n\
                        hysteresis = 0.02\ncrosstalk = 0.02\n";

/// Returns a scenario: five minutes of warming up, and then ten of 1 N on four cells.
fn pressed(seed: u64) -> String {
    format!(
        "seed = {seed}\nduration_s = 910.0\n[[touch]]\nat_s = 300.0\nfor_s = 600.0\ncells = [3, 4, 5, 6]\n\
         force_n = 1.0\n[sensors]\ntemperature_c = [[0.0, 20.0], [300.0, 25.0], [900.0, 35.0]]\n"
    )
}

#[test]
fn ten_minutes_of_touch_keep_their_torque_while_the_sensors_drift() {
    let (mut worst, mut count) = (0.0_f64, 0);
    for (seed, errors) in [(1, "[sensors.force]\n"), (1, DRIFTING), (2, DRIFTING)] {
        let mut bench = bench(&format!("{}{errors}", pressed(seed)), Baseline::On(rule()));
        bench.run(Span::from_millis(905_000));
        for place in 2..6 {
            let torques = bench.torques(place);
            let lost = lost(&torques[..37_400]);
            assert!(lost <= 0.05, "seed {seed}, place {place}: {lost:.4} of the torque is lost, {errors}");
            worst = worst.max(lost);
            count += 1;
            let pages = zeros(&bench, place);
            assert!(pages.iter().any(|page| page.touched), "the touch is reported");
            assert!(!pages.last().unwrap().touched, "so is its end");
            assert_eq!(torques.last().unwrap().1, [0; 6], "after the release nothing is there");
        }
        bench.finish();
        accounts::check(&bench);
    }
    println!(
        "{count} touches of 600 s with 1 N, 25 to 35 °C: at most {:.1} % of the torque lost",
        worst * 100.0
    );
}

const RAMP: &str = "seed = 4\nduration_s = 600.0\n[sensors]\ntemperature_c = [[0.0, 25.0], [600.0, 35.0]]\n";

#[test]
fn a_thermal_ramp_without_a_touch_is_no_contact() {
    let text = format!("{RAMP}{DRIFTING}");
    let mut bench_with = bench(&text, Baseline::On(rule()));
    bench_with.run(Span::from_millis(600_000));
    for place in 0..6 {
        assert_eq!(bench_with.torques(place), [], "{place}");
        let pages = zeros(&bench_with, place);
        assert!(pages.len() > 500 && pages.iter().skip(8).all(|page| page.tared && !page.touched), "{place}");
    }
    // Without a baseline the offsets alone are contacts.
    let mut bench_without = bench(&text, Baseline::Off);
    bench_without.run(Span::from_millis(1_000));
    let touched = (0..6).filter(|&place| !bench_without.torques(place).is_empty()).count();
    assert!(touched > 0, "the sensors have offsets");
}

#[test]
fn a_tare_while_touched_is_refused_and_reported() {
    let text = "seed = 2\nduration_s = 20.0\n[[touch]]\nat_s = 2.0\nfor_s = 5.0\ncells = [3]\nforce_n = 1.0\n\
                [sensors.force]\n";
    let mut bench = bench(text, Baseline::On(rule()));
    bench.run(Span::from_millis(4_000));
    let third = Node::Cell(bench.skin.cells[2].node);
    bench.act(write(third, Parameter::Tare, padded_words([1])));
    bench.run(Span::from_millis(100));
    let refused = |message| {
        matches!(
            message,
            Message::Configured {
                answer: Answer::Refused { number: 12, reason: Answer::REFUSED_CELL_TOUCHED },
                ..
            }
        )
    };
    assert!(messages(&bench).any(refused), "the refusal has its reason");
    let page = *zeros(&bench, 2).last().unwrap();
    assert_eq!((page.refused, page.touched, page.tared), (1, true, true));
    bench.run(Span::from_millis(4_000));
    bench.act(write(third, Parameter::Tare, padded_words([1])));
    bench.run(Span::from_millis(100));
    let written = |message| {
        matches!(message, Message::Configured { answer: Answer::Value { number: 12, written: true, .. }, .. })
    };
    assert!(messages(&bench).any(written), "after the release it is a tare");
}

/// A cell that restarts has no baseline, and a write of it begins with a first tare.
#[test]
fn a_cell_that_is_pressed_with_more_than_the_limit_at_its_start_is_in_contact() {
    let text =
        "seed = 2\nduration_s = 20.0\n[[touch]]\ncells = [3]\nforce_n = 4.0\n[sensors.force]\ngain = 0.05\n";
    let mut bench = bench(text, Baseline::On(rule()));
    bench.run(Span::from_millis(3_000));
    assert!(bench.torques(2).len() > 150, "from the first joints on");
    assert!(zeros(&bench, 2).iter().all(|page| !page.tared), "and that is no zero");
}
