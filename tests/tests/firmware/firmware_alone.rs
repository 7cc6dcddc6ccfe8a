//! The micro:bit's firmware alone in an emulator, over its serial line: starts, resets, flash.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use std::collections::VecDeque;
use std::fs;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use bench::emulate::Firmware;
use model::generate::{SkinRequest, generate};
use protocol::can::Format;
use protocol::factory::FactoryRecord;
use protocol::id::{CellId, Node};
use protocol::message::{Answer, Heartbeat, Joints, Message, NetworkPage, Request, State};
use protocol::packet::{Epoch, Packet};
use protocol::parameters::{MAX_JOINTS, Parameter, Parameters};
use protocol::skin::Skin;
use protocol::slcan::{self, Decoder, SlcanLine};
use tempfile::TempDir;

const SERIAL: u32 = 100_012;
const TIMEOUT: Duration = Duration::from_secs(60);

/// An emulated cell without a bus.
struct Alone {
    qemu: Child,
    line: UnixStream,
    monitor: UnixStream,
    decoder: Decoder,
    came: VecDeque<Message>,
}

fn connected(path: &Path) -> UnixStream {
    let give_up = Instant::now() + TIMEOUT;
    loop {
        match UnixStream::connect(path) {
            Ok(stream) => return stream,
            Err(error) => assert!(Instant::now() < give_up, "{}: {error}", path.display()),
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn heartbeat(message: &Message, claiming: bool) -> Option<Heartbeat> {
    match message {
        Message::Network { page: NetworkPage::Heartbeat(it), .. }
            if it.state.has(State::CLAIMING_NODE_ID) == claiming =>
        {
            Some(*it)
        }
        _ => None,
    }
}

impl Alone {
    /// Starts cell 12 with its flash in `flash` of a folder; `named` tells if its identity is written to it first.
    fn start(folder: &Path, named: bool) -> Self {
        let path = PathBuf::from(std::env::var_os("SKINBUS_FIRMWARE").expect("tests/firmware/run names it"));
        let factory = FactoryRecord {
            node: CellId::new(12).ok(),
            serial: SERIAL,
            format: Format::Fd,
            hosted: true,
            link_ids: [None; 5],
        };
        let elf = if named {
            Firmware::read(&path).unwrap().image_for_cell(&factory)
        } else {
            fs::read(&path).unwrap()
        };
        fs::write(folder.join("cell.elf"), elf).unwrap();
        let mut command = Command::new("qemu-system-arm");
        command.args([
            "-M",
            "microbit",
            "-display",
            "none",
            "-serial",
            "chardev:line",
            "-kernel",
            "cell.elf",
        ]);
        command.args(["-chardev", "socket,id=line,path=line,server=on,wait=on"]);
        command.args(["-monitor", "unix:monitor,server=on,wait=on", "-d", "unimp", "-D", "unimplemented"]);
        command.args(["-semihosting-config", "enable=on,target=native,arg=flash"]);
        command.current_dir(folder).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        for socket in ["line", "monitor"] {
            let _ = fs::remove_file(folder.join(socket));
        }
        let qemu = command.spawn().unwrap();
        let line = connected(&folder.join("line"));
        line.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        let monitor = connected(&folder.join("monitor"));
        Self { qemu, line, monitor, decoder: Decoder::new(), came: VecDeque::new() }
    }

    fn send(&mut self, message: &Message) {
        for frame in message.encode().frames(Format::Fd) {
            self.line.write_all(slcan::encode(&frame).unwrap().as_bytes()).unwrap();
        }
    }

    /// Returns the next message, if one comes in time.
    fn next(&mut self, within: Duration) -> Option<Message> {
        let give_up = Instant::now() + within;
        while self.came.is_empty() && Instant::now() < give_up {
            let mut bytes = [0; 4096];
            let Ok(count) = self.line.read(&mut bytes) else { continue };
            for line in bytes[..count].iter().filter_map(|&byte| self.decoder.push(byte)) {
                // A reset cuts a line.
                let SlcanLine::Frame(frame) = line else { continue };
                self.came.push_back(Message::decode(&Packet::from_fd(&frame).unwrap()).unwrap());
            }
        }
        self.came.pop_front()
    }

    /// Waits for a message, and drops those before it.
    fn waits<T>(&mut self, what: &str, look: impl Fn(&Message) -> Option<T>) -> T {
        let found = self.looks(TIMEOUT, look);
        found.unwrap_or_else(|| panic!("waited {TIMEOUT:?} for {what}"))
    }

    /// Waits for a message for a limited time, and drops those before it.
    fn looks<T>(&mut self, within: Duration, look: impl Fn(&Message) -> Option<T>) -> Option<T> {
        let give_up = Instant::now() + within;
        while Instant::now() < give_up {
            if let Some(found) = self.next(Duration::from_millis(50)).as_ref().and_then(&look) {
                return Some(found);
            }
        }
        None
    }

    fn heartbeat(&mut self, claiming: bool) -> Heartbeat {
        self.waits("a heartbeat", |message| heartbeat(message, claiming))
    }

    /// Presses the button until the first heartbeat is received: a reset cuts a line, and text that follows the cut
    /// line at once is not a frame.
    fn reset(&mut self) -> Heartbeat {
        for _ in 0..12 {
            self.tell_monitor("system_reset");
            if let Some(claims) = self.looks(Duration::from_secs(5), |message| heartbeat(message, true)) {
                return claims;
            }
        }
        panic!("no heartbeat after twelve resets");
    }

    /// Writes and commits parameters, as commissioning does; returns as soon as the commit is answered.
    fn commission(&mut self, parameters: &Parameters) {
        let to = Node::Cell(CellId::new(12).unwrap());
        let hash = parameters.hash().cast_signed();
        let stored = Parameter::stored_for_rows(6).map(|it| (it.number(), parameters.words(it)));
        let commit = (Parameter::Commit.number(), [hash, 0, 0, 0, 0, 0]);
        for ((number, words), tag) in stored.chain([commit]).zip(1..) {
            self.send(&Message::Configure { to, tag, request: Request::Write { number, words } });
            let answer = self.waits("an answer", |message| match message {
                Message::Configured { tag: of, answer, .. } if *of == tag => Some(*answer),
                _ => None,
            });
            assert!(matches!(answer, Answer::Value { .. }), "{number}: {answer:?}");
        }
    }

    fn tell_monitor(&mut self, command: &str) {
        self.monitor.write_all(format!("{command}\n").as_bytes()).unwrap();
    }

    /// Checks that joints are answered.
    fn takes_joints(&mut self, epoch: u8) {
        let joints = Joints { positions: [Default::default(); MAX_JOINTS], in_use: 6 };
        self.send(&Message::Joints { epoch: Epoch(epoch), joints });
        self.send(&Message::Report);
        let taken = self.waits("a report", |message| match message {
            Message::Network { page: NetworkPage::Received(heard), .. } => Some(heard.joints),
            _ => None,
        });
        assert!(taken > 0);
    }
}

impl Drop for Alone {
    fn drop(&mut self) {
        let _ = self.qemu.kill();
        let _ = self.qemu.wait();
    }
}

fn parameters() -> Parameters {
    let text = generate(&SkinRequest { cells: 12, ..SkinRequest::default() }).unwrap();
    let skin = Skin::parse("a skin", &text).unwrap();
    skin.parameters(skin.cells.iter().find(|cell| cell.node.get() == 12).unwrap())
}

// CLAIM-1, CLAIM-5, CONF-8, ID-3
#[test]
#[ignore = "needs tests/firmware/run"]
fn what_a_commit_has_answered_survives_a_kill_at_once_and_a_reset() {
    let folder = TempDir::new().unwrap();
    let parameters = parameters();
    let mut cell = Alone::start(folder.path(), true);
    let first = cell.heartbeat(true);
    assert_eq!((first.serial, first.sent, first.configuration), (SERIAL, 0, 0));
    assert!(!first.state.has(State::FLASH_DAMAGED), "nothing was there yet");
    cell.heartbeat(false);
    cell.commission(&parameters);
    // SIGKILL, right after the answer.
    drop(cell);

    let mut cell = Alone::start(folder.path(), true);
    assert_eq!(cell.heartbeat(true).configuration, parameters.hash());
    assert!(cell.heartbeat(false).state.has(State::CONFIGURED));
    cell.takes_joints(7);
    // The button: the program starts again, in the middle of its work.
    let again = cell.reset();
    assert_eq!((again.sent, again.configuration), (0, parameters.hash()));
    assert!(cell.heartbeat(false).state.has(State::CONFIGURED));
    cell.takes_joints(7);
}

// CONF-8
#[test]
#[ignore = "needs tests/firmware/run"]
fn damaged_flash_is_noticed_and_a_commit_repairs_it() {
    let folder = TempDir::new().unwrap();
    let parameters = parameters();
    let flash = folder.path().join("flash");
    let mut cell = Alone::start(folder.path(), true);
    cell.heartbeat(false);
    cell.commission(&parameters);
    drop(cell);
    let sound = fs::read(&flash).unwrap();
    let mut wrong = sound.clone();
    wrong[40] ^= 4;
    for damaged in [wrong, b"no flash".to_vec(), Vec::new()] {
        fs::write(&flash, &damaged).unwrap();
        let mut cell = Alone::start(folder.path(), true);
        let state = cell.heartbeat(false).state;
        assert!(state.has(State::FLASH_DAMAGED) && !state.has(State::CONFIGURED), "{damaged:?}: {state:?}");
        cell.commission(&parameters);
        cell.waits("a sound cell", |message| match message {
            Message::Network { page: NetworkPage::Heartbeat(it), .. } => {
                (!it.state.has(State::FLASH_DAMAGED) && it.state.has(State::CONFIGURED)).then_some(())
            }
            _ => None,
        });
        drop(cell);
        assert_eq!(fs::read(&flash).unwrap(), sound);
    }
    // A full disk, here simulated by a folder with the file's name: the commit is refused, and nothing has changed.
    let part = folder.path().join("flash.part");
    fs::create_dir(&part).unwrap();
    let mut cell = Alone::start(folder.path(), true);
    cell.heartbeat(false);
    let to = Node::Cell(CellId::new(12).unwrap());
    let words = [parameters.hash().cast_signed(), 0, 0, 0, 0, 0];
    let number = Parameter::Commit.number();
    let stored = Parameter::stored_for_rows(6).map(|it| (it.number(), parameters.words(it)));
    for (number, words) in stored.chain([(number, words)]) {
        cell.send(&Message::Configure { to, tag: number, request: Request::Write { number, words } });
    }
    let answer = cell.waits("the commit's answer", |message| match message {
        Message::Configured { tag, answer, .. } if *tag == number => Some(*answer),
        _ => None,
    });
    assert_eq!(answer, Answer::Refused { number, reason: Answer::REFUSED_FLASH_FAILED });
    assert_eq!(fs::read(&flash).unwrap(), sound);
}

// ID-2
#[test]
#[ignore = "needs tests/firmware/run"]
fn a_cell_that_nobody_has_named_is_silent() {
    let folder = TempDir::new().unwrap();
    let mut cell = Alone::start(folder.path(), false);
    cell.send(&Message::Sync);
    cell.send(&Message::Report);
    assert_eq!(cell.next(Duration::from_secs(2)), None);
}

/// The emulator's watchdog does nothing, but its log of unimplemented devices shows that it is started, and fed while
/// the loop runs.
#[test]
#[ignore = "needs tests/firmware/run"]
fn the_watchdog_is_started_and_fed() {
    let folder = TempDir::new().unwrap();
    let mut cell = Alone::start(folder.path(), true);
    cell.heartbeat(false);
    let written = |offset: &str| {
        let text = fs::read_to_string(folder.path().join("unimplemented")).unwrap();
        text.lines().filter(|line| line.contains("write") && line.contains(offset)).count()
    };
    let (start, feed) = ("offset 0x00010000,", "offset 0x00010600,");
    let text = fs::read_to_string(folder.path().join("unimplemented")).unwrap();
    assert_eq!(written(start), 1, "{text}");
    let before = written(feed);
    cell.heartbeat(false);
    cell.heartbeat(false);
    assert!(written(feed) > before, "{before} before, and none since:\n{text}");
}

/// Measures how much of the RAM was ever written, counted from its end: the emulator's RAM begins with zeros. The cell
/// starts without parameters and with some, commits others, and answers joints.
#[test]
#[ignore = "needs tests/firmware/run"]
fn the_stack_has_at_most_8_kib_and_the_cells_state_is_no_part_of_it() {
    const RAM: usize = 16 << 10;
    const STACK: usize = 8 << 10;
    const STATE: usize = 13 << 9;
    let folder = TempDir::new().unwrap();
    let mut cell = Alone::start(folder.path(), true);
    cell.heartbeat(false);
    cell.commission(&parameters());
    // The emulator keeps the RAM at a reset, so the memory written by the first start counts too.
    cell.reset();
    cell.heartbeat(false);
    cell.commission(&parameters());
    cell.takes_joints(9);
    cell.tell_monitor(&format!("memsave 0x20000000 {RAM} ram"));
    let ram = folder.path().join("ram");
    let give_up = Instant::now() + TIMEOUT;
    while fs::metadata(&ram).map_or(0, |it| it.len()) < RAM as u64 {
        assert!(Instant::now() < give_up);
        std::thread::sleep(Duration::from_millis(5));
    }
    let ram = fs::read(&ram).unwrap();
    let elf = fs::read(folder.path().join("cell.elf")).unwrap();
    let (statics, state) = (statics(&elf), state(&elf));
    let free = ram[statics..].iter().take_while(|byte| **byte == 0).count();
    let stack = RAM - statics - free;
    println!(
        "{stack} bytes of stack; {statics} of statics, {state} of them the cell's state; {free} of {RAM} are free"
    );
    // With words of 64 bits it is some hundred bytes larger.
    let here = size_of::<cell_node::node::Node>();
    assert!((here * 3 / 4..=here).contains(&state), "{state} bytes of state, {here} on this machine");
    assert!(state <= STATE, "{state} bytes of state");
    assert!(stack <= STACK, "{stack} bytes of stack");
    assert!(statics + STACK <= RAM, "{statics} bytes of statics");
}

/// Returns the bytes of RAM of a program's statics.
fn statics(elf: &[u8]) -> usize {
    let word = |at: usize| u32::from_le_bytes(elf[at..at + 4].try_into().unwrap()) as usize;
    let (heads, count) = (word(28), word(44) & 0xFFFF);
    let heads = (0..count).map(|index| heads + 32 * index).filter(|&head| word(head + 8) >= 0x2000_0000);
    heads.map(|head| word(head + 8) + word(head + 20) - 0x2000_0000).max().unwrap()
}

/// Returns the size of the static that holds the cell's state.
fn state(elf: &[u8]) -> usize {
    let word = |at: usize| u32::from_le_bytes(elf[at..at + 4].try_into().unwrap()) as usize;
    let half = |at: usize| usize::from(u16::from_le_bytes(elf[at..at + 2].try_into().unwrap()));
    // The fields of a section: kind, offset and size at 4, 16 and 20; the table of symbols is of kind 2, and refers to
    // its strings at 24.
    let section = |index: usize| word(32) + half(46) * index;
    let symbols = (0..half(48)).map(section).find(|&at| word(at + 4) == 2).expect("cargo leaves the symbols");
    let names = word(section(word(symbols + 24)) + 16);
    let name = |at: usize| elf[names + word(at)..].split(|byte| *byte == 0).next().unwrap();
    let mut entries = (0..word(symbols + 20) / 16).map(|index| word(symbols + 16) + 16 * index);
    let node = entries
        .find(|&at| name(at).windows(5).any(|it| it == b"4NODE") && half(at + 14) != 0)
        .expect("a static");
    word(node + 8)
}
