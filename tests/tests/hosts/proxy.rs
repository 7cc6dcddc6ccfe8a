//! A TCP proxy between two hosts that cuts, stalls and delays connections.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

/// The disturbances of the proxy.
#[derive(Default)]
struct State {
    is_cut: AtomicBool,
    is_stalled: AtomicBool,
    delay_ms: AtomicU64,
    is_over: AtomicBool,
    connections: Mutex<Vec<TcpStream>>,
}

pub(crate) struct Proxy {
    pub(crate) port: u16,
    /// The port that it forwards to.
    pub(crate) to: u16,
    state: Arc<State>,
}

impl Proxy {
    /// Creates a proxy in front of a port of this machine.
    pub(crate) fn before(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let own = listener.local_addr().unwrap();
        let state = Arc::new(State::default());
        let shared = Arc::clone(&state);
        thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                if shared.is_over.load(Ordering::Relaxed) {
                    return;
                }
                if shared.is_cut.load(Ordering::Relaxed) {
                    let _ = client.shutdown(Shutdown::Both);
                } else if let Ok(server) = TcpStream::connect(SocketAddr::from(([127, 0, 0, 1], port))) {
                    for stream in [&client, &server] {
                        stream.set_nodelay(true).unwrap();
                        shared.connections.lock().unwrap().push(stream.try_clone().unwrap());
                    }
                    pump(&client, &server, &shared);
                    pump(&server, &client, &shared);
                }
            }
        });
        Self { port: own.port(), to: port, state }
    }

    /// Cuts all connections and refuses new ones, or ends that.
    pub(crate) fn cut(&self, on: bool) {
        self.state.is_cut.store(on, Ordering::Relaxed);
        for stream in self.state.connections.lock().unwrap().drain(..).filter(|_| on) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Holds back all data silently, or releases it.
    pub(crate) fn stall(&self, on: bool) {
        self.state.is_stalled.store(on, Ordering::Relaxed);
    }

    /// Delays all data by this time.
    pub(crate) fn delay(&self, by: Duration) {
        self.state.delay_ms.store(by.as_millis().try_into().unwrap(), Ordering::Relaxed);
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.state.is_over.store(true, Ordering::Relaxed);
        self.cut(true);
        let _ = TcpStream::connect(SocketAddr::from(([127, 0, 0, 1], self.port)));
    }
}

/// Copies one direction. Data waits for its time in a queue, so that a delay does not reduce the throughput.
fn pump(from: &TcpStream, to: &TcpStream, state: &Arc<State>) {
    let (mut from, mut to) = (from.try_clone().unwrap(), to.try_clone().unwrap());
    let (queue, read) = channel::<(Instant, Vec<u8>)>();
    thread::spawn(move || {
        let mut bytes = [0; 16_384];
        while let Ok(count @ 1..) = from.read(&mut bytes) {
            if queue.send((Instant::now(), bytes[..count].to_vec())).is_err() {
                return;
            }
        }
    });
    let state = Arc::clone(state);
    thread::spawn(move || {
        while let Ok((at, bytes)) = read.recv() {
            let delay = Duration::from_millis(state.delay_ms.load(Ordering::Relaxed));
            thread::sleep((at + delay).saturating_duration_since(Instant::now()));
            while state.is_stalled.load(Ordering::Relaxed) && !state.is_over.load(Ordering::Relaxed) {
                thread::sleep(Duration::from_millis(1));
            }
            if to.write_all(&bytes).is_err() {
                break;
            }
        }
        let _ = to.shutdown(Shutdown::Both);
    });
}
