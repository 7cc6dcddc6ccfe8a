use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process;

use proptest::prelude::*;
use tempfile::TempDir;

use super::datagram::ReceivedDatagram;
use super::*;
use crate::controller::{BadCycle, Controller, ControllerInput, ControllerOutput};
use model::testing::one_cell_skin;
use protocol::packet::pad_with_defaults;

const HELLO: &[u8] = b"SKBC\x01\x00\x03\x00";

fn listen(path: &Path) -> Result<ExternalController, SocketError> {
    ExternalController::listen(path, &one_cell_skin())
}

/// Creates a directory, and a gateway that listens on a socket in it. Returns both, and the path of the socket.
fn gateway() -> (TempDir, PathBuf, ExternalController) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("controller.sock");
    let gateway = listen(&path).unwrap();
    (folder, path, gateway)
}

/// Creates the socket of an external controller, connected to the gateway's socket.
fn program(folder: &TempDir, name: &str) -> UnixDatagram {
    let socket = UnixDatagram::bind(folder.path().join(name)).unwrap();
    socket.connect(folder.path().join("controller.sock")).unwrap();
    socket.set_nonblocking(true).unwrap();
    socket
}

fn input(tick: u64) -> ControllerInput {
    ControllerInput { tick, valid: true, ..ControllerInput::default() }
}

fn velocity(tick: u64, first: f64) -> Vec<u8> {
    let command = JointCommand::Velocity(pad_with_defaults(&[first, 0.0, 0.0, 0.0, 0.0, 0.0]));
    AnswerDatagram { tick, command }.encode(6)
}

fn state(socket: &UnixDatagram) -> StateDatagram {
    let mut bytes = [0; 1_000];
    let length = socket.recv(&mut bytes).unwrap();
    StateDatagram::decode(&bytes[..length]).unwrap()
}

fn count(gateway: &ExternalController, name: &str) -> u64 {
    gateway.named_counters().into_iter().find(|(known, _)| known == name).unwrap().1
}

#[test]
fn a_state_is_the_bytes_of_the_documented_table() {
    let input = ControllerInput {
        tick: 0x0102,
        time: protocol::time::Micros(516_000),
        q: pad_with_defaults(&[1.0, 0.0, 0.0, 0.0, 0.0, -2.0]),
        qdot: pad_with_defaults(&[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]),
        torque: pad_with_defaults(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.25]),
        age: 3,
        contributing: 20,
        valid: true,
        missing: 0b101,
        halted: true,
    };
    let bytes = StateDatagram { input, joints: 6 }.encode();
    assert_eq!(bytes[..16], *b"SKBC\x01\x00\x01\x00\x02\x01\0\0\0\0\0\0");
    assert_eq!(bytes[16..40], *b"\xa0\xdf\x07\0\0\0\0\0\x03\0\0\0\x14\0\0\0\x03\0\x05\0\x06\0\0\0");
    assert_eq!(bytes[40..48], *b"\0\0\0\0\0\0\xf0\x3f");
    assert_eq!(bytes[80..96], *b"\0\0\0\0\0\0\0\xc0\0\0\0\0\0\0\xe0\x3f");
    assert_eq!(bytes[176..], *b"\0\0\0\0\0\0\xd0\x3f");
    assert_eq!(StateDatagram::decode(&bytes), Ok(StateDatagram { input, joints: 6 }));
}

#[test]
fn a_robot_of_more_joints_has_longer_datagrams() {
    let mut input = ControllerInput::default();
    (input.q[0], input.qdot[0], input.torque[12]) = (1.0, 0.5, 0.25);
    let bytes = StateDatagram { input, joints: 13 }.encode();
    assert_eq!(bytes.len(), 40 + 3 * 13 * 8);
    assert_eq!(bytes[40 + 13 * 8..][..8], *b"\0\0\0\0\0\0\xe0\x3f");
    assert_eq!(bytes[40 + 39 * 8 - 8..], *b"\0\0\0\0\0\0\xd0\x3f");
    assert_eq!(StateDatagram::decode(&bytes), Ok(StateDatagram { input, joints: 13 }));
    let answer = AnswerDatagram { tick: 7, command: JointCommand::Velocity(pad_with_defaults(&[1.0; 13])) };
    assert_eq!(answer.encode(13).len(), 24 + 13 * 8);
    assert_eq!(ReceivedDatagram::decode(&answer.encode(13), 13), Ok(ReceivedDatagram::Answer(answer)));
    assert_eq!(ReceivedDatagram::decode(&answer.encode(13), 7), Err(InvalidDatagram::Length));
}

#[test]
fn buses_beyond_the_16th_share_its_bit() {
    let said = |missing| {
        let bytes =
            StateDatagram { input: ControllerInput { missing, ..ControllerInput::default() }, joints: 6 }
                .encode();
        StateDatagram::decode(&bytes).unwrap().input.missing
    };
    assert_eq!([1, 1 << 15, 1 << 16, 1 << 31].map(said), [1, 1 << 15, 1 << 15, 1 << 15]);
}

#[test]
fn an_answer_is_the_bytes_of_the_documented_table() {
    let command = JointCommand::Position(pad_with_defaults(&[-2.0, 0.0, 0.0, 0.0, 0.0, 1.0]));
    let bytes = AnswerDatagram { tick: 7, command }.encode(6);
    assert_eq!(bytes[..24], *b"SKBC\x01\x00\x02\x00\x07\0\0\0\0\0\0\0\x02\0\0\0\0\0\0\0");
    assert_eq!(bytes[24..32], *b"\0\0\0\0\0\0\0\xc0");
    assert_eq!(bytes[64..], *b"\0\0\0\0\0\0\xf0\x3f");
    assert_eq!(
        ReceivedDatagram::decode(&bytes, 6),
        Ok(ReceivedDatagram::Answer(AnswerDatagram { tick: 7, command }))
    );
}

#[test]
fn an_answer_is_executed_in_the_next_tick() {
    let (folder, _, mut gateway) = gateway();
    assert_eq!(gateway.step(&input(0)), ControllerOutput::Bad(BadCycle::NoPeer));
    let program = program(&folder, "program");
    program.send(HELLO).unwrap();
    assert_eq!(
        gateway.step(&input(1)),
        ControllerOutput::Bad(BadCycle::NoPeer),
        "it has not got a state yet"
    );
    assert_eq!(state(&program), StateDatagram { input: input(1), joints: 6 });
    program.send(&velocity(1, 0.5)).unwrap();
    assert_eq!(
        gateway.step(&input(2)),
        ControllerOutput::Move(pad_with_defaults(&[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    );
    let command = JointCommand::Position(pad_with_defaults(&[0.001, 0.0, 0.0, 0.0, 0.0, -9.0]));
    program.send(&AnswerDatagram { tick: 2, command }.encode(6)).unwrap();
    let ControllerOutput::Move([first, _, _, _, _, last, ..]) = gateway.step(&input(3)) else {
        panic!("an answer was there")
    };
    assert!((first - 0.5).abs() < 1e-12, "a thousandth of a radian in 2 ms");
    assert!((last + 3.0).abs() < 1e-12, "no quicker than it may");
    program.send(&velocity(3, 99.0)).unwrap();
    assert_eq!(
        gateway.step(&input(4)),
        ControllerOutput::Move(pad_with_defaults(&[2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    );
    program.send(&velocity(4, 1.0)).unwrap();
    let halted = ControllerInput { halted: true, ..input(5) };
    assert_eq!(
        gateway.step(&halted),
        ControllerOutput::Move(pad_with_defaults(&[0.0; 6])),
        "a halted robot stays"
    );
    assert_eq!((count(&gateway, "answers"), count(&gateway, "missing")), (4, 0));
}

#[test]
fn a_missing_answer_is_a_bad_cycle_and_a_late_one_is_none() {
    let (folder, _, mut gateway) = gateway();
    let program = program(&folder, "program");
    program.send(HELLO).unwrap();
    gateway.step(&input(1));
    assert_eq!(gateway.step(&input(2)), ControllerOutput::Bad(BadCycle::NoAnswer));
    program.send(&velocity(1, 0.5)).unwrap();
    assert_eq!(gateway.step(&input(3)), ControllerOutput::Bad(BadCycle::NoAnswer), "an old tick");
    program.send(&velocity(2, 0.5)).unwrap();
    program.send(&velocity(3, 0.25)).unwrap();
    program.send(&velocity(3, 0.75)).unwrap();
    let step = gateway.step(&input(7));
    assert_eq!(
        step,
        ControllerOutput::Move(pad_with_defaults(&[0.25, 0.0, 0.0, 0.0, 0.0, 0.0])),
        "the first answer to the last tick"
    );
    assert_eq!((count(&gateway, "missing"), count(&gateway, "late")), (2, 2));
    assert_eq!(count(&gateway, "repeated"), 1);
}

#[test]
fn nonsense_is_counted_by_reason_and_makes_the_cycle_bad() {
    let (folder, _, mut gateway) = gateway();
    let program = program(&folder, "program");
    program.send(HELLO).unwrap();
    gateway.step(&input(0));
    let bent = |at: usize, byte| {
        let mut bytes = velocity(0, 0.5);
        bytes[at] = byte;
        bytes.to_vec()
    };
    let cases = [
        ("wrong length", b"SKBC".to_vec()),
        ("wrong length", bent(0, b'S')[..71].to_vec()),
        ("wrong length", [bent(0, b'S'), vec![0]].concat()),
        ("wrong magic", bent(0, b's')),
        ("wrong version", bent(4, 2)),
        ("unknown kind", bent(6, 1)),
        ("unknown command", bent(16, 3)),
        ("not finite", velocity(0, f64::NAN).to_vec()),
        ("not finite", velocity(0, f64::INFINITY).to_vec()),
        ("tick ahead", velocity(u64::MAX, 0.5).to_vec()),
    ];
    for (tick, (why, bytes)) in (1..).zip(&cases) {
        let before = count(&gateway, &format!("nonsense: {why}"));
        program.send(&velocity(tick - 1, 0.5)).unwrap();
        program.send(bytes).unwrap();
        assert_eq!(gateway.step(&input(tick)), ControllerOutput::Bad(BadCycle::Nonsense), "{why}");
        assert_eq!(count(&gateway, &format!("nonsense: {why}")), before + 1);
    }
    program.send(&velocity(10, 0.5)).unwrap();
    assert!(matches!(gateway.step(&input(11)), ControllerOutput::Move(_)), "valid answers still work");
}

#[test]
fn the_sender_of_the_last_hello_is_the_peer_and_others_are_ignored() {
    let (folder, _, mut gateway) = gateway();
    let [first, second] = ["first", "second"].map(|name| program(&folder, name));
    first.send(HELLO).unwrap();
    gateway.step(&input(1));
    second.send(b"nonsense").unwrap();
    second.send(&velocity(1, 1.0)).unwrap();
    first.send(&velocity(1, 0.5)).unwrap();
    assert_eq!(
        gateway.step(&input(2)),
        ControllerOutput::Move(pad_with_defaults(&[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    );
    assert_eq!(count(&gateway, "other senders"), 2);
    second.send(HELLO).unwrap();
    first.send(&velocity(2, 0.5)).unwrap();
    assert_eq!(
        gateway.step(&input(3)),
        ControllerOutput::Bad(BadCycle::NoPeer),
        "the new one has not got a state yet"
    );
    second.send(HELLO).unwrap();
    second.send(&velocity(3, 0.25)).unwrap();
    let step = gateway.step(&input(4));
    assert_eq!(
        step,
        ControllerOutput::Move(pad_with_defaults(&[0.25, 0.0, 0.0, 0.0, 0.0, 0.0])),
        "a second hello changes nothing"
    );
}

#[test]
fn a_peer_that_goes_away_is_noticed_and_may_come_back() {
    let (folder, _, mut gateway) = gateway();
    let first = program(&folder, "program");
    first.send(HELLO).unwrap();
    gateway.step(&input(1));
    drop(first);
    assert_eq!(gateway.step(&input(2)), ControllerOutput::Bad(BadCycle::NoAnswer));
    assert_eq!(gateway.step(&input(3)), ControllerOutput::Bad(BadCycle::NoPeer));
    assert_eq!(count(&gateway, "gone"), 1);
    std::fs::remove_file(folder.path().join("program")).unwrap();
    let again = program(&folder, "program");
    again.send(HELLO).unwrap();
    gateway.step(&input(4));
    again.send(&velocity(4, 0.5)).unwrap();
    assert!(matches!(gateway.step(&input(5)), ControllerOutput::Move(_)));
}

#[test]
fn a_peer_that_does_not_read_delays_nothing() {
    let (folder, _, mut gateway) = gateway();
    let program = program(&folder, "program");
    program.send(HELLO).unwrap();
    for tick in 0..10_000 {
        gateway.step(&input(tick));
    }
    assert!(count(&gateway, "unsent") > 9_000, "{:?}", gateway.named_counters());
    assert_eq!(count(&gateway, "missing"), 9_999);
}

#[test]
fn a_flood_takes_no_more_than_its_share_of_a_tick() {
    let (folder, path, mut gateway) = gateway();
    let flood = UnixDatagram::unbound().unwrap();
    flood.set_nonblocking(true).unwrap();
    let mut sent = 0;
    while sent < 1_000 && flood.send_to(b"SKBC", &path).is_ok() {
        sent += 1;
    }
    gateway.step(&input(0));
    assert_eq!(count(&gateway, "failed"), sent.min(16), "senders without a name cannot be answered");
    assert!(folder.path().exists());
}

#[test]
fn a_socket_is_replaced_when_dead_refused_when_live_and_removed_at_the_end() {
    let (folder, path, gateway) = gateway();
    let error = listen(&path).unwrap_err().to_string();
    let expected =
        format!("another program listens on the socket {}; stop it, or choose another path", path.display());
    assert_eq!(error, expected);
    drop(gateway);
    assert!(!path.exists());
    drop(UnixDatagram::bind(&path).unwrap());
    assert!(path.exists(), "a dead socket's file stays");
    drop(listen(&path).unwrap());
    std::fs::write(&path, "notes").unwrap();
    let error = listen(&path).unwrap_err().to_string();
    assert!(
        error.ends_with("exists and is not a socket, so it was left unchanged; choose another path"),
        "{error}"
    );
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "notes");
    let nowhere = folder.path().join("none/controller.sock");
    let expected = format!("cannot listen on the socket {}", nowhere.display());
    assert_eq!(listen(&nowhere).unwrap_err().to_string(), expected);
}

#[test]
fn only_its_user_may_connect_whatever_the_umask_is() {
    // The umask belongs to the whole process.
    const CHILD: &str = "SKINBUS_TEST_OF_THE_UMASK";
    if std::env::var_os(CHILD).is_some() {
        let (_folder, path, _gateway) = gateway();
        let mode = |path: &Path| std::fs::symlink_metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&path), 0o600);
        let open = path.with_file_name("open.sock");
        let _open = UnixDatagram::bind(&open).unwrap();
        assert_eq!(mode(&open), 0o777, "the umask is 0");
        return;
    }
    let name = std::thread::current().name().unwrap().to_owned();
    let child = process::Command::new("sh")
        .args(["-c", "umask 0 && exec \"$0\" --exact \"$1\""])
        .arg(std::env::current_exe().unwrap())
        .arg(name)
        .env(CHILD, "1")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&child.stdout);
    assert!(child.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
fn another_socket_under_the_same_name_is_not_removed() {
    let (_folder, path, gateway) = gateway();
    std::fs::remove_file(&path).unwrap();
    let _other = UnixDatagram::bind(&path).unwrap();
    drop(gateway);
    assert!(path.exists());
}

proptest! {
    #[test]
    fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        let _ = ReceivedDatagram::decode(&bytes, 6);
        let _ = StateDatagram::decode(&bytes);
    }

    #[test]
    fn an_answer_comes_back(tick: u64, values in proptest::array::uniform6(-1e9..1e9), which: bool) {
        let command = if which { JointCommand::Velocity(pad_with_defaults(&values)) } else { JointCommand::Position(pad_with_defaults(&values)) };
        let answer = AnswerDatagram { tick, command };
        prop_assert_eq!(ReceivedDatagram::decode(&answer.encode(6), 6), Ok(ReceivedDatagram::Answer(answer)));
    }
}

/// Checks the reason for which a gateway counts its controller as absent, with `silent` bad cycles at the end. Also
/// checks that the message names the path of the socket.
fn absent(gateway: &ExternalController, path: &Path, silent: Option<u32>, words: &str) {
    let absence = gateway.absence(silent).unwrap_or_else(|| panic!("not absent: {words}")).to_string();
    assert!(absence.contains(words) && absence.contains(&path.display().to_string()), "{absence}");
    assert!(!absence.contains('\n'), "{absence:?}");
}

#[test]
fn a_controller_that_never_says_hello_is_absent_whatever_else_comes() {
    let (folder, path, mut gateway) = gateway();
    gateway.step(&input(0));
    absent(&gateway, &path, None, "no external controller sent a hello on ");
    let program = program(&folder, "program");
    let of_another_version = [&HELLO[..4], &[2, 0, 3, 0]].concat();
    program.send(&of_another_version).unwrap();
    program.send(&velocity(0, 0.5)).unwrap();
    gateway.step(&input(1));
    absent(&gateway, &path, None, " (2 datagrams received, but none is a hello of this version): start it");
    UnixDatagram::unbound().unwrap().send_to(HELLO, &path).unwrap();
    gateway.step(&input(2));
    absent(&gateway, &path, Some(25), ", 1 datagram received from a socket without an address");
}

#[test]
fn a_controller_that_says_hello_and_never_answers_in_time_is_absent() {
    let (folder, path, mut gateway) = gateway();
    let program = program(&folder, "program");
    program.send(HELLO).unwrap();
    gateway.step(&input(0));
    gateway.step(&input(1));
    // Always one tick behind.
    program.send(&velocity(0, 0.5)).unwrap();
    program.send(b"SKBC").unwrap();
    gateway.step(&input(2));
    let counts = "(2 without an answer, 1 answered late, 1 invalid datagrams)";
    absent(&gateway, &path, None, counts);
    absent(&gateway, &path, Some(25), counts);
}

#[test]
fn a_controller_that_answered_is_absent_only_if_it_is_silent_at_the_end() {
    let (folder, path, mut gateway) = gateway();
    let one = program(&folder, "program");
    one.send(HELLO).unwrap();
    gateway.step(&input(0));
    one.send(&velocity(0, 0.5)).unwrap();
    gateway.step(&input(1));
    assert_eq!(gateway.absence(None), None);
    absent(&gateway, &path, Some(40), " answered 1 ticks, but none of the last 40");
    // A second program takes over; the first one's answers still count.
    let other = program(&folder, "other");
    other.send(HELLO).unwrap();
    gateway.step(&input(2));
    assert_eq!(gateway.absence(None), None);
}

#[test]
fn descriptors_that_a_program_passes_along_are_closed() {
    use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
    use std::io::{IoSlice, Read};
    use std::mem::MaybeUninit;
    use std::os::fd::AsFd;

    let (folder, _path, mut gateway) = gateway();
    let program = program(&folder, "program.sock");
    let (mut read, write) = std::io::pipe().unwrap();
    for _ in 0..10 {
        let passed = [write.as_fd(); 3];
        let mut space = [MaybeUninit::uninit(); 128];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(&passed)));
        sendmsg(&program, &[IoSlice::new(HELLO)], &mut control, SendFlags::empty()).unwrap();
        gateway.step(&input(1));
    }
    drop(write);
    rustix::io::ioctl_fionbio(&read, true).unwrap();
    assert_eq!(read.read(&mut [0]).unwrap(), 0);
}
