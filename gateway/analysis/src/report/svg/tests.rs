use super::*;
use crate::report::figure::{Axis, LowerDiagram};
use roxmltree::{Document, Node};

fn figure(series: Vec<Series>) -> Figure {
    let (x, y) =
        (Axis::new("time", "s").with_ends(0.0, 10.0), Axis::new("torque", "Nm").with_ends(-1.0, 1.0));
    Figure {
        name: "figure".to_owned(),
        title: "A <title> & more".to_owned(),
        x,
        y,
        series,
        ..Figure::default()
    }
}

fn line(points: &[(f64, f64)]) -> Series {
    Series::new("a \"line\" & more", SeriesShape::Line, points.to_vec())
}

/// Returns the lines with this CSS class, each as a list of positions in drawing units.
fn lines<'a>(document: &'a Document<'_>, class: &'a str) -> Vec<Vec<(f64, f64)>> {
    let of_class =
        |node: &Node<'_, '_>| node.has_tag_name((SVG, "polyline")) && node.attribute("class") == Some(class);
    let places = |text: &str| {
        let pairs = text.split_whitespace().map(|pair| pair.split_once(',').unwrap());
        pairs.map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap())).collect()
    };
    let lines = document.descendants().filter(of_class).map(|node| places(node.attribute("points").unwrap()));
    // The legend's stroke is the last one.
    lines.collect()
}

const SVG: &str = "http://www.w3.org/2000/svg";

#[test]
fn values_stand_where_the_axes_say() {
    let text = draw_figure(&figure(vec![line(&[(0.0, -1.0), (5.0, 0.0), (10.0, 1.0)])]));
    let document = Document::parse(&text).unwrap();
    let places = lines(&document, "c0-s");
    let [(left, bottom), (middle, half), (right, top)] = places[0][..] else { panic!("{places:?}") };
    assert!(left < right && top < bottom, "to the right and upwards: {places:?}");
    assert!(((left + right) / 2.0 - middle).abs() <= 1.0 && ((top + bottom) / 2.0 - half).abs() <= 1.0);
    let (width, height) = natural_size(FigureWidth::Wide);
    assert!(left > 0.0 && right < f64::from(width) * f64::from(UNITS_PER_PIXEL));
    assert!(top > 0.0 && bottom < f64::from(height) * f64::from(UNITS_PER_PIXEL));
    // The label of a tick is at its value.
    let words: Vec<_> = document.descendants().filter(|node| node.has_tag_name((SVG, "text"))).collect();
    let at = |word: &str, axis: &str| {
        let node = words.iter().find(|node| node.text().unwrap().trim() == word).unwrap();
        node.attribute(axis).unwrap().parse::<f64>().unwrap()
    };
    assert!((at("5", "x") - middle).abs() <= f64::from(UNITS_PER_PIXEL), "{} {middle}", at("5", "x"));
    assert!((at("0.0", "y") - half).abs() <= f64::from(UNITS_PER_PIXEL), "{} {half}", at("0.0", "y"));
    for word in ["time (s)", "torque (Nm)", "a \"line\" & more"] {
        assert!(words.iter().any(|node| node.text().unwrap().trim() == word), "{word} in {text}");
    }
    let title = document.descendants().find(|node| node.has_tag_name((SVG, "title"))).unwrap();
    assert_eq!(title.text(), Some("A <title> & more"));
}

#[test]
fn what_lies_outside_is_truncated_at_the_edge_and_a_gap_is_a_gap() {
    let inside = [(0.0, -1.0), (10.0, 1.0)];
    let beyond = [(0.0, -3.0), (5.0, 3.0), (10.0, -3.0)];
    let gap = [(0.0, 0.5), (2.0, 0.5), (3.0, f64::NAN), (4.0, 0.5), (6.0, 0.5)];
    let text = draw_figure(&figure(vec![line(&inside), line(&beyond), line(&gap)]));
    let document = Document::parse(&text).unwrap();
    let (frame, beyond, gap) = (lines(&document, "c0-s"), lines(&document, "c1-s"), lines(&document, "c2-s"));
    let [(left, bottom), (right, top)] = frame[0][..] else { panic!("{frame:?}") };
    assert_eq!(beyond.len(), 2 + 1, "two pieces, and the legend's");
    for (x, y) in beyond[..2].concat() {
        assert!((left..=right).contains(&x) && (top - 1.0..=bottom + 1.0).contains(&y), "{x} {y}");
    }
    // From -3 to 3 in 5 s, it crosses -1 after 5/3 s.
    let into = left + (right - left) / 6.0;
    assert!((beyond[0][0].0 - into).abs() <= 2.0, "{beyond:?} {into}");
    assert_eq!(gap.len(), 2 + 1, "{gap:?}");
}

#[test]
fn steps_hold_their_value_dashes_are_an_attribute_and_a_band_is_an_area() {
    let points = vec![(0.0, 0.0), (5.0, 0.5), (10.0, 0.5)];
    let shape = |shape| draw_figure(&figure(vec![Series::new("", shape, points.clone())]));
    let steps = shape(SeriesShape::Steps);
    let steps = lines(&Document::parse(&steps).unwrap(), "c0-s");
    assert_eq!(steps[0].len(), 5);
    assert!(steps[0][0].1 > steps[0][2].1 && (steps[0][1].1 - steps[0][0].1).abs() < 0.5, "{steps:?}");
    assert!(shape(SeriesShape::Dashed).contains("stroke-dasharray"));
    assert!(!shape(SeriesShape::Line).contains("stroke-dasharray"));
    assert!(shape(SeriesShape::Band).contains("<polygon"));
    assert_eq!(shape(SeriesShape::Points).matches("<circle").count(), 3);
}

#[test]
fn nothing_to_draw_is_drawn_as_axes() {
    for points in [vec![], vec![(f64::NAN, 1.0)], vec![(1.0, f64::INFINITY)], vec![(2.0, 3.0)]] {
        for shape in [
            SeriesShape::Line,
            SeriesShape::Dashed,
            SeriesShape::Points,
            SeriesShape::Steps,
            SeriesShape::Band,
        ] {
            for scale in [Axis::new("x", ""), Axis::new("x", "").with_log_scale()] {
                let series = vec![Series::new("something", shape, points.clone())];
                let figure = Figure { series, x: scale.clone(), y: scale, ..figure(Vec::new()) };
                let text = draw_figure(&figure);
                let document = Document::parse(&text).unwrap();
                assert!(document.descendants().any(|node| node.has_tag_name((SVG, "line"))), "{text}");
            }
        }
    }
}

#[test]
fn an_hour_at_500_hz_is_a_small_drawing() {
    let points: Vec<_> =
        (0..1_800_000).map(|n| (f64::from(n) / 180_000.0, f64::from(n % 17) / 17.0)).collect();
    let text = draw_figure(&figure(vec![line(&points)]));
    assert!(text.len() < 60_000, "{}", text.len());
}

#[test]
fn every_colour_has_another_one_on_a_dark_screen() {
    let rules = dark_css_rules();
    for (_, class, colour) in COLOUR_CLASSES {
        assert!(rules.contains(&format!(".{class}-s{{stroke:{colour}}}")));
    }
    let series = (0..9)
        .map(|n| Series::new(format!("s{n}"), SeriesShape::Line, vec![(0.0, 0.0), (10.0, 0.1)]))
        .collect();
    let text = draw_figure(&figure(series));
    let document = Document::parse(&text).unwrap();
    for node in document.descendants() {
        let coloured = ["fill", "stroke"]
            .iter()
            .filter_map(|name| node.attribute(*name))
            .any(|value| value.starts_with('#'));
        assert!(!coloured || node.attribute("class").is_some(), "{node:?}");
    }
}

#[test]
fn a_diagram_below_has_its_own_scale_and_the_same_time() {
    let upper = [(0.0, -100_000.0), (10.0, 100_000.0)];
    let lower = Series::new("", SeriesShape::Line, vec![(0.0, -1e-4), (10.0, 1e-4)]);
    let below = LowerDiagram {
        y: Axis::new("difference", "Nm").with_ends(-1e-4, 1e-4),
        series: vec![lower],
        marks: Vec::new(),
    };
    let upper = Figure { y: Axis::new("torque", "Nm").with_ends(-1e5, 1e5), ..figure(vec![line(&upper)]) };
    let text = draw_figure(&upper.with_lower_diagram(below));
    let document = Document::parse(&text).unwrap();
    let places = lines(&document, "c0-s");
    let ([(left, bottom), (right, top)], [(from, lowest), (to, highest)]) = (&places[0][..], &places[2][..])
    else {
        panic!("the upper line, its legend, the lower line: {places:?}")
    };
    assert_eq!((left, right), (from, to), "one time axis, whatever the widths of the numbers");
    assert!(top < bottom && bottom < highest && highest < lowest, "{places:?}");
    let (_, height) = natural_size(FigureWidth::Wide);
    assert!(*lowest < f64::from(height + LOWER_DIAGRAM_HEIGHT) * f64::from(UNITS_PER_PIXEL), "inside");
    let words: Vec<_> = document
        .descendants()
        .filter(|node| node.has_tag_name((SVG, "text")))
        .filter_map(|node| node.text())
        .map(str::trim)
        .collect();
    assert_eq!(words.iter().filter(|word| **word == "time (s)").count(), 1, "{words:?}");
    assert!(words.contains(&"torque (kNm)") && words.contains(&"difference (µNm)"), "{words:?}");
}

/// Returns the diagrams of a drawing in a page, as a script reads them.
fn readable(text: &str) -> serde_json::Value {
    let document = Document::parse(text).unwrap();
    serde_json::from_str(document.root_element().attribute("data-plots").unwrap()).unwrap()
}

#[test]
fn a_script_finds_the_elements_of_each_series_and_their_values() {
    let gap = [(0.0, 0.5), (2.0, 0.5), (3.0, f64::NAN), (4.0, 0.5), (5.0, 0.25)];
    let shapes = [SeriesShape::Dashed, SeriesShape::Points, SeriesShape::Band, SeriesShape::Line];
    let mut series: Vec<_> = shapes.map(|shape| Series::new("<&>\"", shape, gap.to_vec())).into();
    series.extend((0..Figure::COLOUR_COUNT).map(|_| Series::new("", SeriesShape::Steps, gap.to_vec())));
    let below = LowerDiagram {
        y: Axis::new("error", "Nm").with_ends(1e-6, 1e-2).with_log_scale(),
        series: vec![Series::new("", SeriesShape::Line, vec![(5.0, 1e-4), (10.0, 1e-4)])],
        marks: vec![MarkLine::at_y(1e-3, "limit")],
    };
    let figure = figure(series).with_lower_diagram(below);
    let text = draw_inline(&figure, figure_size(&figure, FigureWidth::Half), "both");
    let document = Document::parse(&text).unwrap();
    let coloured = |node: &Node<'_, '_>| {
        let class = node.attribute("class").unwrap_or_default();
        node.tag_name().name() != "text" && class.starts_with('c') && class[1..2].parse::<u8>().is_ok()
    };
    let drawn: Vec<_> = document.descendants().filter(coloured).collect();
    let plots = readable(&text);
    let mut next = 0;
    for (at, plot) in plots.as_array().unwrap().iter().enumerate() {
        for (index, one) in plot["series"].as_array().unwrap().iter().enumerate() {
            let count = usize::try_from(one[1].as_u64().unwrap()).unwrap();
            let class = format!("c{}", index % Figure::COLOUR_COUNT);
            let own = &drawn[next..next + count];
            assert!(count > 0 && own.iter().all(|node| node.attribute("class").unwrap().starts_with(&class)));
            next += count;
            let name = ["<&>\"", "torque", "error"][if at == 1 { 2 } else { usize::from(index >= 4) }];
            assert_eq!(one[0], name);
        }
        next += usize::try_from(plot["keys"].as_u64().unwrap()).unwrap();
    }
    assert_eq!(next, drawn.len(), "all elements are of a series or a legend");

    // The place of a point is the value that was drawn.
    let last = lines(&document, "c0-s").pop().unwrap()[0];
    let part = |axis: &serde_json::Value, place: f64| {
        let [from, to] = [0, 1].map(|end| axis["at"][end].as_f64().unwrap());
        (place - from) / (to - from)
    };
    let [x, y] = ["x", "y"].map(|axis| &plots[1][axis]);
    assert_eq!((&x["ends"], &y["ends"]), (&serde_json::json!([0.0, 10.0]), &serde_json::json!([1e-6, 1e-2])));
    assert!((part(x, last.0) - 0.5).abs() < 1e-3 && (part(y, last.1) - 0.5).abs() < 2e-3, "{last:?} {y}");
    assert_eq!((&y["log"], &y["base"], &plots[0]["y"]["log"]), (&true.into(), &"Nm".into(), &false.into()));
}
