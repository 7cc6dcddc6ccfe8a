//! The colours of text, grid and series, on paper and on a dark screen.

use std::fmt::Write as _;

use plotters::style::RGBColor;

use super::super::figure::Figure;
use super::colour::add_dark_rules;

/// Colour on paper, CSS class, and colour on a dark screen: for text, faint text, the grid, and each series. The series
/// have Okabe and Ito's colours, which colour-blind readers can distinguish; their yellow is omitted because it is
/// invisible on white.
pub(super) const COLOUR_CLASSES: [(RGBColor, &str, &str); 3 + Figure::COLOUR_COUNT] = [
    (TEXT_COLOUR, "ink", "#E4E4E4"),
    (FAINT_TEXT_COLOUR, "faint", "#A6A6A6"),
    (GRID_COLOUR, "grid", "#3A3D42"),
    (RGBColor(0x00, 0x72, 0xB2), "c0", "#5AB4F0"),
    (RGBColor(0xD5, 0x5E, 0x00), "c1", "#FF8A3D"),
    (RGBColor(0x00, 0x9E, 0x73), "c2", "#35C79A"),
    (RGBColor(0xCC, 0x79, 0xA7), "c3", "#E59AC8"),
    (RGBColor(0xE6, 0x9F, 0x00), "c4", "#F5C04A"),
    (RGBColor(0x56, 0xB4, 0xE9), "c5", "#A8DCFF"),
    (RGBColor(0x33, 0x33, 0x33), "c6", "#DDDDDD"),
];
pub(super) const TEXT_COLOUR: RGBColor = RGBColor(0x22, 0x22, 0x22);
pub(super) const FAINT_TEXT_COLOUR: RGBColor = RGBColor(0x6B, 0x6B, 0x6B);
pub(super) const GRID_COLOUR: RGBColor = RGBColor(0xDD, 0xDD, 0xDD);

/// Returns the colours of the series in order, repeated without end.
pub(super) fn series_colours() -> impl Iterator<Item = RGBColor> {
    COLOUR_CLASSES.iter().skip(3).cycle().map(|(colour, ..)| *colour)
}

/// Returns the colours of text, on paper and on a dark screen.
#[cfg(test)]
pub(crate) fn text_colours() -> [[String; 2]; 2] {
    let texts = [TEXT_COLOUR, FAINT_TEXT_COLOUR];
    let paper = texts.map(|RGBColor(r, g, b)| format!("#{r:02X}{g:02X}{b:02X}"));
    let dark = texts.map(|text| {
        COLOUR_CLASSES.iter().find(|(colour, ..)| *colour == text).map_or("", |(.., dark)| dark).to_owned()
    });
    [paper, dark]
}

/// Returns the CSS rules with the colours for dark screens.
#[must_use]
pub fn dark_css_rules() -> String {
    let mut rules = "@media screen and (prefers-color-scheme:dark){".to_owned();
    for (_, class, colour) in COLOUR_CLASSES {
        let _ = write!(rules, ".{class}-f{{fill:{colour}}}.{class}-s{{stroke:{colour}}}");
    }
    add_dark_rules(&mut rules);
    rules.push('}');
    rules
}
