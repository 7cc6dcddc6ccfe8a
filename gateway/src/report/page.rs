//! Sets a page: one HTML file that needs nothing else, no network and no script.

use std::fmt::Write as _;

use super::figure::{Figure, Finding, Page, Section, Size, Table, Verdict};
use super::svg;

/// The style of all pages: light, dark on dark screens, and black on white paper.
const STYLE: &str = include_str!("page.css");

/// A whole page.
#[must_use]
pub fn html(page: &Page) -> String {
    let mut out = String::new();
    let title = svg::escaped(&page.title);
    let _ = write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>{title}</title>\n\
         <style>\n{STYLE}{}\n</style>\n</head>\n<body>\n<header>\n<h1>{title}</h1>\n",
        svg::dark()
    );
    paragraph(&mut out, "", &page.intro);
    out.push_str("</header>\n");
    if page.sections.len() > 2 {
        out.push_str("<nav><ul>\n");
        for section in &page.sections {
            let (name, title) = (svg::escaped(&section.name), svg::escaped(&section.title));
            let _ = writeln!(out, "<li><a href=\"#{name}\">{title}</a></li>");
        }
        out.push_str("</ul></nav>\n");
    }
    out.push_str("<main>\n");
    for part in &page.sections {
        section(&mut out, part);
    }
    out.push_str("</main>\n");
    if !page.facts.is_empty() {
        out.push_str("<footer>\n<h2>How it came about</h2>\n<dl>\n");
        for (name, value) in &page.facts {
            let _ = writeln!(out, "<dt>{}</dt><dd>{}</dd>", svg::escaped(name), svg::escaped(value));
        }
        out.push_str("</dl>\n</footer>\n");
    }
    out.push_str("</body>\n</html>\n");
    out
}

fn paragraph(out: &mut String, class: &str, text: &str) {
    if !text.is_empty() {
        let class = if class.is_empty() { String::new() } else { format!(" class=\"{class}\"") };
        let _ = writeln!(out, "<p{class}>{}</p>", svg::escaped(text));
    }
}

fn section(out: &mut String, section: &Section) {
    let (name, title) = (svg::escaped(&section.name), svg::escaped(&section.title));
    let _ = writeln!(out, "<section id=\"{name}\">\n<h2>{title}</h2>");
    for text in &section.text {
        paragraph(out, "", text);
    }
    if !section.findings.is_empty() {
        findings(out, &section.findings);
    }
    if !section.figures.is_empty() {
        out.push_str("<div class=\"figures\">\n");
        for part in &section.figures {
            figure(out, part);
        }
        out.push_str("</div>\n");
    }
    for part in &section.tables {
        table(out, part);
    }
    out.push_str("</section>\n");
}

fn figure(out: &mut String, figure: &Figure) {
    let class = if figure.size == Size::Wide { "wide" } else { "half" };
    let _ = writeln!(out, "<figure class=\"{class}\" id=\"{}\">", svg::escaped(&figure.name));
    let natural = svg::natural(figure.size);
    if figure.size == Size::Wide {
        // Letters that can be read across a desk are too small in the hand: a phone gets a drawing of its own.
        out.push_str(&svg::inline(figure, natural, "desk"));
        out.push_str(&svg::inline(figure, svg::natural(Size::Half), "hand"));
    } else {
        out.push_str(&svg::inline(figure, natural, "both"));
    }
    let _ = writeln!(out, "<figcaption>{}</figcaption>\n</figure>", svg::escaped(&figure.title));
}

fn findings(out: &mut String, findings: &[Finding]) {
    let paper = findings.iter().any(|finding| finding.paper.is_some());
    let bar = findings.iter().any(|finding| finding.bar.is_some());
    out.push_str("<div class=\"scroll\"><table class=\"findings\">\n<thead><tr><th>figure</th>");
    if paper {
        out.push_str("<th class=\"n\">paper</th>");
    }
    out.push_str("<th class=\"n\">here</th>");
    if bar {
        out.push_str("<th>must be</th>");
    }
    if paper || bar {
        out.push_str("<th></th>");
    }
    out.push_str("</tr></thead>\n<tbody>\n");
    for finding in findings {
        let _ = write!(out, "<tr><td>{}</td>", svg::escaped(&finding.what));
        if paper {
            let paper = finding.paper.as_ref().map(ToString::to_string).unwrap_or_default();
            let _ = write!(out, "<td class=\"n\">{}</td>", svg::escaped(&paper));
        }
        let _ = write!(out, "<td class=\"n\">{}</td>", svg::escaped(&finding.ours.to_string()));
        if bar {
            let _ = write!(out, "<td>{}</td>", svg::escaped(finding.bar.as_deref().unwrap_or_default()));
        }
        if paper || bar {
            let (class, text) = match (finding.verdict, &finding.bar) {
                (Verdict::Better, None) => ("better", "✓ better"),
                (Verdict::Better, Some(_)) => ("better", "✓ holds"),
                (Verdict::Same, _) => ("same", "= the same"),
                (Verdict::Worse, None) => ("worse", "✗ worse"),
                (Verdict::Worse, Some(_)) => ("worse", "✗ does not hold"),
                (Verdict::Told, _) => ("told", ""),
            };
            let _ = write!(out, "<td class=\"verdict {class}\">{text}</td>");
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody>\n</table></div>\n");
}

fn table(out: &mut String, table: &Table) {
    out.push_str("<div class=\"scroll\"><table>\n");
    if !table.title.is_empty() {
        let _ = writeln!(out, "<caption>{}</caption>", svg::escaped(&table.title));
    }
    let right: Vec<bool> = (0..table.head.len()).map(|column| numbers(table, column)).collect();
    let class = |column: usize| if right.get(column) == Some(&true) { " class=\"n\"" } else { "" };
    out.push_str("<thead><tr>");
    for (column, head) in table.head.iter().enumerate() {
        let _ = write!(out, "<th{}>{}</th>", class(column), svg::escaped(head));
    }
    out.push_str("</tr></thead>\n<tbody>\n");
    for row in &table.rows {
        out.push_str("<tr>");
        for (column, cell) in row.iter().enumerate() {
            let _ = write!(out, "<td{}>{}</td>", class(column), svg::escaped(cell));
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody>\n</table></div>\n");
}

/// Whether a column holds numbers, and stands to the right.
fn numbers(table: &Table, column: usize) -> bool {
    let mut cells =
        table.rows.iter().filter_map(|row| row.get(column)).filter(|cell| !cell.is_empty()).peekable();
    cells.peek().is_some()
        && cells.all(|cell| cell.starts_with(|first: char| first.is_ascii_digit() || "-+−–".contains(first)))
}
