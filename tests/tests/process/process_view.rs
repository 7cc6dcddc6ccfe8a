//! `skinbus view`: a page's WebSocket beside a real bench, and hostile clients.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod intruders;

use skinbus_tests::process;

use std::fs::Permissions;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;

use process::page::{Address, Page, QUIET, address, request_websocket, watched};
use process::{Running, TIMEOUT, TestDir, skin, until};
use serde_json::Value;
use tungstenite::{Error, Message};

#[test]
fn a_press_is_a_torque_and_a_release_takes_it_away() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 12, "--candump run.log");
    let mut page = Page::new(&address);
    assert_eq!(page.scene["cells"].as_array().unwrap().len(), 12);
    assert_eq!(
        (&page.scene["may_press"], &page.scene["joints"][1]["torque_unit"]),
        (&true.into(), &"Nm".into())
    );
    let rest = page.wait_for_snapshot("all cells quiet, and the joints' positions", |it| {
        it.cells.iter().all(|cell| cell.0 == 1) && it.joints.iter().all(|joint| !joint[0].is_nan())
    });
    assert!(rest.cells.iter().all(|cell| cell.1 == 0 && cell.2 == 0));
    page.send(r#"{"do":"choose","cell":5}"#);
    page.press(5, 6.0);
    let pressed = page
        .wait_for_snapshot("the torque of the cell", |it| it.joints.iter().any(|joint| joint[1].abs() > 0.0));
    assert_eq!((pressed.cells[4].1, pressed.cells[4].2), (16, 6_000), "pressed by a page, 6 N");
    let both = page.wait_for_snapshot("the central computation", |it| {
        it.joints.iter().any(|joint| joint[1].abs() > 0.0)
            && it.joints.iter().all(|joint| (joint[1] - joint[2]).abs() < 0.01)
    });
    let said = page.wait_for_status("the cell in detail", |said| {
        said["detail"]["torque"].is_object() && said["detail"]["status"] == "active"
    });
    let detail = &said["detail"];
    assert_eq!(
        (&detail["node"], &detail["status"], &detail["force_n"]),
        (&5.into(), &"active".into(), &6.0.into())
    );
    for (ours, central) in detail["torque"]["distributed"]
        .as_array()
        .unwrap()
        .iter()
        .zip(detail["torque"]["central"].as_array().unwrap())
    {
        assert!((ours.as_f64().unwrap() - central.as_f64().unwrap()).abs() < 2e-3, "{detail}");
    }
    let start = rest.joints[1][0];
    page.wait_for_snapshot("the arm gives way", |it| (it.joints[1][0] - start).abs() > 0.01);
    assert!(both.time >= rest.time);
    page.send(r#"{"do":"release"}"#);
    page.wait_for_snapshot("no torque", |it| {
        it.joints.iter().all(|joint| joint[1] == 0.0) && it.cells[4].0 == 1 && it.cells[4].1 == 0
    });

    // The touch of a page ends when the page goes.
    let mut other = Page::new(&address);
    other.press(7, 3.0);
    page.wait_for_snapshot("a touch of the other page", |it| it.cells[6].2 == 3_000);
    drop(other);
    page.wait_for_snapshot("that it is gone", |it| it.cells[6].2 == 0);
    page.send(r#"{"do":"halt"}"#);
    page.wait_for_status("the halt", |said| said["halted"] == true);
    page.send(r#"{"do":"resume"}"#);
    page.wait_for_status("the resume", |said| said["halted"] == false);
    run.signal(rustix::process::Signal::INT);
    run.end();
    place.is_left_clean();
    assert!(TcpStream::connect(&address.host).is_err(), "the page ends with its run");
    // The page's press is on the bus as stimuli.
    let log = place.read("run.log");
    assert!(log.contains(" 705#") && log.contains(" 707#"), "stimuli of cells 5 and 7");
}

#[test]
fn who_is_no_page_of_this_server_is_refused_and_floods_end_nothing() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 4, "");
    let Address { host, query } = &address;
    let port = host.rsplit(':').next().unwrap();
    let status = |headers: &[(&'static str, &str)]| match request_websocket(&address, headers) {
        Ok((_, status)) => status,
        Err(Error::Http(response)) => response.status().as_u16(),
        Err(error) => panic!("{error}"),
    };
    assert_eq!(status(&[]), 101, "a program that has the token");
    assert_eq!(status(&[("Origin", "http://evil.example")]), 403);
    assert_eq!(status(&[("Origin", "null")]), 403);
    assert_eq!(status(&[("Host", &format!("evil.example:{port}"))]), 403);
    let http = |request: String| {
        let mut stream = TcpStream::connect(&address.host).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = String::new();
        match stream.read_to_string(&mut answer) {
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::ConnectionReset => {}
            Err(error) => panic!("{error}"),
        }
        answer
    };
    let get = |path: &str| http(format!("GET {path}{query} HTTP/1.1\r\nHost: {host}\r\n\r\n"));
    let page = get("/");
    assert!(
        page.starts_with("HTTP/1.1 200 OK") && page.contains("Content-Security-Policy: default-src 'none'")
    );
    assert!(get("/app.js").contains("text/javascript") && get("/../Cargo.toml").starts_with("HTTP/1.1 404"));
    let long = http(format!("GET / HTTP/1.1\r\nHost: {host}\r\nX: {}\r\n\r\n", "x".repeat(20_000)));
    assert!(long.starts_with("HTTP/1.1 431"), "{long}");

    // One page reads nothing, one sends arbitrary data; a third one must still work.
    let stalled = Page::new(&address);
    let mut flood = Page::new(&address);
    let flooding = std::thread::spawn(move || {
        for number in 0..20_000_u32 {
            let text = match number % 8 {
                0 => "{\"do\":\"press\",\"cell\":\"vcan9:1\",\"force_n\":1}".to_owned(),
                1 => format!("{{\"do\":\"choose\",\"cell\":{}}}", number % 256),
                2 => "x".repeat(200),
                3 => "{\"do\":\"press\",\"cell\":2,\"force_n\":1e308}".to_owned(),
                4 => "{\"do\":\"kill\",\"cell\":\"vcan9:1\"}".to_owned(),
                5 => "{\"do\":\"link\",\"cells\":[1,1],\"down\":true}".to_owned(),
                6 => "{\"do\":\"bus\",\"bus\":\"vcan9\",\"down\":false}".to_owned(),
                _ => "{\"do\":\"release\"}".to_owned(),
            };
            if flood.socket.send(Message::text(text)).is_err() {
                break;
            }
        }
    });
    let mut page = Page::new(&address);
    let mut seen = 0;
    page.wait_for_snapshot("snapshots during the flood", |_| {
        seen += 1;
        seen > 60
    });
    flooding.join().unwrap();
    let mut too_long = Page::new(&address);
    let _ = too_long.socket.send(Message::text(" ".repeat(2_000)));
    until("the end of a page that says too much", || {
        loop {
            match too_long.socket.read() {
                Ok(_) => {}
                Err(Error::Io(error)) if error.kind() == ErrorKind::WouldBlock => return None,
                Err(_) => return Some(()),
            }
        }
    });
    page.press(1, 2.0);
    page.wait_for_snapshot("a press as before", |it| {
        it.cells[0].2 == 2_000 && it.joints.iter().any(|joint| joint[1].abs() > 0.0)
    });
    drop(stalled);
    run.signal(rustix::process::Signal::INT);
    run.end();
    let summary = place.summary();
    assert!(summary.total("/buses/0/received") > 0);
    place.is_left_clean();
}

#[test]
fn pages_that_may_only_look_press_nothing() {
    let place = TestDir::new();
    // A busy machine must not halt the robot.
    place.write("skin.toml", &(skin(4) + "\n[safety]\nbad_cycles = 10000\n"));
    place.scenario(QUIET);
    let run = place.running_bench(600.0, "");
    let view = place.start("skinbus", "view skin.toml --bus-kind embedded --read-only");
    let mut page = Page::new(&address(&view));
    assert_eq!(page.scene["may_press"], false);
    page.press(2, 5.0);
    page.send(r#"{"do":"halt"}"#);
    page.act("kill", 3);
    let mut seen = 0;
    let last = page.wait_for_snapshot("snapshots", |_| {
        seen += 1;
        seen > 30
    });
    assert!(last.cells.iter().all(|cell| cell.2 == 0 && cell.1 == 0));
    let said = page.wait_for_status("words", |_| true);
    assert!(said["bench"].is_null(), "it belongs to no run: {said}");
    assert_eq!(run.cells().len(), 4);
    view.signal(rustix::process::Signal::INT);
    view.end().succeeded();
    run.signal(rustix::process::Signal::INT);
    run.end();
    for (words, expected) in [
        (
            "--token-file skin.toml",
            "--token-file skin.toml: a token must consist of 16 to 256 letters or digits",
        ),
        ("--token-file no-such-file", "--token-file no-such-file: No such file or directory"),
        (
            "--address-file skin.toml",
            "--address-file skin.toml: the file exists and does not contain the address of a page",
        ),
        ("--listen nowhere", "--listen"),
        ("", "vcan0"),
    ] {
        let ended = place.start("skinbus", &format!("view skin.toml --bus-kind embedded {words}")).end();
        let said = ended.refusal(2);
        assert!(said.contains(expected), "{words}: {said}");
    }
}

#[test]
fn one_bus_of_a_skin_is_shown_alone() {
    let place = TestDir::new();
    place.start("skinbus", "skin generate --cells 10 --buses 2 -o skin.toml").end().succeeded();
    place.scenario(QUIET);
    let run = place.running_bench(600.0, "");
    let view = place.start("skinbus", "view vcan1 --skin skin.toml --bus-kind embedded");
    let mut page = Page::new(&address(&view));
    assert_eq!(page.scene["buses"].as_array().unwrap().len(), 1);
    assert_eq!(page.scene["buses"][0]["name"], "vcan1");
    let cells = page.scene["cells"].as_array().unwrap().len();
    assert!((1..10).contains(&cells), "{cells}");
    page.wait_for_snapshot("its cells quiet", |it| {
        it.cells.len() == cells && it.cells.iter().all(|cell| cell.0 == 1)
    });
    view.signal(rustix::process::Signal::INT);
    view.end().succeeded();
    run.signal(rustix::process::Signal::INT);
    run.end();
    for (words, expected) in [
        ("view vcan1", "there is no file vcan1: name a skin (to show its buses), a recording, or a bus"),
        (
            "view vcan7 --skin skin.toml",
            "the skin file skin.toml has no bus vcan7; its buses are vcan0, vcan1",
        ),
        ("view vcan1 --skin skin.toml --at 3", "--at is only for a recording, not for live buses"),
    ] {
        let ended = place.start("skinbus", &format!("{words} --bus-kind embedded")).end();
        assert!(ended.refusal(2).contains(expected), "{words}: {}", ended.refusal(2));
    }
}

#[test]
fn a_robot_of_which_the_urdf_is_there_comes_with_its_surface() {
    let place = TestDir::new();
    std::fs::copy(
        concat!(env!("CARGO_MANIFEST_DIR"), "/../gateway/examples/lift.urdf"),
        place.path("lift.urdf"),
    )
    .unwrap();
    place.start("skinbus", "skin import lift.urdf --tip arm7 -o skin.toml").end().succeeded();
    let view = place.start("skinbus", "view skin.toml --wait --bus-kind embedded");
    view.wait_for_stderr("view: http://");
    let address = address(&view);
    let scene = Page::new(&address).scene;
    let shells = scene["shells"].as_array().unwrap();
    let number = |shell: &Value, key: &str| usize::try_from(shell[key].as_u64().unwrap()).unwrap();
    let rows: Vec<_> = shells.iter().map(|shell| number(shell, "row")).collect();
    assert!(rows[0] == 0 && rows.len() > 5 && rows.is_sorted(), "{rows:?}");

    let mut stream = TcpStream::connect(&address.host).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    let Address { host, query } = &address;
    write!(stream, "GET /surface{query} HTTP/1.1\r\nHost: {host}\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let body = answer.windows(4).position(|end| end == b"\r\n\r\n").unwrap() + 4;
    let floats: Vec<_> =
        answer[body..].chunks(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect();
    let corners: Vec<_> = floats.chunks(6).collect();
    assert_eq!(corners.len(), shells.iter().map(|shell| number(shell, "count")).sum::<usize>());
    // The base, a box, has the size that the URDF gives.
    let base = &corners[number(&shells[0], "first")..][..number(&shells[0], "count")];
    let size = [0, 1, 2].map(|axis| {
        let of = |pick: fn(f32, f32) -> f32| base.iter().map(|corner| corner[axis]).reduce(pick).unwrap();
        of(f32::max) - of(f32::min)
    });
    assert!(size.iter().zip([0.5, 0.4, 0.3]).all(|(one, other)| (one - other).abs() < 1e-5), "{size:?}");
    assert_eq!(base.len(), 36, "two triangles for each of six faces");
    view.signal(rustix::process::Signal::INT);
    view.end();
}

#[test]
fn a_page_that_acts_tells_and_does_nothing_without_its_token() {
    let place = TestDir::new();
    let (run, address) = watched(&place, 4, "--address-file address");
    let Address { host, query } = address.clone();
    assert_eq!(query.len(), "?token=".len() + 32, "{query}");
    assert_eq!(place.read("address"), format!("{}\n", address.url()));
    assert_eq!(place.path("address").metadata().unwrap().permissions().mode() & 0o777, 0o600);
    // The token is not on a command line, which every user of the machine can read.
    let token = query.strip_prefix("?token=").unwrap();
    assert!(place.processes().iter().all(|(_, line)| !line.contains(token)));
    let origin = format!("http://{host}");
    for wrong in ["", "?token=", "?token=00000000000000000000000000000000"] {
        let without = Address { host: host.clone(), query: wrong.to_owned() };
        match request_websocket(&without, &[("Origin", &origin)]) {
            Err(Error::Http(answer)) => {
                let body = String::from_utf8(answer.body().clone().unwrap_or_default()).unwrap();
                assert_eq!(answer.status().as_u16(), 403);
                assert!(body.is_empty() || body.contains("open the whole address"), "{body}");
            }
            other => panic!("{:?}", other.map(|(_, status)| status)),
        }
    }
    let mut page = Page::new(&address);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    run.signal(rustix::process::Signal::INT);
    run.end();
    assert!(!place.path("address").exists(), "it goes with the page");
    place.is_left_clean();
}

#[test]
fn a_token_is_taken_from_a_file_or_the_environment() {
    const SECRET: &str = "0123456789abcdefXYZ";
    let place = TestDir::new();
    place.skin(2);
    place.write("token", &format!("{SECRET}\n"));
    std::fs::set_permissions(place.path("token"), Permissions::from_mode(0o600)).unwrap();
    let view = "view skin.toml --wait --bus-kind embedded";
    let run = "run skin.toml --bus-kind embedded --duration 600 --view";
    for (words, variable) in [
        (format!("{view} --token-file token"), ""),
        (view.to_owned(), SECRET),
        (format!("{view} --read-only --token-file token"), ""),
        (format!("{run} --token-file token"), ""),
        (run.to_owned(), SECRET),
    ] {
        let mut command = place.command("skinbus", &words);
        command.env("SKINBUS_TOKEN", variable);
        let served = Running::start(command);
        let address = address(&served);
        assert_eq!(address.query, format!("?token={SECRET}"), "{words}");
        Page::new(&address);
        let without = Address { query: String::new(), ..address };
        assert!(matches!(request_websocket(&without, &[]), Err(Error::Http(_))), "{words}");
        served.signal(rustix::process::Signal::INT);
        served.end();
    }
    // A read-only page needs no token on this machine, but one for other machines.
    for (words, has_token) in [("--read-only", false), ("--read-only --listen 0.0.0.0:0", true)] {
        let served = place.start("skinbus", &format!("{view} {words}"));
        let address = address(&served);
        assert_eq!(!address.query.is_empty(), has_token, "{words}: {}", address.url());
        Page::new(&address);
        served.signal(rustix::process::Signal::INT);
        served.end().succeeded();
    }
    let mut command = place.command("skinbus", &format!("{run} --candump run.log"));
    command.env("SKINBUS_TOKEN", "short");
    let refused = Running::start(command).end();
    assert_eq!(
        refused.refusal(2),
        "skinbus: SKINBUS_TOKEN: a token must consist of 16 to 256 letters or digits"
    );
    assert!(!place.path("run.log").exists(), "nothing was done");
}
