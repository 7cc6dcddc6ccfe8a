//! The bench for Fig. 6 to 8: an arm with 253 cells, which moves out of the way when it is touched.

use protocol::skin::Skin;

use super::Effort;
use model::generate::{SkinRequest, generate};

pub use model::generate::ReplyMode;

/// Returns the name, without extension, of the files of a run in which cells reply in this way.
#[must_use]
pub const fn run_file_name(reply: ReplyMode) -> &'static str {
    match reply {
        ReplyMode::Torque => "single",
        ReplyMode::Sum => "sum",
    }
}

/// The number of cells on the arm in the paper.
const PAPER_CELLS: usize = 253;
/// The number of cells on the arm in a quick run.
const QUICK_CELLS: usize = 24;
/// A scenario with strokes, palms, a grip and a poke. The central computation is switched off at 5.7 s.
const TOUCHES_SCENARIO: &str = include_str!("../../examples/demo.toml");
/// A scenario in which all cells are touched at once. The central computation is switched off at 1.2 s.
const TOUCH_SCENARIO: &str = "# A hand closes around the arm and opens again.
version = 1
duration_s = 2.4
seed = 1

[motion]
kind = \"kinesthetic\"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]

[[mode]]
at_s = 0.0
kind = \"compare\"

[[mode]]
at_s = 1.2
kind = \"distributed\"

[[touch]]
at_s = 0.2
for_s = 2.0
all = true
force_n = 2.0
profile = \"half-sine\"
";

/// Returns the text of the arm's `skin.toml`.
///
/// # Panics
/// Never panics in practice, because this number of cells fits on the arm.
#[must_use]
pub fn skin_toml(reply: ReplyMode, effort: Effort) -> String {
    let cells = match effort {
        Effort::Quick => QUICK_CELLS,
        Effort::Full => PAPER_CELLS,
    };
    generate(&SkinRequest { cells, reply, ..SkinRequest::default() }).expect("so many cells fit on the arm")
}

/// Returns the skin of the paper's arm with 253 cells that reply with torques.
///
/// # Panics
/// Never panics in practice, because a generated skin is valid.
#[must_use]
pub fn paper_skin() -> Skin {
    Skin::parse("skin.toml", &skin_toml(ReplyMode::Torque, Effort::Full)).expect("it has been generated")
}

/// Returns the text of the arm's `scenario.toml`.
#[must_use]
pub const fn scenario_toml(effort: Effort) -> &'static str {
    match effort {
        Effort::Quick => TOUCH_SCENARIO,
        Effort::Full => TOUCHES_SCENARIO,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model::scenario::{Scenario, TorqueSource};
    use protocol::time::Micros;

    #[test]
    fn the_arm_is_that_of_the_demonstration_and_its_scenarios_fit_it() {
        let text = skin_toml(ReplyMode::Torque, Effort::Full);
        assert_eq!(text, include_str!("../../examples/ur5-253.toml"));
        for (reply, effort) in [
            (ReplyMode::Torque, Effort::Full),
            (ReplyMode::Sum, Effort::Full),
            (ReplyMode::Torque, Effort::Quick),
            (ReplyMode::Sum, Effort::Quick),
        ] {
            let skin = Skin::parse("skin.toml", &skin_toml(reply, effort)).unwrap();
            let scenario = Scenario::parse("scenario.toml", scenario_toml(effort), &skin).unwrap();
            let switched = if effort == Effort::Full { 5_700_000 } else { 1_200_000 };
            assert_eq!(scenario.mode_at(Micros(switched - 1)), TorqueSource::Compare);
            assert_eq!(scenario.mode_at(Micros(switched)), TorqueSource::Distributed);
        }
    }
}
