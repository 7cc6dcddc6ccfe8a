//! Skin files: TOML documents whose errors have a line and column, the XML of robot descriptions, and the checked skin
//! description.

pub mod document;
pub mod skin;
pub mod xml;
