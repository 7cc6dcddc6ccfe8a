//! Measures the cost of the embedded bus under a whole skin: 253 clients, each with one exact filter, receive a
//! broadcast at 62.5 Hz, and each answers it to one client.
//!
//! `cargo run --release -p vcan-setup --example skin_pattern [CELLS] [SECONDS] [CELLS_PER_CLIENT]`
//!
//! Almost all of the cost is the system's, which wakes one reader per delivery. Cells that share a client are woken
//! The system causes almost all of the cost, because it wakes one reader for each delivered frame. Cells that share a
//! client are woken together, at a fraction of the cost.
#![allow(clippy::print_stdout, reason = "an example that prints")]

use std::error::Error;
use std::thread::Builder;
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{BIT_RATE_SWITCH, Frame};
use rustix::time::{ClockId, clock_gettime};
use vcan_setup::embedded::Server;

const EPOCH_PERIOD: Duration = Duration::from_millis(16);

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = protocol::usage::command_line().into_iter().skip(1);
    let cells: u32 = arguments.next().map_or(Ok(253), |word| word.parse())?;
    let seconds: u32 = arguments.next().map_or(Ok(10), |word| word.parse())?;
    let share: usize = arguments.next().map_or(Ok(1), |word| word.parse())?;
    let directory = std::env::temp_dir().join(format!("skin-pattern-{}", std::process::id()));
    let server = Server::bind_in(&directory, "vcan0")?;
    let (stop, stopped) = std::os::unix::net::UnixStream::pair()?;
    let serving = std::thread::spawn(move || {
        let totals = server.run(stopped);
        (totals, clock_gettime(ClockId::ThreadCPUTime))
    });

    let exact = |id| vec![Filter { id, mask: Filter::EXACT_MASK }];
    let open = |filters| {
        let options = BusOptions { filters, directory: Some(directory.clone()), ..BusOptions::default() };
        Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options)
    };
    let ids: Vec<_> = (1..=cells).map(|cell| 0x200 + cell).collect();
    for ids in ids.chunks(share.max(1)) {
        let (bus, ids) = (open(exact(0x001))?, ids.to_vec());
        // The threads are not joined; they end with the process.
        Builder::new().stack_size(128 << 10).spawn(move || answer_broadcasts(&bus, &ids))?;
    }
    let gateway = open(vec![Filter { id: 0x200, mask: 0x700 }])?;

    let mut inbox = Inbox::new();
    let mut last_reply = Vec::new();
    let (mut complete, mut replies) = (0_u32, 0_u64);
    let cycles = seconds.saturating_mul(125).div_ceil(2);
    let start = Instant::now();
    let mut due = start;
    for cycle in 0..cycles {
        due += EPOCH_PERIOD;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let sent = Instant::now();
        gateway.send(&[Frame::fd(0x001, BIT_RATE_SWITCH, &u128::from(cycle).to_le_bytes())?])?;
        let mut got = 0;
        while got < cells
            && gateway.wait(Some((due + EPOCH_PERIOD).saturating_duration_since(Instant::now())))?
        {
            gateway.receive(&mut inbox)?;
            got += inbox
                .frames()
                .filter(|reply| reply.frame.data().starts_with(&cycle.to_le_bytes()))
                .map(|_| 1)
                .sum::<u32>();
        }
        replies += u64::from(got);
        if got == cells {
            complete += 1;
            last_reply.push(sent.elapsed());
        }
    }
    let took = start.elapsed();
    drop(stop);
    let (totals, cpu) = serving.join().expect("the bus does not panic");
    let totals = totals?;
    let cpu = Duration::try_from(cpu)?;
    last_reply.sort_unstable();
    let at = |percent: usize| {
        let place = last_reply.len().saturating_sub(1).saturating_mul(percent).div_ceil(100);
        last_reply.get(place).copied().unwrap_or_default()
    };
    println!(
        "{cells} cells, {cycles} cycles in {:.2} s: {complete} complete, {replies} replies",
        took.as_secs_f64()
    );
    println!("last reply after the broadcast: p50 {:.2?}, p99 {:.2?}, max {:.2?}", at(50), at(99), at(100));
    println!("dropped {}, garbage {}", inbox.dropped_count(), totals.garbage);
    println!(
        "the bus: {:.2} ms of CPU per cycle, {:.1} % of one core",
        1e3 * cpu.as_secs_f64() / f64::from(cycles),
        100.0 * cpu.as_secs_f64() / took.as_secs_f64()
    );
    Ok(())
}

/// Answers every broadcast once for each of some cells, with the first bytes of the broadcast, until the bus is closed.
fn answer_broadcasts(bus: &Bus, ids: &[u32]) {
    let mut inbox = Inbox::new();
    let mut replies = Vec::new();
    while bus.wait(None).is_ok() && bus.receive(&mut inbox).is_ok() {
        for heard in inbox.frames() {
            let reply = |&id| Frame::fd(id, BIT_RATE_SWITCH, heard.frame.data()).expect("16 bytes fit");
            replies.clear();
            replies.extend(ids.iter().map(reply));
            if bus.send(&replies).is_err() {
                return;
            }
        }
    }
}
