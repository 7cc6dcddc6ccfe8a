//! The directory of a bus, and the permissions to serve a bus in it.

use super::*;

#[test]
fn a_second_server_is_refused_and_another_name_is_not() {
    let bench = Bench::new();
    let error = ServerThread::start_in(&bench.directory(), BUS).unwrap_err().to_string();
    let path = bench.directory().join("vcan0.bus");
    let rest = "use it, or stop its server first";
    assert_eq!(error, format!("the embedded bus vcan0 is already served at {}: {rest}", path.display()));
    let other = ServerThread::start_in(&bench.directory(), "vcan1").unwrap();
    other.stop().unwrap();
    assert!(path.exists(), "another bus's end leaves the directory and this one alone");
    bench.open(&[]).send(&[frame(1, 1)]).unwrap();
    bench.end();
}

#[test]
fn of_many_that_start_at_once_over_a_stale_socket_one_wins() {
    for _ in 0..10 {
        let parent = TempDir::new().unwrap();
        let directory = parent.path().join("skinbus");
        leave_stale_socket(&directory);
        let won = std::thread::scope(|scope| {
            let starts: Vec<_> =
                (0..8).map(|_| scope.spawn(|| ServerThread::start_in(&directory, BUS))).collect();
            let served: Vec<_> = starts.into_iter().filter_map(|start| start.join().unwrap().ok()).collect();
            served.len()
        });
        assert_eq!(won, 1);
        assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 0);
    }
}

#[test]
fn a_directory_of_the_user_stays_and_one_of_ours_goes_with_its_last_bus() {
    let parent = TempDir::new().unwrap();
    let [users, ours] = ["users", "ours"].map(|name| parent.path().join(name));
    std::fs::DirBuilder::new().mode(0o700).create(&users).unwrap();
    for _ in 0..2 {
        ServerThread::start_in(&users, BUS).unwrap().stop().unwrap();
        assert_eq!(std::fs::read_dir(&users).unwrap().count(), 0);
    }
    let [first, second] = [BUS, "vcan1"].map(|name| ServerThread::start_in(&ours, name).unwrap());
    first.stop().unwrap();
    assert!(ours.exists());
    let file = ours.join("mine");
    std::fs::write(&file, "").unwrap();
    second.stop().unwrap();
    assert!(file.exists());
    std::fs::remove_file(file).unwrap();
    ServerThread::start_in(&ours, BUS).unwrap().stop().unwrap();
    assert!(!ours.exists());
}

/// Leaves the socket that a killed server leaves behind.
fn leave_stale_socket(directory: &Path) {
    drop(protocol::bus::embedded::make_directory(directory).unwrap());
    let socket = rustix::net::socket(AddressFamily::UNIX, SocketType::SEQPACKET, None).unwrap();
    rustix::net::bind(&socket, &socket_address(directory, BUS).unwrap()).unwrap();
}

#[test]
fn servers_that_come_and_go_never_meet_a_directory_that_is_going() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    std::thread::scope(|scope| {
        for name in ["a", "b", "c"] {
            let directory = &directory;
            scope.spawn(move || {
                for _ in 0..50 {
                    ServerThread::start_in(directory, name).unwrap().stop().unwrap();
                }
            });
        }
    });
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 0);
}

#[test]
fn a_directory_that_others_can_enter_is_refused_by_both_sides() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    std::fs::create_dir(&directory).unwrap();
    std::fs::set_permissions(&directory, std::fs::Permissions::from_mode(0o755)).unwrap();
    let expected = format!(
        "the directory {} for embedded buses has mode 0755, so other users can open it: run `chmod 700` on \
         it, or set SKINBUS_DIR to another directory",
        directory.display()
    );
    assert_eq!(ServerThread::start_in(&directory, BUS).unwrap_err().to_string(), expected);
    let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
    let error = Bus::open(BUS, KindChoice::Only(BusKind::Embedded), &options).unwrap_err();
    assert_eq!(error.to_string(), expected);
}

#[test]
fn a_link_a_file_in_the_way_and_a_path_that_is_too_long_are_refused() {
    let parent = TempDir::new().unwrap();
    let (real, link) = (parent.path().join("real"), parent.path().join("link"));
    drop(protocol::bus::embedded::make_directory(&real).unwrap());
    std::os::unix::fs::symlink(&real, &link).unwrap();
    let error = ServerThread::start_in(&link, BUS).unwrap_err().to_string();
    assert!(
        error.starts_with(&format!("cannot use the directory {} for embedded buses", link.display())),
        "{error}"
    );

    std::fs::write(real.join("vcan0.bus"), "").unwrap();
    let error = ServerThread::start_in(&real, BUS).unwrap_err().to_string();
    assert!(error.ends_with("vcan0.bus exists and is not a socket: move it away"), "{error}");

    let error = ServerThread::start_in(&parent.path().join("x".repeat(100)), BUS).unwrap_err().to_string();
    assert!(error.contains("is too long for a Unix socket"), "{error}");
    let error = ServerThread::start_in(&real, "a/b").unwrap_err().to_string();
    assert!(error.starts_with("\"a/b\" is not a valid bus name"), "{error}");
    let error = ServerThread::start_in(&parent.path().join("no/such"), BUS).unwrap_err().to_string();
    assert!(error.contains("cannot use") && error.contains("No such file"), "{error}");
}
