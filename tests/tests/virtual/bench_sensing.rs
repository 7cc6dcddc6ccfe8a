//! Complete benches on which cells send their sensor values: continuously, on events, or not at all.

#![allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::print_stdout,
    clippy::cast_precision_loss,
    reason = "a test may stop, and tells its figures"
)]

use std::collections::BTreeMap;

use model::scenario::Scenario;
use protocol::can::Format;
use protocol::id::{CellId, Kind, Node};
use protocol::message::{Message, Request, SensorPage, SkinSensors};
use protocol::packet::{Lengths, Packet, Reassembler, Reassembly, data_frame_id};
use protocol::parameters::{Parameter, Sensing};
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use protocol::touch::{TouchState, contact_force};
use skinbus_tests::accounts;
use skinbus_tests::bench::{Act, Bench};
use skinbus_tests::fault::{Fault, Harm, Party};
use skinbus_tests::skins;

const AT_62_5_HZ: Sensing = Sensing::Continuous { period_ms: 16 };
/// The time for which a bench is observed.
const OBSERVATION_TIME: Span = Span::from_millis(8_000);
const TOUCHED: usize = 100;

/// Returns touches of half a second to two, one after another, each of some of the first 100 cells, of 0.5 to 6 N times
/// `harder`, and at phases that are independent of epochs.
fn moving(skin: &Skin, harder: f64) -> Scenario {
    let mut text = String::from(
        "version = 1\nduration_s = 10.0\n[motion]\nkind = \"sine\"\nstart_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n\
         amplitude_rad = [0.2, 0.2, 0.2, 0.2, 0.2, 0.2]\nperiod_s = 4.0\n",
    );
    for group in 0..10_usize {
        let nodes: Vec<_> =
            skin.cells.iter().skip(10 * group).take(10).map(|cell| cell.node.to_string()).collect();
        let mut at = 0.013 * group as f64;
        let mut n = group;
        while at < 7.0 {
            let length = 0.5 + 0.31 * (n % 5) as f64;
            let force = harder * (0.5 + 0.55 * ((3 * n) % 11) as f64);
            text += &format!(
                "[[touch]]\nat_s = {at:.3}\nfor_s = {length:.3}\nbus = \"vcan0\"\ncells = [{}]\nforce_n = {force:.2}\n\
                 profile = \"half-sine\"\n",
                nodes.join(", ")
            );
            // The next one follows at once: the cell is in contact all the time, except for an epoch or two.
            at += length + 0.03;
            n += 1;
        }
    }
    Scenario::parse("moving.toml", &text, skin).unwrap()
}

fn switch(mode: Sensing) -> Message {
    to(Node::Everyone, mode)
}

fn to(to: Node, mode: Sensing) -> Message {
    let request = Request::Write { number: Parameter::Sensing.number(), words: mode.words() };
    Message::Configure { to, tag: 1, request }
}

/// Returns the sensors frames on the wire since a time, with their times and senders.
fn sensors_frames(bench: &Bench, since: Micros) -> Vec<(Micros, CellId, SensorPage)> {
    let format = bench.skin.buses[0].format;
    let mut segments = BTreeMap::new();
    let packet = |frame| match format {
        Format::Fd => Packet::from_fd(frame).ok(),
        Format::Classic => {
            let id = data_frame_id(frame).ok()?;
            match segments.entry(id).or_insert(Reassembler::NONE).push(
                Micros(0),
                id,
                Lengths::ALL,
                frame.data(),
            ) {
                Ok(Reassembly::Complete(packet)) => Some(packet),
                Ok(Reassembly::Waiting | Reassembly::Incomplete | Reassembly::Ambiguous) | Err(_) => None,
            }
        }
    };
    let all = bench.wire.iter();
    let packets =
        all.map(|it| (it.at, &it.frame)).scan(packet, |packet, (at, frame)| Some((at, packet(frame))));
    let mut frames = Vec::new();
    for (at, packet) in packets {
        let message = packet.and_then(|packet| Message::decode(&packet).ok());
        if let Some(Message::Sensors { from, page, .. }) = message
            && at >= since
        {
            frames.push((at, from, page));
        }
    }
    frames
}

/// Returns a bench whose cells are in this mode, and the start of the observation, which excludes the frames of the
/// switch.
fn looked_at(skin: &Skin, scenario: &Scenario, mode: Sensing) -> (Bench, Micros) {
    let mut bench = Bench::with(skin, scenario, 7, |_| Micros(0));
    bench.settle();
    bench.act(Act::SendFromGateway(switch(mode)));
    bench.run(Span::from_millis(100));
    let since = bench.now();
    bench.begin();
    bench.run(OBSERVATION_TIME);
    (bench, since)
}

/// Checks the sensors of every touched cell at each joints message, derived from the stimuli on the wire: each change
/// of its contact is a touch or a release, and has its frame before the next joints. Returns the numbers of both.
fn every_turn_was_reported(bench: &Bench, since: Micros) -> (usize, usize) {
    let events = bench.skin.events;
    let frames = sensors_frames(bench, since);
    let mut by_cell = BTreeMap::<CellId, Vec<(Micros, SkinSensors)>>::new();
    for (at, cell, page) in frames {
        if let SensorPage::Skin(skin) = page {
            by_cell.entry(cell).or_default().push((at, skin));
        }
    }
    let mut stimuli = BTreeMap::<CellId, Vec<(u8, SkinSensors)>>::new();
    let mut contact_state = BTreeMap::<CellId, (SkinSensors, TouchState)>::new();
    let (mut touches, mut releases) = (0, 0);
    let period = bench.epoch();
    for it in &bench.wire {
        let message = Packet::from_fd(&it.frame).ok().and_then(|packet| Message::decode(&packet).ok());
        match message {
            Some(Message::Stimulus { to: Node::Cell(cell), from, page: SensorPage::Skin(skin) }) => {
                let protocol::message::StimulusStart::Epoch(first) = from else { continue };
                stimuli.entry(cell).or_default().push((first.0, skin));
            }
            Some(Message::Joints { epoch, .. }) => {
                for (cell, waiting) in &mut stimuli {
                    let (now, touch) = contact_state.entry(*cell).or_default();
                    waiting.retain(|&(first, skin)| {
                        let due = epoch.0.wrapping_sub(first).cast_signed() >= 0;
                        if due {
                            *now = skin;
                        }
                        !due
                    });
                    let next = touch.next(contact_force(now), events.contact.to_bits(), events.hysteresis);
                    if next != *touch && it.at + period < since + OBSERVATION_TIME {
                        let within = |&&(at, said): &&(Micros, SkinSensors)| {
                            at >= it.at && at < it.at + period && said == *now
                        };
                        let frames = by_cell.get(cell).into_iter().flatten().filter(within).count();
                        assert!(frames > 0, "cell {cell} at {:?}: {touch:?} to {next:?} is not told", it.at);
                        touches += usize::from(next == TouchState::Touched);
                        releases += usize::from(*touch == TouchState::Touched);
                    }
                    *touch = next;
                }
            }
            Some(_) | None => {}
        }
    }
    (touches, releases)
}

#[test]
fn events_of_a_whole_skin_are_few_and_miss_no_touch_and_no_release() {
    let skin = skins::ur5_253();
    let idle = Scenario::idle(OBSERVATION_TIME);
    let [moving, hard] = [1.0, 15.0].map(|harder| moving(&skin, harder));
    let seconds = OBSERVATION_TIME.0 as f64 / 1e6;
    let count = |scenario, mode| {
        let (bench, since) = looked_at(&skin, scenario, mode);
        let frames = sensors_frames(&bench, since).len();
        (frames, bench, since)
    };
    let (continuous, mut bench, _) = count(&idle, AT_62_5_HZ);
    let rate = continuous as f64 / seconds / 253.0;
    // 62.5 of the skin and one of the acceleration.
    assert!((rate - 63.5).abs() < 0.1, "{rate}");
    bench.finish();
    accounts::check(&bench);
    let (at_rest, mut bench, _) = count(&idle, Sensing::Event);
    bench.finish();
    accounts::check(&bench);
    let (hit, mut bench, _) = count(&hard, Sensing::Event);
    bench.finish();
    accounts::check(&bench);
    let (in_contact, mut bench, since) = count(&moving, Sensing::Event);
    let share = |frames: usize| 100.0 * frames as f64 / (62.5 * 253.0 * seconds);
    println!("sensors frames of 253 cells in a second, and their part of 62.5 Hz:");
    let figures = [
        ("continuous", continuous),
        ("event, idle", at_rest),
        ("event, 100 in contact, 0.5 to 6 N", in_contact),
        ("event, 100 in contact, 7.5 to 90 N", hit),
    ];
    for (what, frames) in figures {
        println!("  {what:<36}{:>8.0}  {:>5.1} %", frames as f64 / seconds, share(frames));
    }
    assert!(share(at_rest) <= 16.0 && share(in_contact) <= 48.0 && share(hit) <= 48.0);

    // All 100 were in contact at the same time, and almost always.
    let (touches, releases) = every_turn_was_reported(&bench, since);
    println!("  {touches} touches and {releases} releases, each told before the next joints");
    assert!(touches > 5 * TOUCHED && releases > 4 * TOUCHED, "{touches} {releases}");
    let active: usize = bench.wire.iter().filter(|it| it.frame.id() >> 8 == Kind::Torque as u32).count();
    assert!(active as f64 > 0.85 * 100.0 * 62.5 * 7.0, "{active} torques: 100 cells are in contact");
    // The gateway counts the same changes from the frames that it receives.
    bench.finish();
    accounts::check(&bench);
    let sensed = || bench.gateway.table.cells().iter().map(|cell| cell.sensed);
    let total = [sensed().map(|it| it.touches).sum::<u64>(), sensed().map(|it| it.releases).sum()];
    assert!(total[0] >= touches as u64 && total[0] <= touches as u64 + 100, "{total:?} {touches}");
    assert!(total[1] >= releases as u64 && total[1] <= releases as u64 + 100, "{total:?} {releases}");
}

#[test]
fn cells_of_a_continuous_bus_do_not_send_at_once() {
    let skin = skins::ur5_253();
    let (bench, since) = looked_at(&skin, &Scenario::idle(OBSERVATION_TIME), AT_62_5_HZ);
    let frames = sensors_frames(&bench, since);
    let skins = frames.iter().filter(|(_, _, page)| matches!(page, SensorPage::Skin(_)));
    let mut busiest = BTreeMap::<u64, usize>::new();
    skins.for_each(|(at, ..)| *busiest.entry(at.0 / 1_000).or_default() += 1);
    // 253 in 16 ms are 15.8 in one.
    assert!(busiest.values().all(|&count| count <= 19), "{:?}", busiest.values().max());
}

#[test]
fn one_cell_is_switched_alone_and_all_at_once_while_the_bench_runs() {
    for format in [Format::Fd, Format::Classic] {
        let mut bench = Bench::new(&skins::arm(6, format), 3).started();
        let from = bench.now();
        bench.run_epochs(30);
        assert_eq!(sensors_frames(&bench, from), [], "off, as every cell at its start");
        let third = bench.skin.cells[2].node;
        bench.act(Act::Inject(to(Node::Cell(third), AT_62_5_HZ)));
        let from = bench.now();
        bench.run(Span::from_millis(1_000));
        let alone = sensors_frames(&bench, from);
        assert!(alone.iter().all(|&(_, cell, _)| cell == third));
        assert!((62..=67).contains(&alone.len()), "{}", alone.len());

        bench.act(Act::Inject(switch(Sensing::Event)));
        bench.run(Span::from_millis(20));
        let from = bench.now();
        bench.press(4, 2.0);
        bench.run_epochs(2);
        let fifth = bench.skin.cells[4].node;
        let events: Vec<_> = sensors_frames(&bench, from);
        let pressed = |it: &&(Micros, CellId, SensorPage)| matches!(it.2, SensorPage::Skin(skin) if contact_force(&skin) > 0);
        assert!(events.iter().filter(pressed).all(|&(_, cell, _)| cell == fifth), "{events:?}");
        assert!(events.iter().any(|it| pressed(&it)), "{events:?}");

        bench.act(Act::Inject(switch(Sensing::Off)));
        bench.run(Span::from_millis(20));
        let from = bench.now();
        bench.press(4, 0.0);
        bench.run_epochs(30);
        assert_eq!(sensors_frames(&bench, from), []);
        bench.finish();
        accounts::check(&bench);
    }
}

#[test]
fn a_heartbeat_makes_up_for_a_lost_event() {
    let mut bench = Bench::new(&skins::arm(4, Format::Fd), 5).started();
    bench.act(Act::SendFromGateway(switch(Sensing::Event)));
    bench.run(Span::from_millis(300));
    bench.fault(Fault::new(Harm::Lose, 1.0).at_receiver(Party::Gateway).of_kind(Kind::Sensors));
    bench.press(1, 3.0);
    bench.run_epochs(2);
    let touches = |bench: &Bench| bench.gateway.table.cells()[1].sensed.touches;
    assert_eq!(touches(&bench), 0, "the event is lost");
    bench.faults.clear();
    bench.run(Span::from_millis(260));
    assert_eq!(touches(&bench), 1);
    bench.finish();
    accounts::check(&bench);
}

#[test]
fn sensors_frames_do_not_change_the_expected_torques() {
    let course = |mode| {
        let mut bench = Bench::new(&skins::arm(4, Format::Fd), 11).started();
        bench.act(Act::SendFromGateway(switch(mode)));
        for epoch in 0..40 {
            bench.press(epoch % 4, 0.3 * (epoch % 7) as f64);
            bench.run_epochs(1);
        }
        bench.finish();
        accounts::check(&bench);
        let replies: Vec<_> = bench.gateway.table.cells().iter().map(|cell| cell.replies).collect();
        (replies, (0..4).map(|place| bench.torques(place)).collect::<Vec<_>>())
    };
    let silent = course(Sensing::Off);
    assert!(silent.0.iter().all(|replies| replies.due > 0 && replies.missing == 0), "{silent:?}");
    assert_eq!(silent, course(Sensing::Event));
    assert_eq!(silent, course(Sensing::Continuous { period_ms: 5 }));
}
