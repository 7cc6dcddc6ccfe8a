//! Collects errors of connections from Zenoh's log, because Zenoh reports them only there.

use std::collections::BTreeMap;
use std::fmt::{Debug, Write};
use std::sync::mpsc::Sender;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::Interest;
use tracing::{Event as Entry, Level, Metadata, Subscriber};

use crate::event::LinkEvent;
use crate::session::plain;

/// The log target under which Zenoh reports failed connections. Their level is debug, because Zenoh tries again.
const CONNECTIONS: &str = "zenoh::net::runtime::orchestrator";
const FAILED: &str = "Unable to connect to configured peer ";
/// The beginnings of warnings about intended behaviour: gossip is disabled, and a host may be the first one.
const EXPECTED: [&str; 2] = ["Gossip is disabled", "Scouting delay elapsed"];
/// The time during which the same text is reported only once.
const REPEAT_INTERVAL: Duration = Duration::from_secs(60);
/// The maximum number of texts that are compared with new ones.
const TEXTS: usize = 64;

/// A `tracing` subscriber that forwards log entries as events.
struct Log {
    tell: Mutex<Sender<LinkEvent>>,
    said: Mutex<BTreeMap<String, Instant>>,
}

/// Forwards Zenoh's warnings, errors and failed connections to `tell`. Only the first call in a process has an effect.
pub(crate) fn listen(tell: Sender<LinkEvent>) {
    let log = Log { tell: Mutex::new(tell), said: Mutex::default() };
    // If the process already has a subscriber, that one gets the entries.
    let _ = tracing::subscriber::set_global_default(log);
}

#[derive(Default)]
struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}");
        }
    }
}

/// Returns the text to report for a log entry. Returns `None` for expected warnings, and for debug entries about
/// anything but failures.
fn event_text(is_warning: bool, text: &str) -> Option<String> {
    if let Some(failed) = text.strip_prefix(FAILED) {
        let failed = failed.split(". Retry in").next().unwrap_or(failed);
        let (endpoint, why) = failed.split_once("! ").unwrap_or((failed, ""));
        return Some(format!("cannot connect to {endpoint}, retrying: {}", plain(why)));
    }
    let is_expected = EXPECTED.iter().any(|expected| text.starts_with(expected));
    (is_warning && !is_expected)
        .then(|| plain(text.trim_end_matches(". Hint: increase the system open file limit.")))
}

impl Log {
    fn is_new(&self, text: &str) -> bool {
        let (now, mut said) = (Instant::now(), self.said.lock().unwrap_or_else(PoisonError::into_inner));
        said.retain(|_, at| now.duration_since(*at) < REPEAT_INTERVAL);
        said.len() < TEXTS && said.insert(text.to_owned(), now).is_none()
    }
}

impl Subscriber for Log {
    fn register_callsite(&self, metadata: &'static Metadata<'static>) -> Interest {
        if self.enabled(metadata) { Interest::always() } else { Interest::never() }
    }

    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        let is_warning = *metadata.level() <= Level::WARN && metadata.target().starts_with("zenoh");
        metadata.is_event()
            && (is_warning || metadata.target() == CONNECTIONS && *metadata.level() <= Level::DEBUG)
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(LevelFilter::DEBUG)
    }

    fn event(&self, entry: &Entry<'_>) {
        let mut text = Text::default();
        entry.record(&mut text);
        let text =
            event_text(*entry.metadata().level() <= Level::WARN, &text.0).filter(|text| self.is_new(text));
        if let Some(text) = text {
            let tell = self.tell.lock().unwrap_or_else(PoisonError::into_inner);
            let _ = tell.send(LinkEvent::Transport(text));
        }
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_connection_is_one_line_and_an_attempt_is_none() {
        let failed = "Unable to connect to configured peer tcp/10.0.0.1:7447! Can not create a new TCP link bound to \
                      tcp/10.0.0.1:7447: [[Connection refused (os error 111)]] at /x/unicast.rs:9.. Retry in 100ms.";
        assert_eq!(
            event_text(false, failed).unwrap(),
            "cannot connect to tcp/10.0.0.1:7447, retrying: Can not create a new TCP link bound to tcp/10.0.0.1:7447: \
             [[Connection refused (os error 111)]]"
        );
        assert_eq!(event_text(false, "Try to connect: tcp/10.0.0.1:7447"), None);
        assert_eq!(event_text(true, "Scouting delay elapsed before start conditions are met."), None);
        let refused = "received fatal alert: UnknownCA. Hint: increase the system open file limit.";
        assert_eq!(event_text(true, refused).unwrap(), "received fatal alert: UnknownCA");
    }
}
