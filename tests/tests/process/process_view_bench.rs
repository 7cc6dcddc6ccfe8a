//! A page commands its run (processes of cells, links, buses), and shows the lateness of the loop.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use process::page::{Page, watched, watched_skin};
use process::{Running, TestDir, is_stopped, signal, skin, until};
use protocol::can::Format;
use recorded::Recorded;
use rustix::process::{Pid, Signal};
use serde_json::{Value, json};

/// Ends a run with a page, checks the files that it left, and returns its exit code.
fn end(place: &TestDir, run: Running) -> Option<i32> {
    run.signal(Signal::INT);
    let ended = run.end();
    place.is_left_clean();
    place.summary().adds_up();
    ended.code()
}

/// Returns the process that serves a run's page.
fn server(place: &TestDir) -> Pid {
    until("the server of the page", || {
        place
            .processes()
            .into_iter()
            .find(|(_, line)| line.contains(" view --wait --of-run "))
            .map(|(pid, _)| pid)
    })
}

#[test]
fn a_page_kills_stops_and_restarts_cells() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 6, "--record run.mcap");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    page.send(r#"{"do":"choose","cell":5}"#);
    let running = json!([{ "bus": 0, "nodes": [5, 5], "phase": "running" }]);
    let said = page.wait_for_status("its process", |said| said["bench"]["processes"] == running);
    assert_eq!(said["bench"]["buses"], json!([{ "down": false, "links": false }]));

    page.act("kill", 5);
    run.wait_for_stderr("view: kill cell 5 on vcan0\n");
    assert!(page.answer("kill cell 5 on vcan0"));
    page.wait_for_status("its end", |said| said["bench"]["processes"][0]["phase"] == "ended");
    assert!(run.cells().iter().all(|(_, nodes)| nodes != "5"));
    page.wait_for_snapshot("that it is silent", |it| it.cells[4].0 == 4);
    for (action, node, why) in [
        ("kill", 5, "kill cell 5 on vcan0: the process has ended: restart it"),
        ("continue", 2, "continue cell 2 on vcan0: the process is running"),
    ] {
        page.act(action, node);
        assert!(!page.answer(why), "{why}");
    }
    page.act("restart", 5);
    run.wait_for_stderr("view: restart cell 5 on vcan0\n");
    page.wait_for_snapshot("that it is back", |it| it.cells[4].0 == 1);
    let back = run.cell(5);

    page.act("stop", 5);
    until("a stopped cell", || is_stopped(back).then_some(()));
    page.wait_for_snapshot("that it is silent again", |it| it.cells[4].0 == 4);
    page.wait_for_status("that it is stopped", |said| said["bench"]["processes"][0]["phase"] == "stopped");
    page.act("continue", 5);
    page.wait_for_snapshot("that it goes on", |it| it.cells[4].0 == 1);
    assert_eq!(run.cell(5), back);

    for (command, why) in [
        (r#"{"do":"link","cells":[1,2],"down":true}"#, "link down between cell 1 and cell 2 on vcan0: "),
        (
            r#"{"do":"bus","bus":"vcan0","down":false}"#,
            "bus vcan0 up: only a bus that a command of this run took down can be brought up",
        ),
    ] {
        page.send(command);
        assert!(!page.answer(why), "{why}");
    }
    let said = page.wait_for_status("a full second", |said| {
        said["bench"]["lateness"]["second"]["count"].as_u64() > Some(0)
    });
    let late = &said["bench"]["lateness"];
    assert!(
        late["all"]["max"].as_f64() >= late["second"]["p50"].as_f64() && late["skipped"].is_u64(),
        "{late}"
    );
    let code = end(&place, run);
    assert_eq!(code, Some(0), "as one whose scenario has done it");

    let recorded = Recorded::read(&place.path("run.mcap"));
    let notes: Vec<_> = recorded.on("/can/notes").map(|note| note.value["text"].as_str().unwrap()).collect();
    assert_eq!(
        notes,
        ["kill", "restart", "stop", "continue"].map(|action| format!("view: {action} cell 5 on vcan0"))
    );
}

#[test]
fn a_process_of_several_cells_is_acted_on_as_a_whole() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 6, "--cells-per-process 4");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    page.send(r#"{"do":"choose","cell":3}"#);
    page.wait_for_status("its process", |said| said["bench"]["processes"][0]["nodes"] == json!([1, 4]));
    page.act("kill", 3);
    assert!(page.answer("kill cells 1 to 4 on vcan0"));
    let silent = |cells: &[(u8, u8, u16)]| cells.iter().map(|cell| cell.0 == 4).collect::<Vec<_>>();
    page.wait_for_snapshot("four silent cells", |it| {
        silent(&it.cells) == [true, true, true, true, false, false]
    });
    page.act("restart", 1);
    page.wait_for_snapshot("all cells again", |it| it.cells.iter().all(|cell| cell.0 == 1));
    end(&place, run);
}

#[test]
fn a_bus_that_a_page_takes_down_stays_down_until_it_takes_it_up() {
    let place = TestDir::new();
    place.write("skin.toml", &(skin(6) + "\n[safety]\nbad_cycles = 250\n"));
    let (run, address) = watched_skin(&place, "");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    let served = || place.processes().iter().any(|(_, line)| line.contains("vcan-setup serve"));
    assert!(served());
    page.send(r#"{"do":"bus","bus":"vcan0","down":true}"#);
    assert!(page.answer("bus vcan0 down"));
    page.wait_for_status("the bus down", |said| {
        said["buses"][0]["up"] == false && said["bench"]["buses"][0]["down"] == true
    });
    run.wait_for_stderr("the robot is halted: ");
    let why = |said: &Value| said["bench"]["halted"].as_str().map(str::to_owned);
    let said = page.wait_for_status("why it is halted", |said| why(said).is_some());
    assert!(run.stderr().contains(&format!("the robot is halted: {};", why(&said).unwrap())), "{said}");
    assert!(!served(), "it is not served again by itself");
    page.send(r#"{"do":"bus","bus":"vcan0","down":true}"#);
    assert!(!page.answer("the bus is already down"));

    page.send(r#"{"do":"bus","bus":"vcan0","down":false}"#);
    assert!(page.answer("bus vcan0 up"));
    run.wait_for_stderr("vcan0 works again");
    page.wait_for_status("the bus up", |said| {
        said["buses"][0]["up"] == true && said["bench"]["buses"][0]["down"] == false
    });
    page.send(r#"{"do":"resume"}"#);
    page.wait_for_status("that it goes on", |said| why(said).is_none());
    page.wait_for_snapshot("all cells again", |it| it.cells.iter().all(|cell| cell.0 == 1));
    page.press(2, 3.0);
    page.wait_for_snapshot("a torque", |it| it.joints.iter().any(|joint| joint[1].abs() > 0.0));
    page.send(r#"{"do":"release"}"#);

    // As after any other loss: a bus that is down at the end is a bus that the run has lost.
    page.send(r#"{"do":"bus","bus":"vcan0","down":true}"#);
    page.wait_for_status("the bus down again", |said| said["buses"][0]["up"] == false);
    assert_eq!(end(&place, run), Some(1));
    assert_eq!(place.summary().0["buses"][0]["outages"]["times"], 2);
}

#[test]
fn a_bus_that_a_page_takes_down_and_up_at_once_is_no_loss_of_the_run() {
    let place = TestDir::new();
    place.write("skin.toml", &(skin(4) + "\n[safety]\nbad_cycles = 10000\n"));
    let (run, address) = watched_skin(&place, "");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    // In one go, before the run has noticed that the bus was away: once, and again while it comes up.
    for times in [1, 1, 2, 3] {
        let seen = run.stderr().matches("vcan0 works again").count();
        for down in [true, false].repeat(times) {
            page.send(&format!(r#"{{"do":"bus","bus":"vcan0","down":{down}}}"#));
        }
        (0..times).for_each(|_| assert!(page.answer("bus vcan0 down") && page.answer("bus vcan0 up")));
        until("the bus", || (run.stderr().matches("vcan0 works again").count() > seen).then_some(()));
        page.wait_for_status("the bus up", |said| said["bench"]["buses"][0]["down"] == false);
    }
    page.wait_for_snapshot("all cells again", |it| it.cells.iter().all(|cell| cell.0 == 1));
    assert_eq!(end(&place, run), Some(0));
}

#[test]
fn a_cell_that_a_page_restarts_while_its_node_id_is_taken_ends_by_an_error_of_its_own() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 4, "");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    page.act("kill", 3);
    page.wait_for_snapshot("that it is silent", |it| it.cells[2].0 == 4);
    place.write("other.toml", &place.read("skin.toml").replace("serial = 100003\n", "serial = 777\n"));
    let other = place.start("cell-node", "--bus vcan0 --bus-kind embedded --node 3 --skin other.toml");
    page.wait_for_snapshot("another cell 3", |it| it.cells[2].0 == 1);
    page.act("restart", 3);
    let why = "cell 3 is already on vcan0, with serial number ";
    run.wait_for_stderr(&format!("the process of cell 3 on vcan0 ended (exit status: 1: {why}"));
    drop(other);
    assert_eq!(end(&place, run), Some(5));
    let errors = &place.summary().0["cell_errors"];
    assert!(errors[0]["reason"].as_str().unwrap().starts_with(why), "{errors:#}");
    assert_eq!(errors[0]["cells"], json!([{ "bus": "vcan0", "nodes": [3] }]));
}

#[test]
fn a_page_at_an_address_that_is_taken_is_refused_before_the_run() {
    let place = TestDir::new();
    place.skin(4);
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let words =
        format!("run skin.toml --bus-kind embedded --duration 1 --candump run.log --view --listen {address}");
    let refused = place.start("skinbus", &words).end();
    let said = refused.refusal(2);
    assert!(said.starts_with(&format!("skinbus: --listen {address}: Address already in use")), "{said}");
    assert_eq!(place.files(), ["skin.toml"], "nothing was done");
}

#[test]
fn a_link_that_a_page_takes_down_leaves_a_cell_unreachable() {
    let place = TestDir::new();
    process::sums::grid(&place, Format::Fd);
    let (run, address) = watched_skin(&place, "");
    let mut page = Page::new(&address);
    let said = page.wait_for_status("the bench", |said| said["bench"].is_object());
    assert_eq!(said["bench"]["buses"], json!([{ "down": false, "links": true }]));
    let link =
        |down: bool, one: u8, other: u8| format!(r#"{{"do":"link","cells":[{one},{other}],"down":{down}}}"#);
    page.send(&link(true, 1, 12));
    assert!(
        !page.answer(
            "link down between cell 1 and cell 12 on vcan0: the skin has no wire between these cells"
        )
    );
    page.send(&link(true, 4, 3));
    page.send(&link(true, 8, 4));
    run.wait_for_stderr("view: link down between cell 4 and cell 3 on vcan0");
    run.wait_for_stderr("cell 4 on vcan0 has had no route to the gateway for ");
    let down = json!([{ "bus": 0, "nodes": [3, 4] }, { "bus": 0, "nodes": [4, 8] }]);
    page.wait_for_status("both links", |said| said["bench"]["links_down"] == down);
    page.send(&link(false, 3, 4));
    run.wait_for_stderr("cell 4 on vcan0 has a route to the gateway again, after");
    page.wait_for_status("one link", |said| {
        said["bench"]["links_down"] == json!([{ "bus": 0, "nodes": [4, 8] }])
    });
    end(&place, run);
}

#[test]
fn a_server_that_hangs_or_ends_does_not_hold_the_run_up() {
    let place = TestDir::new();
    place.write("skin.toml", &(skin(4) + "\n[safety]\nbad_cycles = 10000\n"));
    let (run, address) = watched_skin(&place, "");
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    let server = server(&place);
    signal(server, Signal::STOP);
    until("a stopped server", || is_stopped(server).then_some(()));
    page.act("kill", 2);
    let lines = |run: &Running| run.stderr().lines().filter(|line| line.contains(" in contact")).count();
    let goes_on = |run: &Running| {
        let before = lines(run);
        until("progress meanwhile", || (lines(run) > before).then_some(()));
    };
    goes_on(&run);
    signal(server, Signal::CONT);
    assert!(page.answer("kill cell 2 on vcan0"));
    // After the page has gone, no client can bring the bus up again.
    page.send(r#"{"do":"bus","bus":"vcan0","down":true}"#);
    assert!(page.answer("bus vcan0 down"));
    signal(server, Signal::KILL);
    run.wait_for_stderr(
        "--view: the process that served the page has ended; the run continues without the page\n",
    );
    run.wait_for_stderr("the process that served vcan0 ended (exit status: 0); a new process serves it");
    run.wait_for_stderr("vcan0 works again");
    goes_on(&run);
    assert_eq!(end(&place, run), Some(0));
    assert_eq!(place.summary().silent(), [2]);
}
