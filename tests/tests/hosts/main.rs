//! A bus over several hosts, in network namespaces: `tests/hosts`.

mod hosts;
