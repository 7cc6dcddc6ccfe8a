//! Traffic on real buses: `skinbus fit` for captures and live buses.

mod show;

use std::io::{self, BufWriter, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use analysis::fit::rates::RequestedRates;
use analysis::shadow::{self, Shadow, StampedAtEnd};
use protocol::bus::{BusError, BusOptions};
use protocol::skin::Skin;
use protocol::stop::{self, InterruptibleWriter};
use protocol::usage::{Failure, ignore_broken_pipe, print_text};
use trace::capture::{CaptureEntry, NoteKind, Reader};

use self::show::write_frames;
use super::{FitCommand, TimeStamps};
use crate::input::{
    self, BusReceiver, LossCounts, POLL_TIMEOUT, is_file, location, no_frame_failure, note_skin_difference,
    open_capture, skin_found_so_far, stop_flag,
};
use crate::output;
use crate::print::comma_separated;

/// Size of the receive buffer in bytes, for frames that wait while others are processed.
const RECEIVE_BUFFER_BYTES: usize = 8 << 20;

/// Result of reading the traffic from a capture or from buses.
struct TrafficInput {
    /// Name of the kind of source.
    what: &'static str,
    /// Number of frames that the recorder lost.
    missing: u64,
    /// Error that ended the input early, if any.
    ended: Result<(), Failure>,
}

impl FitCommand {
    /// Computes and prints for each frame when it would be sent on a bus with bit rates.
    pub(super) fn print_traffic_fit(&self) -> Result<(), Failure> {
        let skin = self.skin.as_deref().map(Skin::read).transpose().map_err(Failure::usage_error)?;
        if let (Some(path), Some(skin)) = (&self.skin, &skin) {
            note_skin_difference(&self.sources, path, skin);
        }
        let mut out = BufWriter::new(InterruptibleWriter::new(io::stdout()));
        let name = comma_separated(self.sources.iter().map(|source| source.display()));
        let mut title = name.clone();
        let mut run_began = None;
        let (mut shadow, taken) = if self.are_captures(&name)? {
            let reader = open_capture(&self.sources, |file| Box::new(file))?;
            reader.name().clone_into(&mut title);
            let skin = skin.or_else(|| skin_found_so_far(&reader, "name one with --skin"));
            let timed_buses = reader.extras().timed_buses().map(str::to_owned).collect();
            let mut shadow = self.create_shadow(skin, timed_buses)?;
            for before in &reader.extras().latched {
                shadow.receive_latched(&before.bus, before.nanos, &before.frame);
            }
            run_began = reader.extras().run_began();
            let taken = pass_capture(reader, &mut shadow, &mut out)?;
            (shadow, taken)
        } else {
            let stopped = stop_flag()?;
            let kinds = self.kinds.kinds_of_any_buses()?;
            let options = BusOptions { receive_buffer: RECEIVE_BUFFER_BYTES, ..BusOptions::default() };
            let receive_ends = input::open_bus_receivers(&self.sources, &kinds, None, &options, None)?;
            let buses = receive_ends.iter().map(BusReceiver::bus).filter(|bus| bus.is_timed());
            let timed_buses = buses.map(|bus| bus.name().to_owned()).collect();
            let mut shadow = self.create_shadow(skin, timed_buses)?;
            let taken = self.receive_live_traffic(receive_ends, &mut shadow, &mut out, &stopped)?;
            (shadow, taken)
        };
        shadow.finish();
        ignore_broken_pipe(write_frames(&mut shadow, &mut out).and_then(|()| out.flush()))?;
        drop(out);
        let mut report = shadow.report();
        for bus in &mut report.buses {
            bus.zero_ns = run_began.unwrap_or(bus.zero_ns);
        }
        for (bus, _) in &self.rates {
            if report.buses.iter().all(|it| it.bus != *bus) {
                output::print_note(format_args!("--rates {bus}=…: {name} contains no frame of bus {bus}"));
            }
        }
        if !self.json && report.frames > 0 {
            print_text(&show::format_report(&title, taken.what, taken.missing, &report))?;
        }
        taken.ended
    }

    /// Returns true if the sources are captures, false if they are buses.
    fn are_captures(&self, name: &str) -> Result<bool, Failure> {
        match self.sources.iter().filter(|source| is_file(source)).count() {
            0 => return Ok(false),
            files if files < self.sources.len() => {
                return Err(Failure::usage_error(format!(
                    "{name}: files and buses cannot be mixed: name one file, the parts of one recording, or only buses"
                )));
            }
            _ => {}
        }
        if self.duration.is_some() {
            return Err(Failure::usage_error(format!(
                "--duration is only for live buses, but {name} is a file: leave it out"
            )));
        }
        self.sources.iter().find(|source| source.is_dir()).map_or(Ok(true), |folder| {
            Err(Failure::usage_error(format!(
                "{} is a directory: name a candump log, an MCAP recording or a bus",
                folder.display()
            )))
        })
    }

    /// Creates the model of the buses with the bit rates of the command line, or else those of the skin, or else common
    /// ones.
    fn create_shadow(&self, skin: Option<Skin>, timed_buses: Vec<String>) -> Result<Shadow, Failure> {
        let requested = RequestedRates { nominal: self.nominal, data: self.data };
        let mut of_bus = self.rates.clone();
        for bus in skin.iter().flat_map(|skin| &skin.buses) {
            let rates = requested.for_bus(bus);
            let rates =
                rates.map_err(|error| Failure::usage_error(format!("bus {}: {error}", bus.name)))?.rates;
            of_bus.push((bus.name.clone(), rates));
        }
        let options = shadow::ShadowOptions {
            rates_by_bus: of_bus,
            bit_errors: self.ber.unwrap_or_default(),
            seed: self.seed.unwrap_or(1),
            each_frame: self.json,
            bench_traffic: self.bench_traffic,
            stamped_at_end: match self.time_stamps {
                Some(TimeStamps::End) => StampedAtEnd::All,
                Some(TimeStamps::Request) => StampedAtEnd::default(),
                None => StampedAtEnd::Named(timed_buses),
            },
            skin,
            ..shadow::ShadowOptions::new(requested.rates().map_err(Failure::usage_error)?)
        };
        Shadow::new(options).map_err(|error| Failure::usage_error(format!("--ber: {error}")))
    }

    /// Receives from buses until a signal, and passes the frames to the model.
    fn receive_live_traffic(
        &self,
        mut receive_ends: Vec<BusReceiver>,
        shadow: &mut Shadow,
        out: &mut impl Write,
        stopped: &AtomicBool,
    ) -> Result<TrafficInput, Failure> {
        let length = self.duration.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
        let end = length.map(|length| Instant::now() + length);
        let mut ended = Ok(());
        while ended.is_ok() && !stopped.load(Ordering::Relaxed) && end.is_none_or(|end| Instant::now() < end)
        {
            input::wait(&receive_ends, POLL_TIMEOUT)?;
            for receive_end in &mut receive_ends {
                if let Err(error) = pass_frames(receive_end, shadow) {
                    ended = Err(Failure::run_error(error));
                }
            }
            if let Err(error) = write_frames(shadow, out).and_then(|()| out.flush()) {
                ignore_broken_pipe(Err(error))?;
                break;
            }
        }
        let mut missing = 0;
        for receive_end in &receive_ends {
            let lost = receive_end.report_missing_frames("read");
            shadow.record_missing(receive_end.bus().name(), lost);
            missing += lost;
        }
        Ok(TrafficInput { what: "live", missing, ended })
    }
}

/// Passes waiting frames to the model.
fn pass_frames(receive_end: &mut BusReceiver, shadow: &mut Shadow) -> Result<(), BusError> {
    while receive_end.receive(Duration::ZERO)? {
        for received in receive_end.frames() {
            shadow.receive(receive_end.bus().name(), received.at_nanos, &received.frame);
        }
    }
    Ok(())
}

/// Passes the frames of a capture to the model, and reports unreadable and lost items.
fn pass_capture(
    mut reader: Reader,
    shadow: &mut Shadow,
    out: &mut impl Write,
) -> Result<TrafficInput, Failure> {
    let name = reader.name().to_owned();
    let what = input::format_name(&reader);
    let (mut frames, mut missing) = (0_u64, LossCounts::default());
    let mut ended = loop {
        match reader.next() {
            Ok(None) => break Ok(()),
            Err(error) => break Err(Failure::run_error(error)),
            Ok(Some(CaptureEntry::Frame(record))) => {
                frames += 1;
                shadow.receive(record.interface, record.time.nanos, &record.frame);
                if let Err(error) = write_frames(shadow, out) {
                    ignore_broken_pipe(Err(error))?;
                    return Ok(TrafficInput { what, missing: missing.frames, ended: Ok(()) });
                }
            }
            Ok(Some(CaptureEntry::Note(note))) => {
                missing.count(&note);
                match note.kind {
                    NoteKind::Dropped(lost) if !note.interface.is_empty() => {
                        shadow.record_missing(note.interface, lost);
                    }
                    NoteKind::Unreadable(why) if missing.unreadable_count() == 1 => {
                        output::print_note(format_args!("{}: {why}", location(&name, note.line)));
                    }
                    NoteKind::Text | NoteKind::CanXl | NoteKind::Dropped(_) | NoteKind::Unreadable(_) => {}
                }
            }
        }
    };
    if !reader.has_times() {
        shadow.without_times();
    }
    missing.print_counts(&reader, "left out");
    if stop::stop_flag().load(Ordering::Relaxed) {
        output::print_note(format_args!("{name}: stopped after {frames} frames"));
    } else if frames == 0 && ended.is_ok() {
        ended = Err(no_frame_failure(&reader));
    }
    Ok(TrafficInput { what, missing: missing.frames, ended })
}
