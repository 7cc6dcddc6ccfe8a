//! Reports on recordings of real benches: figures and tables must agree with the recording, as an independent reader
//! decodes it, and with the gateway's own counts.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::float_cmp, reason = "a figure shows the very numbers of the recording")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::fs;

use analysis::report::figure::{Drawing, Figure, Page, Table, format_quantity};
use analysis::report::run::{ReportOptions, report};
use process::{PRESSED, TestDir, names, skin};
use recorded::Recorded;
use serde_json::Value;

const ERRORS: &str = "Absolute torque errors by joint: of single cells that load the joint, and of the sum over the whole skin";

/// Runs a bench of eight cells that push the arm, compared all the time. Late cells halt it only after 20 s.
fn recorded_bench(place: &TestDir, seconds: f64) -> Recorded {
    place.write("skin.toml", &(skin(8) + "\n[safety]\nbad_cycles = 10000\n"));
    place.scenario(&PRESSED.replace("\"hold\"", "\"kinesthetic\""));
    place.bench(seconds, "--record run.mcap").end().succeeded();
    Recorded::read(&place.path("run.mcap"))
}

fn page(place: &TestDir, name: &str) -> (Page, Option<String>) {
    let report = report(&[place.path(name)], &ReportOptions::default()).unwrap();
    (report.page, report.missing)
}

fn figures(page: &Page) -> impl Iterator<Item = &Figure> {
    page.sections.iter().flat_map(|section| &section.figures)
}

fn drawings(page: &Page) -> impl Iterator<Item = &Drawing> {
    page.sections.iter().flat_map(|section| &section.drawings)
}

/// Parses a time of a report as ns.
fn nanos(text: &str) -> f64 {
    let (number, unit) = text.split_once('\u{a0}').unwrap();
    let (_, scale) = [("ns", 1.0), ("µs", 1e3), ("ms", 1e6), ("s", 1e9)]
        .into_iter()
        .find(|(name, _)| *name == unit)
        .unwrap();
    number.parse::<f64>().unwrap() * scale
}

fn figure<'a>(page: &'a Page, name: &str) -> &'a Figure {
    figures(page).find(|figure| figure.name == name).unwrap_or_else(|| panic!("no figure {name}"))
}

fn table<'a>(page: &'a Page, title: &str) -> &'a Table {
    let mut tables = page.sections.iter().flat_map(|section| &section.tables);
    tables.find(|table| table.title == title).unwrap_or_else(|| panic!("no table {title}"))
}

/// Returns a row by its first cell, without that cell.
fn row<'a>(table: &'a Table, first: &str) -> &'a [String] {
    let row = table.rows.iter().find(|row| row[0] == first);
    &row.unwrap_or_else(|| panic!("no row {first} in {table:?}"))[1..]
}

/// Returns the number of the finding that begins with `what`.
fn found(page: &Page, what: &str) -> f64 {
    let mut findings = page.sections.iter().flat_map(|section| &section.findings);
    findings.find(|finding| finding.what.starts_with(what)).unwrap_or_else(|| panic!("no {what}")).ours.value
}

/// Returns the first, the minimum, the maximum and the last value.
fn span(values: impl Iterator<Item = f64>) -> [f64; 4] {
    let values: Vec<_> = values.filter(|value| value.is_finite()).collect();
    let min = values.iter().copied().fold(f64::INFINITY, f64::min);
    let max = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    [values[0], min, max, values[values.len() - 1]]
}

fn drawn(figure: &Figure, series: usize) -> [f64; 4] {
    span(figure.series[series].points.iter().map(|(_, y)| *y))
}

#[test]
fn figures_show_what_the_recording_holds_and_tables_what_the_gateway_counted() {
    let place = TestDir::new();
    let recorded = recorded_bench(&place, 3.0);
    let (page, missing) = page(&place, "run.mcap");
    assert_eq!(missing, None);
    let summary = place.summary();

    let on = |topic: &str, field: &str, index: Option<usize>| {
        let value =
            |value: &Value| index.map_or_else(|| value[field].as_f64(), |index| value[field][index].as_f64());
        span(recorded.on(topic).map(|message| value(&message.value).unwrap()))
    };
    for joint in 0..6 {
        assert_eq!(
            drawn(figure(&page, "positions"), joint),
            on("/UR5/joint_states", "position", Some(joint))
        );
        assert_eq!(
            drawn(figure(&page, "velocities"), joint),
            on("/UR5/joint_states", "velocity", Some(joint))
        );
        let torque = figures(&page).find(|it| it.name == format!("torque-joint{}", joint + 1));
        let distributed = on("/UR5/torques", "distributed", Some(joint));
        let Some(torque) = torque else {
            // Joints without a torque have no axes; the first joints carry the touch.
            assert_eq!(distributed, [0.0; 4]);
            assert!(joint > 1, "{joint}");
            continue;
        };
        assert_eq!(drawn(torque, 0), distributed);
        let errors = row(table(&page, ERRORS), &format!("joint {}", joint + 1));
        let difference = span(torque.below.as_ref().unwrap().series[0].points.iter().map(|(_, y)| *y));
        let farthest = difference[1].abs().max(difference[2].abs());
        assert_eq!(
            format_quantity(farthest, "Nm"),
            errors[4],
            "the epoch that is farthest from the central computation"
        );
    }
    let moved = drawn(figure(&page, "positions"), 1);
    assert!((moved[0] - moved[3]).abs() > 1e-3, "the arm moves: {moved:?}");
    assert_eq!(drawn(figure(&page, "cycle"), 0), on("/gateway/timing", "took_us", None));
    assert_eq!(drawn(figure(&page, "cycle"), 1), on("/gateway/timing", "central_us", None));
    assert_eq!(drawn(figure(&page, "lateness"), 0), on("/gateway/timing", "late_us", None));
    assert_eq!(drawn(figure(&page, "active-cells"), 0), on("/gateway/timing", "contributing", None));
    assert_eq!(drawn(figure(&page, "active-cells"), 1), on("/UR5/torques", "active", None));
    let times: Vec<_> = recorded.on("/gateway/timing").map(|message| message.nanos).collect();
    let seconds = (times[times.len() - 1] - times[0]) as f64 * 1e-9;
    let last = figure(&page, "positions").series[0].points.last().unwrap().0;
    assert!((last - seconds).abs() < 1e-6, "{last} {seconds}");

    // The gateway's own accounts, which the recording does not contain as numbers.
    let counted = |pointer: &str| summary.number(pointer).to_string();
    let replies = row(table(&page, "Replies by bus"), "vcan0");
    let keys =
        ["replies/due", "replies/in_time", "replies/late"].map(|key| counted(&format!("/buses/0/{key}")));
    assert_eq!(replies[..3], keys);
    let reasons = ["too_late", "skipped", "not_heard", "lost", "in_doubt", "unknown"];
    let missing: u64 = reasons.iter().map(|key| summary.number(&format!("/buses/0/replies/{key}"))).sum();
    assert_eq!(replies[3], missing.to_string());
    assert_eq!(
        replies[4..6],
        ["epochs_due", "epochs_complete"].map(|key| counted(&format!("/buses/0/{key}")))
    );
    assert!(summary.number("/buses/0/replies/in_time") > 0);
    let slowest = summary.figure("/buses/0/last_reply_us/max");
    assert_eq!(replies[8], format_quantity(slowest, "µs"));
    let due: f64 =
        figure(&page, "replies-vcan0").series[0].points.iter().map(|(_, y)| *y).fold(0.0, f64::max);
    assert!((due - 8.0).abs() < 0.5, "all eight are due: {due}");

    let errors = table(&page, ERRORS);
    let all = row(errors, "all");
    for (key, cells) in [("single", &all[..3]), ("whole", &all[3..])] {
        let of = |name: &str| summary.figure(&format!("/accuracy/{key}/{name}"));
        assert_eq!(
            cells,
            [
                format_quantity(of("mean_nm"), "Nm"),
                format_quantity(of("max_nm"), "Nm"),
                counted(&format!("/accuracy/{key}/count"))
            ]
        );
    }
    let single = found(&page, "torques of single cells");
    assert!((single / summary.figure("/accuracy/single/mean_nm") - 1.0).abs() < 1e-9, "{single}");
    let by_joint = errors.rows.iter().filter(|row| row[0].starts_with("joint "));
    let torques: u64 = by_joint.map(|row| row[3].parse::<u64>().unwrap()).sum();
    assert_eq!(torques, summary.number("/accuracy/single/count"));

    let control = table(&page, "The control loop");
    for (name, key) in [
        ("lateness of a tick", "late_us"),
        ("duration of a tick", "took_us"),
        ("central computation in a tick", "central_us"),
    ] {
        let quantile = |name: &str| format_quantity(summary.figure(&format!("/loop/{key}/{name}")), "µs");
        let expected = ["p50", "p90", "p99", "max"].map(quantile);
        for (shown, expected) in row(control, name)[..4].iter().zip(&expected) {
            // The last of three digits may be rounded either way: 2.385 lies between two values.
            let [shown, expected] = [shown, expected].map(|text| nanos(text));
            assert!((shown - expected).abs() <= 0.01 * expected, "{key}: {shown} {expected}");
        }
        assert_eq!(row(control, name)[4], counted(&format!("/loop/{key}/count")));
    }
    let losses = page.sections.iter().find(|section| section.name == "losses").unwrap();
    let counts = table(&page, "All counts");
    assert!(losses.tables.contains(counts));
    assert_eq!(row(counts, "ticks skipped by the loop"), [counted("/loop/ticks_skipped")]);
    assert_eq!(row(counts, "vcan0: frames recorded"), [counted("/recording/frames")]);
    assert_eq!(
        row(counts, "vcan0: packets that cells sent, according to their counters"),
        [counted("/buses/0/uplink/sent")]
    );
    let fact = |name: &str| &page.facts.iter().find(|(fact, _)| fact == name).unwrap().1;
    assert!(fact("command that started the run").contains("--record run.mcap"));
    assert!(fact("idle machine").contains("µs late (median)"));
}

#[test]
fn a_page_and_its_figures_are_complete_and_that_of_a_truncated_recording_names_what_is_missing() {
    let place = TestDir::new();
    recorded_bench(&place, 2.0);
    let before = place.files();
    let ended = place.start("skinbus", "report run.mcap --svg figures").end().succeeded();
    let (whole, _) = page(&place, "run.mcap");
    let all: Vec<_> =
        figures(&whole).map(|it| it.name.as_str()).chain(drawings(&whole).map(Drawing::name)).collect();
    assert_eq!(ended.stdout, format!("run.html: {} figures, also as files in figures\n", all.len()));
    let html = place.read("run.html");
    let mut files = Vec::new();
    for name in &all {
        assert!(html.contains(&format!("id=\"{name}\"")), "{name}");
        files.push(format!("{name}.svg"));
    }
    files.sort();
    assert_eq!(names(&place.path("figures")), files);
    assert!(html.ends_with("</html>\n") && html.contains("skinbus run skin.toml"));
    let after: Vec<_> = place.files().into_iter().filter(|name| !before.contains(name)).collect();
    assert_eq!(after, ["figures", "run.html"]);

    // A command that cannot write leaves no file.
    for (options, said) in [
        (
            "-o run.mcap/run.html",
            "-o run.mcap/run.html: Not a directory (os error 20); name a file in a folder that can be written",
        ),
        (
            "-o nowhere/run.html --svg more",
            "-o nowhere/run.html: No such file or directory (os error 2); name a file in a folder that can be written",
        ),
        (
            "-o new.html --svg run.mcap/more",
            "--svg run.mcap/more: Not a directory (os error 20); name a folder that can be written",
        ),
    ] {
        let refused = place.start("skinbus", &format!("report run.mcap {options}")).end();
        assert_eq!(refused.refusal(2), format!("skinbus: {said}"));
    }
    assert!(!place.path("more").exists() && !place.path("new.html").exists());
    let refused = place.start("skinbus", "report run.mcap -o new.html --nominal 2M").end();
    assert!(refused.refusal(2).contains("nominal bit rate 2000000 bit/s"), "{refused:?}");

    let bytes = fs::read(place.path("run.mcap")).unwrap();
    fs::write(place.path("cut.mcap"), &bytes[..bytes.len() / 2]).unwrap();
    let ended = place.start("skinbus", "report cut.mcap").end().succeeded();
    assert_eq!(ended.stderr.matches('\n').count(), 1, "{ended:?}");
    for words in ["skinbus: cut.mcap: its end is missing", "of the planned 2 s", "s are missing"] {
        assert!(ended.stderr.contains(words), "{words}: {ended:?}");
    }
    assert!(place.read("cut.html").contains("The run is incomplete: its end is missing"));
    // As much as a recovery finds.
    place.start("skinbus", "recover cut.mcap -o recovered.mcap").end().succeeded();
    let recovered = Recorded::read(&place.path("recovered.mcap"));
    let ticks = recovered.on("/gateway/timing").count();
    let (link_down, missing) = page(&place, "cut.mcap");
    assert!(missing.is_some() && ticks > 0 && ticks < 1_000, "{ticks}");
    assert_eq!(row(table(&link_down, "The control loop"), "duration of a tick")[4], ticks.to_string());
}

/// Returns the recorded forces on cells, with their times in ns since 1970.
fn recorded_forces(recorded: &Recorded) -> Vec<(u64, u64, f64)> {
    let topics = recorded
        .messages
        .iter()
        .filter(|message| message.topic.starts_with("/skin/") && !message.topic.ends_with("/points"));
    let of = |message: &recorded::Message| {
        let [nodes, forces] = ["node", "force"].map(|field| message.value[field].as_array().unwrap().clone());
        let cells = nodes
            .into_iter()
            .zip(forces)
            .map(|(node, force)| (message.nanos, node.as_u64().unwrap(), force.as_f64().unwrap_or(0.0)));
        cells.collect::<Vec<_>>()
    };
    topics.flat_map(of).collect()
}

#[test]
fn touches_are_shown_when_and_where_the_recorder_saw_them_and_losses_where_cells_fell_silent() {
    let place = TestDir::new();
    place.skin(8);
    let scenario = "duration_s = 3.0\n[motion]\nkind = \"hold\"\nstart = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n\
                    [[touch]]\nat_s = 0.4\nfor_s = 2.0\ncells = [2, 3]\nforce_n = 5.0\nprofile = \"half-sine\"\n\
                    [[touch]]\nat_s = 1.0\nfor_s = 0.5\ncells = [7]\nforce_n = 9.0\n\
                    [[fault]]\nat_s = 1.2\nkind = \"kill\"\ncells = [3]\n";
    place.scenario(scenario);
    place.bench(3.0, "--record run.mcap").end();
    let recorded = Recorded::read(&place.path("run.mcap"));
    let (page, _) = page(&place, "run.mcap");
    let forces = recorded_forces(&recorded);
    // Forces are latched by broadcasts, of which a busy machine skips some.
    let gaps = forces.windows(2).map(|pair| pair[1].0.saturating_sub(pair[0].0));
    let gap = gaps.max().unwrap() as f64 * 1e-9;
    let ticks: Vec<_> = recorded.on("/gateway/timing").map(|message| message.nanos).collect();
    let [strip, force, losses] = drawings(&page).collect::<Vec<_>>()[..] else {
        panic!("{:?}", drawings(&page).count())
    };
    let (Drawing::Strip(strip), Drawing::Map(force), Drawing::Map(losses)) = (strip, force, losses) else {
        panic!()
    };

    let rows: Vec<_> = strip.groups.iter().flat_map(|group| &group.rows).collect();
    let names: Vec<_> = rows.iter().map(|row| row.caption.as_str()).collect();
    assert_eq!(names, ["2", "3", "7"], "those that were touched");
    let spots: Vec<_> = force.panels.iter().flat_map(|panel| &panel.cells).collect();
    assert_eq!(spots.len(), 8);
    for (row, node) in rows.iter().zip([2, 3, 7]) {
        let of_cell = || forces.iter().filter(move |(_, of, force)| *of == node && *force > 0.0);
        let expected = of_cell().map(|(_, _, force)| *force).fold(0.0, f64::max);
        let spot = spots.iter().find(|spot| spot.caption == format!("vcan0 {node}")).unwrap();
        let near =
            |one: f64, other: f64, by: f64| assert!((one - other).abs() < by, "cell {node}: {one} {other}");
        near(spot.value.unwrap(), expected, 1e-3);
        near(row.values.iter().map(|value| value.2).fold(0.0, f64::max), expected, 1e-3);
        let seconds = |nanos: u64| (nanos as f64 - ticks[0] as f64) * 1e-9;
        let (first, last) = (of_cell().next().unwrap().0, of_cell().next_back().unwrap().0);
        // A bin, and an epoch until the next joints.
        near(row.values[0].0, seconds(first), 0.017 + gap);
        near(row.values.last().unwrap().1, seconds(last), 0.034 + gap);
    }
    let untouched = spots.iter().filter(|spot| spot.value == Some(0.0)).count();
    assert_eq!(untouched, 5);

    let lost: Vec<_> = losses.panels.iter().flat_map(|panel| &panel.cells).collect();
    let of =
        |node: u8| lost.iter().find(|spot| spot.caption == format!("vcan0 {node}")).unwrap().value.unwrap();
    // At least the gateway's count; the killed cell has some on any machine.
    let summary = place.summary();
    for cell in summary.cells() {
        let missing = cell["missing"].as_object().unwrap().values().map(|count| count.as_u64().unwrap());
        let counted = missing.sum::<u64>() + cell["late"].as_u64().unwrap();
        let node = cell["node"].as_u64().unwrap().try_into().unwrap();
        // The packets that the gateway awaits at its end may follow the end of the recording.
        let is_near = of(node) + 4.0 >= counted as f64;
        assert!(is_near && (node != 3 || of(node) > 2.0), "{counted}, {lost:?}, {cell:#}");
    }
    let moments = table(&page, "Moments of losses");
    assert!(moments.rows.iter().any(|row| row[1] == "vcan0: cell 3 is silent"), "{moments:?}");
    let touches = table(&page, "Touches, grouped by link");
    assert!(touches.rows.iter().all(|row| row[2].contains("run.mcap --at ")), "{touches:?}");
    // The command counts from the first tick, like the column beside it.
    let first = forces.iter().filter(|(_, _, force)| *force > 0.0).map(|(nanos, ..)| *nanos).min().unwrap();
    let at: f64 = touches.rows[0][2].rsplit(' ').next().unwrap().parse().unwrap();
    assert!((at - (first - ticks[0]) as f64 * 1e-9).abs() < 0.004 + gap, "{at} {first} {}", ticks[0]);
}
