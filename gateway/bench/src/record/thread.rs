//! The recorder's thread: drains the queues, writes and flushes files, and records diagnostics.

use std::io;
use std::mem;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender};
use std::thread;
use std::time::{Duration, Instant};

use protocol::skin::MAX_ROBOT_JOINTS;
use rustix::time::{ClockId, clock_gettime};

use super::backlog;
use super::facts::realtime_minus_monotonic;
use super::feed::{BusFeed, CapturedItem, RecorderFeed, frame_queue_length};
use super::text::CandumpWriter;
use super::topics::{BusHealth, ROBOT_MESSAGE_COUNT, Topics};
use super::{RecordingOutputs, StopRequest};
use crate::bus::realtime::wall_clock_ns;
use model::latched::LatchedPackets;
use trace::capture::{CaptureNote, NoteKind, RUN_METADATA, run_metadata};
use trace::recording::account::{MessageCount, RecordingAccount};
use trace::recording::layout::Layout;
use trace::recording::series::{FileHead, RecordingEvent, SplitRecording};
use trace::recording::window::{REORDER_WINDOW_NS, ReorderWindow};
use trace::ros2::skin::ContactState;
use trace::ros2::standard::{Diagnosis, DiagnosisLevel, Point};

/// Pause between rounds of the thread.
const DRAIN_PAUSE: Duration = Duration::from_millis(10);
/// Interval between flushes: a killed run may lose the data of this time plus one [`DRAIN_PAUSE`].
const FLUSH_INTERVAL: Duration = Duration::from_millis(40);
/// Interval between readings of the kernel's backlog drops.
const BACKLOG_READ_INTERVAL: Duration = Duration::from_millis(100);
/// Interval between diagnostics messages.
const DIAGNOSTICS_INTERVAL: Duration = Duration::from_millis(500);

/// Figures that the recorder keeps for one bus.
#[derive(Default)]
struct BusRecord {
    latched: LatchedPackets,
    /// Number of frames recorded or counted as lost.
    frames: u64,
    /// Number of frames dropped by the bus.
    dropped: u64,
    /// Number of frames that did not fit into the queue.
    unrecorded: u64,
    /// Number of frames that arrived between two files of the recording and were not written.
    missing: u64,
    /// Number of epochs recorded.
    epochs: u64,
}

/// The output files and their errors.
struct OutputFiles {
    text: Option<CandumpWriter>,
    series: Option<SplitRecording<Topics>>,
    errors: Vec<RecordingEvent>,
}

/// State of the recorder's thread.
pub(super) struct RecorderThread {
    files: OutputFiles,
    feed: RecorderFeed,
    layout: Layout,
    /// Notes about interventions, with their times.
    notes: Receiver<(u64, String)>,
    messages: Sender<String>,
    /// Number of errors already reported.
    reported: usize,
    buses: Vec<BusRecord>,
    /// Joint positions at the last tick.
    q: Option<[f64; MAX_ROBOT_JOINTS]>,
    backlog: Option<u64>,
    /// True once the files contain the start time of the loop.
    start_is_written: bool,
    ticks: u64,
    ticks_skipped: u64,
    max_late_ns: u64,
    scratch: (Vec<ContactState>, Vec<Point>),
}

/// A timer: its period, and when it last expired.
struct PeriodicTimer(Duration, Instant);

impl PeriodicTimer {
    fn new(period: Duration) -> Self {
        Self(period, Instant::now())
    }

    fn is_due(&mut self) -> bool {
        let due = self.1.elapsed() >= self.0;
        if due {
            self.1 = Instant::now();
        }
        due
    }
}

impl RecorderThread {
    pub(super) fn new(
        outputs: RecordingOutputs,
        feed: RecorderFeed,
        layout: Layout,
        (noted, tell): (Receiver<(u64, String)>, Sender<String>),
    ) -> Self {
        let RecordingOutputs { text, series } = outputs;
        let buses = feed.bus_feeds.iter().map(|_| BusRecord::default()).collect();
        Self {
            files: OutputFiles { text, series, errors: Vec::new() },
            feed,
            layout,
            notes: noted,
            messages: tell,
            reported: 0,
            buses,
            q: None,
            backlog: backlog::dropped_packets(),
            start_is_written: false,
            ticks: 0,
            ticks_skipped: 0,
            max_late_ns: 0,
            scratch: (Vec::new(), Vec::new()),
        }
    }

    /// Records until stopped, including all items queued by then.
    pub(super) fn run(mut self, head: FileHead, stop: &StopRequest) -> RecordingAccount {
        if let Some(series) = &mut self.files.series {
            let nanos = head.nanos;
            series.begin_first_file(head, |writer| Topics::new(writer, &self.layout));
            write_robot(series, &self.layout, nanos);
        }
        let (mut flush, mut request, mut diagnose) = (
            PeriodicTimer::new(FLUSH_INTERVAL),
            PeriodicTimer::new(BACKLOG_READ_INTERVAL),
            PeriodicTimer::new(DIAGNOSTICS_INTERVAL),
        );
        let many = frame_queue_length(self.feed.bus_feeds.len()) / 8;
        loop {
            let ended = stop.now.load(Ordering::Acquire);
            let taken = self.drain_queues();
            if ended && stop.discard.load(Ordering::Relaxed) {
                return self.discard();
            }
            if request.is_due() || ended {
                self.record_backlog();
            }
            if diagnose.is_due() || ended {
                self.record_diagnostics();
            }
            if flush.is_due() {
                self.flush();
            }
            self.send_messages();
            if ended {
                break;
            }
            if taken < many {
                thread::sleep(DRAIN_PAUSE);
            }
        }
        self.finish()
    }

    /// Writes the items that are queued now. Returns the length of the longest queue.
    fn drain_queues(&mut self) -> usize {
        let offset = realtime_minus_monotonic();
        if let Some(series) = &mut self.files.series {
            series.set_time(wall_clock_ns());
        }
        let mut most = 0;
        self.drain_ticks(offset);
        for bus in 0..self.feed.bus_feeds.len() {
            most = most.max(self.drain_frames(bus));
            self.drain_contacts(bus);
        }
        for (nanos, text) in self.notes.try_iter() {
            self.files.write_note(nanos, None, NoteKind::Text, &text);
        }
        most
    }

    fn drain_frames(&mut self, bus: usize) -> usize {
        let (Some(bus_feed), Some(seen), Some(name)) =
            (self.feed.bus_feeds.get_mut(bus), self.buses.get_mut(bus), self.layout.buses.get(bus))
        else {
            return 0;
        };
        // Leave items that arrive meanwhile to the next round, so that the other queues are served.
        let waiting = bus_feed.frames.slots();
        let Ok(waiting) = bus_feed.frames.read_chunk(waiting) else { return 0 };
        let taken = waiting.len();
        for captured in waiting {
            match captured {
                CapturedItem::Frame(frame) => {
                    seen.frames += 1;
                    seen.latched.receive(frame);
                    seen.missing += u64::from(self.files.is_between_files());
                    self.files.write_candump(|text| text.add_frame(name, &frame));
                    self.files.write_mcap(MessageCount::ONE_FRAME, |window, topics| {
                        topics.write_frame(window, bus, name, &frame)
                    });
                }
                CapturedItem::Dropped { at_nanos, frames } => {
                    seen.dropped += frames;
                    let place = format!("CAN frames on '{name}' socket");
                    self.files.note_dropped_frames(at_nanos, Some((bus, name)), frames, &place, seen.dropped);
                }
                CapturedItem::Bus { at_nanos, what } => {
                    let line = what.text(name);
                    self.files.write_candump(|text| text.add_note_line(&format!("# {line}")));
                    self.files.write_note(at_nanos, Some((bus, name)), NoteKind::Text, &line);
                }
                CapturedItem::Unrecorded { at_nanos, frames } => {
                    seen.unrecorded += frames;
                    let place = format!("CAN frames on '{name}' in the queue to the recorder");
                    self.files.note_dropped_frames(
                        at_nanos,
                        Some((bus, name)),
                        frames,
                        &place,
                        seen.unrecorded,
                    );
                }
            }
        }
        taken
    }

    fn drain_ticks(&mut self, offset: i64) {
        let Some(ticks) = &mut self.feed.ticks else { return };
        while let Ok(timed) = ticks.pop() {
            self.q = Some(timed.record.q);
            self.ticks += 1;
            self.ticks_skipped += timed.record.skipped;
            self.max_late_ns = self.max_late_ns.max(timed.late_ns);
            let nanos = timed.due_ns.saturating_add_signed(offset);
            let layout = &self.layout;
            if !mem::replace(&mut self.start_is_written, true)
                && let Some(series) = &mut self.files.series
            {
                let since = timed.record.tick.number.saturating_mul(layout.tick_ns);
                series.add_metadata(RUN_METADATA, run_metadata(nanos.saturating_sub(since)));
            }
            let messages = 4 + u64::from(layout.records_poses_at(timed.record.tick.number));
            self.files.write_mcap(MessageCount::other_messages(messages), |window, topics| {
                topics.write_tick(window, layout, nanos, &timed)
            });
        }
    }

    fn drain_contacts(&mut self, bus: usize) {
        let (Some(bus_feed), Some(seen)) = (self.feed.bus_feeds.get_mut(bus), self.buses.get_mut(bus)) else {
            return;
        };
        let Some(queue) = &mut bus_feed.touched else { return };
        while let Ok(touched) = queue.pop() {
            let cloud = seen.epochs.is_multiple_of(self.layout.epochs_per_cloud);
            let q = self.q.as_ref().filter(|_| cloud);
            seen.epochs += 1;
            let patches = self.layout.patches.iter().enumerate().filter(|(_, patch)| patch.bus == bus);
            for (place, _) in patches {
                let messages = if q.is_some() { 2 } else { 1 };
                self.files.write_mcap(MessageCount::other_messages(messages), |window, topics| {
                    topics.write_patch(window, &self.layout, place, &touched, q, &mut self.scratch)
                });
            }
        }
    }

    /// Records new drops in the kernel's backlog; their bus is unknown.
    fn record_backlog(&mut self) {
        let (Some(total), Some(before)) = (backlog::dropped_packets(), self.backlog) else { return };
        let frames = total.saturating_sub(before);
        self.backlog = Some(total);
        if frames > 0 {
            let place = "packets of any network in the kernel's backlog";
            self.files.note_dropped_frames(wall_clock_ns(), None, frames, place, total);
        }
    }

    fn record_diagnostics(&mut self) {
        let Some(series) = &mut self.files.series else { return };
        let mut parts = vec![Diagnosis {
            level: if self.ticks_skipped > 0 { DiagnosisLevel::Warn } else { DiagnosisLevel::Ok },
            name: "gateway: control loop".to_owned(),
            message: if self.ticks_skipped > 0 { "ticks were skipped" } else { "ticks on time" }.to_owned(),
            values: vec![
                ("ticks", mem::take(&mut self.ticks).to_string()),
                ("skipped", mem::take(&mut self.ticks_skipped).to_string()),
                ("max_late_us", (mem::take(&mut self.max_late_ns) / 1_000).to_string()),
            ],
        }];
        let buses = self.feed.bus_feeds.iter().zip(&self.layout.buses).zip(&self.buses);
        parts.extend(buses.map(|((bus_feed, name), seen)| diagnose_bus(bus_feed, name, seen)));
        let lost = series.lost_messages();
        let unrecorded: u64 = self.buses.iter().map(|bus| bus.unrecorded).sum();
        let all_well = lost.frames + lost.others + unrecorded == 0;
        parts.push(Diagnosis {
            level: if all_well { DiagnosisLevel::Ok } else { DiagnosisLevel::Error },
            name: "gateway: recorder".to_owned(),
            message: if all_well { "all data was recorded" } else { "some data was not recorded" }.to_owned(),
            values: vec![
                ("bytes", series.bytes().to_string()),
                ("frames_not_written", lost.frames.to_string()),
                ("others_not_written", lost.others.to_string()),
                ("frames_queue_full", unrecorded.to_string()),
                ("messages_late", series.late_messages().to_string()),
            ],
        });
        let now = wall_clock_ns();
        series.add_messages(MessageCount::other_messages(1), |window, topics| {
            topics.write_diagnostics(window, now, &parts)
        });
    }

    fn flush(&mut self) {
        self.files.write_candump(CandumpWriter::flush);
        let Some(series) = &mut self.files.series else { return };
        // Both segments of a packet to the cells must be in one file.
        let now = wall_clock_ns();
        let holds = self.buses.iter().any(|bus| bus.latched.is_within_a_packet(now));
        if !series.flush_due_messages(holds) || !series.begin_next(|writer| Topics::new(writer, &self.layout))
        {
            return;
        }
        // Each file must be readable without the one before it, so it begins with these frames. Items queued before
        // went into the former file.
        let began = now.saturating_sub(REORDER_WINDOW_NS);
        write_robot(series, &self.layout, began);
        for (bus, (name, seen)) in self.layout.buses.iter().zip(&self.buses).enumerate() {
            for frame in seen.latched.frames() {
                series.add_messages(MessageCount::other_messages(1), |window, topics| {
                    topics.write_latched_frame(window, began, (bus, name), &frame);
                });
            }
        }
        series.write_waiting();
        for (bus, (name, seen)) in self.layout.buses.iter().zip(&mut self.buses).enumerate() {
            let frames = mem::take(&mut seen.missing);
            if frames > 0 {
                let place = format!("CAN frames on '{name}' while nothing could be written");
                // The log contains these frames.
                let line = dropped_frames_line(frames, &place, frames);
                self.files.write_note(wall_clock_ns(), Some((bus, name)), NoteKind::Dropped(frames), &line);
            }
        }
    }

    /// Sends new errors to the user.
    fn send_messages(&mut self) {
        let OutputFiles { series, errors, .. } = &mut self.files;
        errors.extend(series.iter_mut().flat_map(SplitRecording::drain_events));
        for line in errors.get(self.reported..).unwrap_or_default() {
            // At the end of the run the receiver is gone.
            let _ = self.messages.send(line.to_string());
        }
        self.reported = errors.len();
    }

    /// Ends the recording of a run that never began. Removes all outputs except a candump log that contains frames.
    fn discard(mut self) -> RecordingAccount {
        if let Some(series) = &mut self.files.series {
            series.discard();
        }
        let files: Vec<_> = self.files.text.and_then(CandumpWriter::discard).into_iter().collect();
        RecordingAccount {
            frames: files.iter().map(|file| file.frames).sum(),
            files,
            ..RecordingAccount::default()
        }
    }

    fn finish(mut self) -> RecordingAccount {
        let mut recording = RecordingAccount::default();
        let mut lost = 0;
        if let Some(mut series) = self.files.series.take() {
            let (files, unwritten) = series.finish();
            recording.files = files;
            recording.messages_late = series.late_messages();
            lost = unwritten.frames;
            if unwritten.others > 0 {
                recording.messages_lost.insert("unwritten", unwritten.others);
            }
            self.files.errors.extend(series.drain_events());
        }
        if let Some(text) = self.files.text.take() {
            let path = text.path().display().to_string();
            let (file, unwritten, finished) = text.finish();
            recording.files.extend(file);
            lost = lost.max(unwritten);
            // Earlier errors have been reported during the run.
            if let Err(error) = finished {
                self.files.errors.push(RecordingEvent::Other(format!("{path}: {error}")));
            }
        }
        self.send_messages();
        let offered: u64 = self.buses.iter().map(|bus| bus.frames).sum();
        recording.frames = offered.saturating_sub(lost);
        recording.lost_write = lost;
        recording.lost = lost;
        let spent = Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap_or_default();
        recording.processor_s = spent.as_secs_f64();
        recording.errors = self.files.errors.iter().map(|said| said.description().to_owned()).collect();
        recording
    }
}

impl OutputFiles {
    /// Returns true between the end of one file of a recording and the start of the next.
    fn is_between_files(&self) -> bool {
        self.series.as_ref().is_some_and(|series| !series.is_open())
    }

    /// Writes to the candump log, if there is one.
    fn write_candump(&mut self, write: impl FnOnce(&mut CandumpWriter) -> io::Result<()>) {
        if let Some(text) = &mut self.text
            && let Err(error) = write(text)
        {
            let what = format!("{}: {error}", text.path().display());
            self.errors.push(if text.has_ended() {
                RecordingEvent::BrokeOff(what)
            } else {
                RecordingEvent::Other(what)
            });
        }
    }

    /// Writes to the MCAP recording, if there is one.
    fn write_mcap(&mut self, count: MessageCount, write: impl FnOnce(&mut ReorderWindow, &mut Topics)) {
        if let Some(series) = &mut self.series {
            series.add_messages(count, write);
        }
    }

    /// Notes in all outputs that `frames` frames are missing at this point. `place` says where they were lost, `total`
    /// is the number of frames lost there so far, and `bus` is their bus, if known.
    fn note_dropped_frames(
        &mut self,
        nanos: u64,
        bus: Option<(usize, &str)>,
        frames: u64,
        place: &str,
        total: u64,
    ) {
        let line = dropped_frames_line(frames, place, total);
        self.write_candump(|text| text.add_note_line(&line));
        self.write_note(nanos, bus, NoteKind::Dropped(frames), &line);
    }

    /// Adds a note to the MCAP recording only.
    fn write_note(&mut self, nanos: u64, bus: Option<(usize, &str)>, kind: NoteKind, line: &str) {
        let (bus, interface) = bus.unzip();
        let interface = interface.unwrap_or_default();
        let note = CaptureNote { kind, nanos, interface, line: 0, text: line.as_bytes() };
        let one = MessageCount::other_messages(1);
        self.write_mcap(one, |window, topics| topics.write_note(window, bus, &note));
    }
}

/// Writes the robot's description, once per file.
fn write_robot(series: &mut SplitRecording<Topics>, layout: &Layout, nanos: u64) {
    if layout.robot.is_some() {
        series.add_messages(MessageCount::other_messages(ROBOT_MESSAGE_COUNT), |window, topics| {
            topics.write_robot(window, layout, nanos)
        });
    }
}

fn dropped_frames_line(frames: u64, place: &str, total: u64) -> String {
    format!("DROPCOUNT: dropped {frames} {place} (total drops {total})")
}

/// Returns the diagnosis of a bus for the diagnostics topic.
fn diagnose_bus(bus_feed: &BusFeed, name: &str, seen: &BusRecord) -> Diagnosis {
    let (mut cells, mut silent) = (0, 0);
    if let Ok(view) = bus_feed.view.lock() {
        cells = view.cells.len();
        silent = view.cells.iter().filter(|cell| !cell.seen || cell.dead).count();
    }
    let works = bus_feed.state.is_working();
    BusHealth { works, cells, silent, frames: seen.frames, dropped: seen.dropped }.diagnosis(name)
}
