//! `skinbus skin dbc` beside cantools, which decodes and encodes the golden frames by it.
//!
//! `tests/tools/install` installs the tools; `tests/run` does that, and then runs this test.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use skinbus_tests::process;

use std::path::Path;
use std::process::Command;

use process::program;

/// Returns the output of a command that must succeed.
fn said(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {}: {error}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

#[test]
#[ignore = "needs tests/tools/install"]
fn cantools_reads_every_golden_frame_as_its_comment_says_and_writes_it_again() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = here.join("../target/tools/bin/python");
    assert!(python.exists(), "{} is missing: tests/tools/install makes it ready", python.display());
    let folder = tempfile::tempdir().unwrap();
    let [skin, dbc] = ["skin.toml", "skin.dbc"].map(|name| folder.path().join(name));
    said(Command::new(program("skinbus")).args(["skin", "generate", "--cells", "254", "-o"]).arg(&skin));
    said(Command::new(program("skinbus")).args(["skin", "dbc"]).arg(&skin).arg("-o").arg(&dbc));
    let golden = here.join("../protocol/tests/golden/fd.log");
    let compared = said(Command::new(python).arg(here.join("tools/dbc.py")).arg(&dbc).arg(golden));
    let expected = "halt=1 heard=3 heartbeat=12 joints=8 longer=20 ports=3 read=20 refusal=17 refused=3 report=1 \
                    resume=1 sensors=10 stimulus=7 sum=6 sync=1 torque=6 tree=4 unknown=30 value=4 write=40 \
                    written=7\n";
    assert_eq!(compared, expected);
}
