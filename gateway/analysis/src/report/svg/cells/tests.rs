use super::*;
use crate::report::figure::{MapCell, StripGroup, StripRow};
use roxmltree::Document;

const SVG: &str = "http://www.w3.org/2000/svg";

fn newtons(max: f64) -> ColourLegend {
    ColourLegend { caption: "force".to_owned(), unit: "N".to_owned(), max }
}

/// Returns the positions and sizes of the rectangles in a path, as written.
fn rectangles(path: &str) -> Vec<[f64; 4]> {
    let pieces = path.split('z').filter(|piece| !piece.is_empty());
    let numbers = |piece: &str| {
        let mut numbers =
            piece.split(|c: char| c.is_ascii_alphabetic() || c == ' ').filter(|text| !text.is_empty());
        [(); 4].map(|()| numbers.next().unwrap().parse().unwrap())
    };
    pieces.map(numbers).collect()
}

fn path<'a>(document: &'a Document<'_>, class: &str) -> Option<&'a str> {
    let node = document.descendants().filter(|node| node.has_tag_name((SVG, "path")));
    // The legend's element comes first.
    let mut node =
        node.filter(|node| node.attribute("class") == Some(class) && node.first_element_child().is_none());
    node.next_back().and_then(|node| node.attribute("d"))
}

#[test]
fn a_strip_has_each_value_at_its_time_in_its_row_and_colour() {
    let row = |caption: &str, values: &[(f64, f64, f64)]| StripRow {
        caption: caption.to_owned(),
        values: values.into(),
    };
    let groups = vec![
        StripGroup {
            title: "link 2".to_owned(),
            rows: vec![row("7", &[(0.0, 5.0, 4.0)]), row("8", &[(5.0, 10.0, 1.0)])],
        },
        StripGroup { title: "link 3".to_owned(), rows: vec![row("9", &[(2.5, 5.0, 4.0)])] },
    ];
    let strip = CellStrip {
        title: "a < b".to_owned(),
        seconds: (0.0, 10.0),
        legend: newtons(4.0),
        groups,
        ..CellStrip::default()
    };
    let text = draw_cells(&Drawing::Strip(strip.clone()));
    let document = Document::parse(&text).unwrap();
    let tracks = rectangles(path(&document, "track").unwrap());
    let [first, second, third] = tracks[..] else { panic!("{tracks:?}") };
    assert!(first[1] < second[1] && second[1] < third[1], "one below the other");
    let full = rectangles(path(&document, "v15").unwrap());
    let [a, b] = full[..] else { panic!("{full:?}") };
    let (left, wide) = (first[0], first[2]);
    assert_eq!((a[1], b[1]), (first[1], third[1]));
    let near = |one: f64, other: f64| assert!((one - other).abs() < 0.5, "{one} {other}");
    for (one, other) in [(a[0], left), (a[2], wide / 2.0), (b[0], left + wide / 4.0), (b[2], wide / 4.0)] {
        near(one, other);
    }
    let [quarter] = rectangles(path(&document, "v3").unwrap())[..] else { panic!("one") };
    near(quarter[0], left + wide / 2.0);
    // What a script reads: rows where they are drawn, and values in runs.
    let inline = draw_inline(&Drawing::Strip(strip.clone()), 960, "both");
    let inline = Document::parse(&inline).unwrap();
    let label = inline.root_element().attribute("aria-label").unwrap();
    assert_eq!(label, "a < b. Colours: force, 0 to 4\u{a0}N. Vertical: cells. Horizontal: time (s).");
    let readable: serde_json::Value =
        serde_json::from_str(inline.root_element().attribute("data-strip").unwrap()).unwrap();
    assert_eq!(readable["rows"][1], serde_json::json!([second[1], second[3], "cell 8, link 2"]));
    assert_eq!(
        (&readable["x"]["ends"], &readable["legend"]["base"]),
        (&serde_json::json!([0.0, 10.0]), &"N".into())
    );
    let values = strip_values(&strip);
    assert_eq!(values, " data-values=\"[[[0.0,5.0,[4.0]]],[[5.0,5.0,[1.0]]],[[2.5,2.5,[4.0]]]]\"");
    let words: Vec<_> = document
        .descendants()
        .filter(|node| node.has_tag_name((SVG, "text")))
        .filter_map(|node| node.text())
        .collect();
    for word in ["link 2", "link 3", "7", "9", "4\u{a0}N", "2\u{a0}N", "time (s)", "10"] {
        assert!(words.contains(&word), "{word}: {words:?}");
    }
}

#[test]
fn a_map_has_each_cell_once_apart_and_inside() {
    let spot = |at: [f64; 2], value: Option<f64>| MapCell { at, value, caption: format!("vcan0 {at:?}") };
    let cells = (0..30_u32).map(|at| {
        let angle = (f64::from(at % 10) - 4.5) / 10.0 * core::f64::consts::TAU;
        spot([0.05 * angle, f64::from(at / 10) * 0.03], if at == 4 { None } else { Some(f64::from(at)) })
    });
    let tube = LinkPanel { title: "link 2".to_owned(), radius: Some(0.05), cells: cells.collect() };
    let plate =
        LinkPanel { title: "link 3".to_owned(), radius: None, cells: vec![spot([0.3, -0.2], Some(0.0))] };
    let map = CellMap { legend: newtons(29.0), panels: vec![tube, plate], ..CellMap::default() };
    for width in [960, 470] {
        let text = draw_inline(&Drawing::Map(map.clone()), width, "both");
        let document = Document::parse(&text).unwrap();
        let high: f64 =
            document.root_element().attribute("viewBox").unwrap().split(' ').nth(3).unwrap().parse().unwrap();
        let cells: Vec<_> = document
            .descendants()
            .filter(|node| node.has_tag_name((SVG, "path")) && node.first_element_child().is_some())
            .collect();
        assert_eq!(cells.len(), 31);
        let mut middles = Vec::new();
        for cell in &cells {
            let corners: Vec<f64> = cell
                .attribute("d")
                .unwrap()
                .split(['M', 'L', ' ', 'z'])
                .filter(|text| !text.is_empty())
                .map(|text| text.parse().unwrap())
                .collect();
            assert_eq!(corners.len(), 12);
            let middle = [0, 1].map(|way| corners.iter().skip(way).step_by(2).sum::<f64>() / 6.0);
            assert!(
                (0.0..f64::from(width)).contains(&middle[0]) && (0.0..high).contains(&middle[1]),
                "{middle:?}"
            );
            middles.push(middle);
        }
        for (at, one) in middles.iter().enumerate() {
            let nearest = middles[..at].iter().map(|other| (one[0] - other[0]).hypot(one[1] - other[1]));
            assert!(nearest.fold(f64::INFINITY, f64::min) > 8.0, "{at}");
        }
        let titles: Vec<_> =
            cells.iter().map(|cell| cell.first_element_child().unwrap().text().unwrap()).collect();
        assert!(titles[4].ends_with(": not known") && titles[29].ends_with(": 29\u{a0}N"), "{titles:?}");
        assert_eq!(cells[29].attribute("class"), Some("v15"));
        assert_eq!(cells[30].attribute("class"), Some("none"), "no force, no colour");
    }
}
