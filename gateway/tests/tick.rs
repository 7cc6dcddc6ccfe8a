//! What a tick may not do: allocate, or do more work the more cells there are.

#![allow(clippy::unwrap_used, reason = "a test may stop")]
#![expect(unsafe_code, reason = "an allocator that counts has to be one")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use gateway::controller::Kinesthetic;
use gateway::cycle::{Cycle, Tick};
use gateway::generate::{Wanted, generate};
use gateway::robot::SimulatedArm;
use gateway::run::realtime;
use gateway::run::turn::{Line, Shared, Turn};
use gateway::scenario::{Mode, ModeChange, Scenario};
use gateway::table::Table;
use protocol::bus::{Bus, BusKind, Choice, Options};
use protocol::packet::WORDS;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use vcan_setup::embedded::Served;

/// Counts what the current thread allocates.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: everything is left to the system's allocator; counting touches a thread-local integer that needs
// neither a constructor nor a destructor.
unsafe impl GlobalAlloc for Counting {
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
static ALLOCATOR: Counting = Counting;

fn skin(cells: usize) -> Skin {
    let text = generate(&Wanted { cells, ..Wanted::default() }).unwrap();
    Skin::parse("skin.toml", &text).unwrap()
}

/// A loop over one bus, in one mode; its records pile up in a queue that is large enough.
fn turn(skin: &Skin, mode: Mode) -> (Turn, triple_buffer::Input<gateway::table::Snapshot>, Table) {
    let table = Table::new(skin, 0);
    let (input, snapshot) = triple_buffer::triple_buffer(table.snapshot());
    let (positions, _) = rtrb::RingBuffer::new(4_096);
    let (records, _) = rtrb::RingBuffer::new(4_096);
    let works = Arc::new(AtomicBool::new(true));
    let line = Line { format: protocol::can::Format::Fd, snapshot, positions, works };
    let modes = vec![ModeChange { at: Micros(0), mode }];
    let scenario = Scenario { modes, ..Scenario::idle(Span::from_millis(1_000)) };
    let controller = Box::new(Kinesthetic::new(skin).unwrap());
    let cycle = Cycle::new(skin, controller, Box::new(SimulatedArm::new(skin, [0.1; WORDS])));
    (Turn::new(cycle, vec![line], Arc::new(scenario), Arc::new(Shared::default()), records), input, table)
}

#[test]
fn a_tick_allocates_nothing_in_either_mode_also_when_it_sends_on_a_bus() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path().join("skinbus");
    let served = Served::start_in(&directory, "vcan0").unwrap();
    let options = Options { directory: Some(directory), ..Options::default() };
    let bus = Bus::open("vcan0", Choice::Only(BusKind::Embedded), &options).unwrap();
    for mode in [Mode::Distributed, Mode::Compare] {
        let (mut turn, mut snapshots, table) = turn(&skin(253), mode);
        let mut sent = 0;
        let mut allocated = 0;
        for number in 0..1_000 {
            snapshots.input_buffer_mut().take(table.snapshot(), true);
            snapshots.publish();
            let tick = Tick { number, time: Micros(number * 2_000) };
            let before = ALLOCATIONS.with(Cell::get);
            turn.turn(tick, 0, realtime::now(), realtime::now, |_, frames| {
                sent += frames.len();
                bus.send(frames).is_ok()
            });
            allocated += ALLOCATIONS.with(Cell::get) - before;
        }
        assert_eq!((sent, allocated), (125, 0), "{mode:?}");
    }
    served.stop().unwrap();
}

/// Not how long it takes, which another program decides too, but what it looks at: a tick in distributed
/// mode has the same inputs whether there is one cell or 253, and so takes the same steps.
#[test]
fn a_tick_in_distributed_mode_does_not_look_at_cells() {
    for cells in [1, 253] {
        let (mut turn, mut snapshots, table) = turn(&skin(cells), Mode::Distributed);
        // A snapshot without any cell's state: a tick that looked at cells would miss them.
        let mut snapshot = table.snapshot().clone();
        snapshot.felt = Vec::new();
        snapshot.torque = [1.0; WORDS];
        *snapshots.input_buffer_mut() = snapshot;
        snapshots.publish();
        let mut sent = Vec::new();
        for number in 0..64 {
            let tick = Tick { number, time: Micros(number * 2_000) };
            turn.turn(
                tick,
                0,
                0,
                || 0,
                |_, frames| {
                    sent.extend_from_slice(frames);
                    true
                },
            );
        }
        assert_eq!(sent.len(), 8, "{cells} cells");
    }
}
