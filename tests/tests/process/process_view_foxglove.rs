//! `skinbus view --foxglove`: viewers of Foxglove's WebSocket protocol at recordings and at live buses.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};

use process::page::{Page, address};
use process::recorded::decode;
use process::viewer::{TopicMessage, Viewer, request, viewer_url};
use process::{PRESSED, Running, TestDir};
use rustix::process::Signal;
use serde_json::Value;
use trace::capture::MessageReader;
use tungstenite::{Error, Message};

/// Topics that only the control loop can fill.
const LOOP_TOPICS: [&str; 3] = ["/gateway/timing", "/UR5/joint_commands", "/state/vcan0"];

fn recording(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings").join(name)
}

/// Serves a recording that stands at its beginning.
fn served(place: &TestDir, name: &str, more: &str) -> Running {
    std::fs::copy(recording(name), place.path(name)).unwrap();
    place.start("skinbus", &format!("view {name} --at 0 --foxglove 0 {more}"))
}

/// Returns all messages of recordings, by topic.
fn by_topic(messages: impl IntoIterator<Item = TopicMessage>) -> BTreeMap<String, Vec<(u64, Vec<u8>)>> {
    let mut topics = BTreeMap::<_, Vec<_>>::new();
    for TopicMessage { topic, nanos, message } in messages {
        topics.entry(topic).or_default().push((nanos, message));
    }
    topics
}

fn messages_of(paths: &[PathBuf]) -> Vec<TopicMessage> {
    let mut reader = MessageReader::open(paths).unwrap();
    let mut all = Vec::new();
    while let Some(found) = reader.next_until(u64::MAX).unwrap() {
        let (channel, nanos, message) = (found.channel, found.log_nanos, found.message.to_vec());
        all.push(TopicMessage { topic: reader.channels()[channel].topic.clone(), nanos, message });
    }
    all
}

#[test]
fn a_recording_comes_message_for_message_as_it_is_in_the_file() {
    let place = TestDir::new();
    let view = served(&place, "fd.mcap", "");
    let mut viewer = Viewer::new(&viewer_url(&view));
    assert_eq!(viewer.info["capabilities"], serde_json::json!(["time"]));
    let in_order = messages_of(&[place.path("fd.mcap")]);
    let file = by_topic(messages_of(&[place.path("fd.mcap")]));
    let advertised: BTreeSet<_> = viewer.channels.values().map(|it| it["topic"].as_str().unwrap()).collect();
    assert!(file.keys().all(|topic| advertised.contains(topic.as_str())), "{advertised:?}");
    for channel in viewer.channels.values() {
        assert_eq!((&channel["encoding"], &channel["schemaEncoding"]), (&"cdr".into(), &"ros2msg".into()));
    }
    viewer.subscribe_to_all();
    let mut page = Page::new(&address(&view));
    page.wait_for_status("all is read", |said| said["playback"]["read"] == 1.0);
    page.send(r#"{"do":"play","speed":100}"#);
    let mut remaining: BTreeSet<_> = file.keys().cloned().collect();
    let came = viewer.read_until("the last message of each topic", |_, all| {
        if let Some(TopicMessage { topic, nanos, message }) = all.last()
            && file[topic].last().is_some_and(|last| (last.0, &last.1) == (*nanos, message))
        {
            remaining.remove(topic);
        }
        remaining.is_empty()
    });
    let came = by_topic(came);
    assert_eq!(viewer.status, Vec::<Value>::new());
    for (topic, messages) in &file {
        // The last message before the subscription may come a second time.
        let came = &came[topic];
        assert!(came.len() >= messages.len(), "{topic}: {} of {}", came.len(), messages.len());
        assert!(came[came.len() - messages.len()..] == messages[..], "{topic}");
    }

    // Back in time, each topic tells its state there.
    page.send(r#"{"do":"seek","at_s":1.0}"#);
    let said = page.wait_for_status("the position", |said| said["playback"]["at_s"] == 1.0);
    let at: u64 = said["playback"]["at_ns"].as_str().unwrap().parse().unwrap();
    let mut awaited = BTreeSet::from(["/can/vcan0", "/gateway/timing", "/diagnostics"]);
    viewer.read_until("the state there", |viewer, all| {
        if let Some(TopicMessage { topic, nanos, message }) = all.last() {
            // Some messages are in the file after later ones; reading ends at the first that is later than the position.
            let read = in_order.iter().take_while(|it| it.nanos <= at);
            let before = read.filter(|it| it.topic == *topic).last();
            if before.is_some_and(|it| (it.nanos, &it.message) == (*nanos, message)) {
                awaited.remove(topic.as_str());
            }
        }
        awaited.is_empty() && viewer.time == Some(at)
    });
}

#[test]
fn live_topics_are_those_of_the_recording() {
    let place = TestDir::new();
    place.skin(6);
    place.scenario(PRESSED);
    // The view must receive the stimuli at the beginning of the touches.
    let view = place.start("skinbus", "view skin.toml --bus-kind embedded --wait --foxglove 0");
    let mut viewer = Viewer::new(&viewer_url(&view));
    assert_eq!(viewer.info["capabilities"], serde_json::json!([]));
    viewer.subscribe_to_all();
    let bench = place.bench(6.0, "--record run.mcap");
    let topics: BTreeSet<_> =
        viewer.channels.values().map(|it| it["topic"].as_str().unwrap().to_owned()).collect();
    let has_all = |all: &[TopicMessage]| {
        if all.len() < 2_000 || !all.len().is_multiple_of(100) {
            return false;
        }
        let came: BTreeSet<_> = all.iter().map(|it| it.topic.clone()).collect();
        topics.iter().all(|topic| came.contains(topic) || topic == "/can/notes")
    };
    let came = viewer.read_until("all topics", |_, all| has_all(all));
    bench.end().succeeded();
    view.signal(Signal::INT);
    view.end().succeeded();

    let path = place.path("run.mcap");
    let reader = MessageReader::open(std::slice::from_ref(&path)).unwrap();
    let recorded: BTreeMap<_, _> = reader
        .channels()
        .iter()
        .map(|it| (it.topic.as_str(), (it.schema_name.as_str(), str::from_utf8(&it.schema).unwrap())))
        .collect();
    for channel in viewer.channels.values() {
        let told = (channel["schemaName"].as_str().unwrap(), channel["schema"].as_str().unwrap());
        assert_eq!(recorded[channel["topic"].as_str().unwrap()], told);
    }
    let expected = recorded.keys().filter(|topic| !LOOP_TOPICS.contains(topic)).map(|it| (*it).to_owned());
    assert_eq!(topics, expected.collect::<BTreeSet<_>>());

    let file = messages_of(std::slice::from_ref(&path));
    // Each receiver has its own time stamps, and only the run knows which frames are its own.
    let frames = |all: &[TopicMessage]| -> Vec<Value> {
        let frames = all.iter().filter(|it| it.topic == "/can/vcan0");
        let mut values: Vec<_> =
            frames.map(|it| decode(viewer.definition("/can/vcan0"), &it.message)).collect();
        for value in &mut values {
            value["direction"] = Value::Null;
            value["header"] = Value::Null;
        }
        values
    };
    let (came_frames, file_frames) = (frames(&came), frames(&file));
    assert!(came_frames.len() > 100);
    let begin = came_frames.iter().take(100).cloned().collect::<Vec<_>>();
    assert!(file_frames.windows(100).any(|frames| frames == begin), "the frames are those of the recording");

    let of = |all: &[TopicMessage], topic: &str| -> Vec<Value> {
        let messages = all.iter().filter(|it| it.topic == topic);
        messages.map(|it| decode(viewer.definition(topic), &it.message)).collect()
    };
    assert_eq!(of(&came, "/robot_description"), of(&file, "/robot_description"));
    let positions = |value: &Value| -> Vec<f64> {
        value["position"].as_array().unwrap().iter().map(|it| it.as_f64().unwrap()).collect()
    };
    // The arm stands still; a broadcast has words of 16 bits.
    let recorded = positions(of(&file, "/UR5/joint_states").last().unwrap());
    for state in of(&came, "/UR5/joint_states") {
        let came = positions(&state);
        assert_eq!(came.len(), recorded.len());
        assert!(came.iter().zip(&recorded).all(|(one, other)| (one - other).abs() < 2e-3), "{came:?}");
    }
    for topic in topics.iter().filter(|it| it.starts_with("/skin/") && !it.ends_with("/points")) {
        // All cells are touched by 1.5 N in the end.
        let cells = |value: &Value| (value["node"].clone(), value["force"].clone());
        let recorded = cells(of(&file, topic).last().unwrap());
        assert!(of(&came, topic).iter().any(|value| cells(value) == recorded), "{topic}: {recorded:?}");
    }
}

#[test]
fn central_torques_are_absent_while_a_touch_from_before_the_view_lasts() {
    let place = TestDir::new();
    place.skin(6);
    place.scenario(PRESSED);
    let bench = place.running_bench(600.0, "");
    let view = place.start("skinbus", "view skin.toml --bus-kind embedded --foxglove 0");
    let mut viewer = Viewer::new(&viewer_url(&view));
    viewer.subscribe_to_all();
    let topic = "/UR5/torques";
    let of_topic = |all: &[TopicMessage]| all.iter().filter(|it| it.topic == topic).count();
    let came = viewer.read_until("torques", |_, all| of_topic(all) > 50);
    bench.signal(Signal::INT);
    bench.end().succeeded();
    view.signal(Signal::INT);
    view.end().succeeded();
    let mut largest = 0.0_f64;
    for message in came.iter().filter(|it| it.topic == topic) {
        let torques = decode(viewer.definition(topic), &message.message);
        assert_eq!(torques["central"], serde_json::json!([]), "{torques}");
        let distributed = torques["distributed"].as_array().unwrap();
        largest = distributed.iter().map(|it| it.as_f64().unwrap().abs()).fold(largest, f64::max);
    }
    assert!(largest > 0.1, "{largest} Nm");
}

#[test]
fn viewers_that_sleep_or_talk_nonsense_disturb_neither_the_bench_nor_others() {
    let place = TestDir::new();
    place.skin(40);
    place.scenario(PRESSED);
    let bench = place.running_bench(600.0, "");
    let view = place.start("skinbus", "view skin.toml --bus-kind embedded --foxglove 0");
    let url = viewer_url(&view);
    let mut viewers: Vec<_> = (0..19).map(|_| Viewer::new(&url)).collect();
    viewers.iter_mut().for_each(Viewer::subscribe_to_all);
    let mut sleeper = viewers.pop().unwrap();
    let mut talker = Viewer::new(&url);
    for text in [
        "",
        "{",
        r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":99999}]}"#,
        r#"{"op":"unsubscribe","subscriptionIds":[99999]}"#,
        r#"{"op":"advertise","channels":[]}"#,
        r#"{"op":"setParameters","parameters":[]}"#,
    ] {
        talker.send(text);
    }
    talker.socket.send(Message::binary(vec![1, 2, 3])).unwrap();
    talker.read_until("all answers", |viewer, _| viewer.status.len() >= 7);
    for (said, words) in talker.status.iter().zip([
        "not understood",
        "not understood",
        "channel 99999 is not advertised",
        "subscription 99999 does not exist",
        "advertise is not supported: this server only sends",
        "setParameters is not supported: this server only sends",
        "binary messages are not supported: this server only sends",
    ]) {
        assert!(said["message"].as_str().unwrap().contains(words), "{said}");
    }
    // Bytes that are not a WebSocket frame end this viewer alone.
    talker.socket.get_mut().write_all(&[0xFF; 4_096]).unwrap();
    while talker.read().is_ok() {}
    // More than fits into the queue of the viewer that sleeps, and into the buffers of its socket.
    let mut first = viewers.pop().unwrap();
    let came = first.read_until("many messages", |_, all| all.len() > 40_000);
    assert!(came.iter().rev().take(20_000).any(|it| it.topic == "/diagnostics"));
    for viewer in &mut viewers {
        viewer.read_until("further messages", |_, all| all.len() > 100);
    }
    let newest = came.last().unwrap().nanos;
    let came = sleeper.read_until("what it missed", |viewer, all| {
        !viewer.status.is_empty() && all.iter().any(|it| it.nanos >= newest)
    });
    let said = sleeper.status[0]["message"].as_str().unwrap();
    assert!(said.contains(" messages were dropped so far, the oldest first, because this viewer"), "{said}");
    assert!(came.len() < 40_000);
    bench.signal(Signal::INT);
    let ended = bench.end();
    assert_eq!(ended.code(), Some(0), "{}", ended.stderr);
    view.signal(Signal::INT);
    view.end().succeeded();
}

fn refused(error: &Error) -> (u16, String) {
    let Error::Http(response) = error else { panic!("{error}") };
    let body = response.body().as_deref().unwrap_or_default();
    (response.status().as_u16(), String::from_utf8_lossy(body).into_owned())
}

#[test]
fn pages_of_other_sites_and_too_many_viewers_are_refused_in_words() {
    const PROTOCOL: (&str, &str) = ("Sec-WebSocket-Protocol", "foxglove.sdk.v1, foxglove.websocket.v1");
    let place = TestDir::new();
    let view = served(&place, "fd.mcap", "");
    let url = viewer_url(&view);
    for _ in 0..100 {
        let (code, said) =
            refused(&request(&url, &[PROTOCOL, ("Origin", "https://evil.example")]).unwrap_err());
        assert_eq!(code, 403, "{said}");
        let (code, said) = refused(&request(&url, &[]).unwrap_err());
        assert!(code == 400 && said.contains("must offer the subprotocol foxglove.sdk.v1"), "{code} {said}");
    }
    let foxglove = request(&url, &[PROTOCOL, ("Origin", "https://app.foxglove.dev")]).unwrap();
    drop(foxglove);
    let mut inside = Vec::new();
    let refusals = (0..232).filter_map(|_| match Viewer::attempt(&url) {
        Ok(viewer) => {
            inside.push(viewer);
            None
        }
        Err(error) => Some(refused(&error)),
    });
    let refusals: Vec<_> = refusals.collect();
    assert!(inside.len() <= 32 && refusals.len() >= 200, "{} {}", inside.len(), refusals.len());
    for (code, said) in refusals {
        assert!(code == 503 && said.contains("32 viewers are connected, the maximum"), "{code} {said}");
    }
    let mut plain = std::net::TcpStream::connect(url.strip_prefix("ws://").unwrap()).unwrap();
    write!(plain, "GET / HTTP/1.1\r\nHost: {}\r\n\r\n", url.strip_prefix("ws://").unwrap()).unwrap();
    let mut said = String::new();
    plain.read_to_string(&mut said).unwrap();
    assert!(said.starts_with("HTTP/1.1 426 ") && said.contains("connect to it in Foxglove"), "{said}");
    // Those inside are served.
    inside[0].subscribe_to_all();
    inside[0].read_until("messages", |_, all| !all.is_empty());
}

#[test]
fn a_token_is_needed_by_all_viewers_if_the_user_chose_one() {
    let place = TestDir::new();
    place.write("token", "abcdef0123456789\n");
    let view = served(&place, "fd.mcap", "--token-file token");
    let url = viewer_url(&view);
    assert!(url.ends_with("/?token=abcdef0123456789"), "{url}");
    let (bare, _) = url.split_once("/?").unwrap();
    let Err(error) = Viewer::attempt(bare) else { panic!("no token") };
    assert_eq!(refused(&error).0, 403);
    Viewer::new(&url);
}

#[test]
fn what_cannot_be_served_is_refused_in_one_line() {
    let place = TestDir::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    std::fs::copy(recording("fd.mcap"), place.path("fd.mcap")).unwrap();
    std::fs::copy(recording("classic.log"), place.path("classic.log")).unwrap();
    place.skin(3);
    let said = place.start("skinbus", &format!("view fd.mcap --foxglove {port}")).end();
    let expected = format!(
        "--foxglove {port}: Address already in use (os error 98); name another port, or 0 for any free port"
    );
    assert!(said.refusal(2).contains(&expected), "{}", said.refusal(2));
    let said = place.start("skinbus", "view classic.log --skin skin.toml --foxglove 0").end();
    let expected = "--foxglove 0: classic.log is a candump log, and only an MCAP recording has topics: convert it with \
                    `skinbus convert classic.log FILE.mcap`, or leave the option out";
    assert!(said.refusal(2).contains(expected), "{}", said.refusal(2));
}
