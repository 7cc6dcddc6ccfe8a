//! The page of `skinbus report` in a real browser: values under the pointer and at the keyboard's cursor, and commands to
//! copy.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::browser;

use std::fs;

use browser::Browser;
use process::TestDir;

use crate::tools_view::is_accessible;

/// Returns a script with the place of a figure's point, given as shares of the drawing.
fn place(figure: &str, [across, down]: [f64; 2]) -> String {
    format!(
        "(() => {{ const svg = document.querySelector('#{figure} > svg.desk'); svg.scrollIntoView({{ block: 'center' }}); \
         const b = svg.getBoundingClientRect(); return [b.x + {across} * b.width, b.y + {down} * b.height]; }})()"
    )
}

#[test]
#[ignore = "needs tests/tools/install"]
fn values_of_figures_are_read_with_the_pointer_and_the_keyboard() {
    let folder = TestDir::new();
    let recording = concat!(env!("CARGO_MANIFEST_DIR"), "/recordings/fd.mcap");
    fs::copy(recording, folder.path("it's a run.mcap")).unwrap();
    let mut command = folder.command("skinbus", "report -o run.html");
    assert!(command.arg("it's a run.mcap").output().unwrap().status.success());
    let url = format!("file://{}", folder.path("run.html").display());
    let mut browser = Browser::new(1400, 900);
    browser.open(&url);
    browser.until("document.querySelector('.reading')");
    let reading = |figure: &str| {
        format!(
            "(() => {{ const it = document.querySelector('#{figure} .reading:not([hidden])'); return it && it.innerText; }})()"
        )
    };
    let value = |browser: &mut Browser, script: &str| browser.until(script).as_str().unwrap().to_owned();

    // The pointer: the time at the place, and a value of each series with its unit.
    let at = browser.value(&place("positions", [0.5, 0.5]));
    browser.mouse("mouseMoved", [0, 1].map(|axis| at[axis].as_f64().unwrap()));
    let seen = value(&mut browser, &reading("positions"));
    let seconds: f64 = seen.split('\u{a0}').next().unwrap().parse().unwrap();
    let ends =
        browser.value("JSON.parse(document.querySelector('#positions > svg.desk').dataset.plots)[0].x.ends");
    let share = seconds / ends[1].as_f64().unwrap();
    assert!((0.4..0.6).contains(&share), "{seen} of {ends}");
    assert_eq!(seen.matches("\u{a0}rad").count(), 6, "one value for each joint: {seen}");
    assert!(seen.contains('−') && !seen.contains('-'), "a true minus: {seen}");

    // The keyboard: the values change, and screen readers get them.
    let svg = "document.querySelector('#positions > svg.desk')";
    browser.value(&format!("{svg}.focus()"));
    let text = format!("{svg}.getAttribute('aria-valuetext')");
    browser.key("keyDown", "Home");
    let first = value(&mut browser, &text);
    browser.key("keyDown", "ArrowRight");
    let next = value(&mut browser, &text);
    assert!(first.starts_with("0.0") && next != first && next.contains("joint 2 "), "{first} {next}");
    browser.key("keyDown", "End");
    assert!(value(&mut browser, &text) > next);
    browser.key("keyDown", "Escape");
    browser.until(&format!("{} === null", reading("positions")));

    // A command is copied as it is written, in one word for the file.
    let code = value(&mut browser, "document.querySelector('code').textContent");
    assert!(code.starts_with(r"skinbus view 'it'\''s a run.mcap' --at "), "{code}");
    browser.value("document.querySelector('code + button').click()");
    browser.until("['Copied', 'Selected'].includes(document.querySelector('code + button').textContent)");
    assert_eq!(value(&mut browser, "String(getSelection())"), code);

    is_accessible(&mut browser);
    let outside: Vec<_> = browser.requests().into_iter().filter(|it| !it.starts_with(&url)).collect();
    assert_eq!(outside, Vec::<&str>::new(), "the page asks for nothing");
    assert_eq!(browser.complaints(), Vec::<&serde_json::Value>::new());
}
