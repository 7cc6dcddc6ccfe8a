//! Skins for the tests of this crate and of the crates that use it.

use protocol::skin::Skin;

/// A UR5 with one cell on joint 3.
pub const ONE_CELL_SKIN_TOML: &str = r#"version = 1
name = "bare"

[robot]
name = "UR5"
joints = [
  { a = 0.0, alpha = 1.5707963267948966, d = 0.089159, theta_offset = 0.0 },
  { a = -0.425, alpha = 0.0, d = 0.0, theta_offset = 0.0 },
  { a = -0.39225, alpha = 0.0, d = 0.0, theta_offset = 0.0 },
  { a = 0.0, alpha = 1.5707963267948966, d = 0.10915, theta_offset = 0.0 },
  { a = 0.0, alpha = -1.5707963267948966, d = 0.09465, theta_offset = 0.0 },
  { a = 0.0, alpha = 0.0, d = 0.0823, theta_offset = 0.0 },
]

[timing]
control_hz = 500.0
joint_broadcast_hz = 62.5

[contact]
alpha_c = 1.0
alpha_p = 2.0
contact_threshold_n = 0.1
proximity_threshold = 0.25
force_threshold_n = 0.3

[[bus]]
name = "vcan0"
reply = "torque"
format = "fd"

[controller]
kind = "kinesthetic"
inertia = [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
damping = [4.0, 4.0, 4.0, 2.0, 2.0, 2.0]
max_speed_rad_s = [2.0, 2.0, 2.0, 3.0, 3.0, 3.0]

[[cell]]
bus = "vcan0"
node = 1
joint = 3
position = [0.2, 0.01, 0.15]
orientation = [0.7071068, 0.0, 0.0, 0.7071068]
"#;

/// The skin of the demo: 253 cells on two links of a UR5.
pub const UR5_SKIN_TOML: &str = include_str!("../../examples/ur5-253.toml");
/// 126 cells on all links of an arm with seven joints, imported from its URDF.
const PANDA_SKIN_TOML: &str = include_str!("../tests/data/panda.toml");
/// A cell on an arm on a lift.
const LIFT_SKIN_TOML: &str = include_str!("../tests/data/lift.toml");

/// Returns the skin [`UR5_SKIN_TOML`].
///
/// # Panics
/// Never: the skin is valid.
#[must_use]
pub fn ur5_skin() -> Skin {
    Skin::parse("ur5-253.toml", UR5_SKIN_TOML).expect("the tests' skin is valid")
}

/// Returns a skin with cells on all links of an arm with seven joints.
///
/// # Panics
/// See [`ur5_skin`].
#[must_use]
pub fn panda_skin() -> Skin {
    Skin::parse("panda.toml", PANDA_SKIN_TOML).expect("the tests' skin is valid")
}

/// Returns a skin with one cell on an arm on a lift.
///
/// # Panics
/// See [`ur5_skin`].
#[must_use]
pub fn lift_skin() -> Skin {
    Skin::parse("lift.toml", LIFT_SKIN_TOML).expect("the tests' skin is valid")
}

/// Returns [`ONE_CELL_SKIN_TOML`] with a second bus like the first one.
///
/// # Panics
/// Never: the skin is valid.
#[must_use]
pub fn two_bus_skin() -> Skin {
    let bus = ONE_CELL_SKIN_TOML
        .find("[[bus]]")
        .zip(ONE_CELL_SKIN_TOML.find("[controller]"))
        .and_then(|(from, to)| ONE_CELL_SKIN_TOML.get(from..to));
    let cell = ONE_CELL_SKIN_TOML.find("[[cell]]").and_then(|from| ONE_CELL_SKIN_TOML.get(from..));
    let more = bus.into_iter().chain(cell).map(|part| format!("\n{}", part.replace("vcan0", "vcan1")));
    let text = ONE_CELL_SKIN_TOML.to_owned() + &more.collect::<String>();
    Skin::parse("skin.toml", &text).expect("the tests' skin is valid")
}

/// Returns [`ONE_CELL_SKIN_TOML`], parsed and checked.
///
/// # Panics
/// Never: the skin is valid.
#[must_use]
pub fn one_cell_skin() -> Skin {
    Skin::parse("skin.toml", ONE_CELL_SKIN_TOML).expect("the tests' skin is valid")
}
