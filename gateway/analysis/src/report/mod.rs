//! Reports: HTML pages with figures.
//!
//! ```text
//!   a recording ─> run ─┐
//!                       ├─> figure::Page ─> page::html ─> one HTML file
//!   experiments ────────┘        └────────> svg::draw ──> an SVG file for each figure
//! ```
//!
//! [`figure`] has the contents, [`svg`] draws them, [`page`] lays them out; all three are pure.

pub mod figure;
mod finding;
mod number;
pub mod page;
pub mod run;
mod scale;
mod skin;
pub mod svg;
pub mod thin;
