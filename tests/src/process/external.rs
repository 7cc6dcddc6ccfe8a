//! Benches whose control loop is closed by another program, an external controller.

use super::{PRESSED, TestDir, skin};

/// Creates a directory for a bench with an external controller, which halts after a number of consecutive bad cycles.
pub fn place(bad_cycles: u32) -> TestDir {
    let place = TestDir::new();
    let socket = place.path("controller.sock");
    let kinesthetic = |line: &&str| !line.starts_with("inertia = ") && !line.starts_with("damping = ");
    let text = skin(8);
    let text: String = text.lines().filter(kinesthetic).map(|line| format!("{line}\n")).collect();
    let text = text.replace(
        "kind = \"kinesthetic\"",
        &format!("kind = \"external\"\nstart_s = 0.0\nsocket = \"{}\"", socket.display()),
    );
    let safety = format!("\n[safety]\nbad_cycles = {bad_cycles}\n\n[controller]");
    place.write("skin.toml", &text.replace("\n[controller]", &safety));
    place.scenario(&PRESSED.replace("\"hold\"", "\"kinesthetic\""));
    place
}

/// Returns the datagram by which a controller answers a tick with this velocity of all joints, in rad/s.
pub fn answer(tick: u64, velocity: f64) -> Vec<u8> {
    let head = [b"SKBC".as_slice(), &1_u16.to_le_bytes(), &2_u16.to_le_bytes(), &tick.to_le_bytes()].concat();
    let numbers: Vec<u8> = [velocity; 6].iter().flat_map(|number| number.to_le_bytes()).collect();
    [head.as_slice(), &1_u32.to_le_bytes(), &0_u32.to_le_bytes(), &numbers].concat()
}
