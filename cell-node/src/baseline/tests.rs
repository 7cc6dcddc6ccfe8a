use proptest::prelude::*;

use super::*;

const PERIOD: u16 = 16_000;

fn rule() -> BaselineSettings {
    BaselineSettings {
        threshold: Q5_10::nearest(0.1),
        hysteresis: Q1_14::nearest(0.5),
        rate_un_per_s: 2_000,
        limit: Q5_10::nearest(0.5),
        n_per_c: Q1_14::ZERO,
    }
}

fn with(rule: BaselineSettings) -> Baseline {
    let mut baseline = Baseline::default();
    baseline.set_rule(Rule::On(rule));
    baseline
}

fn reads(newtons: f64, degrees: f64) -> SkinSensors {
    #[expect(clippy::cast_possible_truncation, reason = "a few N")]
    let steps = (newtons * 1_024.0).round() as i32;
    let third = steps.div_euclid(3);
    let contact = [third, third, steps - 2 * third].map(|steps| Q5_10::from_bits(steps.try_into().unwrap()));
    SkinSensors { contact, temperature: [Q9_6::nearest(degrees); 2], ..SkinSensors::default() }
}

fn newtons(sensors: &SkinSensors) -> f64 {
    f64::from(contact_force(sensors)) / 1_024.0
}

impl Baseline {
    fn run(&mut self, joints: usize, raw: &SkinSensors) -> f64 {
        for _ in 0..joints {
            self.process_joints(raw, PERIOD);
        }
        newtons(&self.subtract_zero(raw))
    }
}

/// Returns the baseline of a sensor that reads 0.3 N without a touch, at 25 °C.
fn tared(rule: BaselineSettings) -> Baseline {
    let mut baseline = with(rule);
    baseline.run(STEADY_MESSAGES_BEFORE_TARE.into(), &reads(0.3, 25.0));
    assert!(baseline.is_tared());
    baseline
}

#[test]
fn without_a_baseline_nothing_is_subtracted_and_nothing_told() {
    let mut baseline = Baseline::default();
    let raw = reads(0.3, 25.0);
    baseline.run(100, &raw);
    assert_eq!((baseline.subtract_zero(&raw), baseline.page()), (raw, None));
    assert_eq!(baseline.tare(&raw, TareCommand::Untouched), Err(TareRefusal::Off));
}

#[test]
fn a_steady_reading_within_the_limit_is_the_zero_after_a_start() {
    let mut baseline = with(rule());
    for joints in 0..STEADY_MESSAGES_BEFORE_TARE {
        assert!(!baseline.is_tared(), "{joints}");
        assert_eq!(baseline.run(1, &reads(0.3, 25.0)), 0.0, "what is within the limit is none");
    }
    assert!(baseline.is_tared());
    assert_eq!(baseline.run(1, &reads(1.3, 25.0)), 1.0);
    let page = baseline.page().unwrap();
    assert_eq!((page.zero, page.tared, page.touched), (Q5_10::nearest(0.3), true, true));
}

#[test]
fn a_touch_at_the_start_beyond_the_limit_is_a_touch_and_no_zero() {
    let mut baseline = with(rule());
    assert_eq!(baseline.run(500, &reads(0.6, 25.0)), reads_as(0.6));
    assert!(!baseline.is_tared());
    // A changing reading is not used as zero either.
    for joints in 0..500 {
        baseline.run(1, &reads(if joints % 2 == 0 { 0.2 } else { 0.4 }, 25.0));
    }
    assert!(!baseline.is_tared());
}

fn reads_as(newtons: f64) -> f64 {
    f64::from(contact_force(&reads(newtons, 0.0))) / 1_024.0
}

#[test]
fn ten_minutes_of_touch_stay_and_the_release_is_zero() {
    let mut baseline = tared(rule());
    let touched = reads(1.3, 25.0);
    assert_eq!(baseline.run(37_500, &touched), 1.0);
    assert_eq!(baseline.run(1, &reads(0.3, 25.0)), 0.0);
}

#[test]
fn what_changes_slowly_without_a_touch_is_followed_and_what_is_quick_is_a_touch() {
    let mut baseline = tared(rule());
    // 1 mN/s, half of the rate.
    for second in 0..150 {
        let net = baseline.run(62, &reads(0.3 + f64::from(second) * 0.001, 25.0));
        assert!(net.abs() <= 0.003, "{second} s: {net}");
    }
    assert!(!baseline.page().unwrap().limited);
    let net = baseline.run(62_500, &reads(0.54, 25.0));
    assert!((net - 0.04).abs() < 0.001, "0.5 N is the limit: {net}");
    assert!(baseline.page().unwrap().limited);
}

#[test]
fn the_zero_moves_with_the_temperature_in_contact_too() {
    let mut baseline = tared(BaselineSettings { n_per_c: Q1_14::nearest(0.02), ..rule() });
    for degrees in 25..=30 {
        let degrees = f64::from(degrees);
        let net = baseline.run(500, &reads(1.3 + 0.02 * (degrees - 25.0), degrees));
        assert!((net - 1.0).abs() < 0.002, "{degrees}: {net}");
    }
}

#[test]
fn the_coefficient_is_learned_from_a_warm_up_without_a_touch() {
    for (slope, start) in [(0.02, 25.0), (-0.015, 25.0), (0.02, 35.0)] {
        let mut baseline = with(rule());
        baseline.run(STEADY_MESSAGES_BEFORE_TARE.into(), &reads(0.1, start));
        let up = if start > 30.0 { -1.0 } else { 1.0 };
        // One degree per minute, in steps of 1/64 °C.
        for step in 0..640 {
            let degrees = f64::from(step) / 64.0;
            baseline.run(58, &reads(0.1 + slope * up * degrees, start + up * degrees));
        }
        let learned = baseline.page().unwrap().n_per_c.to_f64();
        assert!((learned - slope).abs() < 0.0015, "{learned} of {slope}");
    }
}

#[test]
fn a_jump_of_the_temperature_and_a_slow_change_teach_nothing() {
    let mut baseline = tared(rule());
    baseline.run(10, &reads(0.3, 25.0));
    baseline.run(1_000, &reads(0.33, 28.0));
    assert_eq!(baseline.page().unwrap().n_per_c, Q1_14::ZERO);
    for step in 0..128 {
        baseline.run(200, &reads(0.33 + f64::from(step) * 0.0005, 28.0 + f64::from(step) / 64.0));
    }
    assert_eq!(baseline.page().unwrap().n_per_c, Q1_14::ZERO);
}

#[test]
fn a_tare_needs_that_nothing_touches_it_unless_it_is_forced() {
    let mut baseline = tared(rule());
    let touched = reads(0.45, 25.0);
    baseline.run(50, &touched);
    assert_eq!(baseline.tare(&touched, TareCommand::Untouched), Err(TareRefusal::Touched));
    let page = baseline.page().unwrap();
    assert_eq!((page.refused, page.zero, page.touched), (1, Q5_10::nearest(0.3), true));
    assert_eq!(baseline.tare(&touched, TareCommand::Forced), Ok(()));
    assert_eq!(baseline.run(1, &touched), 0.0);
    let more = reads(0.95, 25.0);
    baseline.run(50, &more);
    assert_eq!(baseline.tare(&more, TareCommand::Forced), Err(TareRefusal::Limit), "0.95 N");
    baseline.tare(&more, TareCommand::Forget).unwrap();
    assert!(!baseline.is_tared());
    assert_eq!(
        with(rule()).tare(&more, TareCommand::Untouched),
        Err(TareRefusal::Touched),
        "it has read nothing"
    );
}

#[test]
fn a_zero_is_shared_by_the_three_words_and_adds_up() {
    for zero in -600..600 {
        let mut baseline = with(BaselineSettings { limit: Q5_10::from_bits(700), ..rule() });
        let contact_words = [zero, 0, 0].map(Q5_10::from_bits);
        baseline.run(40, &SkinSensors { contact: contact_words, ..SkinSensors::default() });
        let raw = SkinSensors { contact: [400, 500, 600].map(Q5_10::from_bits), ..SkinSensors::default() };
        assert_eq!(contact_force(&baseline.subtract_zero(&raw)), 1_500 - i32::from(zero));
        let [first, second, _] = baseline.subtract_zero(&raw).contact.map(Q5_10::to_bits);
        assert!((first - (400 - zero / 3)).abs() <= 1 && (second - (500 - zero / 3)).abs() <= 1, "{zero}");
    }
}

#[test]
fn the_pace_is_the_rate_in_a_period_and_never_more() {
    for (rate, period) in [(2_000, 16_000), (1, 65_535), (65_535, 65_535), (50, 1_000), (65_535, 1)] {
        let exact = f64::from(rate) * f64::from(period) * 1e-12 * 4_194_304.0;
        let got = f64::from(step_per_period(rate, period));
        assert!(got <= exact && got > exact - 1.1, "{rate} {period}: {got} of {exact}");
    }
}

proptest! {
    // BASE-5, BASE-6
    #[test]
    fn the_zero_is_never_quicker_than_the_rate_and_does_not_move_in_contact(
        readings in proptest::collection::vec((-700_i16..2_000, -80_i16..80, 1_usize..40), 1..200),
        rate in 1_u16..,
        limit in 0_i16..1_000,
    ) {
        let mut baseline = with(BaselineSettings { rate_un_per_s: rate, limit: Q5_10::from_bits(limit), ..rule() });
        let most = step_per_period(rate, PERIOD);
        for (force, noise, joints) in readings {
            for joint in 0..joints {
                let noise = if joint % 3 == 0 { noise } else { 0 };
                let contact = [force / 3, force / 3, force / 3 + noise].map(Q5_10::from_bits);
                let raw = SkinSensors { contact, ..SkinSensors::default() };
                let before = baseline;
                baseline.process_joints(&raw, PERIOD);
                if before.is_tared {
                    prop_assert!(before.zero.abs_diff(baseline.zero) <= most.unsigned_abs());
                    if baseline.touch == TouchState::Touched {
                        prop_assert_eq!(before.zero, baseline.zero);
                    }
                }
                prop_assert!(baseline.zero.abs() <= i32::from(limit) << ZERO_EXTRA_FRACTION_BITS);
            }
        }
    }

    #[test]
    fn no_words_panic(
        words: [i16; 6],
        readings in proptest::collection::vec(any::<([i16; 3], i16, u16, u8)>(), 0..100),
    ) {
        let Some(rule) = Rule::from_words(words) else { return Ok(()) };
        let mut baseline = Baseline::default();
        baseline.set_rule(rule);
        for (contact, temperature, period, tare) in readings {
            let raw = SkinSensors {
                contact: contact.map(Q5_10::from_bits),
                temperature: [Q9_6::from_bits(temperature); 2],
                ..SkinSensors::default()
            };
            for _ in 0..tare {
                baseline.process_joints(&raw, period);
            }
            let how = [TareCommand::Forget, TareCommand::Untouched, TareCommand::Forced];
            let _ = how.get(usize::from(tare)).map(|how| baseline.tare(&raw, *how));
            let _ = (baseline.subtract_zero(&raw), baseline.page());
        }
    }
}
