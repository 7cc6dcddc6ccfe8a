//! Measures the cost of waking 253 processes 62.5 times a second, without any work or protocol: each process waits in
//! one call, and sends back the 72 bytes that it received. This is the lower bound for every bench of processes, to be
//! measured on the same machine.
//!
//! `cargo run --release -p vcan-setup --example wake_floor [PROCESSES] [SECONDS]`
#![allow(clippy::print_stdout, reason = "an example that prints")]

use std::error::Error;
use std::os::fd::OwnedFd;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::net::{AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, recv, send, socketpair};

const WAKE_PERIOD: Duration = Duration::from_millis(16);
const ZERO_FRAME: [u8; 72] = [0; 72];

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = protocol::usage::command_line().into_iter().skip(1);
    let first = arguments.next();
    if first.as_deref() == Some("echo") {
        return Ok(echo_datagrams()?);
    }
    let processes: usize = first.map_or(Ok(253), |word| word.parse())?;
    let seconds: u32 = arguments.next().map_or(Ok(5), |word| word.parse())?;
    let mut echoes = Vec::new();
    for _ in 0..processes {
        echoes.push(start_echo_process()?);
    }
    let cpu = || echoes.iter().map(|(child, _)| processor_seconds(child.id())).sum::<f64>();
    let cycles = seconds.saturating_mul(125).div_ceil(2);
    let (before, own, began) = (cpu(), processor_seconds(std::process::id()), Instant::now());
    let mut due = began;
    for _ in 0..cycles {
        due += WAKE_PERIOD;
        for (_, socket) in &echoes {
            send(socket, &ZERO_FRAME, SendFlags::empty())?;
        }
        for (_, socket) in &echoes {
            recv(socket, &mut ZERO_FRAME.clone(), RecvFlags::empty())?;
        }
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
    let took = began.elapsed().as_secs_f64();
    let (echo, query) = ((cpu() - before) / took, (processor_seconds(std::process::id()) - own) / took);
    println!("{processes} processes, {cycles} cycles: {:.3} cores", echo + query);
    println!("echoing processes {echo:.3}, querying process {query:.3}");
    for (child, socket) in &mut echoes {
        rustix::net::shutdown(&*socket, rustix::net::Shutdown::Both)?;
        child.wait()?;
    }
    Ok(())
}

/// Starts a process whose standard input is one end of a socket pair. Returns the process and the other end.
fn start_echo_process() -> Result<(Child, OwnedFd), Box<dyn Error>> {
    let (near, far) = socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)?;
    let child = Command::new(std::env::current_exe()?).arg("echo").stdin(Stdio::from(far)).spawn()?;
    Ok((child, near))
}

fn echo_datagrams() -> rustix::io::Result<()> {
    let mut bytes = ZERO_FRAME;
    let socket = std::io::stdin();
    while recv(&socket, &mut bytes, RecvFlags::empty())?.0 > 0 {
        send(&socket, &bytes, SendFlags::NOSIGNAL)?;
    }
    Ok(())
}

/// Returns the processor time that a process has used so far, in s, as the scheduler counts it.
fn processor_seconds(pid: u32) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{pid}/schedstat")).unwrap_or_default();
    let nanos = text.split_whitespace().next().and_then(|nanos| nanos.parse::<f64>().ok());
    nanos.unwrap_or(0.0) * 1e-9
}
