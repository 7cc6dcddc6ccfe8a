//! Skin files: TOML documents with errors by line and column, the XML of robot descriptions, and the skin
//! itself.

pub mod document;
pub mod skin;
pub mod xml;
