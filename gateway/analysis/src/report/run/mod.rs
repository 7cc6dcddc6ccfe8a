//! A report on a run, from its recording: read once from beginning to end, in bounded memory.
//!
//! ```text
//!   /ROBOT/…, /gateway/timing ─> motion ─┐
//!   /can/BUS ─┬> BusFigures (a Table each)┼─> page
//!             └> Shadow ─────────────────┤
//!   metadata, /can/notes ────────────────┘
//! ```
//!
//! A recording contains the frames, but no counts of replies, losses and errors. The frames pass through the same
//! [`BusTable`](model::table::BusTable) as in the gateway, and so give the same accounts. The load of a real bus is
//! that of `skinbus fit` for the same recording.

mod bus_figures;
mod frames_only;
mod moments;
mod motion;
mod page;
mod touched;

use std::path::{Path, PathBuf};

use protocol::skin::{Skin, SkinBus};
use protocol::wire_time::BitRatesError;
use thiserror::Error;

use super::figure::Page;
use crate::fit::rates::{ChosenRates, RequestedRates};
use crate::shadow::{self, Shadow};
use bus_figures::BusFigures;
use frames_only::FramesOnlyCapture;
use motion::TickSeries;
use trace::capture::{
    CaptureEntry, CaptureError, CaptureFormat, CaptureNote, NoteKind, OtherMessage, Reader, RecordingExtras,
    RecordingItem, SKIN_ATTACHMENT, seconds_since,
};
use trace::recording::layout::Layout;
use trace::ros2::read;

/// The error of making a report on a recording.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReportError {
    /// The recording cannot be opened, or the file is not a recording.
    #[error(transparent)]
    Open(CaptureError),
    /// The recording cannot be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The capture has frames only, and the options do not name its skin.
    #[error(
        "{name} is a candump log, which contains only frames: name the skin with --skin, or make a recording, which \
         contains the skin, with `skinbus run SKIN --record run.mcap`"
    )]
    Log {
        /// Name of the capture.
        name: String,
    },
    /// The capture has only frames that a report cannot use.
    #[error("{name} {what}")]
    Frames {
        /// Name of the capture.
        name: String,
        /// The reason and the remedy, as the rest of a sentence.
        what: String,
    },
    /// The skin in the options differs from the one in the recording.
    #[error("{name} was recorded with a different skin")]
    OtherSkin {
        /// Name of the recording.
        name: String,
        /// The skin that is attached to the recording.
        recorded: Box<Skin>,
    },
    /// The recording is from another program, or is empty.
    #[error(
        "{name} contains no run: {what}; record one with `skinbus run SKIN --record run.mcap`{}",
        if *.has_skin { "" } else { ", or name the skin of a capture with --skin" }
    )]
    Foreign {
        /// Name of the recording.
        name: String,
        /// The part that is missing.
        what: String,
        /// True if the options name a skin.
        has_skin: bool,
    },
    /// The recording ends before the first data of a run.
    #[error("{name} contains no run that can be shown: {what}")]
    Unfinished {
        /// Name of the recording.
        name: String,
        /// The part that is missing.
        what: String,
    },
    /// CAN does not allow the bit rates.
    #[error("{bus}: {source}; correct --nominal or --data")]
    Rates {
        /// Name of the bus.
        bus: String,
        /// The limit that the rates violate.
        source: BitRatesError,
    },
}

/// A report, with warnings about its recording.
#[derive(Clone, Debug, PartialEq)]
pub struct RunReport {
    /// Contents of the report.
    pub page: Page,
    /// A sentence about the missing end, if the recording is cut off or damaged.
    pub missing: Option<String>,
    /// True if the recording is damaged, so that the report covers only the part before the damage.
    pub is_damaged: bool,
    /// Name of the recording.
    pub name: String,
    /// Warnings for standard error about a capture with frames only: missing parts, and other remarks.
    pub remarks: Vec<String>,
}

/// Options of a report.
#[derive(Clone, Debug, Default)]
pub struct ReportOptions {
    /// The command, as shown on the page.
    pub command: String,
    /// Nominal bit rate of all buses in bit/s, replacing the skin's.
    pub nominal: Option<u32>,
    /// Data bit rate of FD frames in bit/s, replacing the skin's.
    pub data: Option<u32>,
    /// The skin of a capture with frames only, and its file.
    pub skin: Option<(PathBuf, Skin)>,
}

impl ReportOptions {
    /// Returns where the bit rates of a bus come from: the names of the options, or the key in the skin; `None` for
    /// defaults.
    fn rates_origin(&self, bus: &SkinBus) -> Option<&'static str> {
        match (self.nominal, self.data, bus.bitrate) {
            (Some(_), Some(_), _) => Some("--nominal, --data"),
            (Some(_), None, _) => Some("--nominal"),
            (None, Some(_), _) => Some("--data"),
            (None, None, Some(_)) => Some("skin: bitrate"),
            (None, None, None) => None,
        }
    }

    /// Returns the bit rates for which the load of a bus is computed.
    fn rates(&self, bus: &SkinBus) -> Result<ChosenRates, ReportError> {
        let rates = RequestedRates { nominal: self.nominal, data: self.data }.for_bus(bus);
        rates.map_err(|source| ReportError::Rates { bus: bus.name.clone(), source })
    }
}

/// Reads a recording, whose parts are given in order, and creates its report.
///
/// # Errors
/// Returns [`ReportError`] if the files are not a recording of a run, if they contain no run, or if CAN does not allow
/// the bit rates.
pub fn report(paths: &[PathBuf], options: &ReportOptions) -> Result<RunReport, ReportError> {
    let (run, broken, is_damaged) = read_recording(paths, options)?;
    let missing = broken.map(|why| run.early_end_sentence(&why));
    let page = page::report_page(&run, &options.command, missing.as_deref());
    let is_frames_only = run.frames_only.is_some();
    let lacking = is_frames_only.then(|| format!("the capture does not contain: {}", run.missing_parts()));
    let remarks = lacking.into_iter().chain(run.remarks).collect();
    Ok(RunReport { page, missing, is_damaged, name: run.name, remarks })
}

/// Checks that the files are recordings, without reading them to the end.
///
/// # Errors
/// Returns [`ReportError`] if a file is not a recording, or cannot be opened.
pub fn check_recordings(paths: &[PathBuf], options: &ReportOptions) -> Result<(), ReportError> {
    open_recording(paths, options).map(drop)
}

/// Opens a recording. Also returns the size of its files in bytes, if known.
fn open_recording(paths: &[PathBuf], options: &ReportOptions) -> Result<(Reader, Option<u64>), ReportError> {
    let mut items = Reader::open_with_all_topics(paths).map_err(ReportError::Open)?;
    let name = items.name().to_owned();
    let bytes =
        |path: &PathBuf| path.metadata().ok().filter(std::fs::Metadata::is_file).map(|about| about.len());
    let bytes = paths.iter().map(bytes).sum::<Option<u64>>();
    if items.format() == CaptureFormat::Candump && (options.skin.is_none() || bytes == Some(0)) {
        let empty = bytes == Some(0);
        // A text of another kind would be refused with a skin, too.
        if bytes.is_some()
            && !items.has_frame()?
            && let Some((kind, hint)) = items.text_kind()
        {
            let what = format!("is {kind}, not a candump log or MCAP recording: {hint}");
            return Err(ReportError::Frames { name, what });
        }
        return Err(if empty {
            ReportError::Foreign { name, what: "it is empty".to_owned(), has_skin: options.skin.is_some() }
        } else {
            ReportError::Log { name }
        });
    }
    Ok((items, bytes))
}

/// Reads the whole recording. Also returns the reason why it ends early, if it does, and true if that is damage.
fn read_recording(
    paths: &[PathBuf],
    options: &ReportOptions,
) -> Result<(RunData, Option<String>, bool), ReportError> {
    let (mut items, bytes) = open_recording(paths, options)?;
    let name = items.name().to_owned();
    // The header is known once the file is open, unless the file is damaged; then the damage is the reason.
    let begun = RunData::from_extras(&name, bytes.unwrap_or(0), (items.format(), items.extras()), options);
    while begun.is_err() && items.extras().skin().is_none() && items.next_item()?.is_some() {}
    let mut run = begun?;
    run.files = paths.to_vec();
    let damaged = loop {
        match items.next_item() {
            Ok(Some(item)) => run.receive_item(&item),
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
    };
    run.finish();
    let unfinished = items.extras().unfinished.clone();
    if run.frames_only.is_some() {
        run.remarks = items.remarks();
        if let Some(what) = run.unusable_reason(&items).filter(|_| damaged.is_none()) {
            return Err(ReportError::Frames { name, what });
        }
    }
    if run.is_empty() {
        let nothing = || "it contains no ticks and no frames of the buses in its skin".to_owned();
        return Err(match damaged {
            Some(error) => error.into(),
            None => match unfinished {
                Some(what) => ReportError::Unfinished { name, what },
                None => ReportError::Foreign { name, what: nothing(), has_skin: options.skin.is_some() },
            },
        });
    }
    let is_damaged = damaged.is_some();
    Ok((run, damaged.map(|error| error.to_string()).or(unfinished), is_damaged))
}

/// Creates the timing model of the real buses for which the load is computed.
fn create_shadow(skin: &Skin, bus_figures: &[BusFigures], timed_buses: Vec<String>) -> Shadow {
    let rates = RequestedRates::default().rates().expect("the default rates are valid");
    let of_bus =
        bus_figures.iter().map(|bus_figures| (bus_figures.name.clone(), bus_figures.rates.rates)).collect();
    let options = shadow::ShadowOptions {
        rates_by_bus: of_bus,
        each_frame: true,
        stamped_at_end: shadow::StampedAtEnd::Named(timed_buses),
        skin: Some(skin.clone()),
        ..shadow::ShadowOptions::new(rates)
    };
    Shadow::new(options).expect("a bit-error rate of 0 is valid")
}

/// The content of a recording, as far as it has been read.
#[derive(Debug)]
struct RunData {
    skin: Skin,
    /// Path of the recording; the next field is the size of its files in bytes.
    name: String,
    bytes: u64,
    /// Metadata records by name.
    metadata: Vec<(String, Vec<(String, String)>)>,
    /// The topics of joints and of torques.
    topics: [String; 2],
    /// The recording's files, in the given order.
    files: Vec<PathBuf>,
    /// Time of the first message, in ns since 1970.
    began: Option<u64>,
    /// Time that counts as 0 s in commands, in s after the first message: the first tick of the run, or else the first
    /// frame.
    zero: Option<f64>,
    /// Start of the loop, in ns since 1970, if the recording has it.
    run_began: Option<u64>,
    motion: TickSeries,
    bus_figures: Vec<BusFigures>,
    shadow: Shadow,
    /// Number of packets, of any network, that the kernel dropped before they reached their sockets.
    backlog: u64,
    /// Number of frames on buses that are not in the skin, and the name of the first such bus.
    others: u64,
    other_bus: Option<String>,
    /// Number of messages that do not match the type of their topic.
    unreadable: u64,
    /// The additional state for a capture with frames only.
    frames_only: Option<FramesOnlyCapture>,
    /// Warnings about a capture with frames only.
    remarks: Vec<String>,
}

impl RunData {
    fn from_extras(
        name: &str,
        bytes: u64,
        (format, extras): (CaptureFormat, &RecordingExtras),
        options: &ReportOptions,
    ) -> Result<Self, ReportError> {
        let has_skin = options.skin.is_some();
        let foreign = |what: String| ReportError::Foreign { name: name.to_owned(), what, has_skin };
        let recorded = extras.skin();
        let skin_file = options.skin.as_ref().map_or_else(|| Path::new(""), |(file, _)| file.as_path());
        let is_log = format == CaptureFormat::Candump;
        let frames_only = recorded.is_none().then(|| FramesOnlyCapture::new(is_log, skin_file));
        let Some(skin) = recorded.or_else(|| options.skin.clone().map(|(_, skin)| Ok(skin))) else {
            let what = format!("it has no attachment {SKIN_ATTACHMENT}");
            return Err(match &extras.unfinished {
                Some(why) => {
                    ReportError::Unfinished { name: name.to_owned(), what: format!("{what} ({why})") }
                }
                None => foreign(what),
            });
        };
        let skin = skin.map_err(|error| foreign(format!("the attached {error}")))?;
        if options.skin.as_ref().is_some_and(|(_, given)| *given != skin) {
            return Err(ReportError::OtherSkin { name: name.to_owned(), recorded: Box::new(skin) });
        }
        let layout = Layout::new(&skin);
        let buses = skin.buses.iter().enumerate();
        let bus_figures = buses.map(|(at, bus)| {
            let rates = (options.rates(bus)?, options.rates_origin(bus));
            Ok(BusFigures::new(&skin, at, rates, frames_only.is_some()))
        });
        let mut bus_figures = bus_figures.collect::<Result<Vec<_>, ReportError>>()?;
        let timed_buses = extras.timed_buses().map(str::to_owned).collect();
        let mut shadow = create_shadow(&skin, &bus_figures, timed_buses);
        for before in &extras.latched {
            shadow.receive_latched(&before.bus, before.nanos, &before.frame);
            if let Some(bus_figures) = skin.bus_index(&before.bus).and_then(|bus| bus_figures.get_mut(bus)) {
                bus_figures.receive_latched(before);
            }
        }
        bus_figures.iter_mut().for_each(BusFigures::begin_counting);
        Ok(Self {
            topics: ["joint_states", "torques"].map(|topic| format!("/{}/{topic}", layout.arm)),
            motion: TickSeries::new(layout.joints.len()),
            name: name.to_owned(),
            bytes,
            metadata: extras.metadata.clone(),
            skin,
            files: Vec::new(),
            began: None,
            zero: None,
            run_began: extras.run_began(),
            bus_figures,
            shadow,
            backlog: 0,
            others: 0,
            other_bus: None,
            unreadable: 0,
            frames_only,
            remarks: Vec::new(),
        })
    }

    fn receive_item(&mut self, item: &RecordingItem<'_>) {
        match item {
            RecordingItem::Entry(CaptureEntry::Frame(record)) => {
                let at = self.seconds_since_start(record.time.nanos);
                let zero = self.run_began.map_or(at, |nanos| self.seconds_since_start(nanos));
                self.zero.get_or_insert(zero);
                let bus = self.skin.bus_index(record.interface);
                match bus.and_then(|bus| Some((bus, self.bus_figures.get_mut(bus)?))) {
                    Some((bus, bus_figures)) => {
                        let effect = bus_figures.receive_frame(at, record);
                        if let Some(frames_only) = &mut self.frames_only {
                            frames_only.began.get_or_insert(record.time.nanos);
                            let so_far = (&self.skin, self.bus_figures.as_slice());
                            frames_only.receive_frame((at, bus, effect), so_far, &mut self.motion);
                        }
                        self.shadow.receive(record.interface, record.time.nanos, &record.frame);
                        self.add_real_load();
                    }
                    None => {
                        self.others += 1;
                        self.other_bus.get_or_insert_with(|| record.interface.to_owned());
                    }
                }
            }
            RecordingItem::Entry(CaptureEntry::Note(note)) => self.receive_note(note),
            // Without its skin, these are not read, and are reported as missing.
            RecordingItem::Other(other) if self.frames_only.is_none() => self.receive_message(other),
            RecordingItem::Other(_) => {}
        }
    }

    fn receive_note(&mut self, note: &CaptureNote<'_>) {
        match note.kind {
            NoteKind::Dropped(frames) => {
                match self.skin.bus_index(note.interface).and_then(|bus| self.bus_figures.get_mut(bus)) {
                    Some(bus_figures) => bus_figures.dropped = bus_figures.dropped.saturating_add(frames),
                    None => self.backlog = self.backlog.saturating_add(frames),
                }
            }
            NoteKind::Unreadable(_) => self.unreadable += 1,
            NoteKind::Text | NoteKind::CanXl => {}
        }
    }

    fn receive_message(&mut self, other: &OtherMessage<'_>) {
        let at = self.seconds_since_start(other.nanos);
        let [states, torques] = &self.topics;
        let taken = if other.topic == states {
            read::decode_joints(other.message).map(|joints| self.motion.record_joints(at, &joints))
        } else if other.topic == torques {
            read::decode_torques(other.message).map(|torques| self.motion.record_torques(at, &torques))
        } else if other.topic == "/gateway/timing" {
            read::decode_loop_timing(other.message).map(|timing| self.motion.record_timing(at, &timing))
        } else {
            Ok(())
        };
        self.unreadable += u64::from(taken.is_err());
    }

    /// Converts a time in ns since 1970 to s after the first message.
    fn seconds_since_start(&mut self, nanos: u64) -> f64 {
        seconds_since(*self.began.get_or_insert(nanos), nanos)
    }

    /// Adds the frames whose load on the real bus the timing model has computed.
    fn add_real_load(&mut self) {
        while let Some(frame) = self.shadow.poll() {
            let at = self.seconds_since_start(frame.nanos);
            let bus = frame.bus.and_then(|bus| self.skin.bus_index(self.shadow.bus(bus)));
            let bus_figures = bus.and_then(|bus| self.bus_figures.get_mut(bus));
            bus_figures.into_iter().for_each(|bus_figures| bus_figures.add_real_load(at, frame.bits));
        }
    }

    fn finish(&mut self) {
        self.bus_figures.iter_mut().for_each(BusFigures::finish);
        self.shadow.finish();
        self.add_real_load();
        if let Some(frames_only) = &self.frames_only {
            frames_only.finish(&mut self.motion);
        }
    }

    /// Returns true if a capture with frames only has joints.
    fn has_joints(&self) -> bool {
        self.frames_only.is_some() && self.bus_figures.iter().any(|bus_figures| bus_figures.joints.is_some())
    }

    /// Returns the parts that a report on this capture with frames only lacks, as a list in words.
    fn missing_parts(&self) -> String {
        let missing = self.frames_only.as_ref().map(|it| it.missing_parts(&self.bus_figures, &self.motion));
        missing.unwrap_or_default().join("; ")
    }

    /// Returns the reason why a capture with frames only cannot be reported, as the rest of a sentence; `None` if it
    /// can.
    fn unusable_reason(&self, items: &Reader) -> Option<String> {
        if !items.has_times() {
            return Some(
                "has lines without time stamps, which a report needs: make the log with `candump -L`"
                    .to_owned(),
            );
        }
        if self.bus_figures.iter().any(|bus_figures| bus_figures.frames > 0) {
            return None;
        }
        let buses: Vec<_> = self.skin.buses.iter().map(|bus| bus.name.as_str()).collect();
        Some(match (&self.other_bus, items.text_kind()) {
            (Some(other), _) => {
                format!(
                    "has no frame of the skin's buses ({}): its frames are from {other}; name the skin that has this bus",
                    buses.join(", ")
                )
            }
            (None, Some((what, hint))) => format!("is {what}, not a candump log or MCAP recording: {hint}"),
            (None, None) => "contains no frame: expected a log as `candump -L` writes it".to_owned(),
        })
    }

    fn is_empty(&self) -> bool {
        self.motion.counts.ticks == 0 && self.bus_figures.iter().all(|bus_figures| bus_figures.frames == 0)
    }

    /// Returns a value from the recording's metadata, by record and key.
    fn metadata_value(&self, record: &str, key: &str) -> Option<&str> {
        let (_, facts) = self.metadata.iter().find(|(name, _)| name == record)?;
        facts.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
    }

    /// Returns a sentence about a recording that ends early; `why` is the reason.
    fn early_end_sentence(&self, why: &str) -> String {
        let here = self.motion.duration_s();
        let planned =
            self.metadata_value("configuration", "duration_s").and_then(|text| text.parse::<f64>().ok());
        let lacks = planned.filter(|planned| *planned > here).map_or_else(String::new, |planned| {
            format!(" of the planned {planned} s: {:.2} s are missing", planned - here)
        });
        format!("{why}. The recording covers {here:.2} s{lacks}")
    }
}
