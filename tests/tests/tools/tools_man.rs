//! The man pages, as `man` shows them.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fs;
use std::process::Command;

use skinbus_tests::process::program;

#[test]
#[ignore = "needs man"]
fn every_page_is_shown_without_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let made = Command::new(program("skinbus")).arg("man").arg(folder.path()).output().unwrap();
    assert!(made.status.success(), "{made:?}");
    let mut pages = 0;
    for page in fs::read_dir(folder.path()).unwrap().map(|page| page.unwrap().path()) {
        let mut man = Command::new("man");
        man.args(["--warnings", "-l"])
            .arg(&page)
            .env("MANWIDTH", "80")
            .env("LC_ALL", "C.UTF-8")
            .env("MANPAGER", "cat");
        let shown = man.output().unwrap();
        let text = String::from_utf8_lossy(&shown.stdout);
        assert!(
            shown.status.success() && text.contains("SYNOPSIS") && text.contains("OPTIONS"),
            "{page:?}: {shown:?}"
        );
        assert_eq!(String::from_utf8_lossy(&shown.stderr), "", "{page:?}");
        pages += 1;
    }
    assert!(pages > 25, "{pages}");
}
