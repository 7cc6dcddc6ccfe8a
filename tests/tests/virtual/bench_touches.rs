//! Complete benches whose scenarios press cells with forces of their own.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use model::central::CentralComputation;
use model::scenario::Scenario;
use protocol::can::Format;
use protocol::fixed::Q3_12;
use protocol::time::Micros;
use skinbus_tests::bench::Bench;
use skinbus_tests::skins;

/// Times in s after the begin of the touch and forces in N, far above the thresholds.
const PROFILE: [[f64; 2]; 4] = [[0.0, 2.0], [0.5, 8.0], [0.75, 8.0], [1.5, 3.0]];

fn force_at(since: f64) -> Option<f64> {
    let pairs = PROFILE.windows(2).map(|pair| (pair[0], pair[1]));
    let mut inside = pairs.filter(|([from, _], [to, _])| (*from..*to).contains(&since));
    inside.next().map(|([from, low], [to, high])| low + (high - low) * (since - from) / (to - from))
}

#[test]
fn the_torque_of_a_cell_follows_the_points_of_a_profile() {
    let skin = skins::arm(8, Format::Fd);
    let points = PROFILE.map(|[at, force]| format!("[{at:?}, {force:?}]")).join(", ");
    // 0.32 s are 20 epochs.
    let text = format!(
        "duration_s = 3.0\n[motion]\nkind = \"hold\"\nstart = [0.3, -1.2, 1.0, -1.4, -1.57, 0.2]\n\
         [[touch]]\nat_s = 0.32\ncells = [\"vcan0:6\"]\nprofile = [{points}]\n"
    );
    let scenario = Scenario::parse("profile.toml", &text, &skin).unwrap();
    let mut bench = Bench::with(&skin, &scenario, 7, |_| Micros(0)).started();
    bench.run_epochs(130);

    let central = CentralComputation::new(&skin);
    let frames = central.frames_at_positions(&scenario.motion.start);
    let torques = bench.torques(5);
    let mut pressed = 0;
    for (epoch, words) in &torques {
        let since = f64::from(*epoch) / 62.5 - 0.32;
        let force = force_at(since).unwrap_or(0.0);
        pressed += usize::from(force > 0.0);
        for (word, expected) in words.iter().zip(central.cell_torque(5, &frames, force)) {
            let got = Q3_12::from_bits(*word).to_f64();
            assert!((got - expected).abs() < 0.002, "epoch {epoch}, {force} N: {got} {expected}");
        }
    }
    // 1.5 s: from epoch 20 to 113.
    assert_eq!(pressed, 94, "{torques:?}");
    assert!(bench.torques(4).is_empty(), "nothing presses another cell");
    let largest = torques.iter().flat_map(|(_, words)| words).map(|word| word.unsigned_abs()).max();
    assert!(largest.unwrap() > 400, "a torque that is far from its rounding: {largest:?}");
}
