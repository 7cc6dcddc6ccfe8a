//! Bit rates of a real driver: set, checked, and compared with `ip`.
//!
//! Needs root and the lab machine's two emulated controllers: `tests/vcan lab_kvaser_rates`.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use skinbus_tests::process::program;
use tempfile::TempDir;

/// A folder with a skin on can0, of classic format with this bit rate.
struct Bench(TempDir);

impl Bench {
    fn new() -> Self {
        ip("link set can0 down");
        Self(TempDir::new().unwrap())
    }

    fn write(&self, keys: &str) {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        let text = std::fs::read_to_string(root.join("gateway/examples/ur5-253.toml")).unwrap();
        let text = text.replace("\"vcan0\"", "\"can0\"").replacen("format = \"fd\"", keys, 1);
        std::fs::write(self.0.path().join("skin.toml"), text).unwrap();
    }

    /// Returns the exit code, standard output, and the line on standard error.
    fn run(&self, arguments: &str) -> (i32, String, String) {
        let mut command = Command::new(program("vcan-setup"));
        command.args(arguments.split_whitespace()).current_dir(self.0.path());
        let output = command.output().unwrap();
        let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.code().unwrap(), out, err.trim_start_matches("vcan-setup: ").trim_end().to_owned())
    }
}

fn ip(arguments: &str) -> String {
    let output = Command::new("ip").args(arguments.split_whitespace()).output().unwrap();
    assert!(output.status.success(), "ip {arguments}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Returns true if can0 is up, and its bit rate.
fn can0() -> (bool, Value) {
    let links: Vec<Value> = serde_json::from_str(&ip("-json -details link show can0")).unwrap();
    let up = links[0]["flags"].as_array().unwrap().iter().any(|flag| flag == "UP");
    (up, links[0]["linkinfo"]["info_data"]["bittiming"]["bitrate"].clone())
}

const HALF: &str = "format = \"classic\"\nbitrate = 500000";
const WHOLE: &str = "format = \"classic\"\nbitrate = 1000000";

#[test]
#[ignore = "needs the lab machine's controllers"]
fn bit_rates_are_checked_and_set_only_on_request() {
    let bench = Bench::new();
    bench.write(HALF);
    bench.run("up skin.toml --set-bit-rates");
    ip("link set can0 down");
    let before = can0();

    bench.write(WHOLE);
    let (code, out, err) = bench.run("up skin.toml");
    let expected = "can0 runs at 500 kbit/s, but skin.toml requires 1000 kbit/s: `sudo vcan-setup up skin.toml \
                    --set-bit-rates` sets them, or change skin.toml";
    assert_eq!((code, out.as_str(), err.as_str()), (1, "", expected));
    let (code, out, _) = bench.run("up skin.toml --set-bit-rates --dry-run");
    assert!(code == 0 && out.starts_with("would set can0 to 1000 kbit/s instead of 500 kbit/s"), "{out}");
    let named = bench.run("up can0");
    assert!(
        named.0 == 2
            && named.2.starts_with("can0 is CAN hardware (kvaser_pci), which vcan-setup does not change"),
        "{named:?}"
    );
    assert_eq!(bench.run("down can0").0, 2);
    assert_eq!(bench.run("down skin.toml").0, 0);
    assert_eq!(bench.run("doctor skin.toml").0, 1);
    assert_eq!(can0(), before, "none of them did anything");

    let said = bench.run("up skin.toml --set-bit-rates");
    assert_eq!(said, (0, "can0 is up at 1000 kbit/s\n".to_owned(), String::new()));
    assert_eq!(can0(), (true, 1_000_000.into()));
    let unchanged =
        "can0 is CAN hardware (kvaser_pci), runs at 1000 kbit/s, as the skin requires, and stays unchanged\n";
    for again in ["up skin.toml --set-bit-rates", "up skin.toml"] {
        assert_eq!(bench.run(again), (0, unchanged.to_owned(), String::new()));
    }
    bench.write(HALF);
    assert_eq!(bench.run("up skin.toml --set-bit-rates").0, 0, "from up as well");
    assert_eq!(can0(), (true, 500_000.into()));
    let status: Value = serde_json::from_str(&bench.run("status can0 --json").1).unwrap();
    let hardware = &status["interfaces"][0]["hardware"];
    assert_eq!(
        (&hardware["driver"], &hardware["bitrate"], &hardware["state"]),
        (&"kvaser_pci".into(), &500_000.into(), &"ERROR-ACTIVE".into())
    );
}

#[test]
#[ignore = "needs the lab machine's controllers"]
fn what_the_hardware_cannot_do_leaves_it_as_it_was() {
    let bench = Bench::new();
    bench.write(HALF);
    assert_eq!(bench.run("up skin.toml --set-bit-rates").0, 0);
    let before = can0();
    assert_eq!(before, (true, 500_000.into()));

    bench.write("format = \"fd\"\nbitrate = 500000\ndata_bitrate = 2000000");
    let (code, out, err) = bench.run("up skin.toml --set-bit-rates");
    let expected = "cannot set can0 to 500 kbit/s, data 2000 kbit/s: this hardware has no CAN FD; in the skin, set format = \"classic\" for the bus and remove data_bitrate";
    assert_eq!((code, out.as_str(), err.as_str()), (1, "", expected));
    assert_eq!(can0(), before);

    // A clock of 8 MHz can produce 888888 bit/s, and no rate nearer to the requested one.
    bench.write("format = \"classic\"\nbitrate = 930000");
    let (code, _, err) = bench.run("up skin.toml --set-bit-rates");
    assert!(code == 1 && err.starts_with("cannot set can0 to 930 kbit/s: "), "{err}");
    assert!(err.contains("the nearest bit rates that its clock allows are 888888 bit/s"), "{err}");
    assert_eq!(can0(), before);
}

#[test]
#[ignore = "needs the lab machine's controllers"]
fn the_doctor_knows_what_is_wrong_with_hardware() {
    let bench = Bench::new();
    bench.write(HALF);
    assert_eq!(bench.run("up skin.toml --set-bit-rates").0, 0);
    let doctor = || bench.run("doctor skin.toml --no-spawn").1;
    assert!(doctor().contains("ok    can0 runs at 500 kbit/s, as the skin requires\n"), "{}", doctor());
    ip("link set can0 down");
    assert!(doctor().contains("fault can0 is CAN hardware (kvaser_pci), but down\n"), "{}", doctor());
    ip("link set can0 up type can listen-only on");
    assert!(doctor().contains("fault can0 is in listen-only mode"), "{}", doctor());
    ip("link set can0 down");
    ip("link set can0 up type can listen-only off");
    bench.write(WHOLE);
    let fault =
        "fault can0 is CAN hardware (kvaser_pci) with 500 kbit/s, but the skin requires 1000 kbit/s\n";
    assert!(doctor().contains(fault), "{}", doctor());
    bench.write("format = \"fd\"");
    assert!(doctor().contains("with MTU 16, and CAN FD needs 72"), "{}", doctor());
}
