//! Measures the round-trip time that `vcan-setup link` adds, and its processor time per frame. Two embedded buses of
//! this machine stand for the two hosts.
//!
//! `cd vcan-setup/link && cargo build --locked --release --bins --examples && target/release/examples/link_cost`
#![allow(clippy::print_stdout, reason = "an example that prints")]

use std::error::Error;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use protocol::bus::{Bus, BusKind, BusOptions, Inbox, KindChoice};
use protocol::can::Frame;
use rustix::process::{Pid, Signal, kill_process};
use vcan_setup::embedded::ServerThread;

type Outcome<T> = Result<T, Box<dyn Error>>;

const BUS: &str = "vcan0";
const PINGS: usize = 1_000;
const PAUSE: Duration = Duration::from_millis(1);
/// The number of frames sent at once, like the replies of a bus's cells, and the number of repetitions.
const CELLS: usize = 100;
const EPOCHS: usize = 625;
const EPOCH: Duration = Duration::from_millis(16);
const PING: u32 = 0x123;
const PONG: u32 = 0x321;
const SOON: Duration = Duration::from_secs(5);

fn main() -> Outcome<()> {
    let folder = std::env::temp_dir().join(format!("link-cost-{}", std::process::id()));
    let [here, there] = ["here", "there"].map(|name| folder.join(name));
    let _served = [serve(&here)?, serve(&there)?];
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let mut links = Links(Vec::new());
    links.start(&here, "here", &format!("--listen=tcp/127.0.0.1:{port}"))?;
    links.start(&there, "there", &format!("--connect=tcp/127.0.0.1:{port}"))?;

    let near = open(&here)?;
    let mut pings = 0..;
    let mut rounds = [Vec::new(), Vec::new()];
    // Rounds on one bus and rounds over the link alternate, so that other load on the machine affects both alike.
    for turn in 0..10 {
        for (far, rounds) in [&here, &there].into_iter().zip(&mut rounds) {
            let answers = Answers::start(open(far)?)?;
            until_answered(&near, &mut pings)?;
            for _ in 0..PINGS / 10 {
                thread::sleep(PAUSE);
                rounds.push(round_trip(&near, &mut pings)?.ok_or("a ping was not answered")?);
            }
            answers.stop();
        }
        if turn == 0 {
            rounds.iter_mut().for_each(Vec::clear);
        }
    }
    let [one_bus, linked] = rounds.map(|mut rounds| {
        rounds.sort_unstable();
        [50, 99].map(|percent| rounds.get(rounds.len() * percent / 100).copied().unwrap_or_default())
    });
    println!("round trip on one bus    p50 {:.0?}, p99 {:.0?}", one_bus[0], one_bus[1]);
    println!("round trip over the link p50 {:.0?}, p99 {:.0?}", linked[0], linked[1]);
    println!("added by the link, p50   {:.0?}", linked[0].saturating_sub(one_bus[0]));

    let far = open(&there)?;
    let answer = |node, epoch| -> Outcome<Frame> {
        Ok(Frame::fd(0x200 + u32::try_from(node)?, 1, &usize::to_le_bytes(epoch))?)
    };
    let (before, began, mut inbox, mut received) = (links.processor(), Instant::now(), Inbox::new(), 0);
    for number in 1..=EPOCHS {
        far.send(&(1..=CELLS).map(|node| answer(node, number)).collect::<Outcome<Vec<_>>>()?)?;
        let due = began + EPOCH * u32::try_from(number)?;
        while near.wait(Some(due.saturating_duration_since(Instant::now())))? && Instant::now() < due {
            received += near.receive(&mut inbox)?;
        }
    }
    let took = links.processor() - before;
    println!("{CELLS} frames every {EPOCH:?}: {received} of {} arrived", EPOCHS * CELLS);
    println!(
        "CPU time of both links   {:.1} us per frame",
        took * 1e6 / f64::from(u32::try_from(received.max(1))?)
    );
    drop(links);
    std::fs::remove_dir_all(folder)?;
    Ok(())
}

fn serve(folder: &Path) -> Outcome<ServerThread> {
    std::fs::create_dir_all(folder)?;
    std::fs::set_permissions(folder, std::os::unix::fs::PermissionsExt::from_mode(0o700))?;
    Ok(ServerThread::start_in(folder, BUS)?)
}

fn open(folder: &Path) -> Outcome<Bus> {
    let options = BusOptions { directory: Some(folder.to_owned()), ..BusOptions::default() };
    Ok(Bus::open(BUS, KindChoice::Only(BusKind::Embedded), &options)?)
}

/// The links of both hosts, which are stopped on drop.
struct Links(Vec<Child>);

impl Links {
    fn start(&mut self, folder: &Path, host: &str, how: &str) -> Outcome<()> {
        // The program is in the folder above that of the examples.
        let program: PathBuf =
            std::env::current_exe()?.parent().and_then(Path::parent).ok_or("no folder")?.join("vcan-link");
        let mut command = Command::new(program);
        command.args([BUS, "--bus-kind=embedded", "--host", host, how]).env("SKINBUS_DIR", folder);
        self.0.push(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?);
        Ok(())
    }

    /// Returns the processor time that all threads of both links have used so far, in s, as the scheduler counts it.
    fn processor(&self) -> f64 {
        let nanos = |path: PathBuf| {
            let text = std::fs::read_to_string(path).unwrap_or_default();
            text.split_whitespace().next().and_then(|nanos| nanos.parse::<f64>().ok()).unwrap_or(0.0)
        };
        let threads = |child: &Child| std::fs::read_dir(format!("/proc/{}/task", child.id()));
        let all = self.0.iter().filter_map(|child| threads(child).ok()).flatten().flatten();
        all.map(|thread| nanos(thread.path().join("schedstat"))).sum::<f64>() * 1e-9
    }
}

impl Drop for Links {
    fn drop(&mut self) {
        for link in &mut self.0 {
            let _ = i32::try_from(link.id())
                .ok()
                .and_then(Pid::from_raw)
                .map(|pid| kill_process(pid, Signal::TERM));
            let _ = link.wait();
        }
    }
}

/// A thread that answers each ping.
struct Answers {
    stop: std::sync::Arc<AtomicBool>,
    thread: thread::JoinHandle<()>,
}

impl Answers {
    fn start(bus: Bus) -> Outcome<Self> {
        let stop = std::sync::Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let answer = move || {
            let mut inbox = Inbox::new();
            while !stopped.load(Ordering::Relaxed) {
                if bus.wait_and_receive(&mut inbox, Duration::from_millis(25)).is_err() {
                    return;
                }
                for ping in inbox.frames().filter(|received| received.frame.raw_id() == PING) {
                    // The answers differ in their data, because the link would take a repeated frame for one that went
                    // around a circle.
                    let _ = Frame::fd(PONG, 1, ping.frame.data()).map(|pong| bus.send(&[pong]));
                }
            }
        };
        Ok(Self { stop, thread: thread::Builder::new().spawn(answer)? })
    }

    fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ = self.thread.join();
    }
}

/// Sends pings until one is answered: the responder has then opened its bus, and the links are connected.
fn until_answered(near: &Bus, pings: &mut impl Iterator<Item = u32>) -> Outcome<()> {
    let began = Instant::now();
    while began.elapsed() < SOON {
        if round_trip(near, pings)?.is_some() {
            return Ok(());
        }
    }
    Err("no ping was answered: is vcan-link built beside the folder of the examples?".into())
}

fn round_trip(near: &Bus, pings: &mut impl Iterator<Item = u32>) -> Outcome<Option<Duration>> {
    let ping = Frame::fd(PING, 1, &pings.next().ok_or("too many pings")?.to_le_bytes())?;
    let (mut inbox, began) = (Inbox::new(), Instant::now());
    near.send(&[ping])?;
    let answered = near.wait(Some(Duration::from_millis(100)))?;
    let took = began.elapsed();
    near.receive(&mut inbox)?;
    Ok(answered.then_some(took))
}
