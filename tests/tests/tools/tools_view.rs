//! The page of `skinbus run --view` in a real browser: a click presses a cell, and the arm gives way.
//!
//! `tests/tools/install` installs the browser; `tests/tools/run` does that, and then runs this test.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::print_stdout,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop, and its figures are what it is about"
)]

use skinbus_tests::process;
use skinbus_tests::process::browser;

use browser::Browser;
use process::TestDir;
use process::log::Log;
use process::page::{address, watched};
use protocol::can::Format;
use protocol::message::{Message, SensorPage};
use serde_json::json;

/// The rules of accessibility and the checker for them.
const AXE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/axe/node_modules/axe-core/axe.min.js");

/// A script that finds texts with too little contrast.
const CONTRAST: &str = include_str!("../../tools/contrast.js");

/// Returns the serious and critical findings of axe-core, which is loaded into the page.
fn findings(browser: &mut Browser) -> Vec<String> {
    browser.value(
        "window.found = null; axe.run().then((it) => { window.found = [it.passes.length, it.violations.filter((it) =>
         ['serious', 'critical'].includes(it.impact)).map((it) => `${it.id}: ${it.nodes[0].html}`)]; }); 0",
    );
    let found = browser.until("window.found");
    assert!(found[0].as_u64().unwrap() > 20, "rules were looked at");
    serde_json::from_value(found[1].clone()).unwrap()
}

/// Checks accessibility at two widths, light and dark.
pub(crate) fn is_accessible(browser: &mut Browser) {
    let axe = std::fs::read_to_string(AXE).expect("tests/tools/install makes axe-core ready");
    browser.value(&format!("{axe};0"));
    for (width, scheme) in [(1400, "light"), (1400, "dark"), (390, "light"), (390, "dark")] {
        browser.resize(width, 844);
        browser.scheme(scheme);
        browser.until(&format!("document.documentElement.scrollWidth <= {width}"));
        assert_eq!(findings(browser), Vec::<String>::new(), "{width} px, {scheme}");
        has_contrast(browser, &format!("{width} px, {scheme}"));
    }
}

/// Checks the contrast of every text, with all buttons as they are, under the pointer, and pressed.
fn has_contrast(browser: &mut Browser, place: &str) {
    browser.call("DOM.enable", &json!({}));
    browser.call("CSS.enable", &json!({}));
    for state in [json!([]), json!(["hover"]), json!(["hover", "active"])] {
        let root = browser.call("DOM.getDocument", &json!({ "depth": 0 }))["root"]["nodeId"].clone();
        let query = json!({ "nodeId": root, "selector": "button, select, summary" });
        let nodes = browser.call("DOM.querySelectorAll", &query)["nodeIds"].as_array().unwrap().clone();
        assert!(!nodes.is_empty());
        // Labels of events come and go, so a node may not exist any more.
        for node in &nodes {
            let forced = json!({ "nodeId": node, "forcedPseudoClasses": state });
            browser.try_call("CSS.forcePseudoState", &forced);
        }
        assert_eq!(browser.value(CONTRAST), json!([]), "{place}, buttons {state}");
        for node in &nodes {
            browser.try_call("CSS.forcePseudoState", &json!({ "nodeId": node, "forcedPseudoClasses": [] }));
        }
    }
}

/// Checks that the page requested nothing from elsewhere, and reported no error.
fn is_content(browser: &Browser, url: &str) {
    let host = url.split(['#', '?']).next().unwrap();
    assert!(host.starts_with("http://127.0.0.1:"), "{host}");
    let outside: Vec<_> = browser
        .requests()
        .into_iter()
        .filter(|it| !it.starts_with(host) && !it.starts_with("data:"))
        .collect();
    assert_eq!(outside, Vec::<&str>::new(), "the page asks for nothing outside");
    assert_eq!(browser.complaints(), Vec::<&serde_json::Value>::new());
}

#[test]
#[ignore = "needs tests/tools/install"]
fn a_click_in_a_browser_is_a_torque_on_the_bus_and_the_arm_gives_way() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 24, "--candump run.log");
    let url = address.url();
    let mut browser = Browser::new(1400, 900);
    browser.scheme("light");
    browser.open(&url);
    browser.until("window.skinbus && window.skinbus.frames > 3");
    browser.until("document.getElementById('facts').textContent.includes('Cells24')");

    // Here the processor draws: the page reports that, and draws a still picture in full resolution.
    assert_eq!(browser.value("document.getElementById('software').hidden"), false);
    browser.until(
        "(() => { const c = document.getElementById('picture'); return c.width === 2 * c.clientWidth; })()",
    );

    // A cell whose front is visible.
    let found = browser.until(
        "(() => { for (let i = 0; i < 24; i++) { const at = window.skinbus.where(i); if (at) return [i, ...at]; } return null; })()",
    );
    let number = |value: &serde_json::Value| value.as_f64().unwrap();
    let stage = browser.value("(() => { const b = document.getElementById('picture').getBoundingClientRect(); return [b.x, b.y]; })()");
    let at = [number(&stage[0]) + number(&found[1]), number(&stage[1]) + number(&found[2])];
    let before = browser.until("(() => { const all = window.skinbus.joints(); return all.length && all.every(Number.isFinite) && all; })()");
    browser.mouse("mousePressed", at);
    browser.until("document.getElementById('facts').textContent.includes('In contact1')");
    browser.until("document.getElementById('cell').textContent.includes('Torque of epoch')");
    browser.until("document.getElementById('cell').textContent.includes('active')");
    let moved = format!("window.skinbus.joints().some((q, i) => Math.abs(q - {before}[i]) > 0.01)");
    browser.until(&moved);
    browser.mouse("mouseReleased", at);
    browser.until("document.getElementById('facts').textContent.includes('In contact0')");

    // The same with the keyboard, on the next cell.
    browser.key("keyDown", "n");
    browser.key("keyDown", " ");
    browser.until("document.getElementById('facts').textContent.includes('In contact1')");
    browser.key("keyUp", " ");
    browser.until("document.getElementById('facts').textContent.includes('In contact0')");

    // The process of that cell.
    let kill = "[...document.querySelectorAll('button')].find((it) => it.textContent === 'Kill')";
    browser.until(&format!("{kill} && !{kill}.disabled"));
    browser.value(&format!("{kill}.click()"));
    browser.until("document.getElementById('answer').textContent.startsWith('kill cell ')");
    browser.until(&format!(
        "{kill}.disabled && document.getElementById('facts').textContent.includes('Silent1')"
    ));

    is_accessible(&mut browser);
    // The checker does find faults.
    browser.value("document.getElementById('halt').textContent = ''");
    assert_eq!(findings(&mut browser).len(), 1);
    is_content(&browser, &url);
    drop(browser);
    run.signal(rustix::process::Signal::INT);
    run.end();

    // On the bus a torque follows the stimulus.
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let node = u8::try_from(found[0].as_u64().unwrap()).unwrap() + 1;
    let (mut pressed, mut epochs, mut answered) = (false, 0, false);
    for (message, _) in &log.messages {
        match message {
            Message::Stimulus { page: SensorPage::Skin(_), .. } => pressed = true,
            Message::Joints { .. } if pressed && !answered => epochs += 1,
            Message::Torque { from, torque, .. } if from.get() == node && !torque.is_zero() => {
                answered = true
            }
            _ => {}
        }
    }
    println!("the torque came {epochs} epochs after the stimulus");
    assert!(answered, "none in {epochs} epochs");
    place.is_left_clean();
}

/// A click as long as a hand's: the row must not move away between press and release, and the explanation must come
/// into view.
#[test]
#[ignore = "needs tests/tools/install"]
fn a_click_on_why_of_a_moving_list_explains_and_a_halt_says_what_to_press() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 12, "");
    let mut browser = Browser::new(1400, 900);
    browser.scheme("dark");
    browser.open(&address.url());
    browser.until("window.skinbus && window.skinbus.frames > 3");
    browser.value(
        "(() => { const it = document.getElementById('search'); it.value = 'vcan0:5'; it.onchange(); })()",
    );
    let place_of = |browser: &mut Browser, element: &str| {
        let at = browser.until(&format!(
            "(() => {{ const it = {element}; if (!it) return null; const b = it.getBoundingClientRect(); \
             return [b.x + b.width / 2, b.y + b.height / 2]; }})()"
        ));
        [0, 1].map(|axis| at[axis].as_f64().unwrap())
    };
    browser.until("!document.getElementById('hold').disabled");
    let hold = place_of(&mut browser, "document.getElementById('hold')");
    for kind in ["mouseMoved", "mousePressed", "mouseReleased"] {
        browser.mouse(kind, hold);
    }
    browser.until("document.getElementById('facts').textContent.includes('In contact1')");
    // Pressed and under the pointer, in the dark scheme: both colours are the pressed ones.
    browser.until(
        "(() => { const it = document.getElementById('hold'), style = getComputedStyle(it); \
         return it.matches(':hover') && it.getAttribute('aria-pressed') === 'true' && \
         style.color === 'rgb(28, 32, 36)' && style.backgroundColor === 'rgb(98, 181, 242)'; })()",
    );

    let button = "document.querySelectorAll('#frames button')[1]";
    let mut answered = 0;
    for clicks in 1.. {
        browser.value("document.getElementById('side').scrollTop = 0");
        browser.until(button);
        browser.value("document.getElementById('frames').scrollIntoView({ block: 'end' })");
        let pressed = loop {
            let near = place_of(&mut browser, button);
            browser.mouse("mouseMoved", near);
            let at = place_of(&mut browser, button);
            browser.mouse("mousePressed", at);
            let [x, y] = at;
            if browser.value(&format!("document.elementFromPoint({x}, {y}).textContent === 'Why'")) == true {
                break at;
            }
            browser.mouse("mouseReleased", at);
        };
        browser.value("window.rows = document.getElementById('frames').textContent");
        std::thread::sleep(std::time::Duration::from_millis(400));
        assert_eq!(
            browser.value("document.getElementById('frames').textContent === window.rows"),
            true,
            "the list stands still while the mouse is down"
        );
        browser.mouse("mouseReleased", pressed);
        // On a busy machine the frame may be too old by now, which the page reports.
        let said = browser
            .until("/^Explanation, epoch|^No answer/.exec(document.getElementById('why').textContent)?.[0]");
        browser.until(
            "(() => { const box = document.getElementById('why').getBoundingClientRect(); \
             return box.top >= 0 && box.bottom <= innerHeight; })()",
        );
        answered += u32::from(said == "Explanation, epoch");
        if answered == 2 {
            break;
        }
        assert!(clicks < 60, "{answered} of {clicks} clicks were answered");
        // The list continues, and this explanation is closed.
        browser.value("document.getElementById('hold-frames').click()");
        browser.value("document.getElementById('why').replaceChildren()");
    }

    browser.value("document.getElementById('halt').click()");
    browser.until(
        "document.getElementById('halted').textContent === \
         'The robot is halted: a halt frame was received. Press Resume to continue.'",
    );
    let colour = "getComputedStyle(document.getElementById('resume')).backgroundColor";
    assert_eq!(browser.value(colour), "rgb(98, 181, 242)", "the next step is marked");
    is_accessible(&mut browser);
    browser.value("document.getElementById('resume').click()");
    browser.until("document.getElementById('halted').hidden");

    // A reload works; without the token there is one line that says what to do.
    browser.call("Page.reload", &serde_json::json!({}));
    browser.until("window.skinbus && window.skinbus.snapshots > 3");
    is_content(&browser, &address.url());
    let referers = browser.events.iter().map(|event| &event["params"]["request"]["headers"]["Referer"]);
    let referers: Vec<_> =
        referers.filter_map(|referer| referer.as_str()).filter(|it| !it.is_empty()).collect();
    assert_eq!(referers, Vec::<&str>::new(), "the token leaves by no Referer");
    browser.open(&format!("http://{}/", address.host));
    browser.until("document.body.textContent.startsWith('403: the token is missing')");
    drop(browser);
    run.signal(rustix::process::Signal::INT);
    run.end();
    place.is_left_clean();
}

#[test]
#[ignore = "needs tests/tools/install"]
fn a_recording_is_gone_through_in_a_browser() {
    let place = TestDir::new();
    let from = concat!(env!("CARGO_MANIFEST_DIR"), "/recordings/fd.mcap");
    std::fs::copy(from, place.path("fd.mcap")).unwrap();
    let view = place.start("skinbus", "view fd.mcap");
    let url = format!("{}#at=0.9", address(&view).url());
    let mut browser = Browser::new(1400, 900);
    browser.open(&url);
    let at = "(() => { const said = document.querySelector('#time output').textContent; return said.startsWith('0:') ? Number(said.slice(2, 8)) : NaN; })()";
    let click = |name: &str| {
        format!("[...document.querySelectorAll('#time button')].find((it) => it.title === '{name}').click()")
    };
    browser.until(&format!("window.skinbus && window.skinbus.frames > 1 && {at} === 0.9"));
    assert_eq!(browser.value("getComputedStyle(document.getElementById('commands')).display"), "none");

    // An epoch forwards and backwards.
    browser.value(&click("Next epoch"));
    browser.until(&format!("{at} > 0.9 && {at} < 0.92"));
    browser.value(&click("Previous epoch"));
    browser.until(&format!("{at} < 0.91"));
    // It plays to its end, and jumps back to a touch.
    browser.value(&click("Play"));
    browser.until(&format!("{at} > 1.2"));
    browser.until(&format!("{at} > 2.1"));
    browser.value(&click("Previous event"));
    browser.until(&format!("{at} < 2"));
    // Its torque comes within an epoch or two.
    browser.until(&format!(
        "!document.getElementById('facts').textContent.includes('In contact0') || ({}, false)",
        click("Next epoch")
    ));
    // The slider.
    browser.value("(() => { const it = document.querySelector('#time input'); it.value = 0; it.oninput(); it.onchange(); })()");
    browser.until(&format!("{at} === 0"));

    // A cell's frames, and the explanation of its torque.
    browser.value("location.hash = '#at=1'");
    browser.until(&format!("{at} === 1"));
    browser.value(
        "(() => { const it = document.getElementById('search'); it.value = 'vcan0:1'; it.onchange(); })()",
    );
    browser.until("document.querySelector('#frames button')");
    browser.value("document.querySelector('#frames button').click()");
    browser.until("document.getElementById('why').textContent.includes('nearest')");

    // The curves come from the recording, and a label of an event goes there.
    browser.until("/^cells .*Nm$/.test(document.querySelector('.lane .values').textContent)");
    assert_eq!(browser.value("document.getElementById('link').textContent"), "paused");
    let label = "document.querySelector('.strip button:not(.bare)')";
    browser.until(label);
    browser.value(&format!("window.there = /(\\d+\\.\\d+)$/.exec({label}.title)[1]; {label}.click()"));
    browser.until(&format!("Math.abs({at} - Number(window.there)) < 0.001"));
    // A plot is read by keyboard.
    browser.value("document.querySelector('.lane canvas').focus()");
    browser.key("keyDown", "Home");
    browser.until(
        "document.activeElement.getAttribute('aria-valuenow') === document.activeElement.getAttribute('aria-valuemin')",
    );
    is_accessible(&mut browser);
    is_content(&browser, &url);
    drop(browser);
    view.signal(rustix::process::Signal::INT);
    view.end().succeeded();
}

#[test]
#[ignore = "needs tests/tools/install"]
fn a_skin_is_looked_at_in_a_file_without_a_server() {
    let place = TestDir::new();
    place.skin(24);
    place.start("skinbus", "skin show skin.toml -o skin.html").end().succeeded();
    let url = format!("file://{}", place.path("skin.html").display());
    let mut browser = Browser::new(1400, 900);
    browser.open(&format!("{url}#vcan0:7"));
    browser.until("window.skinbus && window.skinbus.frames > 0");
    let title = "document.getElementById('cell-title').textContent";
    browser.until(&format!("{title} === 'vcan0:7'"));
    browser.until("window.skinbus.where(6)");
    // A click selects another cell, and a click beside all cells selects none.
    browser.value("document.getElementById('whole').click()");
    let at = |browser: &mut Browser, expression: &str| {
        let found = browser.until(expression);
        [0, 1].map(|axis| found[axis].as_f64().unwrap())
    };
    let cell = at(
        &mut browser,
        "(() => { const b = document.getElementById('picture').getBoundingClientRect(); for (let i = 7; i < 24; i++) { \
         const at = window.skinbus.where(i); if (at) return [b.x + at[0], b.y + at[1], window.seen = i]; } return null; })()",
    );
    let click = |browser: &mut Browser, at| {
        for kind in ["mousePressed", "mouseReleased"] {
            browser.mouse(kind, at);
        }
    };
    click(&mut browser, cell);
    browser.until(&format!("{title} === `vcan0:${{window.seen + 1}}`"));
    let corner = at(
        &mut browser,
        "(() => { const b = document.getElementById('picture').getBoundingClientRect(); return [b.x + 3, b.y + 3]; })()",
    );
    click(&mut browser, corner);
    browser.until(&format!("{title} === 'No cell chosen'"));
    // A search, and a neighbour of the cell that it found.
    let search = |text: &str| {
        format!(
            "document.getElementById('search').value = '{text}'; document.getElementById('find').requestSubmit()"
        )
    };
    browser.value(&search("99"));
    browser.until("document.getElementById('cell').textContent === 'There is no cell 99.'");
    browser.value(&search("3"));
    browser.until(&format!("{title} === 'vcan0:3'"));
    browser.value("document.querySelector('#cell button').click()");
    browser.until(&format!("{title} !== 'vcan0:3'"));
    is_accessible(&mut browser);
    let outside: Vec<_> = browser.requests().into_iter().filter(|it| !it.starts_with(&url)).collect();
    assert_eq!(outside, Vec::<&str>::new(), "the page asks for nothing");
    assert_eq!(browser.complaints(), Vec::<&serde_json::Value>::new());
}

/// Prints the frame rate of the page with a moving arm, beside the 253 processes of its cells.
#[test]
#[ignore = "needs tests/tools/install"]
fn a_page_in_software_draws_an_arm_that_moves() {
    let place = TestDir::new();
    place.skin(253);
    place.scenario(
        "version = 1\nduration_s = 120.0\n\n[motion]\nkind = \"sine\"\nstart_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n\
         amplitude_rad = [0.5, 0.3, 0.4, 0.3, 0.2, 0.2]\nperiod_s = 10.0\n",
    );
    let run = place.start("skinbus", "run skin.toml --bus-kind embedded --scenario scenario.toml --view");
    let url = address(&run).url();
    let mut browser = Browser::new(1400, 900);
    browser.open(&url);
    browser.until("window.skinbus && window.skinbus.frames > 10");
    let count = |browser: &mut Browser| {
        let counts = browser.value("[window.skinbus.frames, window.skinbus.snapshots]");
        [0, 1].map(|at| counts[at].as_f64().unwrap())
    };
    let (from, began) = (count(&mut browser), std::time::Instant::now());
    std::thread::sleep(std::time::Duration::from_secs(8));
    let (to, passed) = (count(&mut browser), began.elapsed().as_secs_f64());
    let [frames, snapshots] = [0, 1].map(|at| (to[at] - from[at]) / passed);
    println!("{frames:.1} frames/s of {snapshots:.1} snapshots/s");
    assert!(frames > 0.0 && snapshots > 0.0);
    drop(browser);
    run.signal(rustix::process::Signal::INT);
    run.end();
    place.is_left_clean();
}
