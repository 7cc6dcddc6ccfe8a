//! Renders a page as one self-contained HTML file. It loads nothing; its script only shows values under the pointer, and
//! copies commands.

use std::fmt::Write as _;

use protocol::xml::escaped;

use super::figure::{Drawing, Figure, FigureWidth, Finding, FindingVerdict, Page, Section, Table};
use super::svg;

/// The style of all pages: light, dark on dark screens, and black on white for paper.
const PAGE_CSS: &str = include_str!("page.css");
/// The script of all pages. HTML ends it at `</script>`, and XML at the end of the section.
const PAGE_SCRIPT: &str = include_str!("page.js");

/// Renders a page, from its title to its last section, as the text of an HTML file.
#[must_use]
pub fn page_html(page: &Page) -> String {
    let mut out = String::new();
    let title = escaped(&page.title);
    let _ = write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n\
         <meta name=\"color-scheme\" content=\"light dark\"/>\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; \
         script-src 'unsafe-inline'\"/>\n<title>{title}</title>\n\
         <style>\n{PAGE_CSS}{}\n</style>\n</head>\n<body>\n<header>\n<h1>{title}</h1>\n",
        svg::dark_css_rules()
    );
    write_paragraph(&mut out, &page.intro);
    out.push_str("</header>\n");
    if page.sections.len() > 2 {
        out.push_str("<nav><ul>\n");
        for section in &page.sections {
            let (name, title) = (escaped(&section.name), escaped(&section.title));
            let _ = writeln!(out, "<li><a href=\"#{name}\">{title}</a></li>");
        }
        out.push_str("</ul></nav>\n");
    }
    out.push_str("<main>\n");
    for part in &page.sections {
        write_section(&mut out, part);
    }
    out.push_str("</main>\n");
    if !page.facts.is_empty() {
        out.push_str("<footer>\n<h2>Origin</h2>\n<dl>\n");
        for (name, value) in &page.facts {
            let _ = writeln!(out, "<dt>{}</dt><dd>{}</dd>", escaped(name), escaped(value));
        }
        out.push_str("</dl>\n</footer>\n");
    }
    let _ = write!(out, "<script>\n//<![CDATA[\n{PAGE_SCRIPT}//]]>\n</script>\n</body>\n</html>\n");
    out
}

fn write_paragraph(out: &mut String, text: &str) {
    if !text.is_empty() {
        let _ = writeln!(out, "<p>{}</p>", escaped(text));
    }
}

fn write_section(out: &mut String, section: &Section) {
    let (name, title) = (escaped(&section.name), escaped(&section.title));
    let _ = writeln!(out, "<section id=\"{name}\">\n<h2>{title}</h2>");
    for text in &section.text {
        write_paragraph(out, text);
    }
    if !section.findings.is_empty() {
        write_findings(out, &section.findings);
    }
    for drawing in &section.drawings {
        let (name, title) = (escaped(drawing.name()), escaped(drawing.title()));
        let values = match drawing {
            Drawing::Strip(strip) => svg::strip_values(strip),
            Drawing::Map(_) => String::new(),
        };
        let _ = writeln!(out, "<figure class=\"wide\" id=\"{name}\"{values}>");
        out.push_str(&svg::inline_cells(drawing, svg::natural_size(FigureWidth::Wide).0, "desk"));
        out.push_str(&svg::inline_cells(drawing, svg::natural_size(FigureWidth::Half).0, "hand"));
        let _ = writeln!(out, "<figcaption>{title}</figcaption>\n</figure>");
    }
    if !section.figures.is_empty() {
        out.push_str("<div class=\"figures\">\n");
        for part in &section.figures {
            write_figure(out, part);
        }
        out.push_str("</div>\n");
    }
    for part in &section.tables {
        write_table(out, part);
    }
    out.push_str("</section>\n");
}

fn write_figure(out: &mut String, figure: &Figure) {
    let class = if figure.size == FigureWidth::Wide { "wide" } else { "half" };
    let _ = writeln!(out, "<figure class=\"{class}\" id=\"{}\">", escaped(&figure.name));
    let natural = svg::figure_size(figure, figure.size);
    if figure.size == FigureWidth::Wide {
        // Letters that are readable on a desktop are too small on a phone, which gets its own drawing.
        out.push_str(&svg::draw_inline(figure, natural, "desk"));
        out.push_str(&svg::draw_inline(figure, svg::figure_size(figure, FigureWidth::Half), "hand"));
    } else {
        out.push_str(&svg::draw_inline(figure, natural, "both"));
    }
    let _ = writeln!(out, "<figcaption>{}</figcaption>\n</figure>", escaped(&figure.title));
}

/// The attribute of right-aligned cells.
const NUMBER_CLASS_ATTRIBUTE: &str = " class=\"n\"";

fn write_findings(out: &mut String, findings: &[Finding]) {
    let paper = findings.iter().any(|finding| finding.paper.is_some());
    let limit = findings.iter().any(|finding| finding.bar.is_some() || finding.against.is_some());
    let shown = [true, paper, true, limit, paper || limit];
    // A table that is wider than the screen can be scrolled with the keyboard.
    out.push_str("<div class=\"scroll\" tabindex=\"0\"><table class=\"findings\">\n<thead>");
    let head = [
        ("quantity", ""),
        ("paper", NUMBER_CLASS_ATTRIBUTE),
        ("here", NUMBER_CLASS_ATTRIBUTE),
        ("limit", ""),
        ("", ""),
    ];
    write_row(out, "th", shown_cells(head, shown));
    out.push_str("</thead>\n<tbody>\n");
    for finding in findings {
        let (class, verdict) = match (finding.verdict, &finding.bar) {
            (FindingVerdict::Better, None) => ("better", "✓ better"),
            (FindingVerdict::Better, Some(_)) => ("better", "✓ met"),
            (FindingVerdict::Same, _) => ("same", "= the same"),
            (FindingVerdict::Busy, None) => ("busy", "△ slow machine"),
            (FindingVerdict::Busy, Some(_)) => ("busy", "△ busy machine"),
            (FindingVerdict::Worse, None) => ("worse", "✗ worse"),
            (FindingVerdict::Worse, Some(_)) => ("worse", "✗ not met"),
            (FindingVerdict::Stated, _) => ("stated", ""),
        };
        let origin = finding.origin.as_ref().map(|origin| format!(" ({origin})")).unwrap_or_default();
        let limit = finding.bar.as_ref().or(finding.against.as_ref());
        let limit = limit.map(|limit| format!("{limit}{origin}")).unwrap_or_default();
        let papers = finding.paper.as_ref().map(ToString::to_string).unwrap_or_default();
        let command = finding.command.as_deref().map(command_html);
        let command = command.map_or_else(String::new, |command| format!("<br/>{command}"));
        let _ = write!(out, "<tr><td>{}{command}</td>", escaped(&finding.what));
        let cells: [(&str, &str); 4] = [
            (&papers, " class=\"n\" data-head=\"paper\""),
            (&finding.ours.to_string(), " class=\"n\" data-head=\"here\""),
            (&limit, " class=\"bar\" data-head=\"limit\""),
            (verdict, &format!(" class=\"verdict {class}\"")),
        ];
        let [_, paper, ours, limit, verdict] = shown;
        write_cells(out, "td", shown_cells(cells, [paper, ours, limit, verdict]));
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody>\n</table></div>\n");
}

fn write_table(out: &mut String, table: &Table) {
    // A heading, not a caption: a caption would be as wide as the table, even if that is wider than the screen.
    if !table.title.is_empty() {
        let _ = writeln!(out, "<h3>{}</h3>", escaped(&table.title));
    }
    let class = if table.commands { " class=\"moments\"" } else { "" };
    let _ = writeln!(out, "<div class=\"scroll\" tabindex=\"0\"><table{class}>");
    let columns = 0..table.head.len();
    let classes: Vec<_> = columns
        .map(|column| if is_number_column(table, column) { NUMBER_CLASS_ATTRIBUTE } else { "" })
        .collect();
    let classes = || classes.iter().copied().chain(std::iter::repeat(""));
    out.push_str("<thead>");
    write_row(out, "th", table.head.iter().map(String::as_str).zip(classes()));
    out.push_str("</thead>\n<tbody>\n");
    for cells in &table.rows {
        match cells.split_last() {
            Some((command, cells)) if table.commands => {
                out.push_str("<tr>");
                write_cells(out, "td", cells.iter().map(String::as_str).zip(classes()));
                let _ = write!(out, "<td>{}</td></tr>", command_html(command));
            }
            _ => write_row(out, "td", cells.iter().map(String::as_str).zip(classes())),
        }
        out.push('\n');
    }
    out.push_str("</tbody>\n</table></div>\n");
}

/// Formats a command without line breaks inside the names of options, where a break could follow a hyphen.
fn command_html(text: &str) -> String {
    let word = |word: &str| match word.starts_with('-') {
        true => format!("<span>{}</span>", escaped(word)),
        false => escaped(word),
    };
    format!("<code>{}</code>", text.split(' ').map(word).collect::<Vec<_>>().join(" "))
}

/// Returns those of the cells whose column is shown.
fn shown_cells<T, const N: usize>(cells: [T; N], shown: [bool; N]) -> impl Iterator<Item = T> {
    cells.into_iter().zip(shown).filter(|(_, shown)| *shown).map(|(cell, _)| cell)
}

/// Writes a row of an HTML table; `cells` gives the text and the attributes of each cell.
fn write_row<'a>(out: &mut String, tag: &str, cells: impl Iterator<Item = (&'a str, &'a str)>) {
    out.push_str("<tr>");
    write_cells(out, tag, cells);
    out.push_str("</tr>");
}

fn write_cells<'a>(out: &mut String, tag: &str, cells: impl Iterator<Item = (&'a str, &'a str)>) {
    for (text, attributes) in cells {
        let _ = write!(out, "<{tag}{attributes}>{}</{tag}>", escaped(text));
    }
}

/// Returns true if a column contains numbers, so that it is right-aligned.
fn is_number_column(table: &Table, column: usize) -> bool {
    let mut cells =
        table.rows.iter().filter_map(|row| row.get(column)).filter(|cell| !cell.is_empty()).peekable();
    cells.peek().is_some()
        && cells.all(|cell| cell.starts_with(|first: char| first.is_ascii_digit() || "-+−–".contains(first)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::figure::{Axis, Quantity, Series, SeriesShape};
    use roxmltree::{Document, ParsingOptions};

    fn whole() -> Page {
        let series = vec![Series::new("line", SeriesShape::Line, vec![(0.0, 1.0), (1.0, 2.0)])];
        let figure = |name: &str, size| Figure {
            name: name.to_owned(),
            title: format!("{name} <&>"),
            size,
            x: Axis::new("time", "s"),
            y: Axis::new("torque", "Nm"),
            series: series.clone(),
            ..Figure::default()
        };
        let nm = |value| Quantity::new(value, "Nm");
        let section = |name: &str| Section {
            name: name.to_owned(),
            title: "One & two".to_owned(),
            text: vec!["a < b".to_owned()],
            figures: vec![
                figure(&format!("{name}-wide"), FigureWidth::Wide),
                figure(&format!("{name}-half"), FigureWidth::Half),
            ],
            findings: vec![
                Finding::less_is_better("error", 0.0054, nm(6.3e-5))
                    .with_command(Some("look <here>".to_owned())),
                Finding::new_unrated("slope", nm(0.25).with_half_interval(0.5))
                    .with_requirement("below 1 Nm", false)
                    .with_origin("--limit"),
            ],
            tables: vec![
                Table {
                    title: "cells".to_owned(),
                    head: vec!["cell".to_owned(), "late".to_owned()],
                    rows: vec![
                        vec!["vcan0 1".to_owned(), "12".to_owned()],
                        vec!["vcan0 2".to_owned(), "–".to_owned()],
                    ],
                    ..Table::default()
                },
                Table::new(
                    "moments",
                    ["at", "look"],
                    [["2 s".to_owned(), "skinbus view 'a b' --at 2".to_owned()]],
                )
                .with_commands(),
            ],
            ..Section::default()
        };
        Page {
            title: "A page & more".to_owned(),
            intro: "<script>".to_owned(),
            facts: vec![("command".to_owned(), "skinbus run 'a' > b".to_owned())],
            sections: vec![section("one"), section("two"), section("three")],
        }
    }

    /// Returns the relative luminance of a colour of the form `#rgb` or `#rrggbb`, by WCAG 2.
    fn luminance(colour: &str) -> f64 {
        let digits = colour.strip_prefix('#').unwrap();
        let doubled: String = digits.chars().flat_map(|digit| [digit, digit]).collect();
        let digits = if digits.len() == 3 { doubled.as_str() } else { digits };
        let part = |at: usize| {
            let part = f64::from(u8::from_str_radix(&digits[at..at + 2], 16).unwrap()) / 255.0;
            if part <= 0.040_45 { part / 12.92 } else { ((part + 0.055) / 1.055).powf(2.4) }
        };
        0.2126 * part(0) + 0.7152 * part(2) + 0.0722 * part(4)
    }

    #[test]
    fn every_colour_of_text_has_contrast_and_red_is_not_amber() {
        let colours = |line: &str| -> Vec<(String, String)> {
            let inside = line.split_once('{').unwrap().1.trim_end_matches('}');
            let pairs = inside.split(';').map(|pair| pair.split_once(':').unwrap());
            pairs.map(|(name, colour)| (name.to_owned(), colour.to_owned())).collect()
        };
        let schemes: Vec<_> =
            PAGE_CSS.lines().filter(|line| line.starts_with(":root{")).map(colours).collect();
        assert_eq!(schemes.len(), 2, "light and dark");
        for (scheme, svg_texts) in schemes.iter().zip(svg::text_colours()) {
            let of = |name: &str| scheme.iter().find(|(it, _)| it == name).unwrap().1.clone();
            let texts = ["--ink", "--faint", "--link", "--good", "--warn", "--bad"].map(of);
            for (ground, text) in ["--ground", "--panel"]
                .map(of)
                .iter()
                .flat_map(|ground| texts.iter().chain(&svg_texts).map(move |text| (ground, text)))
            {
                let [dark, light] = {
                    let mut both = [luminance(ground), luminance(text)];
                    both.sort_by(f64::total_cmp);
                    both
                };
                let contrast = (light + 0.05) / (dark + 0.05);
                assert!(contrast >= 4.5, "{text} on {ground}: {contrast:.2}");
            }
            // Red has less green than blue or about as much; amber has clearly more.
            let green_over_blue = |colour: &str| {
                let part = |at: usize| i32::from(u8::from_str_radix(&colour[at..at + 2], 16).unwrap());
                part(3) - part(5)
            };
            assert!(green_over_blue(&of("--bad")) < 16 && green_over_blue(&of("--warn")) > 60, "{scheme:?}");
        }
    }

    #[test]
    fn what_a_busy_machine_did_is_not_red() {
        let section = |finding: Finding| Section::new("one", "One").with_findings([finding]);
        let html = |finding| {
            let page = Page { sections: vec![section(finding)], ..Page::default() };
            page_html(&page).split_once("<tbody>").unwrap().1.to_owned()
        };
        let broken = || Finding::new_unrated("ticks skipped", 3.0).with_requirement("none", false);
        assert!(html(broken()).contains("class=\"verdict worse\">✗ not met"));
        assert!(html(broken().or_busy_machine()).contains("class=\"verdict busy\">△ busy machine"));
        let slower = Finding::less_is_better("time", 1.0, (2.0, "µs")).or_busy_machine();
        assert!(html(slower).contains("class=\"verdict busy\">△ slow machine"));
        let met = Finding::new_unrated("ticks skipped", 0.0).with_requirement("none", true).or_busy_machine();
        assert!(html(met).contains("class=\"verdict better\">✓ met"));
    }

    /// Returns all text of an element.
    fn text(node: roxmltree::Node<'_, '_>) -> String {
        node.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).collect()
    }

    #[test]
    fn a_page_is_well_formed_whole_and_needs_nothing_else() {
        let html = page_html(&whole());
        let document = Document::parse_with_options(
            &html,
            ParsingOptions { allow_dtd: true, ..ParsingOptions::default() },
        );
        let document = document.unwrap_or_else(|error| panic!("{error}\n{html}"));
        let all = |name: &str| {
            document.descendants().filter(|node| node.tag_name().name() == name).collect::<Vec<_>>()
        };
        assert_eq!(text(all("h1")[0]), "A page & more");
        assert_eq!(all("figure").len(), 6);
        assert_eq!(all("svg").len(), 9, "a wide figure has a drawing for the hand");
        assert_eq!(all("script").len(), 1, "its own");
        assert!(all("script")[0].attributes().len() == 0 && all("img").is_empty() && all("link").is_empty());
        assert!(!html.replace("http://www.w3.org/2000/svg", "").contains("://"), "nothing is fetched");
        let policy = all("meta")
            .into_iter()
            .find_map(|meta| meta.attribute("content").filter(|_| meta.has_attribute("http-equiv")));
        assert!(policy.unwrap().starts_with("default-src 'none';"));
        for drawing in all("svg") {
            let label = drawing.attribute("aria-label").unwrap();
            assert!(label.ends_with(" <&>. Vertical: torque (Nm). Horizontal: time (s)."), "{label}");
        }
        let names: Vec<_> = document.descendants().filter_map(|node| node.attribute("id")).collect();
        for link in all("a") {
            let to = link.attribute("href").unwrap().strip_prefix('#').unwrap();
            assert_eq!(names.iter().filter(|name| **name == to).count(), 1, "{to}");
        }
        let rows: Vec<_> = all("tr").into_iter().map(text).collect();
        assert!(
            rows.contains(
                &"errorlook <here>5.4\u{a0}mNm63\u{a0}µNmbelow the paper's value✓ better".to_owned()
            ),
            "{rows:?}"
        );
        assert!(
            rows.contains(&"slope250 ± 500\u{a0}mNmbelow 1 Nm (--limit)✗ not met".to_owned()),
            "{rows:?}"
        );
        let right: Vec<_> =
            all("td").into_iter().filter(|cell| cell.attribute("class") == Some("n")).map(text).collect();
        assert!(right.contains(&"12".to_owned()) && right.contains(&"–".to_owned()));
        assert!(!right.contains(&"vcan0 1".to_owned()));
        let commands: Vec<_> = all("code").into_iter().map(text).collect();
        assert_eq!(commands[..2], ["look <here>", "skinbus view 'a b' --at 2"]);
        assert!(text(all("footer")[0]).contains("skinbus run 'a' > b"));
    }
}
