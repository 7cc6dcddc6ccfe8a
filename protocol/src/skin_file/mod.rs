//! Files that describe a skin: TOML documents with errors by line and column, the XML of robots, and the skin itself.

pub mod document;
pub mod skin;
pub mod xml;
