//! The threads of a control channel: one reads commands, one writes events, one for each bus receives, and one serves
//! them all.

use std::collections::BTreeMap;
use std::io::{self, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bench::bus::follow::FollowedItem;
use bench::bus::listen::now;
use bench::remote::{BenchCommand, BenchState, JsonPipe};
use protocol::bus::KindChoices;
use protocol::message::Message;
use protocol::skin::Skin;

use super::event::ControlEvent;
use super::queue::{EventQueue, UnreadEvents};
use super::request::{InputLine, read_line};
use super::state::{ControlOutput, ControlState};
use crate::followed::{BusOpener, FollowedBus, time_of_read_frames};
use crate::lock_ignoring_poison;

/// The time for which the serving thread waits for a command.
const COMMAND_TIMEOUT: Duration = Duration::from_millis(5);
/// The interval at which the state is brought up to date without commands.
const TIME_INTERVAL: Duration = Duration::from_millis(20);
/// The time for which a thread lets frames accumulate after the first one, so that it wakes up less often.
const FRAME_GATHER_TIME: Duration = Duration::from_millis(2);
/// The number of lines that are read ahead.
const MAX_LINES_READ_AHEAD: usize = 64;
/// The time within which the last event must be read.
const LAST_EVENT_TIMEOUT: Duration = Duration::from_secs(5);

/// The run that a control channel controls.
#[derive(Debug)]
pub struct ChannelOptions {
    /// The skin of the run.
    pub skin: Skin,
    /// The version of the program, for the first event.
    pub version: &'static str,
    /// The kind of each bus.
    pub kinds: KindChoices,
    /// The directory of embedded buses; `None` for the default one.
    pub directory: Option<PathBuf>,
    /// The kind and the folder of each bus, for the first event.
    pub places: Vec<(&'static str, Option<String>)>,
}

/// A line of the input, or its end.
type Input = Option<InputLine>;

/// A control channel that is served by threads.
#[derive(Debug)]
pub struct ControlChannel {
    events: Arc<EventQueue>,
    lines: Arc<Mutex<Receiver<Input>>>,
    serving: JoinHandle<ControlState>,
    stop: Arc<AtomicBool>,
}

/// A channel after its run, before the last event.
#[derive(Debug)]
pub struct StoppedChannel {
    events: Arc<EventQueue>,
    /// True if a thread of the channel failed, so that commands may be unanswered.
    pub has_failed: bool,
}

/// Stops the channel if its thread panics: it would answer wrongly without it.
struct StopOnPanic<'a>(&'a AtomicBool);

impl Drop for StopOnPanic<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.store(true, Ordering::Relaxed);
        }
    }
}

impl ControlChannel {
    /// Starts a channel that reads commands from `input` and writes events to `output`. Returns it with the connection
    /// for the run.
    ///
    /// # Errors
    /// Returns [`io::Error`] if a connection or a thread cannot be made.
    pub fn start(
        options: ChannelOptions,
        input: impl Read + Send + 'static,
        mut output: impl Write + Send + 'static,
    ) -> io::Result<(Self, JsonPipe)> {
        let (here, there) = UnixStream::pair()?;
        let here = JsonPipe::new(here.try_clone()?, here)?;
        let there = JsonPipe::new(there.try_clone()?, there)?;
        let (sender, lines) = sync_channel(MAX_LINES_READ_AHEAD);
        let (events, lines) = (Arc::new(EventQueue::default()), Arc::new(Mutex::new(lines)));
        let stop = Arc::new(AtomicBool::new(false));
        let named = |name: &str| thread::Builder::new().name(name.to_owned());
        // These two threads may wait for the other program for as long as the process lives.
        named("commands").spawn(move || read_lines(input, &sender))?;
        named("events").spawn({
            let events = Arc::clone(&events);
            move || events.write_to(&mut output)
        })?;
        let serving = named("channel").spawn({
            let (events, lines, stop) = (Arc::clone(&events), Arc::clone(&lines), Arc::clone(&stop));
            move || serve(options, here, &lines, &events, &stop)
        })?;
        Ok((Self { events, lines, serving, stop }, there))
    }

    /// Stops the channel after the run, and answers the commands that are still under way.
    #[must_use]
    pub fn stop(self) -> StoppedChannel {
        self.stop.store(true, Ordering::Relaxed);
        let state = self.serving.join();
        let has_failed = state.is_err();
        if let Ok(mut state) = state {
            state.handle_end(lock_ignoring_poison(&self.lines).try_iter().flatten());
            state.take_output().events.iter().for_each(|event| self.events.push(event));
        }
        StoppedChannel { events: self.events, has_failed }
    }
}

impl StoppedChannel {
    /// Sends the last event.
    ///
    /// # Errors
    /// Returns the reason why the events were not read to their end.
    pub fn finish(self, last: &ControlEvent) -> Result<(), UnreadEvents> {
        self.events.finish(last, LAST_EVENT_TIMEOUT)
    }
}

/// Reads lines until the input ends.
fn read_lines(input: impl Read, lines: &SyncSender<Input>) {
    let mut input = BufReader::new(input);
    loop {
        // An input that cannot be read has ended.
        let line = read_line(&mut input).unwrap_or_default();
        let ended = line.is_none();
        if lines.send(line).is_err() || ended {
            return;
        }
    }
}

/// Serves a channel until `stop` is set or the run has ended.
fn serve(
    options: ChannelOptions,
    run: JsonPipe,
    lines: &Mutex<Receiver<Input>>,
    events: &EventQueue,
    stop: &AtomicBool,
) -> ControlState {
    let ChannelOptions { skin, version, kinds, directory, places } = options;
    let opener = BusOpener { kinds: &kinds, directory: directory.as_deref() };
    // A bus that does not exist yet is opened when it appears.
    let buses: Vec<_> =
        skin.buses.iter().filter_map(|bus| FollowedBus::open(bus, opener, true).ok()).collect();
    let shared = Mutex::new(ControlState::new(skin, version, places));
    thread::scope(|scope| {
        for (index, bus) in buses.iter().enumerate() {
            let (shared, buses) = (&shared, &buses);
            let receive = move || {
                let _guard = StopOnPanic(stop);
                bus.receive(opener, FRAME_GATHER_TIME, stop, |follower| {
                    let mut state = lock_ignoring_poison(shared);
                    follower.for_each_item(|item| {
                        if let FollowedItem::Frame(received) = item {
                            state.handle_frame(index, received.at_nanos, &received.frame);
                        }
                    });
                    state.handle_bus_state(now(), index, !follower.is_lost(), follower.dropped_frames());
                    let ControlOutput { messages, .. } = push_events(&mut state, events);
                    drop(state);
                    send_messages(buses, &messages);
                });
            };
            // Without this bus the channel would answer wrongly: a failure ends it, and so the run.
            thread::Builder::new().spawn_scoped(scope, receive).expect("a thread for each bus");
        }
        let (shared, buses, unsent_halts) = (&shared, &buses, BTreeMap::new());
        Server { run, lines, events, shared, buses, unsent: Vec::new(), unsent_halts }.serve(stop);
    });
    shared.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// The thread that handles commands, time, and the state of the run.
struct Server<'a> {
    run: JsonPipe,
    lines: &'a Mutex<Receiver<Input>>,
    events: &'a EventQueue,
    shared: &'a Mutex<ControlState>,
    buses: &'a [FollowedBus],
    /// Commands that did not fit into the pipe to the run.
    unsent: Vec<BenchCommand>,
    /// For each bus that did not take it, the last halt or resume.
    unsent_halts: BTreeMap<usize, Message>,
}

impl Server<'_> {
    fn serve(&mut self, stop: &AtomicBool) {
        let mut has_ended = false;
        let mut due = Instant::now();
        while !stop.load(Ordering::Relaxed) && !self.run.has_ended() {
            let accepts = !has_ended && lock_ignoring_poison(self.shared).accepts_lines();
            let line = if accepts { self.next_line() } else { Err(RecvTimeoutError::Timeout) };
            if line.is_err() && !accepts {
                thread::sleep(COMMAND_TIMEOUT);
            }
            let now = time_of_read_frames(self.buses);
            let mut state = lock_ignoring_poison(self.shared);
            while let Some(seen) = self.run.receive::<BenchState>() {
                state.handle_bench_state(now, seen);
            }
            if due <= Instant::now() {
                due = Instant::now() + TIME_INTERVAL;
                state.handle_time(now);
            }
            match line {
                Ok(Some(line)) => state.handle_line(now, line),
                Ok(None) | Err(RecvTimeoutError::Disconnected) => {
                    has_ended = true;
                    state.handle_end_of_input(now);
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
            let ControlOutput { messages, commands, .. } = push_events(&mut state, self.events);
            drop(state);
            self.send(&messages);
            self.unsent.extend(commands);
            let run = &mut self.run;
            let sent = self.unsent.iter().take_while(|command| run.send(command)).count();
            self.unsent.drain(..sent);
        }
        stop.store(true, Ordering::Relaxed);
    }

    /// Sends messages. A halt or resume is repeated until its bus takes it.
    fn send(&mut self, messages: &[(usize, Message)]) {
        let retried = std::mem::take(&mut self.unsent_halts);
        let is_replaced = |bus: usize| messages.iter().any(|(of, it)| *of == bus && is_halt_or_resume(it));
        let retried = retried.into_iter().filter(|(bus, _)| !is_replaced(*bus));
        for (bus, message) in retried.chain(messages.iter().copied()) {
            let is_sent = self.buses.get(bus).is_some_and(|bus| bus.send(&message));
            if !is_sent && is_halt_or_resume(&message) {
                self.unsent_halts.insert(bus, message);
            }
        }
    }

    fn next_line(&self) -> Result<Input, RecvTimeoutError> {
        lock_ignoring_poison(self.lines).recv_timeout(COMMAND_TIMEOUT)
    }
}

/// Pushes the events of the state, while it is locked so that they keep their order. Returns the other effects.
fn push_events(state: &mut ControlState, events: &EventQueue) -> ControlOutput {
    let output = state.take_output();
    output.events.iter().for_each(|event| events.push(event));
    output
}

const fn is_halt_or_resume(message: &Message) -> bool {
    matches!(message, Message::Halt | Message::Resume)
}

/// Sends stimuli. A press whose stimulus is lost is not confirmed.
fn send_messages(buses: &[FollowedBus], messages: &[(usize, Message)]) {
    for (bus, message) in messages {
        if let Some(bus) = buses.get(*bus) {
            let _ = bus.send(message);
        }
    }
}
