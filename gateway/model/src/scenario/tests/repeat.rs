//! Touches that repeat with a period.

use super::*;
use protocol::message::SkinSensors;

/// Number of epochs of the shortest period that holds all touches of the good scenario, at 62.5 epochs per second.
const SHORTEST: u64 = 225;

fn repeating(seconds: f64, more: &str) -> Scenario {
    let text = GOOD.replacen("seed = 7\n", &format!("seed = 7\ntouches_repeat_s = {seconds}\n"), 1);
    Scenario::parse("s.toml", &format!("{text}{more}"), &three()).unwrap()
}

/// Returns the length of this number of epochs, in s.
fn seconds(epochs: u64) -> f64 {
    Span(epochs * 16_000).seconds()
}

#[test]
fn the_period_is_read_and_holds_all_touches() {
    assert_eq!(good().touches_repeat, None);
    assert_eq!(repeating(12.0, "").touches_repeat, Some(Span(12_000_000)));
    assert_eq!(
        repeating(seconds(SHORTEST), "").touches_repeat,
        Some(Span(3_600_000)),
        "the last touch ends then"
    );
    let begin = "seed = 7\n";
    let with = |key: &str| says(begin, &format!("{begin}{key}\n"));
    assert_eq!(
        with("touches_repeat_s = 0.0"),
        "s.toml:4: touches_repeat_s = 0: must be above 0, and at most 3.2e7"
    );
    assert_eq!(
        with("touches_repeat_s = 3.5"),
        "s.toml:21: touch[0].for_s = 1.6: the touch must end before all touches repeat at touches_repeat_s = 3.5"
    );
    let endless = format!("{GOOD}[[touch]]\nat_s = 4.0\ncells = [2]\nforce_n = 1.0\n");
    let read = |period: &str| {
        Scenario::parse(
            "s.toml",
            &endless.replacen(begin, &format!("{begin}touches_repeat_s = {period}\n"), 1),
            &three(),
        )
    };
    assert!(read("4.5").is_ok(), "it lasts until all begin again");
    assert_eq!(
        by_line(read("4.0").unwrap_err()),
        "s.toml:49: touch[2].at_s = 4: the touch must end before all touches repeat at touches_repeat_s = 4"
    );
}

#[test]
fn motion_modes_and_faults_do_not_begin_again() {
    let drift = "[[fault]]\nat_s = 0.0\nkind = \"drift\"\ncells = [3]\nn_per_s = 0.01\n";
    let (repeating, once) =
        (repeating(5.0, drift), Scenario { touches_repeat: None, ..repeating(5.0, drift) });
    // The joints move continuously across the end of a period.
    for at_s in [4.999, 5.0, 5.001, 9.999, 10.0] {
        let [state, before] = [at_s, at_s - 1e-3].map(|at_s| repeating.motion.state_at(at_s).unwrap());
        assert_eq!(Some(state), once.motion.state_at(at_s));
        let [speed, highest] = [(state.position[0] - before.position[0]) / 1e-3, 0.5 * TAU / 4.0];
        assert!(speed.abs() <= highest + 1e-9, "{at_s}: {speed}");
    }
    assert_eq!(repeating.mode_at(Micros(10_000_000)), TorqueSource::Distributed);
    let touches = Touches::new(&repeating, &three());
    assert!((force(&touches, 2, 625) - 0.1).abs() < 1e-3, "10 s of drift");
}

proptest! {
    #[test]
    fn touches_are_those_of_the_same_time_in_the_first_period(
        more in 0_u64..400,
        epoch in 0_u64..1_000_000,
        cell in 0_usize..3,
    ) {
        let period = SHORTEST + more;
        let (again, once) = (repeating(seconds(period), ""), good());
        let [again, once] = [again, once].map(|scenario| Touches::new(&scenario, &three()));
        prop_assert_eq!(again.sensors(cell, epoch), once.sensors(cell, epoch % period));
        prop_assert_eq!(again.sensors(cell, epoch), again.sensors(cell, epoch + period));
    }

    /// The changes from epoch to epoch add up to the words of every cell in every period, even if epochs are skipped.
    #[test]
    fn changes_add_up_over_periods(steps in proptest::collection::vec(1_u64..300, 1..40)) {
        let endless = "[[touch]]\nat_s = 2.9\ncells = [2]\nforce_n = 1.0\n";
        let mut touches = Touches::new(&repeating(seconds(SHORTEST + 7), endless), &three());
        let mut known = [SkinSensors::default(); 3];
        let (mut before, mut epoch) = (None, 0);
        for step in steps {
            for stimulus in touches.stimuli_between(before, epoch) {
                known[stimulus.cell] = stimulus.readings.skin;
            }
            for (cell, known) in known.iter().enumerate() {
                prop_assert_eq!(*known, touches.sensors(cell, epoch), "cell {}, epoch {}", cell, epoch);
            }
            before = Some(epoch);
            epoch += step;
        }
    }
}
