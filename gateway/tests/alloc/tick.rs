//! A tick must not allocate, whether its buses accept its frames or not.
//!
//! A test that its cost does not grow with the cells is not needed: `Cycle::tick` gets totals and no cells.

#![allow(clippy::unwrap_used, reason = "a test may stop")]
#![expect(unsafe_code, reason = "an allocator that counts has to be one")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use bench::bus::follow::BusSource;
use bench::bus::link::SharedBus;
use bench::bus::realtime;
use control::controller::KinestheticController;
use control::cycle::turn::{BusPort, BusState, SharedRunState, TickDriver};
use control::cycle::{ControlCycle, Tick};
use control::robot::SimulatedArm;
use model::generate::{SkinRequest, generate};
use model::scenario::{ModeChange, Scenario, TorqueSource};
use model::table::BusTable;
use protocol::bus::{Bus, BusKind, BusOptions, KindChoice};
use protocol::can::Frame;
use protocol::packet::pad_with_defaults;
use protocol::packet::{Epoch, WORDS};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use vcan_setup::embedded::ServerThread;

/// Counts the allocations of the current thread.
struct CountingAllocator;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: everything is left to the system's allocator; counting touches a thread-local integer that needs
// neither a constructor nor a destructor.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer came from `alloc` above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

fn skin(cells: usize) -> Skin {
    let text = generate(&SkinRequest { cells, ..SkinRequest::default() }).unwrap();
    Skin::parse("skin.toml", &text).unwrap()
}

/// Creates a loop over one bus in one mode; its records fit into a queue that is large enough.
fn turn(
    skin: &Skin,
    mode: TorqueSource,
) -> (TickDriver, triple_buffer::Input<model::table::Snapshot>, BusTable) {
    let (turn, input, table, _) = turn_of(skin, mode);
    (turn, input, table)
}

/// Creates such a loop, and the state of its bus.
fn turn_of(
    skin: &Skin,
    mode: TorqueSource,
) -> (TickDriver, triple_buffer::Input<model::table::Snapshot>, BusTable, Arc<BusState>) {
    let table = BusTable::new(skin, 0);
    let (input, snapshot) = triple_buffer::triple_buffer(table.snapshot());
    let (positions, _) = rtrb::RingBuffer::new(4_096);
    let (records, _) = rtrb::RingBuffer::new(4_096);
    let state = Arc::<BusState>::default();
    let line = BusPort { format: protocol::can::Format::Fd, snapshot, positions, state: Arc::clone(&state) };
    let modes = vec![ModeChange { at: Micros(0), mode }];
    let scenario = Scenario { modes, ..Scenario::idle(Span::from_millis(1_000)) };
    let controller = Box::new(KinestheticController::new(skin).unwrap());
    let cycle = ControlCycle::new(
        skin,
        controller,
        Box::new(SimulatedArm::new(skin, pad_with_defaults(&[0.1; WORDS]))),
    );
    let turn =
        TickDriver::new(cycle, vec![line], Arc::new(scenario), Arc::new(SharedRunState::default()), records);
    (turn, input, table, state)
}

#[test]
fn a_tick_allocates_nothing_in_either_mode_also_on_a_bus_that_takes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path().join("skinbus");
    let served = ServerThread::start_in(&directory, "vcan0").unwrap();
    let options = BusOptions { directory: Some(directory), ..BusOptions::default() };
    let bus = Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap();
    for mode in [TorqueSource::Distributed, TorqueSource::Compare] {
        assert_eq!(ticks(mode, &bus, true), Run { sent: 125, taken: 125, allocations: 0 }, "{mode:?}");
    }
    served.stop().unwrap();
    let without = ticks(TorqueSource::Distributed, &bus, false);
    assert_eq!(
        without,
        Run { sent: 240, taken: 0, allocations: 0 },
        "the joints, a halt, and it again before each of the 114 joints after it: the bus is gone"
    );
}

#[test]
fn a_halt_that_a_bus_refused_is_resent_before_its_next_joints_and_then_every_8() {
    let (mut turn, mut snapshots, table) = turn(&skin(4), TorqueSource::Distributed);
    let mut taken = Vec::new();
    // No broadcast is read back, so the robot is halted within the first 100 ticks.
    for number in 0..200_u64 {
        snapshots.input_buffer_mut().copy_from(table.snapshot(), false);
        snapshots.publish();
        turn.run_tick(
            Tick { number, time: Micros(number * 2_000) },
            0,
            0,
            || 0,
            |_, frames| {
                let takes = number >= 100;
                taken.extend(frames.iter().filter(|_| takes).map(Frame::id));
                takes
            },
        );
    }
    let (halt, joints) = (0x000, 0x001);
    // The 14th to the 25th: joints of epochs 13 to 24.
    let expected = [&[halt][..], &[joints; 3], &[halt], &[joints; 8], &[halt], &[joints; 1]].concat();
    assert_eq!(taken, expected);
}

#[test]
fn a_bus_that_is_back_gets_the_state_of_the_robot_before_its_next_joints() {
    let (mut turn, mut snapshots, table, bus) = turn_of(&skin(4), TorqueSource::Distributed);
    let mut said = Vec::new();
    for number in 0..64_u64 {
        bus.works.store(!(20..30).contains(&number), Ordering::Relaxed);
        let snapshot = snapshots.input_buffer_mut();
        snapshot.copy_from(table.snapshot(), false);
        snapshot.sums.read_back = number.checked_sub(1).map(|sent| Epoch((sent / 8).to_le_bytes()[0]));
        // Another sender halts the robot while the bus works for the second time.
        snapshot.sums.halts = u32::from(number >= 44);
        snapshots.publish();
        let tick = Tick { number, time: Micros(number * 2_000) };
        turn.run_tick(
            tick,
            0,
            0,
            || 0,
            |_, frames| {
                said.extend(frames.iter().map(|frame| (number, frame.id())));
                true
            },
        );
    }
    let (halt, joints, resume) = (0x000, 0x001, 0x003);
    let others: Vec<_> = said.iter().copied().filter(|(_, id)| *id != joints).collect();
    assert_eq!(others[..2], [(32, resume), (44, halt)], "back at tick 30, and the next joints are due at 32");
    assert!(said.iter().position(|it| *it == (32, resume)) < said.iter().position(|it| *it == (32, joints)));
}

#[test]
fn a_bus_that_was_opened_again_is_found_by_the_tick_which_allocates_nothing_for_it() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path().join("skinbus");
    let serve = || ServerThread::start_in(&directory, "vcan0").unwrap();
    let options = BusOptions { directory: Some(directory.clone()), ..BusOptions::default() };
    let frames = [Frame::classic(0x001, &[0; 8]).unwrap()];
    let first = serve();
    let bus = Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap();
    let (link, mut monitor, mut slot) = SharedBus::new(bus, options);
    let mut offer = || {
        let before = ALLOCATIONS.with(Cell::get);
        let taken = slot.read().try_send_all(&frames);
        (taken, ALLOCATIONS.with(Cell::get) - before)
    };
    assert_eq!(offer(), (true, 0));
    first.stop().unwrap();
    assert!(monitor.mark_lost(true) && !monitor.mark_lost(true), "reported once");
    assert_eq!((offer(), link.is_gone(), link.state.is_working()), ((false, 0), true, false));
    assert!(monitor.reopen().is_err() && link.is_gone());
    let second = serve();
    monitor.reopen().unwrap();
    assert_eq!(
        (link.is_gone(), link.state.is_working()),
        (false, false),
        "open, and nothing was received on it yet"
    );
    assert!(monitor.mark_working() && !monitor.mark_working() && link.state.is_working());
    assert_eq!(offer(), (true, 0));
    link.send(&frames).unwrap();
    assert_eq!(second.stop().unwrap().frames, 2);
}

#[derive(Debug, PartialEq)]
struct Run {
    sent: usize,
    taken: usize,
    allocations: u64,
}

/// Runs a thousand ticks that send on a bus, which accepts the frames or not.
fn ticks(mode: TorqueSource, bus: &Bus, carries: bool) -> Run {
    let (mut turn, mut snapshots, table) = turn(&skin(253), mode);
    let mut run = Run { sent: 0, taken: 0, allocations: 0 };
    for number in 0..1_000_u64 {
        let snapshot = snapshots.input_buffer_mut();
        snapshot.copy_from(table.snapshot(), true);
        snapshot.sums.read_back = carries.then(|| Epoch((number / 8).to_le_bytes()[0]));
        snapshots.publish();
        let tick = Tick { number, time: Micros(number * 2_000) };
        let before = ALLOCATIONS.with(Cell::get);
        turn.run_tick(tick, 0, realtime::monotonic_ns(), realtime::monotonic_ns, |_, frames| {
            let taken = bus.try_send_all(frames);
            run.sent += frames.len();
            run.taken += if taken { frames.len() } else { 0 };
            taken
        });
        run.allocations += ALLOCATIONS.with(Cell::get) - before;
    }
    run
}
