//! Time to receive the 253 replies of an epoch, beside the plainest C loop with `recv`: `cargo bench -p gateway --bench
//! epoch`
//!
//! All frames wait in the socket when the clock starts, as when a receiver has let them gather. *Frames* is the
//! receiver's work to get them with their time stamps (`recvmmsg`); *table* adds their processing: CRC, accounts, sums.
//! The C program (`recv.c`) receives each frame alone, without a time stamp, and reads one byte of it.

use std::path::{Path, PathBuf};
use std::process::{Command, exit};
use std::time::{Duration, Instant};

use criterion::{Criterion, Throughput};
use model::generate::{SkinRequest, generate};
use model::table::BusTable;
use protocol::bus::{Bus, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{Format, Frame};
use protocol::fixed::Q3_12;
use protocol::id::CellId;
use protocol::message::{Joints, Message};
use protocol::packet::Epoch;
use protocol::skin::Skin;
use protocol::time::Micros;
use vcan_setup::embedded::ServerThread;

const CELLS: usize = 253;
/// Identifier of a frame that shows the delivery of all replies before it.
const END_MARKER_ID: u32 = 0x7FF;

/// An embedded bus with replies, their sender, and their receiver.
struct ReplyBus {
    _served: ServerThread,
    cells: Bus,
    gateway: Bus,
    bell: Bus,
    inbox: Inbox,
}

impl ReplyBus {
    fn new(directory: PathBuf) -> Self {
        let served = ServerThread::start_in(&directory, "vcan0").expect("a new directory");
        let open = |filters| {
            let directory = Some(directory.clone());
            let options = BusOptions { filters, directory, receive_buffer: 1 << 20, ..BusOptions::default() };
            Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).expect("it is served")
        };
        let gateway = open(vec![Filter { id: 0x200, mask: 0x700 }]);
        let bell = open(vec![Filter { id: END_MARKER_ID, mask: Filter::EXACT_MASK }]);
        Self { cells: open(Vec::new()), gateway, bell, inbox: Inbox::new(), _served: served }
    }

    /// Queues all these frames in the gateway's socket.
    fn send_replies(&mut self, replies: &[Frame]) {
        self.cells.send(replies).expect("there is room");
        self.cells
            .send(&[Frame::classic(END_MARKER_ID, &[]).expect("an empty frame")])
            .expect("there is room");
        // The server sends frames to its clients in the order of arrival.
        assert!(self.bell.wait(Some(Duration::from_secs(10))).expect("it is served"), "it is delivered");
        self.bell.receive(&mut self.inbox).expect("it is served");
    }

    /// Receives all waiting frames, and passes them to `hear`. Returns the time.
    fn receive_epoch(&mut self, mut hear: impl FnMut(u64, &Frame)) -> Duration {
        let (mut taken, began) = (0, Instant::now());
        while taken < CELLS {
            let more = self.gateway.receive(&mut self.inbox).expect("it is served");
            self.inbox.frames().for_each(|received| hear(received.at_nanos, &received.frame));
            assert!(more > 0, "{taken} frames, and no more");
            taken += more;
        }
        began.elapsed()
    }
}

/// The replies of an epoch.
fn reply_frames(epoch: Epoch) -> Vec<Frame> {
    let reply = |from: CellId| {
        let torque = [0.1, -0.2, 0.3, 0.05, 0.01, 0.0].map(Q3_12::nearest);
        Message::Torque { from, epoch, torque: torque.map(Q3_12::to_bits).into() }.encode().frames(Format::Fd)
    };
    CellId::all().take(CELLS).flat_map(reply).collect()
}

/// A table that follows epochs.
struct Listener {
    table: BusTable,
    number: u64,
}

impl Listener {
    fn new() -> Self {
        let text = generate(&SkinRequest { cells: CELLS, ..SkinRequest::default() }).expect("a UR5 has room");
        let skin = Skin::parse("skin.toml", &text).expect("a generated skin is sound");
        let mut table = BusTable::new(&skin, 0);
        table.set_torque_comparison(false);
        Self { table, number: 0 }
    }

    /// Opens the next epoch, like the gateway's own joints when they are read back.
    fn open_epoch(&mut self) -> Epoch {
        let epoch = Epoch(self.number.to_le_bytes()[0]);
        let joints = Joints { in_use: 6, ..Joints::default() };
        for frame in (Message::Joints { epoch, joints }).encode().frames(Format::Fd) {
            self.table.handle_frame(Micros(self.number * 16_000), true, &frame, &mut |_| None);
        }
        self.number += 1;
        epoch
    }

    fn receive(&mut self, frame: &Frame) {
        let at = Micros((self.number - 1) * 16_000 + 1_000);
        self.table.handle_frame(at, false, frame, &mut |_| None);
    }
}

/// Compiles the C program with the compiler that links Rust programs.
fn compile_c_program() -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/recv.c");
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("recv");
    let compiler = std::env::var("CC").unwrap_or_else(|_| "cc".to_owned());
    let mut command = Command::new(&compiler);
    let done = command.args(["-O2", "-Wall", "-Werror", "-o"]).arg(&program).arg(&source).status();
    if !done.is_ok_and(|status| status.success()) {
        eprintln!(
            "epoch: {compiler} cannot compile {}; install gcc, or name another compiler with CC",
            source.display()
        );
        exit(1);
    }
    program
}

/// Lets the C program receive `epochs` epochs. Returns the time that it prints.
fn time_c_program(program: &Path, epochs: u64) -> Duration {
    let output = Command::new(program).args([epochs.to_string(), CELLS.to_string()]).output();
    let output = output.expect("it was compiled");
    let text = String::from_utf8_lossy(&output.stdout);
    let words: Vec<u64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    let &[nanos, sum] = words.as_slice() else { unreachable!("recv prints two numbers: {output:?}") };
    assert_eq!(sum, epochs * (1..=253).sum::<u64>(), "every frame was taken");
    Duration::from_nanos(nanos)
}

fn main() {
    let program = compile_c_program();
    let place = tempfile::tempdir().expect("a temporary directory");
    let mut wire = ReplyBus::new(place.path().join("skinbus"));
    let mut listener = Listener::new();
    let mut criterion = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(2))
        .configure_from_args();

    let mut group = criterion.benchmark_group("epoch of 253 frames");
    group.throughput(Throughput::Elements(CELLS as u64));
    let frames = reply_frames(Epoch(0));
    group.bench_function("frames", |bencher| {
        bencher.iter_custom(|epochs| {
            let mut sum = 0;
            let took = (0..epochs).map(|_| {
                wire.send_replies(&frames);
                wire.receive_epoch(|at_nanos, frame| sum += u64::from(frame.len()) + (at_nanos & 1))
            });
            let took = took.sum();
            assert!(sum >= epochs * 253 * 16, "every frame was taken");
            took
        });
    });
    group.bench_function("table", |bencher| {
        bencher.iter_custom(|epochs| {
            let mut took = Duration::ZERO;
            for _ in 0..epochs {
                let epoch = listener.open_epoch();
                wire.send_replies(&reply_frames(epoch));
                took += wire.receive_epoch(|_, frame| listener.receive(frame));
                assert_eq!(listener.table.snapshot().sums.contributing, 253, "every reply counts");
            }
            took
        });
    });
    group.bench_function("recv in C", |bencher| {
        bencher.iter_custom(|epochs| time_c_program(&program, epochs))
    });
    group.finish();
    criterion.final_summary();
}
