//! `vcan-setup serve` as a process.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process::program;
use skinbus_tests::process::served;

use std::io::{BufRead, BufReader, Read};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use protocol::bus::embedded::{
    ClientHello, HelloReply, encode_drop_notice, seqpacket_socket, socket_address,
};
use protocol::bus::{Bus, BusError, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{EXTENDED, Frame};
use protocol::candump::{self, CandumpLine};
use rustix::net::sockopt::{self, Timeout};
use rustix::net::{RecvFlags, SendFlags, SocketFlags};
use rustix::process::{Pid, Signal, kill_process};
use served::Served;
use tempfile::TempDir;

/// Starts a server, and waits until it is ready.
fn serve(directory: &Path, arguments: &[&str]) -> Served {
    let mut command = Command::new(program("vcan-setup"));
    command.args(["serve", "vcan0"]).args(arguments).env("SKINBUS_DIR", directory);
    let (child, line) = Served::start(&mut command);
    assert_eq!(line, format!("serving vcan0 at {}\n", directory.join("vcan0.bus").display()));
    child
}

fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

fn ended(mut child: Served, parent: &TempDir) -> ExitStatus {
    let status = child.wait().unwrap();
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 0, "nothing is left behind");
    status
}

#[test]
fn frames_pass_once_the_line_is_printed_and_a_signal_ends_it_well() {
    for end in [Signal::TERM, Signal::INT] {
        let parent = TempDir::new().unwrap();
        let directory = parent.path().join("skinbus");
        let child = serve(&directory, &[]);
        let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
        let [a, b] =
            [(); 2].map(|()| Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap());
        let frame = Frame::fd(0x123, 1, &[1; 16]).unwrap();
        a.send(&[frame]).unwrap();
        let mut inbox = Inbox::new();
        assert!(b.wait(Some(Duration::from_secs(60))).unwrap());
        assert_eq!(b.receive(&mut inbox).unwrap(), 1);
        assert_eq!(inbox.frames().next().unwrap().frame, frame);
        signal(&child, end);
        assert_eq!(ended(child, &parent).code(), Some(0));
    }
}

#[test]
fn the_end_of_standard_input_ends_it_only_when_asked_to() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let mut child = serve(&directory, &["--until-eof"]);
    drop(child.stdin.take());
    assert_eq!(ended(child, &parent).code(), Some(0));

    let mut child = serve(&directory, &[]);
    drop(child.stdin.take());
    std::thread::sleep(Duration::from_millis(50));
    assert_eq!(child.try_wait().unwrap(), None);
    signal(&child, Signal::TERM);
    assert_eq!(ended(child, &parent).code(), Some(0));
}

#[test]
fn a_parent_that_is_killed_takes_it_along_even_while_standard_input_stays_open() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    // The shell's standard input is this test's pipe, which stays open.
    let script =
        format!("exec 3<&0; '{}' serve vcan0 --until-eof <&3 & wait", program("vcan-setup").display());
    let mut shell = Command::new("sh")
        .args(["-c", &script])
        .env("SKINBUS_DIR", &directory)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut output = BufReader::new(shell.stdout.take().unwrap());
    let mut line = String::new();
    output.read_line(&mut line).unwrap();
    assert!(line.starts_with("serving vcan0 at "), "{line}");
    let input = shell.stdin.take();
    shell.kill().unwrap();
    shell.wait().unwrap();
    // The server has the other end of the output: when that closes, the server has ended.
    output.read_to_string(&mut line).unwrap();
    assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 0);
    drop(input);
}

#[test]
fn while_the_server_is_stopped_a_sender_waits_and_then_says_how_many_went_out() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let child = serve(&directory, &[]);
    let send_timeout = Duration::from_millis(50);
    let options = BusOptions { directory: Some(directory), send_timeout, ..BusOptions::default() };
    let [a, b] = [(); 2].map(|()| Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap());
    let frames: Vec<_> = (0..5000_u32).map(|n| Frame::classic(1, &n.to_le_bytes()).unwrap()).collect();

    signal(&child, Signal::STOP);
    let before = Instant::now();
    let error = a.send(&frames).unwrap_err();
    assert!(before.elapsed() >= send_timeout);
    assert!(matches!(error.cause, BusError::Full { .. }) && error.cause.is_temporary(), "{error}");
    let sent = &frames[..error.sent];
    assert!(sent.len() >= 253, "{error}");

    signal(&child, Signal::CONT);
    let (mut inbox, mut heard) = (Inbox::new(), Vec::new());
    while heard.len() < sent.len() {
        assert!(b.wait(Some(Duration::from_secs(60))).unwrap(), "{} of {} heard", heard.len(), sent.len());
        b.receive(&mut inbox).unwrap();
        heard.extend(inbox.frames().map(|received| received.frame));
    }
    assert_eq!(heard, sent);
    a.send(&frames[..1]).unwrap();
    signal(&child, Signal::TERM);
    ended(child, &parent);
}

#[test]
fn a_timeout_of_the_socket_is_set_when_it_is_too_long_or_ran_out() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let child = serve(&directory, &[]);
    let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
    let [a, b] = [(); 2].map(|()| Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap());
    let mut inbox = Inbox::new();
    let mut wait = |millis, comes: bool| {
        if comes {
            a.send(&[Frame::classic(1, &[]).unwrap()]).unwrap();
            assert!(b.wait(Some(Duration::from_secs(60))).unwrap());
        }
        let count = b.wait_and_receive(&mut inbox, Duration::from_millis(millis)).unwrap();
        assert_eq!(count, usize::from(comes));
        // The kernel rounds to its ticks, of 10 ms at most.
        let set = sockopt::socket_timeout(&b, Timeout::Recv).unwrap().unwrap();
        [25, 100].into_iter().find(|&millis| set.abs_diff(Duration::from_millis(millis)).as_millis() <= 10)
    };
    assert_eq!(wait(200, true), Some(100));
    assert_eq!(wait(30, true), Some(25), "it may not be longer");
    assert_eq!(wait(200, true), Some(25), "a frame came, so that a shorter one is kept");
    assert_eq!(wait(200, false), Some(25));
    assert_eq!(wait(200, false), Some(100), "it ran out");
    assert_eq!(wait(200, true), Some(100));
    assert_eq!(wait(2, false), Some(100), "not used");
    signal(&child, Signal::TERM);
    ended(child, &parent);
}

#[test]
fn after_a_kill_the_name_can_be_served_again() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let mut child = serve(&directory, &[]);
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(directory.join("vcan0.bus").exists(), "a killed server leaves its socket");
    let child = serve(&directory, &[]);
    signal(&child, Signal::TERM);
    ended(child, &parent);
}

#[test]
fn wrong_use_is_2_and_failure_is_1_each_in_one_line() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let run = |name| {
        let mut command = Command::new(program("vcan-setup"));
        let output = command.args(["serve", name]).env("SKINBUS_DIR", &directory).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, said) = run("much-too-long-a-name");
    assert_eq!(code, Some(2));
    assert!(said.contains("\"much-too-long-a-name\" is not a valid bus name: use 1 to 15 bytes"), "{said}");

    let child = serve(&directory, &[]);
    let (code, said) = run("vcan0");
    assert_eq!((code, said.lines().count()), (Some(1), 1), "{said}");
    assert!(said.starts_with("vcan-setup: the embedded bus vcan0 is already served at "), "{said}");
    signal(&child, Signal::TERM);
    ended(child, &parent);
}

const DOCUMENT: &str = include_str!("../../../docs/reference/embedded-bus.md");

/// Writes the document's program in a language to a file.
fn listing(language: &str, folder: &Path) -> PathBuf {
    let fence = format!("\n```{language}\n");
    let mut blocks = DOCUMENT.split(&fence).skip(1);
    let text = blocks.next().and_then(|rest| rest.split("\n```").next()).unwrap();
    assert_eq!(blocks.next(), None, "one program in {language}");
    let path = folder.join(format!("attach.{language}"));
    std::fs::write(&path, format!("{text}\n")).unwrap();
    path
}

/// Returns the document's programs, ready to be run.
fn listings(folder: &Path) -> [Vec<PathBuf>; 2] {
    let program = folder.join("attach");
    let mut compiler = Command::new("cc");
    let compiler =
        compiler.args(["-Wall", "-Wextra", "-Werror", "-o"]).arg(&program).arg(listing("c", folder));
    assert!(compiler.status().expect("cc is needed: apt install gcc libc6-dev").success());
    [vec![program], vec!["python3".into(), listing("python", folder)]]
}

/// Attaches one of them to the bus `vcan0` in a directory.
fn attach(listing: &[PathBuf], directory: &Path) -> Child {
    let mut command = Command::new(&listing[0]);
    command.args(&listing[1..]).arg(directory).arg("vcan0").stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().expect("python3 is needed: apt install python3")
}

/// Returns the frames that the document's programs send.
fn sent_by_listings() -> [Frame; 2] {
    let mut data = [0; 12];
    data[..3].copy_from_slice(&[1, 2, 3]);
    let id = 0x123_4567 | EXTENDED;
    [Frame::classic(id, &data[..3]).unwrap(), Frame::fd(id, 1, &data).unwrap()]
}

fn nanos_now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos().try_into().unwrap()
}

#[test]
fn the_documents_programs_send_receive_and_end_with_the_server() {
    let parent = TempDir::new().unwrap();
    let folder = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let frames = [
        Frame::classic(0x001, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap(),
        Frame::fd(0x20C, 1, &[0xA5; 64]).unwrap(),
        Frame::classic(0x7FF, &[]).unwrap(),
        Frame::fd(0x1FFF_FFFF | EXTENDED, 0, &[0xFF]).unwrap(),
    ];
    for listing in listings(folder.path()) {
        for end in [Signal::TERM, Signal::KILL] {
            let mut server = serve(&directory, &[]);
            let options = BusOptions { directory: Some(directory.clone()), ..BusOptions::default() };
            let bus = Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap();
            let mut program = attach(&listing, &directory);
            let (mut inbox, mut received) = (Inbox::new(), Vec::new());
            while received.len() < 2 {
                assert!(bus.wait(Some(Duration::from_secs(60))).unwrap(), "{listing:?}: {received:?}");
                bus.receive(&mut inbox).unwrap();
                received.extend(inbox.frames().map(|received| received.frame));
            }
            assert_eq!(received, sent_by_listings(), "{listing:?}");

            let before = nanos_now() - 1_000;
            bus.send(&frames).unwrap();
            let mut output = BufReader::new(program.stdout.take().unwrap());
            for frame in frames {
                let mut line = String::new();
                output.read_line(&mut line).unwrap();
                let Ok(CandumpLine::Frame(record)) = candump::parse(line.trim_end()) else {
                    panic!("{line}")
                };
                assert_eq!((record.interface, record.frame), ("vcan0", frame));
                assert!((before..=nanos_now()).contains(&record.time.nanos), "{line}");
            }
            signal(&server, end);
            let (mut rest, mut errors) = (String::new(), String::new());
            output.read_to_string(&mut rest).unwrap();
            program.stderr.take().unwrap().read_to_string(&mut errors).unwrap();
            assert_eq!((program.wait().unwrap().code(), rest.as_str(), errors.as_str()), (Some(0), "", ""));
            server.wait().unwrap();
        }
    }
}

/// Plays the server for a program that attaches: answers its hello, and returns the connection.
fn greeted(listener: &OwnedFd, answer: HelloReply) -> OwnedFd {
    let socket = rustix::net::accept(listener).unwrap();
    let mut bytes = [0; 64];
    let (len, _) = rustix::net::recv(&socket, &mut bytes, RecvFlags::empty()).unwrap();
    let filters = vec![Filter::ALL];
    let hello = ClientHello { filters, buffer: 1 << 20, version: 2, ..ClientHello::default() };
    assert_eq!(ClientHello::decode(&bytes[..len]), Some(hello));
    rustix::net::send(&socket, &answer.encode(), SendFlags::empty()).unwrap();
    socket
}

#[test]
fn the_documents_programs_read_to_the_end_and_say_when_they_are_refused() {
    let folder = TempDir::new().unwrap();
    let listener = seqpacket_socket(SocketFlags::empty()).unwrap();
    rustix::net::bind(&listener, &socket_address(folder.path(), "vcan0").unwrap()).unwrap();
    rustix::net::listen(&listener, 1).unwrap();
    for listing in listings(folder.path()) {
        let program = attach(&listing, folder.path());
        let socket = greeted(&listener, HelloReply::Welcome { granted: 1 << 21, version: 2, stamps: false });
        for (frame, flags) in sent_by_listings().iter().zip([RecvFlags::empty(), RecvFlags::PEEK]) {
            let mut bytes = [0; 73];
            let (len, _) = rustix::net::recv(&socket, &mut bytes, flags).unwrap();
            assert_eq!(len, frame.byte_len());
            rustix::net::send(&socket, &encode_drop_notice(3), SendFlags::empty()).unwrap();
            rustix::net::send(&socket, &frame.to_bytes()[..len], SendFlags::empty()).unwrap();
        }
        // With a frame of the program unread, which the system reports to it.
        drop(socket);
        let output = program.wait_with_output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        let frames: Vec<_> = said.lines().map(|line| line.split(' ').next_back().unwrap()).collect();
        assert_eq!(frames, ["01234567#010203", "01234567##5010203000000000000000000"]);

        let program = attach(&listing, folder.path());
        drop(greeted(&listener, HelloReply::Refused { version: 3 }));
        let output = program.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), said.lines().count()), (Some(1), 1), "{said}");
        assert!(said.ends_with("refused, it speaks version 3\n"), "{said}");
    }
}

#[test]
fn what_was_ignored_is_said_at_the_end() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let mut command = Command::new(program("vcan-setup"));
    command.args(["serve", "vcan0"]).env("SKINBUS_DIR", &directory);
    let (mut server, _) = Served::start(command.stderr(Stdio::piped()));
    let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
    let [a, b] = [(); 2].map(|()| Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap());
    rustix::net::send(&a, &[0; 13], SendFlags::empty()).unwrap();
    a.send(&[Frame::classic(1, &[]).unwrap()]).unwrap();
    assert!(b.wait(Some(Duration::from_secs(60))).unwrap(), "what came before has been read");
    signal(&server, Signal::TERM);
    let mut said = String::new();
    server.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    let status = server.wait().unwrap();
    assert_eq!((status.code(), said.lines().count()), (Some(0), 1), "{said}");
    assert!(
        said.contains("vcan0: ignored 1 invalid datagrams") && said.contains("refused 0 clients"),
        "{said}"
    );
}

/// Starts a server with a limit of open files, given as an option of `ulimit`.
fn serve_with_files(directory: &Path, limit: &str) -> Served {
    // Other tests may pass on descriptors of theirs, which would count.
    let mut command = Command::new("bash");
    let line = format!(
        "for fd in $(ls /proc/$$/fd); do [ $fd -le 2 ] || [ $fd = 255 ] || eval \"exec $fd>&-\"; done; \
         ulimit {limit} && exec \"$0\" serve vcan0"
    );
    command.args(["-c", &line]).arg(program("vcan-setup")).env("SKINBUS_DIR", directory);
    let (child, line) = Served::start(command.stderr(Stdio::piped()));
    assert!(line.starts_with("serving vcan0 at "), "{line}");
    child
}

/// Checks that a frame passes from one client to another one, which has no other frames waiting.
fn passes(from: &Bus, to: &Bus) {
    let frame = Frame::classic(0x123, &[5]).unwrap();
    from.send(&[frame]).unwrap();
    assert!(to.wait(Some(Duration::from_secs(60))).unwrap(), "no frame passes");
    let mut inbox = Inbox::new();
    assert_eq!(to.receive(&mut inbox).unwrap(), 1);
    assert_eq!(inbox.frames().next().unwrap().frame, frame);
}

#[test]
fn clients_for_which_there_is_no_file_are_turned_away_and_the_others_go_on() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let mut server = serve_with_files(&directory, "-n 64");
    let options = BusOptions { directory: Some(directory), filters: vec![], ..BusOptions::default() };
    let open = |options: &BusOptions| Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), options);
    let listening = BusOptions { filters: vec![Filter::ALL], ..options.clone() };
    let [a, b] = [(); 2].map(|()| open(&listening).unwrap());
    passes(&a, &b);
    let (others, refused): (Vec<_>, Vec<_>) = (0..100).map(|_| open(&options)).partition(Result::is_ok);
    assert!((40..60).contains(&others.len()), "{}", others.len());
    for error in refused {
        let error = error.unwrap_err();
        assert!(matches!(error, BusError::NoRoom(_)) && error.may_open_later(), "{error}");
        assert!(error.to_string().contains("cannot accept another client"), "{error}");
    }
    passes(&a, &b);
    drop(others);
    passes(&b, &a);
    // There is room again as soon as the server has noticed that they are gone.
    let again = std::iter::repeat_with(|| open(&listening)).find_map(Result::ok).unwrap();
    passes(&again, &a);
    signal(&server, Signal::TERM);
    let mut said = String::new();
    server.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(
        said.starts_with("vcan-setup: vcan0: rejected ") && said.contains("no file descriptor of 64"),
        "{said}"
    );
    assert_eq!(ended(server, &parent).code(), Some(0));
}

/// Returns the processor time of a process, in ticks of 10 ms.
fn processor_ticks(pid: u32) -> u64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let (_, after_name) = stat.rsplit_once(')').unwrap();
    after_name.split_whitespace().skip(11).take(2).map(|ticks| ticks.parse::<u64>().unwrap()).sum()
}

#[test]
fn a_server_that_has_no_files_left_rests_and_ends_by_a_signal() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let server = serve_with_files(&directory, "-n 64");
    let options = BusOptions { directory: Some(directory), filters: vec![], ..BusOptions::default() };
    let open = || Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options);
    let clients: Vec<_> = std::iter::repeat_with(open).map_while(Result::ok).collect();
    let before = processor_ticks(server.id());
    std::thread::sleep(Duration::from_millis(300));
    let used = processor_ticks(server.id()) - before;
    assert!(used < 10, "{used} of 30 ticks, while nothing happens");
    signal(&server, Signal::TERM);
    assert_eq!(ended(server, &parent).code(), Some(0));
    drop(clients);
}

#[test]
fn a_server_lets_in_as_many_clients_as_the_system_allows() {
    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let server = serve_with_files(&directory, "-Sn 64");
    let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
    let open = || Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap();
    let clients: Vec<_> = (0..100).map(|_| open()).collect();
    passes(&clients[0], &clients[99]);
    signal(&server, Signal::TERM);
    assert_eq!(ended(server, &parent).code(), Some(0));
}

#[test]
fn descriptors_that_a_client_passes_along_are_closed() {
    use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, sendmsg};
    use std::mem::MaybeUninit;
    use std::os::fd::AsFd;

    let parent = TempDir::new().unwrap();
    let directory = parent.path().join("skinbus");
    let server = serve(&directory, &[]);
    let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
    let [a, b] = [(); 2].map(|()| Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap());
    let (mut read, write) = std::io::pipe().unwrap();
    let frame = Frame::classic(1, &[]).unwrap();
    for count in 1..=100 {
        let passed = vec![write.as_fd(); count % 4 + 1];
        let mut space = [MaybeUninit::uninit(); 128];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(&passed)));
        let bytes = frame.to_bytes();
        let bytes = std::io::IoSlice::new(&bytes[..frame.byte_len()]);
        sendmsg(&a, &[bytes], &mut control, SendFlags::empty()).unwrap();
    }
    drop(write);
    let (mut inbox, mut received) = (Inbox::new(), 0);
    while received < 100 {
        assert!(b.wait(Some(Duration::from_secs(60))).unwrap(), "{received} frames");
        received += b.receive(&mut inbox).unwrap();
    }
    assert_eq!(read.read(&mut [0]).unwrap(), 0, "nobody has the other end");
    signal(&server, Signal::TERM);
    assert_eq!(ended(server, &parent).code(), Some(0));
}
