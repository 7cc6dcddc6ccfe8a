//! Draws a figure as SVG.
//!
//! The drawing contains the colours for paper, so that every program can show it. Each colour also has a class, with
//! which [`dark_css_rules()`] replaces it on a dark screen.

mod cells;
mod colour;
mod palette;
mod reading;

pub use cells::{draw_cells, draw_inline as inline_cells, strip_values};
pub use palette::dark_css_rules;
#[cfg(test)]
pub(crate) use palette::text_colours;

use plotters::chart::{ChartBuilder, ChartContext};
use plotters::coord::Shift;
use plotters::coord::cartesian::Cartesian2d;
use plotters::drawing::{DrawingArea, DrawingAreaErrorKind, IntoDrawingArea};
use plotters::element::{Circle, PathElement, Polygon, Rectangle, Text};
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{Color, IntoFont, RGBColor, ShapeStyle, TextStyle};
use plotters_svg::SVGBackend;
use protocol::xml::escaped;

use super::figure::{Axis, Figure, FigureWidth, MarkAxis, MarkLine, Series, SeriesShape};
use super::scale::AxisSpan;
use super::thin::thin_points;
use palette::{COLOUR_CLASSES, FAINT_TEXT_COLOUR, GRID_COLOUR, TEXT_COLOUR, series_colours};
use reading::{ReadableAxis, ReadablePlot, data_attribute};

/// Number of drawing units per pixel, so that positions are whole numbers.
const UNITS_PER_PIXEL: i32 = 8;
/// Height of a diagram below another one, in pixels.
const LOWER_DIAGRAM_HEIGHT: u32 = 170;
/// Size of letters, in pixels.
const LETTER_SIZE_PX: f64 = 13.0;
/// Widths of lines in drawing units. The plotting library would draw each dash as a line of its own, of which a noisy
/// curve has thousands. So dashed lines have unique widths, by which they are found and given a dash attribute.
const LINE_WIDTH: u32 = 13;
const DASHED_LINE_WIDTH: u32 = 14;
const DOTTED_LINE_WIDTH: u32 = 9;
const DASH_PATTERNS: [(u32, &str); 2] = [(DASHED_LINE_WIDTH, "56 36"), (DOTTED_LINE_WIDTH, "16 24")];

/// Returns the width and the height of a figure in pixels, before scaling.
#[must_use]
pub const fn natural_size(size: FigureWidth) -> (u32, u32) {
    match size {
        FigureWidth::Wide => (960, 320),
        FigureWidth::Half => (470, 270),
    }
}

/// Returns the width and the height of a figure in pixels, including a diagram below it.
#[must_use]
pub(crate) const fn figure_size(figure: &Figure, size: FigureWidth) -> (u32, u32) {
    let (width, height) = natural_size(size);
    (width, if figure.below.is_some() { height + LOWER_DIAGRAM_HEIGHT } else { height })
}

/// Draws a standalone SVG file, for a paper or a document.
#[must_use]
pub fn draw_figure(figure: &Figure) -> String {
    let (width, height) = figure_size(figure, figure.size);
    let style = format!("<style>{}</style>\n", dark_css_rules());
    let attributes = format!("width=\"{width}\" height=\"{height}\" font-family=\"sans-serif\"");
    // Other programs show the title of a file; in a page it would cover the values that the script shows.
    let title = format!("<title>{}</title>\n", escaped(&figure.title));
    let (_, body) = draw(figure, (width, height));
    svg_document(figure, (width, height), &attributes, &format!("{title}{style}{body}"))
}

/// Draws a figure as an element of a page that contains the CSS rules of [`dark_css_rules()`]; `size` is the size in
/// pixels before scaling. The page's script reads the values.
#[must_use]
pub fn draw_inline(figure: &Figure, size: (u32, u32), class: &str) -> String {
    let (plots, body) = draw(figure, size);
    svg_document(figure, size, &format!("class=\"{class}\"{}", data_attribute("plots", &plots)), &body)
}

/// Returns the diagrams of a figure as a script reads them, and the SVG elements with the end of the document.
fn draw(figure: &Figure, (width, height): (u32, u32)) -> (Vec<ReadablePlot>, String) {
    let unit = UNITS_PER_PIXEL.unsigned_abs();
    let mut drawing = String::new();
    let area = SVGBackend::with_string(&mut drawing, (width * unit, height * unit)).into_drawing_area();
    // A drawing in memory can only fail if the area is too small.
    let drawn = draw_diagrams(figure, &area).and_then(|plots| area.present().map(|()| plots));
    drop(area);
    let body = drawing.split_once(">\n").map_or("", |(_, body)| body);
    match drawn {
        Ok(plots) => (plots, add_css_classes(body)),
        Err(_) => (Vec::new(), "</svg>\n".to_owned()),
    }
}

fn svg_document(figure: &Figure, (width, height): (u32, u32), attributes: &str, body: &str) -> String {
    let unit = UNITS_PER_PIXEL.unsigned_abs();
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\" {attributes} \
         stroke-linejoin=\"round\">\n{body}",
        width * unit,
        height * unit,
        escaped(&figure.description())
    )
}

/// Adds the CSS class to every colour of an SVG text.
fn add_css_classes(body: &str) -> String {
    let mut body = body.replace(" opacity=\"1\"", "").replace(" font-family=\"sans-serif\"", "");
    for (RGBColor(r, g, b), class, _) in COLOUR_CLASSES {
        for (attribute, kind) in [("fill", 'f'), ("stroke", 's')] {
            let colour = format!("{attribute}=\"#{r:02X}{g:02X}{b:02X}\"");
            body = body.replace(&colour, &format!("class=\"{class}-{kind}\" {colour}"));
        }
    }
    for (width, dashes) in DASH_PATTERNS {
        let width = format!("stroke-width=\"{width}\"");
        body = body.replace(&width, &format!("{width} stroke-dasharray=\"{dashes}\""));
    }
    body
}

type SvgArea<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type SvgChart<'a, 'b> = ChartContext<'b, SVGBackend<'a>, Cartesian2d<AxisSpan, AxisSpan>>;
type DrawResult<T = ()> = Result<T, DrawingAreaErrorKind<std::io::Error>>;

/// One of the diagrams of a figure.
#[derive(Clone, Copy)]
struct Diagram<'a> {
    axes: (&'a Axis, &'a Axis),
    /// The axes, fitted to the data.
    x: AxisSpan,
    y: AxisSpan,
    series: &'a [Series],
    marks: &'a [MarkLine],
    /// True if the labels of the horizontal axis belong below this diagram.
    is_lowest: bool,
}

impl<'a> Diagram<'a> {
    fn from_figure(figure: &'a Figure) -> Vec<Self> {
        let upper = (&figure.y, figure.series.as_slice(), figure.marks.as_slice());
        let lower = figure.below.as_ref().map(|it| (&it.y, it.series.as_slice(), it.marks.as_slice()));
        let drawn = || std::iter::once(upper).chain(lower);
        let points = || drawn().flat_map(|(_, series, _)| series).flat_map(|series| &series.points);
        let marks =
            |marks: &'a [MarkLine], on| marks.iter().filter(move |mark| mark.on == on).map(|mark| mark.at);
        let across = points().filter(|point| point.1.is_finite()).map(|point| point.0);
        let x = AxisSpan::new(&figure.x, across.chain(marks(&figure.marks, MarkAxis::X)), 0.0);
        let count = drawn().count();
        let diagrams = drawn().enumerate().map(|(at, (axis, series, of_marks))| {
            let up = series.iter().flat_map(|series| &series.points).map(|point| point.1);
            let y = AxisSpan::new(axis, up.chain(marks(of_marks, MarkAxis::Y)), 0.06);
            Self { axes: (&figure.x, axis), x, y, series, marks: of_marks, is_lowest: at + 1 == count }
        });
        diagrams.collect()
    }

    /// Returns the maximum number of ticks of the vertical axis, for a height in drawing units.
    const fn max_ticks(height: u32) -> usize {
        // A low diagram needs closer ticks.
        let distance = if height > pixels_to_units(LOWER_DIAGRAM_HEIGHT) { 42 } else { 32 };
        (height / pixels_to_units(distance)) as usize
    }

    /// Returns the number of letters of the longest label on the vertical axis.
    fn longest_label_letters(&self, height: u32) -> usize {
        let most = Self::max_ticks(height);
        let ticks = self.y.ticks(most).into_iter();
        ticks.map(|tick| self.y.tick_caption(tick, most).chars().count()).max().unwrap_or(1)
    }
}

fn draw_diagrams(figure: &Figure, area: &SvgArea<'_>) -> DrawResult<Vec<ReadablePlot>> {
    let diagrams = Diagram::from_figure(figure);
    let (_, height) = area.dim_in_pixel();
    let (upper, lower) = match figure.below {
        Some(_) => area.split_vertically(height.saturating_sub(pixels_to_units(LOWER_DIAGRAM_HEIGHT))),
        None => area.split_vertically(height),
    };
    let areas = [upper, lower];
    let digits = diagrams
        .iter()
        .zip(&areas)
        .map(|(diagram, area)| diagram.longest_label_letters(area.dim_in_pixel().1));
    // Both diagrams have the same left edge.
    let left = pixels_to_units(34)
        + pixels_to_signed_units(0.62 * LETTER_SIZE_PX * digits.max().unwrap_or(1) as f64).unsigned_abs();
    diagrams.iter().zip(&areas).map(|(diagram, area)| draw_diagram(diagram, area, left)).collect()
}

fn draw_diagram(diagram: &Diagram<'_>, area: &SvgArea<'_>, left: u32) -> DrawResult<ReadablePlot> {
    let Diagram { axes, x, y, series, marks, is_lowest } = *diagram;
    let (width, height) = area.dim_in_pixel();
    let (x_most, y_most) = ((width / pixels_to_units(80)) as usize, Diagram::max_ticks(height));
    let rows = legend_rows(series, width);
    let top = pixels_to_units(8) + pixels_to_units(20) * u32::try_from(rows.len()).unwrap_or(0);
    let (above, below) = area.split_vertically(top);
    let mut chart = ChartBuilder::on(&below)
        .margin_right(pixels_to_units(24))
        .margin_top(pixels_to_units(4))
        .x_label_area_size(pixels_to_units(if is_lowest { 44 } else { 12 }))
        .y_label_area_size(left)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .x_labels(x_most)
        .y_labels(y_most)
        .max_light_lines(1)
        .light_line_style(GRID_COLOUR.mix(0.0))
        .bold_line_style(GRID_COLOUR.stroke_width(pixels_to_units(1)))
        .axis_style(FAINT_TEXT_COLOUR.stroke_width(pixels_to_units(1)))
        .label_style(text_style(&TEXT_COLOUR, LETTER_SIZE_PX))
        .axis_desc_style(text_style(&TEXT_COLOUR, LETTER_SIZE_PX))
        .set_all_tick_mark_size(pixels_to_units(5))
        .x_label_formatter(&|tick| if is_lowest { x.tick_caption(*tick, x_most) } else { String::new() })
        .y_label_formatter(&|tick| y.tick_caption(*tick, y_most))
        .x_desc(if is_lowest { x.title(axes.0) } else { String::new() })
        .y_desc(y.title(axes.1))
        .draw()?;
    let (columns, lines) = chart.plotting_area().dim_in_pixel();
    let grain = (columns / UNITS_PER_PIXEL.unsigned_abs(), lines / UNITS_PER_PIXEL.unsigned_abs());
    let mut elements = Vec::with_capacity(series.len());
    for (series, colour) in series.iter().zip(series_colours()) {
        let name = if series.caption.is_empty() { &axes.1.caption } else { &series.caption };
        elements.push((name.clone(), draw_series(&mut chart, series, colour, (&x, &y), grain)?));
    }
    for mark in marks {
        draw_mark(&mut chart, mark, (&x, &y))?;
    }
    let mut keys = 0;
    for (row, entries) in (0..).zip(&rows) {
        for (at, series, colour) in entries {
            draw_legend_entry(&above, series, *colour, (*at, row))?;
            keys += if series.shape == SeriesShape::Dashed { 2 } else { 1 };
        }
    }
    let corner = |place: f64| chart.backend_coord(&(x.value_at(place), y.value_at(place)));
    let (from, to) = (corner(0.0), corner(1.0));
    Ok(ReadablePlot {
        x: ReadableAxis::new(axes.0, &x, [from.0, to.0].map(f64::from)),
        y: ReadableAxis::new(axes.1, &y, [from.1, to.1].map(f64::from)),
        series: elements,
        keys,
    })
}

/// Draws a series, and returns the number of its elements.
fn draw_series(
    chart: &mut SvgChart<'_, '_>,
    series: &Series,
    colour: RGBColor,
    (x, y): (&AxisSpan, &AxisSpan),
    (columns, lines): (u32, u32),
) -> DrawResult<usize> {
    let placed = series.points.iter().map(|point| (x.position(point.0), y.position(point.1)));
    let style =
        colour.stroke_width(if series.shape == SeriesShape::Dashed { DASHED_LINE_WIDTH } else { LINE_WIDTH });
    let back = |points: Vec<(f64, f64)>| -> Vec<(f64, f64)> {
        points.into_iter().map(|(across, up)| (x.value_at(across), y.value_at(up))).collect()
    };
    let mut elements = 0;
    match series.shape {
        SeriesShape::Line | SeriesShape::Dashed | SeriesShape::Steps => {
            for run in line_pieces(&placed.collect::<Vec<_>>()) {
                let run = thin_points(run, columns);
                let run = if series.shape == SeriesShape::Steps { stair_points(&run) } else { run };
                for piece in clip_line(&run) {
                    let points = back(piece);
                    chart.draw_series([PathElement::new(points, style)])?;
                    elements += 1;
                }
            }
        }
        SeriesShape::Points => {
            let mut points: Vec<_> = placed.filter(is_inside).collect();
            // Dots that cover each other are drawn once.
            let cell = |point: &(f64, f64)| {
                ((point.0 * f64::from(columns)).floor(), (point.1 * f64::from(lines)).floor())
            };
            if points.len() > 500 {
                points.sort_by(|a, b| cell(a).partial_cmp(&cell(b)).unwrap_or(std::cmp::Ordering::Equal));
                points.dedup_by(|a, b| cell(a) == cell(b));
            }
            let radius =
                if points.len() > 300 { pixels_to_signed_units(1.2) } else { pixels_to_signed_units(2.6) };
            elements = points.len();
            chart.draw_series(
                back(points).into_iter().map(|point| Circle::new(point, radius, colour.filled())),
            )?;
        }
        SeriesShape::Band => {
            let points = placed
                .filter(is_finite)
                .map(|point| (point.0.clamp(0.0, 1.0), point.1.clamp(0.0, 1.0)))
                .collect();
            chart.draw_series([Polygon::new(back(points), colour.mix(0.25).filled())])?;
            elements = 1;
        }
    }
    Ok(elements)
}

/// Returns true if a point, given as positions from 0 to 1, is inside the diagram.
fn is_inside(point: &(f64, f64)) -> bool {
    (0.0..=1.0).contains(&point.0) && (0.0..=1.0).contains(&point.1)
}

fn is_finite(point: &(f64, f64)) -> bool {
    point.0.is_finite() && point.1.is_finite()
}

/// Returns the pieces of a line between gaps, which are points with values that are not finite.
fn line_pieces(points: &[(f64, f64)]) -> impl Iterator<Item = &[(f64, f64)]> {
    points.split(|point| !is_finite(point)).filter(|run| !run.is_empty())
}

/// Returns the points of a line that holds each value until the next one, in steps.
pub(crate) fn stair_points(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut stairs = Vec::with_capacity(points.len() * 2);
    for point in points {
        if let Some(&(_, held)) = stairs.last() {
            stairs.push((point.0, held));
        }
        stairs.push(*point);
    }
    stairs
}

/// Returns the pieces of a line that are inside the diagram, cut at its edges.
fn clip_line(points: &[(f64, f64)]) -> Vec<Vec<(f64, f64)>> {
    if let [point] = points {
        // A single point would be an invisible line of no length.
        let dash = vec![(point.0 - 0.001, point.1), (point.0 + 0.001, point.1)];
        return if is_inside(point) { vec![dash] } else { Vec::new() };
    }
    let mut pieces: Vec<Vec<(f64, f64)>> = Vec::new();
    for pair in points.windows(2) {
        let [a, b] = pair else { continue };
        let (mut from, mut to) = (0.0_f64, 1.0_f64);
        for (at, way) in [(a.0, b.0 - a.0), (a.1, b.1 - a.1)] {
            if way == 0.0 {
                if !(0.0..=1.0).contains(&at) {
                    to = -1.0;
                }
            } else {
                let (low, high) = (-at / way, (1.0 - at) / way);
                from = from.max(low.min(high));
                to = to.min(low.max(high));
            }
        }
        if from > to {
            continue;
        }
        let point = |part: f64| (a.0 + part * (b.0 - a.0), a.1 + part * (b.1 - a.1));
        let end = if to < 1.0 { point(to) } else { *b };
        match pieces.last_mut() {
            Some(piece) if from == 0.0 && piece.last() == Some(a) => piece.push(end),
            _ => pieces.push(vec![if from > 0.0 { point(from) } else { *a }, end]),
        }
    }
    pieces
}

fn draw_mark(chart: &mut SvgChart<'_, '_>, mark: &MarkLine, (x, y): (&AxisSpan, &AxisSpan)) -> DrawResult {
    let place = if mark.on == MarkAxis::X { x.position(mark.at) } else { y.position(mark.at) };
    if !(0.0..=1.0).contains(&place) {
        return Ok(());
    }
    let ends =
        if mark.on == MarkAxis::X { [(place, 0.0), (place, 1.0)] } else { [(0.0, place), (1.0, place)] };
    let line = ends.map(|(across, up)| (x.value_at(across), y.value_at(up)));
    chart
        .draw_series([PathElement::new(line.to_vec(), FAINT_TEXT_COLOUR.stroke_width(DOTTED_LINE_WIDTH))])?;
    // Put the text on the side with room.
    let (across, up, side, end) = match mark.on {
        MarkAxis::X if place > 0.6 => (place, 1.0, HPos::Right, VPos::Top),
        MarkAxis::X => (place, 1.0, HPos::Left, VPos::Top),
        MarkAxis::Y if place > 0.9 => (1.0, place, HPos::Right, VPos::Top),
        MarkAxis::Y => (1.0, place, HPos::Right, VPos::Bottom),
    };
    let gap = if matches!(side, HPos::Left) { 0.006 } else { -0.006 };
    let style = text_style(&FAINT_TEXT_COLOUR, LETTER_SIZE_PX - 1.0).pos(Pos::new(side, end));
    let at = (x.value_at(across + gap), y.value_at(up - if mark.on == MarkAxis::X { 0.02 } else { 0.0 }));
    chart.draw_series([Text::new(mark.caption.clone(), at, style)])?;
    Ok(())
}

/// Returns the rows of the legend. Each entry has its horizontal start, its series, and the colour of the series.
fn legend_rows(series: &[Series], width: u32) -> Vec<Vec<(i32, &Series, RGBColor)>> {
    let named = series.iter().zip(series_colours()).filter(|(series, _)| !series.caption.is_empty());
    let mut rows: Vec<Vec<_>> = Vec::new();
    let mut at = i32::MAX;
    for (series, colour) in named {
        let room =
            pixels_to_signed_units(48.0 + 0.56 * LETTER_SIZE_PX * series.caption.chars().count() as f64);
        if at.saturating_add(room) > i32::try_from(width).unwrap_or(i32::MAX) {
            rows.push(Vec::new());
            at = pixels_to_signed_units(12.0);
        }
        if let Some(row) = rows.last_mut() {
            row.push((at, series, colour));
        }
        at = at.saturating_add(room);
    }
    rows
}

fn draw_legend_entry(
    area: &SvgArea<'_>,
    series: &Series,
    colour: RGBColor,
    (at, row): (i32, i32),
) -> DrawResult {
    let middle = pixels_to_signed_units(15.0) + row * pixels_to_signed_units(20.0);
    let end = at + pixels_to_signed_units(22.0);
    let style: ShapeStyle = colour.stroke_width(pixels_to_units(2));
    match series.shape {
        SeriesShape::Line | SeriesShape::Steps => {
            area.draw(&PathElement::new([(at, middle), (end, middle)], style))?
        }
        SeriesShape::Dashed => {
            for from in [at, at + pixels_to_signed_units(13.0)] {
                area.draw(&PathElement::new(
                    [(from, middle), (from + pixels_to_signed_units(9.0), middle)],
                    style,
                ))?;
            }
        }
        SeriesShape::Points => {
            area.draw(&Circle::new(
                (at + pixels_to_signed_units(11.0), middle),
                pixels_to_signed_units(3.0),
                colour.filled(),
            ))?;
        }
        SeriesShape::Band => {
            let half = pixels_to_signed_units(5.0);
            let corners = [(at, middle - half), (end, middle + half)];
            area.draw(&Rectangle::new(corners, colour.mix(0.25).filled()))?;
        }
    }
    let style = text_style(&TEXT_COLOUR, LETTER_SIZE_PX).pos(Pos::new(HPos::Left, VPos::Center));
    area.draw(&Text::new(series.caption.clone(), (end + pixels_to_signed_units(6.0), middle), style))
}

/// Returns the text style for letters of a size in pixels. The plotting library draws them smaller by a factor of 1.24,
/// which is corrected here.
fn text_style<'a>(colour: &RGBColor, size: f64) -> TextStyle<'a> {
    ("sans-serif", size * 1.24 * f64::from(UNITS_PER_PIXEL)).into_font().color(colour)
}

const fn pixels_to_units(count: u32) -> u32 {
    count * UNITS_PER_PIXEL.unsigned_abs()
}

#[expect(clippy::cast_possible_truncation, reason = "a length in a picture")]
fn pixels_to_signed_units(count: f64) -> i32 {
    (count * f64::from(UNITS_PER_PIXEL)).round() as i32
}

#[cfg(test)]
mod tests;
