//! Skins for tests.

use std::fmt::Write;
use std::path::Path;

use protocol::can::Format;
use protocol::skin::Skin;

/// Returns a UR5 with `cells` cells on one bus, spread over its joints, each with a different pose. The cells have
/// thresholds of 0.1 N and do not use proximity. Torques are held for 2 epochs, and decay over 4.
///
/// # Panics
/// Panics if there are more cells than a bus has node ids.
#[must_use]
pub fn arm(cells: u8, format: Format) -> Skin {
    let format = match format {
        Format::Fd => "fd",
        Format::Classic => "classic",
    };
    let mut text = format!(
        r#"version = 1
name = "arm-{cells}"

[robot]
name = "UR5"
joints = [
  {{ a = 0.0, alpha = 1.5707963267948966, d = 0.089159, theta_offset = 0.0 }},
  {{ a = -0.425, alpha = 0.0, d = 0.0, theta_offset = 0.3 }},
  {{ a = -0.39225, alpha = 0.0, d = 0.0, theta_offset = 0.0 }},
  {{ a = 0.0, alpha = 1.5707963267948966, d = 0.10915, theta_offset = -1.0 }},
  {{ a = 0.0, alpha = -1.5707963267948966, d = 0.09465, theta_offset = 0.0 }},
  {{ a = 0.0, alpha = 0.0, d = 0.0823, theta_offset = 0.0 }},
]

[timing]
control_hz = 500.0
joint_broadcast_hz = 62.5

[contact]
alpha_c = 1.0
alpha_p = 0.0
contact_threshold_n = 0.1
proximity_threshold = 0.05
force_threshold_n = 0.1

[safety]
hold_epochs = 2
decay_epochs = 4
bad_cycles = 25

[[bus]]
name = "vcan0"
reply = "torque"
format = "{format}"

[controller]
kind = "kinesthetic"
inertia = [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
damping = [4.0, 4.0, 4.0, 2.0, 2.0, 2.0]
max_speed = [2.0, 2.0, 2.0, 3.0, 3.0, 3.0]
"#
    );
    for node in 1..=cells {
        let joint = 1 + (node - 1) % 6;
        let turn = f64::from(node);
        let [x, y, z] = [0.05 * turn.sin(), 0.06 * turn.cos(), 0.07 * (0.5 * turn).sin()];
        let (sin, cos) = (0.4 * turn).sin_cos();
        let cell = format!(
            "\n[[cell]]\nbus = \"vcan0\"\nnode = {node}\nserial = {serial}\njoint = {joint}\n\
             position = [{x:.6}, {y:.6}, {z:.6}]\norientation = [{sin:.9}, 0.0, 0.0, {cos:.9}]\n",
            serial = 1_000 + u32::from(node)
        );
        text.write_str(&cell).expect("a string takes everything");
    }
    Skin::parse("arm.toml", &text).expect("the tests' skin is sound")
}

/// Returns the 253-cell arm of the examples.
///
/// # Panics
/// Panics if the file is missing or invalid.
#[must_use]
pub fn ur5_253() -> Skin {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../gateway/examples/ur5-253.toml");
    Skin::read(&path).expect("the example is sound")
}
