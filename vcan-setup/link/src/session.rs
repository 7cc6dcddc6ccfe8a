//! Converts the settings of a link into a configuration of Zenoh.

use std::fmt;
use std::io;
use std::path::PathBuf;

use protocol::bus::{BusError, KindChoice};
use serde_json::Value;
use thiserror::Error;
use zenoh::Config;
use zenoh::key_expr::KeyExpr;

/// The word for frames in a Zenoh key. The frames of a host have the key `skinbus/frames/BUS/HOST`, and so has its
/// liveliness token.
pub(crate) const FRAMES: &str = "frames";
/// The word for counts in a Zenoh key. A host's counts of the other hosts' frames have the key
/// `skinbus/heard/BUS/HOST`.
pub(crate) const HEARD: &str = "heard";

/// The settings of a link.
#[derive(Clone, Debug)]
pub(crate) struct LinkSettings {
    /// The name of the bus, which is the same on all hosts.
    pub(crate) bus: String,
    /// The kind of the local bus.
    pub(crate) choice: KindChoice,
    /// The directory of embedded buses; `None` for the default one.
    pub(crate) directory: Option<PathBuf>,
    /// The name under which the other hosts know this host.
    pub(crate) host: String,
    /// The path of a configuration file of Zenoh.
    pub(crate) config: Option<PathBuf>,
    /// Endpoints to connect to, such as `tcp/192.168.1.7:7447`.
    pub(crate) connect: Vec<String>,
    /// Endpoints at which other hosts can connect.
    pub(crate) listen: Vec<String>,
}

/// The reason why a bus cannot be linked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub(crate) enum LinkError {
    /// The bus cannot be opened, or was lost and cannot be reopened.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The configuration is wrong, or Zenoh cannot start with it.
    #[error("{0}")]
    Zenoh(String),
    /// The link neither listens nor connects.
    #[error(
        "no endpoint: give the address of another host (--connect) or an address of this host (--listen), or both in a \
         file for --config"
    )]
    Alone,
    /// An endpoint has an unsupported form. The fields are the option or file that contains it, and the endpoint.
    #[error("{0} {1}: an endpoint is tcp/HOST:PORT or tls/HOST:PORT")]
    Endpoint(String, String),
    /// Some endpoints use TLS and others do not.
    #[error("{plain} does not use TLS, but {secure} does: use tls/ for all endpoints or for none")]
    PlainBesideTls {
        /// An endpoint without TLS.
        plain: String,
        /// An endpoint with TLS.
        secure: String,
    },
    /// The name of the bus or the host contains characters that a Zenoh key cannot have.
    #[error("'{0}' cannot be part of a Zenoh key: {1}")]
    Name(String, String),
    /// Another process of this machine already links the bus.
    #[error("the bus '{0}' is already linked by a process on this host: use it for all hosts, or stop it")]
    Twice(String),
    /// The system call that waits for frames failed.
    #[error("cannot wait for frames: {0}")]
    Wait(#[source] io::Error),
}

impl LinkSettings {
    /// Converts an error of Zenoh, and adds the name of the configuration file if there is one.
    pub(crate) fn blame(&self, error: &str) -> LinkError {
        let of = self.config.as_ref().map_or_else(String::new, |path| format!("{}: ", path.display()));
        LinkError::Zenoh(format!("{of}{}", plain(error)))
    }
}

impl LinkError {
    /// Returns true if the options or the configuration are wrong, rather than the state of the machine.
    #[must_use]
    pub(crate) const fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::Alone | Self::Endpoint(..) | Self::PlainBesideTls { .. } | Self::Name(..) | Self::Twice(_)
        )
    }

    pub(crate) fn zenoh(error: impl fmt::Display) -> Self {
        Self::Zenoh(plain(&error.to_string()))
    }
}

/// Returns the message of a Zenoh error without the source file positions in it.
pub(crate) fn plain(error: &str) -> String {
    let message = error.split_once("msg: \"").and_then(|(_, rest)| rest.split_once("\", location"));
    let text = message.map_or(error, |(message, _)| message);
    text.split(" at /").next().unwrap_or(text).trim_end_matches('.').to_owned()
}

/// Builds the configuration of Zenoh from the configuration file. Endpoints of the command line replace those of the
/// file.
///
/// By default Zenoh listens without TLS, searches for other hosts by multicast, and introduces hosts to each other.
/// This function sets all options that decide who can reach the bus.
///
/// # Errors
///
/// Returns [`LinkError`] if the file cannot be read, if an endpoint has an unsupported form or lacks TLS beside others
/// with TLS, or if no endpoint is given.
pub(crate) fn config(settings: &LinkSettings) -> Result<Config, LinkError> {
    let mut config = match &settings.config {
        Some(path) => Config::from_file(path).map_err(|error| settings.blame(&error.to_string()))?,
        None => Config::default(),
    };
    let mode = value(&config, "mode")?;
    let mode = mode.as_str().unwrap_or("peer");
    let endpoints = Endpoints::new(settings, &config, mode)?;
    let mut set = |key: &str, value: &str| config.insert_json5(key, value).map_err(LinkError::zenoh);
    set("mode", &format!("\"{mode}\""))?;
    set("listen/endpoints", &list(&endpoints.listen))?;
    set("transport/link/protocols", if endpoints.secure { "[\"tls\"]" } else { "[\"tcp\"]" })?;
    for key in [
        "scouting/multicast/enabled",
        "scouting/gossip/enabled",
        "adminspace/enabled",
        "plugins_loading/enabled",
        "transport/shared_memory/enabled",
    ] {
        set(key, "false")?;
    }
    if !settings.connect.is_empty() {
        set("connect/endpoints", &list(&settings.connect))?;
        set("connect/timeout_ms", "-1")?;
        set("connect/exit_on_failure", "false")?;
        set("connect/retry", "{ period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2 }")?;
    }
    // Up to 16 batches of 64 KiB wait for the network. Data that finds no room within 1 ms is dropped by Zenoh.
    set("transport/link/tx/queue/size/real_time", "16")?;
    // The time without data after which a connection is closed, in ms.
    set("transport/link/tx/lease", "1000")?;
    // Programs that connect by TLS must authenticate themselves, unless the file sets this option.
    if endpoints.secure && !endpoints.listen.is_empty() {
        set_unless_given(&mut config, "transport/link/tls/enable_mtls")?;
    }
    set_unless_given(&mut config, "transport/link/tls/verify_name_on_connect")?;
    Ok(config)
}

/// The endpoints of a link, checked and with their use of TLS.
struct Endpoints {
    listen: Vec<String>,
    /// True if all endpoints use TLS; false if none of them does.
    secure: bool,
}

impl Endpoints {
    fn new(settings: &LinkSettings, config: &Config, mode: &str) -> Result<Self, LinkError> {
        let file = settings.config.as_ref().map_or_else(String::new, |path| path.display().to_string());
        let choose = |option: &str, given: &[String], key: &str| {
            let (source, endpoints) = if given.is_empty() {
                (format!("{file}: {key}"), configured(config, key, mode)?)
            } else {
                (option.to_owned(), given.to_vec())
            };
            for endpoint in &endpoints {
                let known = ["tcp/", "tls/"].iter().any(|protocol| endpoint.starts_with(protocol));
                if !known || !endpoint.contains(':') {
                    return Err(LinkError::Endpoint(source, endpoint.clone()));
                }
            }
            Ok(endpoints)
        };
        let listen = choose("--listen", &settings.listen, "listen/endpoints")?;
        let connect = choose("--connect", &settings.connect, "connect/endpoints")?;
        let all = || listen.iter().chain(&connect);
        let secure = all().find(|endpoint| endpoint.starts_with("tls/"));
        let plain = all().find(|endpoint| !endpoint.starts_with("tls/"));
        match (plain, secure) {
            (None, None) => Err(LinkError::Alone),
            (Some(plain), Some(secure)) => {
                Err(LinkError::PlainBesideTls { plain: plain.clone(), secure: secure.clone() })
            }
            (_, secure) => Ok(Self { secure: secure.is_some(), listen }),
        }
    }
}

/// Returns the endpoints that the configuration file gives under this key and mode. Returns none if they are Zenoh's
/// defaults.
fn configured(config: &Config, key: &str, mode: &str) -> Result<Vec<String>, LinkError> {
    let given = value(config, key)?;
    if given == value(&Config::default(), key)? {
        return Ok(Vec::new());
    }
    let mut endpoints = Vec::new();
    flatten(given.get(mode).unwrap_or(&given), &mut endpoints);
    Ok(endpoints)
}

/// Collects the endpoints of a list, including those of its groups. A group is an object with `locators`.
fn flatten(value: &Value, into: &mut Vec<String>) {
    match value {
        Value::String(endpoint) => into.push(endpoint.clone()),
        Value::Array(values) => values.iter().for_each(|value| flatten(value, into)),
        Value::Object(group) => group.get("locators").into_iter().for_each(|value| flatten(value, into)),
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

fn value(config: &Config, key: &str) -> Result<Value, LinkError> {
    let text = config.get_json(key).map_err(LinkError::zenoh)?;
    serde_json::from_str(&text).map_err(LinkError::zenoh)
}

fn list(endpoints: &[String]) -> String {
    serde_json::to_string(endpoints).unwrap_or_default()
}

/// Sets an option to true, unless the configuration file sets it.
fn set_unless_given(config: &mut Config, key: &str) -> Result<(), LinkError> {
    if value(config, key)?.is_null() {
        config.insert_json5(key, "true").map_err(LinkError::zenoh)?;
    }
    Ok(())
}

pub(crate) fn key(what: &str, bus: &str, host: &str) -> Result<KeyExpr<'static>, LinkError> {
    for name in [bus, host] {
        if name != "*" && name.contains(['*', '$', '?', '#', '/']) {
            let why = "it contains one of * $ ? # /".to_owned();
            return Err(LinkError::Name(name.to_owned(), why));
        }
    }
    let text = format!("skinbus/{what}/{bus}/{host}");
    KeyExpr::try_from(text).map_err(|error| LinkError::Name(format!("{bus}, {host}"), error.to_string()))
}

pub(crate) fn host_of(key: &str) -> &str {
    key.rsplit('/').next().unwrap_or(key)
}

/// Returns a random number that distinguishes this start of the link from others.
pub(crate) fn life() -> u64 {
    let mut bytes = [0; 8];
    // Early at boot the system may have no random bytes yet.
    match rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty()) {
        Ok(8) => u64::from_ne_bytes(bytes),
        _ => u64::from(std::process::id()) << 32 ^ u64::from(std::process::id()),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// Returns the configuration that results from a file with this text and from these options, or the error.
    fn configured_by(text: &str, connect: &[&str], listen: &[&str]) -> Result<Config, LinkError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("link.json5");
        fs::write(&path, text).unwrap();
        let owned = |texts: &[&str]| texts.iter().map(|&text| text.to_owned()).collect();
        config(&LinkSettings {
            bus: "vcan0".to_owned(),
            choice: KindChoice::Auto,
            directory: None,
            host: "here".to_owned(),
            config: (!text.is_empty()).then_some(path),
            connect: owned(connect),
            listen: owned(listen),
        })
    }

    fn listeners(config: &Config) -> Value {
        value(config, "listen/endpoints").unwrap()
    }

    #[test]
    fn nothing_listens_but_what_is_named_in_any_mode() {
        for mode in ["", "mode: \"peer\",", "mode: \"router\",", "mode: \"client\","] {
            for connect in [
                "[\"tls/robot:7447\"]",
                "{ peer: [\"tls/robot:7447\"], router: [\"tls/robot:7447\"], client: [\"tls/robot:7447\"] }",
            ] {
                for rest in ["", "listen: {},", "listen: { timeout_ms: 1 },", "listen: { endpoints: {} },"] {
                    let text = format!("{{ {mode} connect: {{ endpoints: {connect} }}, {rest} }}");
                    let config = configured_by(&text, &[], &[]).unwrap();
                    assert_eq!(listeners(&config), serde_json::json!([]), "{text}");
                }
            }
            let named = format!("{{ {mode} connect: {{ endpoints: [\"tls/a:1\"] }} }}");
            let config = configured_by(&named, &[], &["tls/0.0.0.0:7447"]).unwrap();
            assert_eq!(listeners(&config), serde_json::json!(["tls/0.0.0.0:7447"]));
        }
        let config = configured_by("", &["tcp/robot:7447"], &[]).unwrap();
        assert_eq!(listeners(&config), serde_json::json!([]));
        let of_another_mode = "{ mode: \"router\", listen: { endpoints: { peer: [\"tls/a:1\"] } }, connect: { endpoints: [\"tls/b:1\"] } }";
        assert_eq!(listeners(&configured_by(of_another_mode, &[], &[]).unwrap()), serde_json::json!([]));
    }

    #[test]
    fn no_endpoint_lacks_tls_beside_one_with_tls() {
        let listening = "{ listen: { endpoints: [\"tls/[::]:7447\"] } }";
        let connecting = "{ connect: { endpoints: [\"tls/robot:7447\"] } }";
        let both = "{ listen: { endpoints: [\"tls/[::]:7447\", \"tcp/[::]:7448\"] } }";
        let nested = "{ connect: { endpoints: [{ strategy: \"allOf\", locators: [\"tls/robot:1\", \"tcp/robot:1\"] }] } }";
        for (text, connect, listen) in [
            (listening, &["tcp/robot:1"][..], &[][..]),
            (connecting, &[], &["tcp/[::]:0"]),
            (both, &[], &[]),
            (nested, &[], &[]),
            ("", &["tls/robot:1"], &["tcp/[::]:1"]),
        ] {
            let error = configured_by(text, connect, listen).unwrap_err();
            assert!(
                matches!(error, LinkError::PlainBesideTls { .. }),
                "{text} {connect:?} {listen:?}: {error}"
            );
            assert!(error.is_usage());
        }
        let config = configured_by(connecting, &[], &[]).unwrap();
        assert_eq!(value(&config, "transport/link/protocols").unwrap(), serde_json::json!(["tls"]));
    }

    #[test]
    fn other_protocols_and_no_endpoint_are_refused() {
        for text in [
            "{ listen: { endpoints: [\"udp/[::]:1\"] } }",
            "{ connect: { endpoints: [\"unixsock-stream/a\"] } }",
        ] {
            assert!(matches!(configured_by(text, &[], &[]), Err(LinkError::Endpoint(..))), "{text}");
        }
        for text in ["{}", "{ mode: \"router\" }", ""] {
            assert!(matches!(configured_by(text, &[], &[]), Err(LinkError::Alone)), "{text}");
        }
    }

    #[test]
    fn who_connects_by_tls_has_to_prove_who_it_is() {
        let mtls = "transport/link/tls/enable_mtls";
        let listening = |tls: &str| {
            format!(
                "{{ listen: {{ endpoints: [\"tls/[::]:1\"] }}, transport: {{ link: {{ tls: {{ {tls} }} }} }} }}"
            )
        };
        for (text, expected) in [
            (listening(""), Value::Bool(true)),
            (listening("enable_mtls: false"), Value::Bool(false)),
            ("{ connect: { endpoints: [\"tls/a:1\"] } }".to_owned(), Value::Null),
        ] {
            assert_eq!(value(&configured_by(&text, &[], &[]).unwrap(), mtls).unwrap(), expected, "{text}");
        }
    }

    #[test]
    fn nobody_is_looked_for_or_told_of_others() {
        let text = "{ connect: { endpoints: [\"tcp/a:1\"] }, scouting: { multicast: { enabled: true }, gossip: { enabled: true } }, \
                    adminspace: { enabled: true } }";
        let config = configured_by(text, &[], &[]).unwrap();
        for key in [
            "scouting/multicast/enabled",
            "scouting/gossip/enabled",
            "adminspace/enabled",
            "plugins_loading/enabled",
        ] {
            assert_eq!(value(&config, key).unwrap(), Value::Bool(false), "{key}");
        }
    }
}
