//! `--control`: commands on standard input and events on standard output.

use std::fs::File;
use std::io::{self, Stdin};
use std::os::fd::AsFd;
use std::path::Path;

use bench::remote::Remote;
use bench::run::RunOptions;
use bench::summary::Summary;
use protocol::bus::embedded::default_directory;
use protocol::usage::Failure;
use rustix::io::ioctl_fionbio;
use view::control::ControlEvent;
use view::control::channel::{ChannelOptions, ControlChannel};

use crate::output::is_standard_output;

/// Checks that standard output is free for events.
pub(super) fn check_standard_output(written: &[(&str, Option<&Path>)]) -> Result<(), Failure> {
    match written.iter().find(|(_, path)| path.is_some_and(is_standard_output)) {
        Some((option, _)) => Err(Failure::usage_error(format!(
            "{option} -: with --control, standard output has only events: name a file"
        ))),
        None => Ok(()),
    }
}

/// Starts the channel. Returns it with its connection for the run.
pub(super) fn start_channel(options: &RunOptions) -> Result<(ControlChannel, Remote), Failure> {
    let directory = options.directory.clone().unwrap_or_else(default_directory);
    let places = options.skin.buses.iter().map(|bus| {
        let kind = options.kinds.kind_of(&bus.name).resolve(&bus.name);
        let directory = (!kind.is_interface()).then(|| directory.display().to_string());
        (kind.name(), directory)
    });
    let channel = ChannelOptions {
        skin: options.skin.clone(),
        version: env!("CARGO_PKG_VERSION"),
        kinds: options.kinds.clone(),
        directory: options.directory.clone(),
        places: places.collect(),
    };
    // The handles of the standard library lock and buffer each line.
    let output = File::from(io::stdout().as_fd().try_clone_to_owned().map_err(failure)?);
    let input: Stdin = io::stdin();
    // Non-blocking streams would seem to have ended. Kinds of files that cannot be switched do not block.
    let _ = ioctl_fionbio(&input, false);
    let _ = ioctl_fionbio(&output, false);
    let (channel, lines) = ControlChannel::start(channel, input, output).map_err(failure)?;
    Ok((channel, Remote { name: "control", lines, ends_run: true }))
}

/// Sends the last event, and returns the result of the run.
pub(super) fn end_channel(
    channel: Option<ControlChannel>,
    summary: Option<&Summary>,
    done: Result<(), Failure>,
) -> Result<(), Failure> {
    let Some(channel) = channel else { return done };
    let channel = channel.stop();
    let done = match done {
        Ok(()) if channel.has_failed => Err(Failure::run_error("--control: a thread of the channel failed")),
        done => done,
    };
    let (code, text) = match &done {
        Ok(()) => (0, None),
        Err(failure) => (failure.code(), Some(failure.to_string())),
    };
    let summary = summary.and_then(|summary| serde_json::to_value(summary).ok());
    let read = channel.finish(&ControlEvent::Ended { code, text, summary });
    done.and_then(|()| read.map_err(|unread| Failure::run_error(format!("--control: {unread}"))))
}

fn failure(error: io::Error) -> Failure {
    Failure::run_error(format!("--control: {error}"))
}
