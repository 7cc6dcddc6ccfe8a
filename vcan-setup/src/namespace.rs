//! Network namespaces, as people name them.

use core::fmt;
use std::ffi::OsStr;
use std::fs::File;
use std::io;
use std::path::PathBuf;

use thiserror::Error;

/// Where `ip netns` keeps the namespaces that have names.
pub const NAMED: &str = "/run/netns";

/// A network namespace as it was named.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Namespace {
    /// A name that `ip netns` lists.
    Name(String),
    /// That of a process.
    Process(u32),
    /// A file that stands for it.
    Path(PathBuf),
}

/// A namespace that is not there or cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NamespaceError {
    /// No such name.
    #[error(
        "there is no network namespace {name} in {NAMED}: `sudo ip netns add {name}` makes it, `ip netns` lists them; a process' number or a path is taken too"
    )]
    Name {
        /// The name.
        name: String,
    },
    /// No such process.
    #[error(
        "there is no network namespace {pid} in {NAMED}, and no process {pid}: is it still running? `ip netns` lists names"
    )]
    Process {
        /// Its number.
        pid: u32,
    },
    /// Any other error of the system.
    #[error("cannot open the network namespace {}: {source}", path.display())]
    Io {
        /// Its file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

impl Namespace {
    /// What a word names: a path holds a `/`, a name comes before a process of the same number.
    #[must_use]
    pub fn named(word: &OsStr) -> Self {
        let Some(word) = word.to_str().filter(|word| !word.contains('/')) else {
            let is_path = word.as_encoded_bytes().contains(&b'/');
            return Self::Path(if is_path { word.into() } else { PathBuf::from(NAMED).join(word) });
        };
        match word.parse() {
            Ok(pid) if !PathBuf::from(NAMED).join(word).exists() => Self::Process(pid),
            Ok(_) | Err(_) => Self::Name(word.to_owned()),
        }
    }

    /// The file that stands for it.
    #[must_use]
    pub fn path(&self) -> PathBuf {
        match self {
            Self::Name(name) => PathBuf::from(NAMED).join(name),
            Self::Process(pid) => PathBuf::from(format!("/proc/{pid}/ns/net")),
            Self::Path(path) => path.clone(),
        }
    }

    /// Opens it.
    ///
    /// # Errors
    /// When it is not there, or may not be opened.
    pub fn open(&self) -> Result<File, NamespaceError> {
        let path = self.path();
        File::open(&path).map_err(|source| match (self, source.kind()) {
            (Self::Name(name), io::ErrorKind::NotFound) => NamespaceError::Name { name: name.clone() },
            (Self::Process(pid), io::ErrorKind::NotFound) => NamespaceError::Process { pid: *pid },
            _ => NamespaceError::Io { path, source },
        })
    }

    /// The beginning of a command that runs `ip` in it.
    #[must_use]
    pub fn ip(&self) -> String {
        match self {
            Self::Name(name) => format!("ip -n {name}"),
            Self::Process(pid) => format!("nsenter -t {pid} -n ip"),
            Self::Path(path) => format!("nsenter --net={} ip", path.display()),
        }
    }
}

/// As `ip link add ... netns` takes it.
impl fmt::Display for Namespace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) => f.write_str(name),
            Self::Process(pid) => write!(f, "{pid}"),
            Self::Path(path) => write!(f, "{}", path.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_word_is_a_path_a_process_or_a_name() {
        for (word, namespace, path, ip) in [
            ("blue", Namespace::Name("blue".into()), "/run/netns/blue", "ip -n blue"),
            ("77", Namespace::Process(77), "/proc/77/ns/net", "nsenter -t 77 -n ip"),
            ("./ns", Namespace::Path("./ns".into()), "./ns", "nsenter --net=./ns ip"),
        ] {
            assert_eq!(Namespace::named(OsStr::new(word)), namespace);
            assert_eq!((namespace.path(), namespace.ip()), (PathBuf::from(path), ip.to_owned()));
            assert_eq!(namespace.to_string(), word);
        }
    }

    #[test]
    fn one_that_is_not_there_says_how_to_make_it() {
        let error = Namespace::named(OsStr::new("nosuchspace")).open().unwrap_err().to_string();
        assert!(error.contains("`sudo ip netns add nosuchspace` makes it"), "{error}");
        let error = Namespace::named(OsStr::new("4294967295")).open().unwrap_err().to_string();
        assert!(error.contains("no process 4294967295"), "{error}");
        let error = Namespace::named(OsStr::new("/nowhere/ns")).open().unwrap_err().to_string();
        assert!(error.starts_with("cannot open the network namespace /nowhere/ns: No such file"), "{error}");
    }
}
