//! A recording on a disk that loses its power: ext4 in an image, copied while a run writes. Unsynced data is not in the
//! copy.
//!
//! Needs root, mkfs.ext4 and loop devices; `tests/tools/run` reports when it has to skip this test.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use process::{TestDir, until};
use recorded::Recorded;
use rustix::process::Signal;

/// ext4 in an image; a file's data and name reach it when they are synced, or after five minutes.
struct Disk {
    image: PathBuf,
    mounted: PathBuf,
}

fn run(program: &str, arguments: &[&str]) {
    let done = Command::new(program).args(arguments).output().unwrap();
    assert!(done.status.success(), "{program} {arguments:?}: {}", String::from_utf8_lossy(&done.stderr));
}

impl Disk {
    fn new(folder: &Path) -> Self {
        let image = folder.join("disk");
        File::create(&image).unwrap().set_len(64 << 20).unwrap();
        run("mkfs.ext4", &["-q", "-F", image.to_str().unwrap()]);
        Self::mount(image)
    }

    fn mount(image: PathBuf) -> Self {
        let mounted = image.with_extension("mounted");
        fs::create_dir(&mounted).unwrap();
        run("mount", &["-o", "loop,commit=300", image.to_str().unwrap(), mounted.to_str().unwrap()]);
        Self { image, mounted }
    }

    /// Returns the disk as a loss of power would leave it now. No program may write meanwhile.
    fn after_a_power_loss(&self, number: u32) -> Self {
        let copy = self.image.with_file_name(format!("disk-{number}"));
        loop {
            fs::copy(&self.image, &copy).unwrap();
            if fs::read(&self.image).unwrap() == fs::read(&copy).unwrap() {
                return Self::mount(copy);
            }
        }
    }

    fn files(&self) -> Vec<String> {
        let names = fs::read_dir(&self.mounted).unwrap();
        names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.mounted).status();
    }
}

#[test]
#[ignore = "needs root and loop devices"]
fn a_recordings_file_that_has_its_name_is_whole_after_a_loss_of_power() {
    let place = TestDir::new();
    place.pressed();
    let disk = Disk::new(&place.path(""));
    let record = disk.mounted.join("run.mcap");
    let bench = place.running_bench(600.0, &format!("--record {} --record-split 1s", record.display()));
    let mut whole = 0;
    for number in 0..4_u32 {
        let names = || disk.files().iter().filter(|name| name.ends_with(".mcap")).count();
        until("another file", || (names() > number as usize).then_some(()));
        // Another program syncs a file of its own, and with it the names of all.
        File::create(disk.mounted.join("others")).unwrap().sync_all().unwrap();
        bench.signal(Signal::STOP);
        let after = disk.after_a_power_loss(number);
        bench.signal(Signal::CONT);
        for name in after.files().iter().filter(|name| name.ends_with(".mcap")) {
            let recorded = Recorded::read(&after.mounted.join(name));
            // On a busy machine a part may have few messages.
            assert!(!recorded.messages.is_empty(), "{name}");
            whole += 1;
        }
    }
    assert!(whole >= 4, "{whole} files had their names");
    bench.signal(Signal::TERM);
    bench.end();
    let after = disk.after_a_power_loss(9);
    let there: Vec<_> = disk.files();
    assert!(there.len() >= 6 && there.iter().all(|name| after.files().contains(name)), "{there:?}");
    for name in there.iter().filter(|name| name.ends_with(".mcap")) {
        assert_eq!(fs::read(disk.mounted.join(name)).unwrap(), fs::read(after.mounted.join(name)).unwrap());
    }
}
