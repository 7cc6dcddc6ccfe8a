//! The bench of Fig. 6 to 8: an arm with 253 cells that yields to touches.

use protocol::skin::Skin;

use super::Effort;
use model::generate::{Target, generate};

pub use model::generate::Reply;

/// Returns the name of the files of a run with this kind of replies.
#[must_use]
pub const fn name(reply: Reply) -> &'static str {
    match reply {
        Reply::Torque => "single",
        Reply::Sum => "sum",
    }
}

/// The number of cells of the paper's arm.
const CELLS: usize = 253;
/// The number of cells of a quick run.
const QUICK_CELLS: usize = 24;
/// A scenario with strokes, palms, a grip and a poke; the central computation is off from 5.7 s on.
const TOUCHES: &str = include_str!("../../examples/demo.toml");
/// A scenario with a touch of all cells at once; the central computation is off from 1.2 s on.
const TOUCH: &str = "# A hand closes around the arm and opens again.
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

/// Returns the arm's `skin.toml`.
///
/// # Panics
/// Never: this number of cells fits.
#[must_use]
pub fn skin(reply: Reply, effort: Effort) -> String {
    let cells = match effort {
        Effort::Quick => QUICK_CELLS,
        Effort::Full => CELLS,
    };
    generate(&Target { cells, reply, ..Target::default() }).expect("so many cells fit on the arm")
}

/// Returns the paper's arm, whose cells reply with torques.
///
/// # Panics
/// Never: a generated skin can be parsed.
#[must_use]
pub fn paper() -> Skin {
    Skin::parse("skin.toml", &skin(Reply::Torque, Effort::Full)).expect("it has been generated")
}

/// Returns the arm's `scenario.toml`.
#[must_use]
pub const fn scenario(effort: Effort) -> &'static str {
    match effort {
        Effort::Quick => TOUCH,
        Effort::Full => TOUCHES,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use model::scenario::{Mode, Scenario};
    use protocol::time::Micros;

    #[test]
    fn the_arm_is_that_of_the_demonstration_and_its_scenarios_fit_it() {
        let text = skin(Reply::Torque, Effort::Full);
        assert_eq!(text, include_str!("../../examples/ur5-253.toml"));
        for (reply, effort) in [
            (Reply::Torque, Effort::Full),
            (Reply::Sum, Effort::Full),
            (Reply::Torque, Effort::Quick),
            (Reply::Sum, Effort::Quick),
        ] {
            let skin = Skin::parse("skin.toml", &skin(reply, effort)).unwrap();
            let scenario = Scenario::parse("scenario.toml", scenario(effort), &skin).unwrap();
            let switched = if effort == Effort::Full { 5_700_000 } else { 1_200_000 };
            assert_eq!(scenario.mode_at(Micros(switched - 1)), Mode::Compare);
            assert_eq!(scenario.mode_at(Micros(switched)), Mode::Distributed);
        }
    }
}
