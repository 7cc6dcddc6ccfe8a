//! The colours of values: cividis (Nuñez, Anderton and Renslow, *Optimizing colormaps with consideration for color
//! vision deficiency*, 2018), whose order all readers can see, with any kind of colour vision. High values contrast
//! with the background: dark on paper, light on a dark screen.

use std::fmt::Write as _;

/// Number of colours for values above 0.
pub(super) const COLOUR_LEVEL_COUNT: usize = 16;

/// The colours of cividis at equal distances, as red, green and blue.
const CIVIDIS_RGB: [[f64; 3]; 10] = [
    [0.0, 34.0, 78.0],
    [18.0, 53.0, 112.0],
    [59.0, 73.0, 108.0],
    [87.0, 93.0, 109.0],
    [112.0, 113.0, 115.0],
    [138.0, 134.0, 120.0],
    [165.0, 156.0, 116.0],
    [195.0, 179.0, 105.0],
    [225.0, 204.0, 85.0],
    [254.0, 232.0, 56.0],
];

/// The background of cells and rows, on paper and on a dark screen.
pub(super) const BACKGROUND_COLOURS: [&str; 2] = ["#EBEDEF", "#26292E"];

/// Returns the cividis colour at a position from 0 to 1, as a CSS colour.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 9, and 0 to 255")]
fn cividis_css_colour(place: f64) -> String {
    let at = place.clamp(0.0, 1.0) * (CIVIDIS_RGB.len() - 1) as f64;
    let (from, part) = (at.floor() as usize, at.fract());
    let [one, next] =
        [from, from + 1].map(|at| CIVIDIS_RGB.get(at).or(CIVIDIS_RGB.last()).copied().unwrap_or_default());
    let mut text = "#".to_owned();
    for (one, next) in one.into_iter().zip(next) {
        let _ = write!(text, "{:02X}", (one + part * (next - one)).round() as u8);
    }
    text
}

/// Returns the colours of a level on paper and on a dark screen; levels count from 0.
pub(super) fn level_colours(level: usize) -> [String; 2] {
    let part = level as f64 / (COLOUR_LEVEL_COUNT - 1) as f64;
    [cividis_css_colour(1.0 - part), cividis_css_colour(0.2 + 0.8 * part)]
}

/// Returns the level of colour, from 0, for a value above 0 and up to `max`.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 15")]
pub(super) fn colour_level(value: f64, max: f64) -> usize {
    let part = (value / max).clamp(0.0, 1.0) * COLOUR_LEVEL_COUNT as f64;
    (part.ceil() as usize).clamp(1, COLOUR_LEVEL_COUNT) - 1
}

/// Adds the CSS rules with which a dark screen replaces the colours.
pub(super) fn add_dark_rules(rules: &mut String) {
    let [_, track] = BACKGROUND_COLOURS;
    let _ = write!(rules, ".track{{fill:{track}}}");
    for level in 0..COLOUR_LEVEL_COUNT {
        let [_, colour] = level_colours(level);
        let _ = write!(rules, ".v{level}{{fill:{colour}}}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the relative luminance of a colour, by the sRGB standard.
    fn luminance(colour: &str) -> f64 {
        let part = |at: usize| f64::from(u8::from_str_radix(&colour[at..at + 2], 16).unwrap()) / 255.0;
        let [r, g, b] = [1, 3, 5].map(|at| part(at).powf(2.2));
        0.2126 * r + 0.7152 * g + 0.0722 * b
    }

    #[test]
    fn levels_grow_darker_on_paper_and_lighter_on_a_dark_screen() {
        let all: Vec<_> = (0..COLOUR_LEVEL_COUNT).map(level_colours).collect();
        assert_eq!(all[0][0], "#FEE838");
        assert_eq!(all[COLOUR_LEVEL_COUNT - 1], ["#00224E", "#FEE838"]);
        assert!(all.is_sorted_by(|one, next| luminance(&one[0]) > luminance(&next[0])));
        assert!(all.is_sorted_by(|one, next| luminance(&one[1]) < luminance(&next[1])));
    }

    #[test]
    fn every_value_above_0_has_a_level() {
        assert_eq!([1e-9, 0.5, 1.0, 7.0].map(|value| colour_level(value, 1.0)), [0, 7, 15, 15]);
    }
}
