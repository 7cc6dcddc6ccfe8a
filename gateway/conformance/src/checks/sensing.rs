//! Checks of sensor values that a cell sends without a request: in event mode, in continuous mode, and at switches
//! between modes.

use protocol::fixed::{Q, Q1_14, Q3_12};
use protocol::id::Node;
use protocol::message::{Message, SensorPage, SensorReadings, SkinSensors, StimulusStart};
use protocol::packet::{Epoch, padded_words};
use protocol::parameters::{Events, MAX_JOINTS};
use protocol::time::Span;

use super::beats::format_ms;
use super::sensing_model::EventModel;
use crate::arm::{self, TestRandom};
use crate::bus::StopReason;
use crate::session::{CellPacket, Session};

const SENSING_PARAMETER: u8 = 7;
const EVENTS_PARAMETER: u8 = 8;
const EVENT_TEST_STEPS: usize = 160;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::fast_example_parameters(6))?;
    session.known.senses = true;
    session.write_parameter(EVENTS_PARAMETER, Events::default().words())?;
    let done = check_sensing_switches(session)
        .and_then(|()| check_torque_before_page(session))
        .and_then(|()| check_events(session, Events::default(), 3))
        .and_then(|()| check_events(session, smallest_event_thresholds(), 4))
        .and_then(|()| check_pages_after_beats(session))
        .and_then(|()| check_events_while_halted(session))
        .and_then(|()| check_continuous_pages(session));
    done?;
    session.write_first_words(SENSING_PARAMETER, [0])?;
    session.write_parameter(EVENTS_PARAMETER, Events::default().words())?;
    session.wait_for_late_packets()?;
    session.known.senses = false;
    session.receive_for(Span::from_millis(300))?;
    session.begin_exchange();
    Ok(())
}

/// Returns thresholds for which every change except that of proximity is an event, without hysteresis.
fn smallest_event_thresholds() -> Events {
    let [contact, proximity, temperature, acceleration, hysteresis] = [0, 700, 0, 0, 0];
    Events {
        contact: Q::from_bits(contact),
        proximity: Q::from_bits(proximity),
        temperature: Q::from_bits(temperature),
        acceleration: Q::from_bits(acceleration),
        hysteresis: Q::from_bits(hysteresis),
    }
}

/// Returns the numbers of the sensors pages among these packets.
fn sensor_page_numbers(heard: &[CellPacket]) -> Vec<u8> {
    heard.iter().filter_map(|it| Some(it.sensors()?.1.number())).collect()
}

fn format_pages(pages: &[u8]) -> String {
    if pages.is_empty() {
        return "none".to_owned();
    }
    pages.iter().map(ToString::to_string).collect::<Vec<_>>().join(" and ")
}

/// Writes parameter 7, and checks the pages that follow at once.
fn check_sensing_switch(
    session: &mut Session<'_>,
    mode: [i16; 2],
    expected: &[u8],
    what: &str,
) -> Result<(), StopReason> {
    session.wait_for_heartbeat_gap(Span::from_millis(60))?;
    session.begin_exchange();
    session.write_parameter(SENSING_PARAMETER, padded_words(mode))?;
    session.receive_for(Span::from_millis(8))?;
    let pages = sensor_page_numbers(session.answers());
    session.check("SENSE-4", pages == expected, || {
        format!(
            "after {what}, the sensors pages sent were {}, but {} were expected",
            format_pages(&pages),
            format_pages(expected)
        )
    });
    session.mark_packets_expected();
    Ok(())
}

fn check_sensing_switches(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.write_first_words(SENSING_PARAMETER, [0])?;
    session.wait_for_late_packets()?;
    check_sensing_switch(session, [2, 0], &[0, 1], "a switch to event mode")?;
    check_sensing_switch(session, [2, 0], &[], "a write of the same mode")?;
    check_sensing_switch(session, [1, 1_000], &[0, 1], "a switch to continuous mode")?;
    check_sensing_switch(session, [1, 1_000], &[], "a write of the same period")?;
    check_sensing_switch(session, [1, 1_001], &[0, 1], "a change of the period")?;
    check_sensing_switch(session, [0, 0], &[], "a switch to off")?;
    check_sensing_switch(session, [2, 0], &[0, 1], "a switch to event mode")
}

/// Checks that the torque of a touch is sent before its sensors page.
fn check_torque_before_page(session: &mut Session<'_>) -> Result<(), StopReason> {
    for sum in [4_096, 0] {
        session.wait_for_heartbeat_gap(Span::from_millis(60))?;
        session.send_stimulus(arm::press_with_sum(sum))?;
        let step = session.send_next_joints(&[0x0321; MAX_JOINTS])?;
        let kinds: Vec<_> = step.exchange.answers.iter().map(|it| it.message.id().kind.name()).collect();
        session.check("TIME-3", kinds == ["torque", "sensors"], || {
            let kinds = kinds.join(", ");
            format!(
                "in event mode, the cell must send a torque message and then a sensors page when a touch \
                 starts or ends, but it sent: {kinds}"
            )
        });
    }
    Ok(())
}

/// Checks random values around the thresholds: a page comes exactly when the model requires it.
fn check_events(session: &mut Session<'_>, events: Events, seed: u64) -> Result<(), StopReason> {
    let mut dice = TestRandom::new(seed);
    session.write_first_words(SENSING_PARAMETER, [0])?;
    session.write_parameter(EVENTS_PARAMETER, events.words())?;
    session.switch_test_mode(true)?;
    session.known.active = None;
    session.send_next_joints(&[0; MAX_JOINTS])?;
    session.known.active = Some(false);
    session.write_first_words(SENSING_PARAMETER, [2])?;
    session.receive_for(Span::from_millis(10))?;
    session.begin_exchange();
    let mut model = EventModel::new(events);
    for step in 0..session.reduced_attempts(EVENT_TEST_STEPS) {
        let (skin, acceleration) = match crafted_readings(&events).get(step) {
            Some(skin) => (*skin, None),
            None => random_readings(&mut dice, &events, &model, step),
        };
        if step == CRAFTED_READINGS - 1 {
            // Writing the same thresholds again changes nothing.
            session.write_parameter(EVENTS_PARAMETER, events.words())?;
        }
        session.send_stimulus(skin)?;
        if let Some(acceleration) = acceleration {
            let to = Node::Cell(session.cell);
            let page = SensorPage::Acceleration(acceleration);
            session.send_messages(&[Message::Stimulus { to, from: StimulusStart::Next, page }])?;
        }
        // Pages that came with a regular heartbeat count as sent, too.
        for heard in session.packets_since_exchange() {
            if let Some((_, page)) = heard.sensors() {
                model.mark_page_sent(page);
            }
        }
        let turned = model.state_text();
        let (expected, ids) = model.latch_values(skin, acceleration);
        let before = Epoch(session.known.last_epoch);
        let (from, skips) = (session.packets.len(), session.skips);
        let came = session.send_next_joints(&[0; MAX_JOINTS])?;
        let beats = session.answers().iter().filter(|it| it.heartbeat_and_epoch().is_some()).count();
        let sent: Vec<_> =
            came.exchange.answers.iter().filter_map(|it| it.sensors().map(|(_, page)| *page)).collect();
        let numbers = sensor_page_numbers(&came.exchange.answers);
        let all = session.packets.get(from..).unwrap_or_default().iter().filter_map(CellPacket::sensors);
        all.for_each(|(_, page)| model.mark_page_sent(page));
        // Skipped joints make no event, and a page with a heartbeat may replace the one that the next joints would have
        // sent.
        if beats == 1 && skips == session.skips {
            session.check(ids, numbers == expected, || {
                let moved = acceleration
                    .map_or_else(String::new, |it| arm::format_page(SensorPage::Acceleration(it)));
                format!(
                    "after {} {moved} was latched at step {} (state before: {turned}), the sensors pages \
                     sent were {}, but {} were expected",
                    arm::format_skin(Some(skin)),
                    step + 1,
                    format_pages(&numbers),
                    format_pages(&expected)
                )
            });
        }
        // Pages with a regular heartbeat may have come before the joints, or have crossed them on the bus.
        let after = came.exchange.answers.iter().filter(|it| it.at > came.exchange.at);
        let mut pages = after.filter_map(CellPacket::sensors).filter(|(epoch, _)| *epoch != before);
        let is_latched = pages.all(|(_, page)| model.equals_latched(page));
        session.check("SENSE-7", is_latched, || {
            let sent: Vec<_> = sent.iter().map(|page| arm::format_page(*page)).collect();
            format!(
                "sensors pages must contain the latched values, but the cell sent {}, which is not latched",
                sent.join("; ")
            )
        });
        if step % 40 == 39 {
            // The pages of a report count as sent, too.
            for page in session.request_report()?.iter().filter_map(CellPacket::sensors) {
                model.mark_page_sent(page.1);
            }
        }
    }
    session.stimulate_and_send_joints(&[0; MAX_JOINTS], arm::press_with_sum(0))?;
    session.send_next_joints(&[0; MAX_JOINTS])?;
    Ok(())
}

/// The number of crafted values, for cases that random values may miss.
const CRAFTED_READINGS: usize = 6;

/// Returns a touch whose sum exceeds a word, and one that fades. Each ends so softly that only the end of the contact
/// is an event.
fn crafted_readings(events: &Events) -> [SkinSensors; CRAFTED_READINGS] {
    let touch = events.contact.to_bits().max(1);
    let soft = (touch / 8).max(1);
    [[i16::MAX, i16::MAX, 0], [soft, 0, 0], [0; 3], [touch, 0, 0], [soft, 0, 0], [0; 3]]
        .map(|contact| SkinSensors { contact: contact.map(Q::from_bits), ..SkinSensors::default() })
}

/// Returns sensor values near the last sent ones, and near the thresholds.
fn random_readings(
    dice: &mut TestRandom,
    events: &Events,
    model: &EventModel,
    step: usize,
) -> (SkinSensors, Option<[Q3_12; 3]>) {
    let sent = model.sent_skin();
    let mut skin = sent;
    let near = |dice: &mut TestRandom, threshold: i16| {
        let steps =
            [0, 1, -1, threshold, threshold - 1, -threshold, 1 - threshold, threshold / 2, -threshold / 2];
        dice.choose(&steps)
    };
    match step % 5 {
        0 => skin.contact = [0, 0, 0].map(Q::from_bits),
        1 => {
            let [a, b, c] = skin.contact.map(Q::<10>::to_bits);
            skin.contact = [a.saturating_add(near(dice, events.contact.to_bits())), b, c].map(Q::from_bits);
        }
        2 => {
            let threshold = events.contact.to_bits();
            let sum = dice.choose(&[threshold, threshold - 1, threshold / 2, threshold / 2 - 1, 1, 0, -1]);
            skin.contact = [sum, 0, 0].map(Q::from_bits);
        }
        3 => {
            let threshold = events.proximity.to_bits();
            let steps = [0, threshold, threshold - 1, threshold / 2, threshold / 2 - 1, 1, threshold * 2];
            skin.proximity = Q1_14::from_bits(dice.choose(&steps));
        }
        _ => {
            let [a, b] = skin.temperature.map(Q::<6>::to_bits);
            skin.temperature =
                [a, b.saturating_add(near(dice, events.temperature.to_bits()))].map(Q::from_bits);
        }
    }
    let acceleration = step.is_multiple_of(3).then(|| {
        let [x, y, z] = model.sent_acceleration().map(Q::<12>::to_bits);
        [x, y.saturating_add(near(dice, events.acceleration.to_bits())), z].map(Q::from_bits)
    });
    (skin, acceleration)
}

/// Checks that in event mode page 0 follows each regular heartbeat, and page 1 every fourth one since the switch.
fn check_pages_after_beats(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.write_first_words(SENSING_PARAMETER, [0])?;
    session.wait_for_heartbeat_gap(Span::from_millis(60))?;
    session.begin_exchange();
    session.write_first_words(SENSING_PARAMETER, [2])?;
    session.receive_for(Span::from_millis(10))?;
    session.begin_expected_exchange();
    session.receive_for(Span::from_millis(2_050))?;
    let mut beats: Vec<Vec<u8>> = Vec::new();
    for heard in session.answers() {
        match (heard.heartbeat_and_epoch(), heard.sensors(), beats.last_mut()) {
            (Some(_), ..) => beats.push(Vec::new()),
            (None, Some((_, page)), Some(last)) => {
                last.push(page.number());
            }
            _ => {}
        }
    }
    session.mark_packets_expected();
    let all = SensorReadings::default().simulated_pages().map(|page| page.number());
    let is_so = beats.len() >= 7
        && beats.iter().enumerate().all(|(place, pages)| {
            let expected: &[u8] = if place % 4 == 3 { &all } else { &[0] };
            pages == expected
        });
    session.check("SENSE-10", is_so, || {
        let all: Vec<_> = beats.iter().map(|pages| format_pages(pages)).collect();
        let count = beats.len();
        format!(
            "in event mode, sensors page 0 must follow each heartbeat, and all pages must follow every fourth \
             heartbeat; {count} heartbeats were followed by these pages: {}",
            all.join(", ")
        )
    });
    // Other heartbeats are not followed by pages.
    session.wait_for_heartbeat_gap(Span::from_millis(60))?;
    let sync = session.exchange_messages(&[])?;
    session.check("SENSE-10", sync.is_silent(), || {
        "no sensors page may follow the heartbeat that answers a sync, but the cell sent one".to_owned()
    });
    Ok(())
}

fn check_events_while_halted(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.begin_exchange();
    session.send_messages(&[Message::Halt])?;
    (session.known.halted, session.known.active) = (Some(true), Some(false));
    session.wait_for_heartbeat_gap(Span::from_millis(60))?;
    for sum in [5_000, 0] {
        session.send_stimulus(arm::press_with_sum(sum))?;
        let step = session.send_next_joints(&[0; MAX_JOINTS])?;
        let pages = sensor_page_numbers(&step.exchange.answers);
        session.check("SENSE-11", pages == [0], || {
            let pages = format_pages(&pages);
            format!(
                "a halted cell in event mode must send sensors page 0 when a touch starts or ends, but it \
                 sent {pages}"
            )
        });
    }
    session.send_messages(&[Message::Resume])?;
    session.known.halted = Some(false);
    session.write_first_words(SENSING_PARAMETER, [0])?;
    session.wait_for_late_packets()
}

fn check_continuous_pages(session: &mut Session<'_>) -> Result<(), StopReason> {
    for period in [50, 120] {
        check_page_times(session, period, false)?;
    }
    // As short as the period of the joints: no page is early.
    check_page_times(session, 16, true)?;
    if session.about.committed {
        check_page_times(session, 40, true)?;
    }
    Ok(())
}

/// Checks that page 0 comes at the times `t + P + P n / 255 + i P`, with the switch at t, the period P, the node id n
/// and i = 0, 1, ... If joints come and P is longer than their period, a page may be earlier by up to that period.
fn check_page_times(session: &mut Session<'_>, period: u64, with_joints: bool) -> Result<(), StopReason> {
    const JOINTS_PERIOD_US: u64 = 16_000;
    const MAX_LATENESS_US: u64 = 20_000;
    const PAGE_TIME_SLACK_US: u64 = 2_000;
    let (id, early) = match with_joints {
        true if period * 1_000 > JOINTS_PERIOD_US => ("SENSE-6", JOINTS_PERIOD_US),
        true => ("SENSE-6", 0),
        false => ("SENSE-5", 0),
    };
    for attempt in 0..3 {
        session.write_first_words(SENSING_PARAMETER, [0])?;
        session.wait_for_late_packets()?;
        session.begin_exchange();
        let period_ms = i16::try_from(period).unwrap_or_default();
        session.write_first_words(SENSING_PARAMETER, [1, period_ms])?;
        let Some(began) = session.answers().first().map(|it| it.at) else { return Ok(()) };
        let span = Span::from_millis(12 * period);
        let mut due = began + Span(7_000);
        while with_joints && due < began + span {
            session.wait_for_packets(due, |_| false)?;
            let epoch = session.next_epoch();
            let joints = session.joints_message(epoch, &[0; MAX_JOINTS]);
            session.send_messages(&[joints])?;
            session.known.epoch = Some(epoch);
            due = due + Span(JOINTS_PERIOD_US);
        }
        session.wait_for_packets(began + span, |_| false)?;
        let late = session.bench_lateness();
        let all: Vec<_> = session.answers().iter().filter_map(|it| Some((it.at, *it.sensors()?.1))).collect();
        session.mark_packets_expected();
        let skin = all.iter().filter(|(_, page)| matches!(page, SensorPage::Skin(_))).skip(1);
        let times: Vec<_> = skin.map(|(at, _)| at.elapsed_since(began).0).collect();
        let first = period * 1_000 + period * 1_000 * u64::from(session.cell.get()) / 255;
        let is_in_time = |(place, at): (usize, &u64)| {
            let due = first + place as u64 * period * 1_000;
            let slack = PAGE_TIME_SLACK_US + at / 100;
            (due.saturating_sub(early + slack)..=due + MAX_LATENESS_US + slack).contains(at)
        };
        let is_so = (10..=12).contains(&times.len()) && times.iter().enumerate().all(is_in_time);
        if is_so || attempt == 2 || late.0 < 1_000 {
            session.check(id, is_so, || {
                let times = format_ms(times.iter().copied());
                format!(
                    "with a period of {period} ms{}, the cell must send sensors page 0 {} ms after the switch \
                     and then every {period} ms, but it sent it {times} ms after the switch",
                    if with_joints { " and a joints message every 16 ms" } else { "" },
                    first / 1_000
                )
            });
            return Ok(());
        }
    }
    Ok(())
}
