//! Draws strips and maps of cells.

use std::fmt::Write as _;

use protocol::xml::escaped;
use serde::Serialize;

use super::super::figure::{
    Axis, CellMap, CellStrip, ColourLegend, Drawing, FigureWidth, LinkPanel, format_quantity,
};
use super::super::number::round_to_three_digits;
use super::super::scale::AxisSpan;
use super::colour::{BACKGROUND_COLOURS, COLOUR_LEVEL_COUNT, colour_level, level_colours};
use super::palette::{FAINT_TEXT_COLOUR, TEXT_COLOUR, dark_css_rules};
use super::reading::{ReadableAxis, ReadableUnit, data_attribute};
use super::{LETTER_SIZE_PX, natural_size};

/// Mean width of a letter, in pixels.
const LETTER_WIDTH_PX: f64 = 0.56 * LETTER_SIZE_PX;
/// Margin of a drawing, in pixels.
const MARGIN_PX: f64 = 12.0;
/// Height of the legend with the space below it, in pixels.
const LEGEND_HEIGHT_PX: f64 = 52.0;
/// Height of the heading of a panel or group, in pixels.
const HEADING_HEIGHT_PX: f64 = 24.0;
/// Maximum distance between the centres of adjacent cells, in pixels.
const MAX_CELL_PITCH_PX: f64 = 18.0;
/// Overlap of adjacent areas in pixels, so that no seams are visible.
const SEAM_OVERLAP_PX: f64 = 0.3;
/// Distance between cells in m that is assumed for a link with a single cell.
const SINGLE_CELL_PITCH_M: f64 = 0.028;

/// Draws a standalone SVG file.
#[must_use]
pub fn draw_cells(drawing: &Drawing) -> String {
    let style = format!("<title>{}</title>\n<style>{}</style>\n", escaped(drawing.title()), dark_css_rules());
    let (width, _) = natural_size(FigureWidth::Wide);
    let Body { height, elements, .. } = draw_body(drawing, width.into());
    let attributes = format!("width=\"{width}\" height=\"{height}\" font-family=\"sans-serif\"");
    svg_document(drawing, (width.into(), height), &attributes, &format!("{style}{elements}"))
}

/// Draws cells as an element of a page that contains the CSS rules of [`dark_rules`](super::dark_css_rules); `width` is
/// the width in pixels before scaling.
#[must_use]
pub fn draw_inline(drawing: &Drawing, width: u32, class: &str) -> String {
    let Body { height, data, elements } = draw_body(drawing, width.into());
    svg_document(drawing, (width.into(), height), &format!("class=\"{class}\"{data}"), &elements)
}

/// Returns the values of each row of a strip as an attribute, from which the script of a page reads them: runs of equal
/// intervals, each with its start and interval in s, and the values.
#[must_use]
pub fn strip_values(strip: &CellStrip) -> String {
    let rows = strip.groups.iter().flat_map(|group| &group.rows);
    let runs: Vec<Vec<(f64, f64, Vec<f64>)>> = rows
        .map(|row| {
            let follows = |one: &(f64, f64, f64), next: &(f64, f64, f64)| {
                let (step, next_step) = (one.1 - one.0, next.1 - next.0);
                (next.0 - one.1).abs() < 1e-6 && (next_step - step).abs() < 1e-6
            };
            let runs = row.values.chunk_by(follows).filter_map(|run| {
                let (from, to, _) = run.first()?;
                let values = run.iter().map(|(.., value)| round_to_three_digits(*value)).collect();
                Some((round_to_micros(*from), round_to_micros(to - from), values))
            });
            runs.collect()
        })
        .collect();
    data_attribute("values", &runs)
}

/// Rounds a time in s to µs.
fn round_to_micros(seconds: f64) -> f64 {
    (seconds * 1e6).round() / 1e6
}

fn svg_document(drawing: &Drawing, (width, height): (f64, f64), attributes: &str, body: &str) -> String {
    let label = escaped(&drawing.description());
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{label}\" \
         {attributes} font-size=\"{LETTER_SIZE_PX}\">\n{body}</svg>\n"
    )
}

/// The contents of a drawing.
struct Body {
    /// Height in pixels.
    height: f64,
    /// The attribute from which the script of a page reads values.
    data: String,
    /// The SVG elements.
    elements: String,
}

fn draw_body(drawing: &Drawing, width: f64) -> Body {
    let mut elements = String::new();
    let (height, data) = match drawing {
        Drawing::Strip(strip) => {
            let (height, readable) = write_strip(&mut elements, strip, width);
            (height, data_attribute("strip", &readable))
        }
        Drawing::Map(map) => (write_map(&mut elements, map, width), data_attribute("map", &())),
    };
    Body { height: height.ceil(), data, elements }
}

/// A strip as a script reads it, beside the values of [`strip_values`].
#[derive(Serialize)]
struct ReadableStrip {
    x: ReadableAxis,
    /// Top and height of each row, and the name of its cell.
    rows: Vec<(f64, f64, String)>,
    legend: ReadableLegend,
}

#[derive(Serialize)]
struct ReadableLegend {
    caption: String,
    #[serde(flatten)]
    unit: ReadableUnit,
}

/// The alignment of a text.
#[derive(Clone, Copy)]
enum TextAnchor {
    Start,
    Middle,
    End,
}

fn write_text(out: &mut String, (x, y): (f64, f64), anchor: TextAnchor, is_faint: bool, text: &str) {
    let (colour, class) = if is_faint { (FAINT_TEXT_COLOUR, "faint-f") } else { (TEXT_COLOUR, "ink-f") };
    let anchor = match anchor {
        TextAnchor::Start => "",
        TextAnchor::Middle => " text-anchor=\"middle\"",
        TextAnchor::End => " text-anchor=\"end\"",
    };
    let (r, g, b) = (colour.0, colour.1, colour.2);
    let _ = writeln!(
        out,
        "<text x=\"{x:.1}\" y=\"{y:.1}\"{anchor} class=\"{class}\" fill=\"#{r:02X}{g:02X}{b:02X}\">{}</text>",
        escaped(text)
    );
}

fn write_line(out: &mut String, path: &str) {
    let (r, g, b) = (FAINT_TEXT_COLOUR.0, FAINT_TEXT_COLOUR.1, FAINT_TEXT_COLOUR.2);
    let _ = writeln!(
        out,
        "<path class=\"faint-s\" fill=\"none\" stroke=\"#{r:02X}{g:02X}{b:02X}\" stroke-width=\"1\" d=\"{path}\"/>"
    );
}

fn write_background(out: &mut String, path: &str) {
    let [paper, _] = BACKGROUND_COLOURS;
    let _ = writeln!(out, "<path class=\"track\" fill=\"{paper}\" d=\"{path}\"/>");
}

/// Areas to fill, by level of colour; the areas of a level become one SVG element.
#[derive(Default)]
struct LevelPaths([String; COLOUR_LEVEL_COUNT]);

impl LevelPaths {
    fn path_of_value(&mut self, value: f64, max: f64) -> Option<&mut String> {
        self.0.get_mut(colour_level(value, max))
    }

    fn write_paths(self, out: &mut String) {
        for (level, path) in self.0.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
            let [paper, _] = level_colours(level);
            let _ = writeln!(out, "<path class=\"v{level}\" fill=\"{paper}\" d=\"{path}\"/>");
        }
    }
}

fn add_rectangle(path: &mut String, (x, y): (f64, f64), (width, height): (f64, f64)) {
    let _ = write!(path, "M{x:.1} {y:.1}h{width:.1}v{height:.1}h-{width:.1}z");
}

/// Draws the legend of the colours at the top.
fn write_legend(out: &mut String, legend: &ColourLegend, width: f64) {
    let bar = (width * 0.4).min(260.0);
    let left = MARGIN_PX + LETTER_WIDTH_PX * legend.caption.chars().count() as f64 + 14.0;
    write_text(out, (MARGIN_PX, 23.0), TextAnchor::Start, false, &legend.caption);
    let mut levels = LevelPaths::default();
    for at in 0..COLOUR_LEVEL_COUNT {
        let part = bar / COLOUR_LEVEL_COUNT as f64;
        let path = levels.path_of_value((at as f64 + 0.5) / COLOUR_LEVEL_COUNT as f64, 1.0);
        path.into_iter().for_each(|path| {
            add_rectangle(path, (left + part * at as f64, 12.0), (part + SEAM_OVERLAP_PX, 14.0))
        });
    }
    levels.write_paths(out);
    for (part, anchor) in [(0.0, TextAnchor::Middle), (0.5, TextAnchor::Middle), (1.0, TextAnchor::Middle)] {
        write_text(
            out,
            (left + part * bar, 42.0),
            anchor,
            true,
            &format_quantity(part * legend.max, &legend.unit),
        );
    }
}

fn write_strip(out: &mut String, strip: &CellStrip, width: f64) -> (f64, ReadableStrip) {
    write_legend(out, &strip.legend, width);
    let rows: usize = strip.groups.iter().map(|group| group.rows.len()).sum();
    let row = if rows > 20 { 14.0 } else { 18.0 };
    let captions = strip.groups.iter().flat_map(|group| &group.rows).map(|row| row.caption.chars().count());
    let left = MARGIN_PX + LETTER_WIDTH_PX * captions.max().unwrap_or(0) as f64 + 10.0;
    let right = width - 24.0;
    let time = Axis::new("time", "s").with_ends(strip.seconds.0, strip.seconds.1);
    let span = AxisSpan::new(&time, [].into_iter(), 0.0);
    let place = |seconds: f64| left + span.position(seconds).clamp(0.0, 1.0) * (right - left);
    let (mut tracks, mut levels, mut y) = (String::new(), LevelPaths::default(), LEGEND_HEIGHT_PX);
    let mut readable = Vec::new();
    for group in &strip.groups {
        write_text(out, (MARGIN_PX, y + 16.0), TextAnchor::Start, false, &group.title);
        y += HEADING_HEIGHT_PX;
        for of_cell in &group.rows {
            write_text(out, (left - 8.0, y + row * 0.5 + 4.5), TextAnchor::End, true, &of_cell.caption);
            add_rectangle(&mut tracks, (left, y), (right - left, row - 2.0));
            readable.push((y, row - 2.0, format!("cell {}, {}", of_cell.caption, group.title)));
            for (from, to, value) in &of_cell.values {
                let (from, to) = (place(*from), place(*to));
                let path = levels.path_of_value(*value, strip.legend.max);
                path.into_iter().for_each(|path| {
                    add_rectangle(path, (from, y), ((to - from).max(0.5) + SEAM_OVERLAP_PX, row - 2.0))
                });
            }
            y += row;
        }
        y += 4.0;
    }
    write_background(out, &tracks);
    levels.write_paths(out);
    let mut axis = format!("M{left:.1} {y:.1}H{right:.1}");
    let most = if width > 600.0 { 12 } else { 5 };
    for tick in span.ticks(most) {
        let x = place(tick);
        let _ = write!(axis, "M{x:.1} {y:.1}v5");
        write_text(out, (x, y + 19.0), TextAnchor::Middle, false, &span.tick_caption(tick, most));
    }
    write_line(out, &axis);
    write_text(out, ((left + right) / 2.0, y + 38.0), TextAnchor::Middle, false, &span.title(&time));
    let (caption, unit) = (strip.legend.caption.clone(), ReadableUnit::new(&strip.legend.unit));
    let x = ReadableAxis::new(&time, &span, [left, right]);
    (y + 46.0, ReadableStrip { x, rows: readable, legend: ReadableLegend { caption, unit } })
}

/// The cells of one panel, and the area that they cover in m.
struct PanelLayout<'a> {
    panel: &'a LinkPanel,
    /// The smallest coordinates of the area in m; in the next field, its width and height.
    from: [f64; 2],
    size: [f64; 2],
    /// Median distance from a cell to its nearest neighbour, in m.
    pitch: f64,
    /// Mean direction of the nearest neighbours, modulo 60 degrees.
    turn: f64,
}

impl<'a> PanelLayout<'a> {
    fn new(panel: &'a LinkPanel) -> Self {
        let nearest = panel.cells.iter().filter_map(|cell| {
            let [x, y] = cell.at;
            let others = panel.cells.iter().map(|other| (other.at[0] - x, other.at[1] - y));
            let others =
                others.map(|(x, y)| (x.hypot(y), y.atan2(x))).filter(|(distance, _)| *distance > 1e-6);
            others.min_by(|one, other| one.0.total_cmp(&other.0))
        });
        let mut nearest: Vec<_> = nearest.collect();
        nearest.sort_by(|one, other| one.0.total_cmp(&other.0));
        let pitch = nearest.get(nearest.len() / 2).map_or(SINGLE_CELL_PITCH_M, |(distance, _)| *distance);
        let [sine, cosine] = nearest.iter().fold([0.0, 0.0], |[sine, cosine], (_, way)| {
            [sine + (6.0 * way).sin(), cosine + (6.0 * way).cos()]
        });
        let ends = |of: fn([f64; 2]) -> f64| {
            let all = panel.cells.iter().map(|cell| of(cell.at));
            all.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), at| (from.min(at), to.max(at)))
        };
        let (mut x, y) = (ends(|[x, _]| x), ends(|[_, y]| y));
        if let Some(radius) = panel.radius {
            // A cylinder covers the full circumference.
            x = (-core::f64::consts::PI * radius, core::f64::consts::PI * radius);
        }
        let (from, size) = ([x.0, y.0].map(|at| at - pitch * 0.6), [x.1 - x.0, y.1 - y.0]);
        Self { panel, from, size: size.map(|size| size + pitch * 1.2), pitch, turn: sine.atan2(cosine) / 6.0 }
    }
}

fn write_map(out: &mut String, map: &CellMap, width: f64) -> f64 {
    write_legend(out, &map.legend, width);
    let sheets: Vec<_> =
        map.panels.iter().filter(|panel| !panel.cells.is_empty()).map(PanelLayout::new).collect();
    let max = |of: &dyn Fn(&PanelLayout<'_>) -> f64| sheets.iter().map(of).fold(f64::MIN_POSITIVE, f64::max);
    let pitch = sheets.iter().map(|sheet| sheet.pitch).fold(f64::INFINITY, f64::min);
    // Scale in pixels per metre, the same for all links.
    let scale =
        (MAX_CELL_PITCH_PX / pitch).min((width - 2.0 * MARGIN_PX - 50.0) / max(&|sheet| sheet.size[0]));
    let (mut x, mut y, mut height) = (MARGIN_PX, LEGEND_HEIGHT_PX, 0.0_f64);
    for sheet in &sheets {
        let title = LETTER_WIDTH_PX * sheet.panel.title.chars().count() as f64;
        let wide = (sheet.size[0] * scale + 50.0).max(title);
        if x > MARGIN_PX && x + wide > width - MARGIN_PX {
            (x, y, height) = (MARGIN_PX, y + height, 0.0);
        }
        let high = write_panel(out, sheet, &map.legend, (x, y), scale);
        (x, height) = (x + wide + 20.0, height.max(high + 12.0));
    }
    y + height
}

/// Draws one link, and returns its height in pixels, including heading and axis.
fn write_panel(
    out: &mut String,
    sheet: &PanelLayout<'_>,
    legend: &ColourLegend,
    (x, y): (f64, f64),
    scale: f64,
) -> f64 {
    write_text(out, (x, y + 14.0), TextAnchor::Start, false, &sheet.panel.title);
    let (left, top) = (x + 44.0, y + HEADING_HEIGHT_PX);
    let [wide, high] = sheet.size.map(|size| size * scale);
    let mut ground = String::new();
    add_rectangle(&mut ground, (left, top), (wide, high));
    write_background(out, &ground);
    let mut axis = String::new();
    let radius = sheet.pitch / 3_f64.sqrt() * 0.94 * scale;
    for cell in &sheet.panel.cells {
        let [across, down] =
            [cell.at[0] - sheet.from[0], cell.at[1] - sheet.from[1]].map(|from| from * scale);
        let mut path = String::new();
        for corner in 0..6_u32 {
            let angle = sheet.turn + core::f64::consts::FRAC_PI_3 * (f64::from(corner) + 0.5);
            let (x, y) = (left + across + radius * angle.cos(), top + down + radius * angle.sin());
            let _ = write!(path, "{}{x:.1} {y:.1}", if corner == 0 { "M" } else { "L" });
        }
        path.push('z');
        write_hexagon(out, cell.value, legend, &cell.caption, &path);
    }
    // The axes show cm along the link, and degrees around it.
    let step = if high > 120.0 { 0.1 } else { 0.05 };
    let length = sheet.size[1] - sheet.pitch * 1.2;
    let first = sheet.from[1] + sheet.pitch * 0.6;
    for at in 0..40_u32 {
        let along = f64::from(at) * step;
        if along > length + 1e-6 {
            break;
        }
        let y = top + (first + along - sheet.from[1]) * scale;
        let _ = write!(axis, "M{left:.1} {y:.1}h-5");
        let text = if at == 0 { "0 cm".to_owned() } else { format!("{:.0}", along * 100.0) };
        write_text(out, (left - 7.0, y + 4.5), TextAnchor::End, true, &text);
    }
    let bottom = top + high;
    if sheet.panel.radius.is_some() {
        for (at, degrees) in (0_u32..).zip(["−180°", "−90°", "0°", "90°", "180°"]) {
            let part = f64::from(at) / 4.0;
            let inner = sheet.pitch * 0.6 * scale;
            let x = left + inner + part * (wide - 2.0 * inner);
            let _ = write!(axis, "M{x:.1} {bottom:.1}v5");
            if wide > 200.0 || at % 2 == 0 {
                write_text(out, (x, bottom + 18.0), TextAnchor::Middle, true, degrees);
            }
        }
    } else {
        write_text(out, (left, bottom + 18.0), TextAnchor::Start, true, "flat");
    }
    write_line(out, &axis);
    HEADING_HEIGHT_PX + high + 24.0
}

fn write_hexagon(out: &mut String, value: Option<f64>, legend: &ColourLegend, caption: &str, path: &str) {
    let (fill, text) = match value {
        Some(value) if value > 0.0 => {
            let level = colour_level(value, legend.max);
            let [paper, _] = level_colours(level);
            (format!("class=\"v{level}\" fill=\"{paper}\""), format_quantity(value, &legend.unit))
        }
        Some(_) => ("class=\"none\" fill=\"none\"".to_owned(), format_quantity(0.0, &legend.unit)),
        None => ("class=\"none\" fill=\"none\" stroke-dasharray=\"2 2\"".to_owned(), "not known".to_owned()),
    };
    let (r, g, b) = (FAINT_TEXT_COLOUR.0, FAINT_TEXT_COLOUR.1, FAINT_TEXT_COLOUR.2);
    let _ = writeln!(
        out,
        "<path {fill} stroke=\"#{r:02X}{g:02X}{b:02X}\" stroke-width=\"0.5\" d=\"{path}\"><title>{}: {}</title></path>",
        escaped(caption),
        escaped(&text)
    );
}

#[cfg(test)]
mod tests;
