//! Network namespaces, as a user names them: by a name, a process id, or a path.

use core::fmt;
use std::ffi::OsStr;
use std::fs::File;
use std::io;
use std::path::PathBuf;

use thiserror::Error;

/// The directory in which `ip netns` keeps the namespaces that have names.
pub const NAMESPACE_DIRECTORY: &str = "/run/netns";

/// A network namespace as named by the user.
#[derive(Clone, Debug, Eq, PartialEq)]
pub enum Namespace {
    /// A name that `ip netns` lists.
    Name(String),
    /// The namespace of a process.
    Process(u32),
    /// The path of a namespace file.
    Path(PathBuf),
}

/// The reason why a network namespace cannot be opened.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NamespaceError {
    /// There is no namespace of this name.
    #[error(
        "there is no network namespace {name} in {NAMESPACE_DIRECTORY}: `ip netns` lists namespaces, `sudo \
         ip netns add {name}` creates it; a process id or a path is accepted too"
    )]
    Name {
        /// The name.
        name: String,
    },
    /// There is neither a namespace nor a process with this number.
    #[error(
        "there is neither a network namespace {pid} in {NAMESPACE_DIRECTORY} nor a process {pid}: check the \
         process id; `ip netns` lists namespaces"
    )]
    Process {
        /// The process id.
        pid: u32,
    },
    /// Another system error.
    #[error("cannot open the network namespace {}: {source}", path.display())]
    Io {
        /// The path of the namespace file.
        path: PathBuf,
        /// The system error.
        source: io::Error,
    },
}

impl Namespace {
    /// Parses an argument. If it contains a `/`, it is a path. A number is the name of a namespace if that exists, and
    /// a process id otherwise.
    #[must_use]
    pub fn parse(word: &OsStr) -> Self {
        let Some(word) = word.to_str().filter(|word| !word.contains('/')) else {
            let is_path = word.as_encoded_bytes().contains(&b'/');
            return Self::Path(if is_path {
                word.into()
            } else {
                PathBuf::from(NAMESPACE_DIRECTORY).join(word)
            });
        };
        match word.parse() {
            Ok(pid) if !PathBuf::from(NAMESPACE_DIRECTORY).join(word).exists() => Self::Process(pid),
            Ok(_) | Err(_) => Self::Name(word.to_owned()),
        }
    }

    /// Returns the path of the namespace file.
    #[must_use]
    pub fn path(&self) -> PathBuf {
        match self {
            Self::Name(name) => PathBuf::from(NAMESPACE_DIRECTORY).join(name),
            Self::Process(pid) => PathBuf::from(format!("/proc/{pid}/ns/net")),
            Self::Path(path) => path.clone(),
        }
    }

    /// Opens the namespace file.
    ///
    /// # Errors
    /// Returns [`NamespaceError`] if the namespace does not exist or may not be opened.
    pub fn open(&self) -> Result<File, NamespaceError> {
        let path = self.path();
        File::open(&path).map_err(|source| match (self, source.kind()) {
            (Self::Name(name), io::ErrorKind::NotFound) => NamespaceError::Name { name: name.clone() },
            (Self::Process(pid), io::ErrorKind::NotFound) => NamespaceError::Process { pid: *pid },
            _ => NamespaceError::Io { path, source },
        })
    }

    /// Returns the beginning of a shell command that runs `ip` in the namespace.
    #[must_use]
    pub fn ip_command(&self) -> String {
        match self {
            Self::Name(name) => format!("ip -n {name}"),
            Self::Process(pid) => format!("nsenter -t {pid} -n ip"),
            Self::Path(path) => format!("nsenter --net={} ip", path.display()),
        }
    }
}

/// Formats the namespace for the option `netns` of `ip link add`.
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
            assert_eq!(Namespace::parse(OsStr::new(word)), namespace);
            assert_eq!((namespace.path(), namespace.ip_command()), (PathBuf::from(path), ip.to_owned()));
            assert_eq!(namespace.to_string(), word);
        }
    }

    #[test]
    fn one_that_is_not_there_says_how_to_make_it() {
        let error = Namespace::parse(OsStr::new("nosuchspace")).open().unwrap_err().to_string();
        assert!(error.contains("`sudo ip netns add nosuchspace` creates it"), "{error}");
        let error = Namespace::parse(OsStr::new("4294967295")).open().unwrap_err().to_string();
        assert!(error.contains("nor a process 4294967295"), "{error}");
        let error = Namespace::parse(OsStr::new("/nowhere/ns")).open().unwrap_err().to_string();
        assert!(error.starts_with("cannot open the network namespace /nowhere/ns: No such file"), "{error}");
    }
}
