//! How a bus is linked: what is said on the command line, as Zenoh has it.

use std::fmt;
use std::io;
use std::path::PathBuf;

use protocol::bus::{BusError, Choice};
use thiserror::Error;
use zenoh::Config;
use zenoh::key_expr::KeyExpr;

/// What a host takes from its bus: `skinbus/frames/BUS/HOST`. The liveliness tokens have these keys too.
pub(super) const FRAMES: &str = "frames";
/// What a host has heard of each other: `skinbus/heard/BUS/HOST`.
pub(super) const HEARD: &str = "heard";

/// How a bus is linked.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The bus here, and elsewhere.
    pub bus: String,
    /// Its kind here.
    pub choice: Choice,
    /// Where embedded buses live; `None` is the usual directory.
    pub directory: Option<PathBuf>,
    /// This host's name.
    pub host: String,
    /// A configuration of Zenoh.
    pub config: Option<PathBuf>,
    /// Where to connect to, as `tcp/192.168.1.7:7447`.
    pub connect: Vec<String>,
    /// Where to wait for others.
    pub listen: Vec<String>,
}

/// Why a bus cannot be linked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LinkError {
    /// The bus cannot be opened, or is lost for good.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The configuration is wrong, or Zenoh cannot start with it.
    #[error("{0}")]
    Zenoh(String),
    /// Nobody could find this link, and it could find nobody.
    #[error(
        "no --connect, no --listen and no --config: say where the other hosts are, or where they find this one"
    )]
    Alone,
    /// An endpoint of another form.
    #[error("{0} {1}: an endpoint is tcp/HOST:PORT or tls/HOST:PORT")]
    Endpoint(&'static str, String),
    /// The bus or the host has a name that no key can have.
    #[error("'{0}' cannot be a part of a key of Zenoh: {1}")]
    Name(String, String),
    /// Another process here links the bus.
    #[error("the bus '{0}' is linked already by another process here: one link carries it to all hosts")]
    Twice(String),
    /// The system cannot wait.
    #[error("cannot wait for frames: {0}")]
    Wait(#[source] io::Error),
}

impl Settings {
    /// An error of Zenoh, and the configuration that it may be about.
    pub(super) fn blame(&self, error: &str) -> LinkError {
        let of = self.config.as_ref().map_or_else(String::new, |path| format!("{}: ", path.display()));
        LinkError::Zenoh(format!("{of}{}", plain(error)))
    }
}

impl LinkError {
    /// Whether the user has asked for what cannot be.
    #[must_use]
    pub const fn is_usage(&self) -> bool {
        matches!(self, Self::Alone | Self::Endpoint(..) | Self::Name(..) | Self::Twice(_))
    }

    pub(super) fn zenoh(error: impl fmt::Display) -> Self {
        Self::Zenoh(plain(&error.to_string()))
    }
}

/// What an error of Zenoh says, without the places in its source.
pub(super) fn plain(error: &str) -> String {
    let message = error.split_once("msg: \"").and_then(|(_, rest)| rest.split_once("\", location"));
    let text = message.map_or(error, |(message, _)| message);
    text.split(" at /").next().unwrap_or(text).trim_end_matches('.').to_owned()
}

/// Zenoh's configuration: what a file says, and for the rest nothing that others were not told of.
pub(super) fn config(settings: &Settings) -> Result<Config, LinkError> {
    for (option, endpoints) in [("--connect", &settings.connect), ("--listen", &settings.listen)] {
        for endpoint in endpoints {
            let known = ["tcp/", "tls/"].iter().any(|protocol| endpoint.starts_with(protocol));
            if !known || !endpoint.contains(':') {
                return Err(LinkError::Endpoint(option, endpoint.clone()));
            }
        }
    }
    let mut config = match &settings.config {
        Some(path) => Config::from_file(path).map_err(|error| settings.blame(&error.to_string()))?,
        None if settings.connect.is_empty() && settings.listen.is_empty() => return Err(LinkError::Alone),
        None => Config::default(),
    };
    let mut set = |key: &str, value: &str| config.insert_json5(key, value).map_err(LinkError::zenoh);
    let list = |of: &[String]| serde_json::to_string(of).unwrap_or_default();
    if settings.config.is_none() {
        set("mode", "\"peer\"")?;
        set("listen/endpoints", "[]")?;
    }
    set("scouting/multicast/enabled", "false")?;
    set("scouting/gossip/enabled", "false")?;
    if !settings.listen.is_empty() {
        set("listen/endpoints", &list(&settings.listen))?;
    }
    if !settings.connect.is_empty() {
        set("connect/endpoints", &list(&settings.connect))?;
        set("connect/timeout_ms", "-1")?;
        set("connect/exit_on_failure", "false")?;
        set("connect/retry", "{ period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2 }")?;
    }
    // Batches of 64 KiB that wait for the network, of at most 16: what finds no room in them within 1 ms is lost.
    set("transport/link/tx/queue/size/real_time", "16")?;
    // A link that says nothing for so long is lost.
    set("transport/link/tx/lease", "1000")?;
    Ok(config)
}

pub(super) fn key(what: &str, bus: &str, host: &str) -> Result<KeyExpr<'static>, LinkError> {
    for name in [bus, host] {
        if name != "*" && name.contains(['*', '$', '?', '#', '/']) {
            let why = "it has one of * $ ? # /".to_owned();
            return Err(LinkError::Name(name.to_owned(), why));
        }
    }
    let text = format!("skinbus/{what}/{bus}/{host}");
    KeyExpr::try_from(text).map_err(|error| LinkError::Name(format!("{bus}, {host}"), error.to_string()))
}

pub(super) fn host_of(key: &str) -> &str {
    key.rsplit('/').next().unwrap_or(key)
}

/// A number that no other start has.
pub(super) fn life() -> u64 {
    let mut bytes = [0; 8];
    // Early at boot there may be nothing random.
    match rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty()) {
        Ok(8) => u64::from_ne_bytes(bytes),
        _ => u64::from(std::process::id()) << 32 ^ u64::from(std::process::id()),
    }
}
