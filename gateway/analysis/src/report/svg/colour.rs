//! The colours of values: viridis (Smith and van der Walt, *A better default colormap for Matplotlib*, 2015), whose
//! order all readers can see, with any kind of colour vision. High values contrast with the background: dark on paper,
//! light on a dark screen. The pages of `skinbus view` have the same colours (`gateway/view/web/colours.js`).

use std::fmt::Write as _;

/// Number of colours for values above 0.
pub(super) const COLOUR_LEVEL_COUNT: usize = 16;

/// The colours of viridis at equal distances, as red, green and blue.
const VIRIDIS_RGB: [[f64; 3]; 10] = [
    [68.0, 1.0, 84.0],
    [72.0, 40.0, 120.0],
    [62.0, 74.0, 137.0],
    [49.0, 104.0, 142.0],
    [38.0, 130.0, 142.0],
    [31.0, 158.0, 137.0],
    [53.0, 183.0, 121.0],
    [110.0, 206.0, 88.0],
    [181.0, 222.0, 43.0],
    [253.0, 231.0, 37.0],
];
/// The parts of viridis for the lowest and the highest value, on paper and on a dark screen.
const SCALES: [[f64; 2]; 2] = [[0.9, 0.0], [0.4, 1.0]];

/// The background of cells and rows, on paper and on a dark screen.
pub(super) const BACKGROUND_COLOURS: [&str; 2] = ["#EBEDEF", "#26292E"];

/// Returns the viridis colour at a position from 0 to 1, as a CSS colour.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 9, and 0 to 255")]
fn viridis_css_colour(place: f64) -> String {
    let at = place.clamp(0.0, 1.0) * (VIRIDIS_RGB.len() - 1) as f64;
    let (from, part) = (at.floor() as usize, at.fract());
    let [one, next] =
        [from, from + 1].map(|at| VIRIDIS_RGB.get(at).or(VIRIDIS_RGB.last()).copied().unwrap_or_default());
    let mut text = "#".to_owned();
    for (one, next) in one.into_iter().zip(next) {
        let _ = write!(text, "{:02X}", (one + part * (next - one)).round() as u8);
    }
    text
}

/// Returns the colours of a level on paper and on a dark screen; levels count from 0.
pub(super) fn level_colours(level: usize) -> [String; 2] {
    let part = level as f64 / (COLOUR_LEVEL_COUNT - 1) as f64;
    SCALES.map(|[low, high]| viridis_css_colour(low + (high - low) * part))
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
        assert_eq!(all[0], ["#BCDF2A", "#2A788E"]);
        assert_eq!(all[COLOUR_LEVEL_COUNT - 1], ["#440154", "#FDE725"]);
        assert!(all.is_sorted_by(|one, next| luminance(&one[0]) > luminance(&next[0])));
        assert!(all.is_sorted_by(|one, next| luminance(&one[1]) < luminance(&next[1])));
    }

    #[test]
    fn the_pages_have_the_same_colours() {
        let page = include_str!("../../../../view/web/colours.js");
        let stops = VIRIDIS_RGB.map(|[r, g, b]| format!("[{r}, {g}, {b}]")).join(", ");
        assert!(page.contains(&format!("const STOPS = [{stops}];")), "{stops}");
        let [paper, dark] = SCALES.map(|[low, high]| format!("[{low}, {high}]"));
        assert!(page.contains(&format!("const [ON_DARK, ON_LIGHT] = [{dark}, {paper}];")), "{dark}, {paper}");
    }

    #[test]
    fn every_value_above_0_has_a_level() {
        assert_eq!([1e-9, 0.5, 1.0, 7.0].map(|value| colour_level(value, 1.0)), [0, 7, 15, 15]);
    }
}
