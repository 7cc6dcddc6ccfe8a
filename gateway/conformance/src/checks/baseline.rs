//! The zero of the force sensor: how the cell finds, tracks, holds and reports it.

use protocol::fixed::Q9_6;
use protocol::message::{BaselinePage, SensorPage, SkinSensors};
use protocol::packet::{WORDS, padded_words};
use protocol::parameters::MAX_JOINTS;
use protocol::time::Span;

use crate::arm;
use crate::bus::StopReason;
use crate::session::{CellPacket, JointsResult, Reply, Session};

const BASELINE_PARAMETER: u8 = 11;
const TARE_PARAMETER: u8 = 12;
/// The words of parameter 11 for a zero that is held: a touch begins at 0.1 N and ends at half of that, and the zero is
/// at most 0.5 N.
pub(super) const HELD_ZERO_RULE: [i16; WORDS] = [1, 102, 8_192, 0, ZERO_LIMIT, 0];
const ZERO_LIMIT: i16 = 512;
/// The words of parameter 11 for a zero that tracks the reading at the highest rate: by 1.07 steps of a contact word at
/// each joints message.
const TRACKING_ZERO_RULE: [i16; WORDS] = [2, 102, 8_192, -1, ZERO_LIMIT, 0];
/// The temperature slope of the zero: 0.02 N/°C.
const TEMPERATURE_SLOPE: i16 = 328;
/// The number of joints messages after which the first tare is done, with some margin.
const JOINTS_BEFORE_TARE: usize = 40;
/// A temperature of 25 °C, as a sensor word.
const TEMPERATURE_25_C: i16 = 25 << 6;
const TOUCH_SUM: i32 = 1_024;
const REFUSAL_REASON_TOUCHED: i16 = 20;
const REFUSAL_REASON_BEYOND_LIMIT: i16 = 21;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::fast_example_parameters(6))?;
    (session.known.senses, session.known.adapts) = (true, true);
    let done = check_rule_ranges(session)
        .and_then(|()| check_first_tare(session))
        .and_then(|()| check_zero_held(session))
        .and_then(|()| check_zero_tracking(session))
        .and_then(|()| check_temperature(session))
        .and_then(|()| check_tare_requests(session))
        .and_then(|()| check_baseline_pages(session));
    done?;
    session.write_first_words(BASELINE_PARAMETER, [0])?;
    session.wait_for_late_packets()?;
    (session.known.senses, session.known.adapts) = (false, false);
    session.prepare_cell(&arm::fast_example_parameters(6))?;
    Ok(())
}

fn skin_reading(sum: i32, temperature: i16) -> SkinSensors {
    SkinSensors { temperature: [Q9_6::from_bits(temperature); 2], ..arm::press_with_sum(sum) }
}

/// Sends joints messages with this sum of contact words and this temperature, and returns the result of the last one.
fn send_reading(
    session: &mut Session<'_>,
    sum: i32,
    temperature: i16,
    joints: usize,
) -> Result<JointsResult, StopReason> {
    session.send_stimulus(skin_reading(sum, temperature))?;
    let mut step = session.send_next_joints(&[0x0321; MAX_JOINTS])?;
    for _ in 1..joints {
        step = session.send_next_joints(&[0x0321; MAX_JOINTS])?;
    }
    Ok(step)
}

/// Requests a report, and returns the sum of the contact words, the zero (page 3) and page 0.
fn request_baseline(
    session: &mut Session<'_>,
) -> Result<Option<(i32, BaselinePage, SkinSensors)>, StopReason> {
    session.wait_for_heartbeat_gap(Span::from_millis(30))?;
    let pages = session.request_report()?;
    let pages: Vec<_> = pages.iter().filter_map(CellPacket::sensors).map(|(_, page)| *page).collect();
    let skin =
        pages.iter().find_map(|page| if let SensorPage::Skin(skin) = page { Some(*skin) } else { None });
    let zero = pages.iter().find_map(baseline_page);
    session.check("BASE-7", zero.is_some(), || {
        "the cell must answer a report with sensors page 3, but it did not send that page".to_owned()
    });
    let sum = |skin: SkinSensors| skin.contact.iter().map(|word| i32::from(word.to_bits())).sum();
    Ok(skin.zip(zero).map(|(skin, zero)| (sum(skin), zero, skin)))
}

const fn baseline_page(page: &SensorPage) -> Option<BaselinePage> {
    if let SensorPage::Baseline(page) = page { Some(*page) } else { None }
}

/// Writes parameter 11 with words other than the present ones, so that the cell searches for its zero again.
fn write_rule(session: &mut Session<'_>, rule: [i16; WORDS]) -> Result<(), StopReason> {
    let reply = session.write_parameter(BASELINE_PARAMETER, rule)?;
    session.check("BASE-1", reply == Reply::Value(rule), || {
        format!(
            "a write of {} to parameter 11 must be accepted, but the answer was {reply}",
            Reply::Value(rule)
        )
    });
    Ok(())
}

/// Writes parameter 11, and sends joints with this sum of contact words until the first tare is done.
fn write_rule_and_tare(session: &mut Session<'_>, rule: [i16; WORDS], sum: i32) -> Result<(), StopReason> {
    write_rule(session, rule)?;
    send_reading(session, sum, TEMPERATURE_25_C, JOINTS_BEFORE_TARE)?;
    Ok(())
}

fn is_near(value: i32, expected: i32, by: i32) -> bool {
    (value - expected).abs() <= by
}

fn check_rule_ranges(session: &mut Session<'_>) -> Result<(), StopReason> {
    let bad = [
        [3, 102, 8_192, 2_000, 512, 0],
        [-1, 102, 8_192, 2_000, 512, 0],
        [2, 0, 8_192, 2_000, 512, 0],
        [1, -1, 8_192, 2_000, 512, 0],
        [2, 102, -1, 2_000, 512, 0],
        [2, 102, 16_385, 2_000, 512, 0],
        [2, 102, 8_192, 0, 512, 0],
        [1, 102, 8_192, 0, -1, 0],
    ];
    write_rule(session, [0; WORDS])?;
    let cases = bad.map(|words| (BASELINE_PARAMETER, words)).into_iter();
    for (number, bad) in cases.chain([3, -1, 1, 2].map(|word| (TARE_PARAMETER, padded_words([word])))) {
        let reply = session.write_parameter(number, bad)?;
        session.check("BASE-1", reply == Reply::Refused(19), || {
            format!(
                "while the baseline is off, the cell must refuse a write of {} to parameter {number} with \
                 reason 19 (invalid value), but the answer was {reply}",
                Reply::Value(bad)
            )
        });
    }
    for (written, expected) in
        [([0, 9, 9, 9, 9, 9], [0; WORDS]), ([1, 102, 8_192, 77, ZERO_LIMIT, 0], HELD_ZERO_RULE)]
    {
        let reply = session.write_parameter(BASELINE_PARAMETER, written)?;
        session.check("CONF-3", reply == Reply::Value(expected), || {
            format!(
                "a write of {} to parameter 11 must be answered with 0 in the unused words, but the answer \
                 was {reply}",
                Reply::Value(written)
            )
        });
    }
    write_rule(session, [0; WORDS])?;
    let step = send_reading(session, 307, TEMPERATURE_25_C, 1)?;
    session.check("BASE-1", step.torque.is_some(), || {
        "while the baseline is off, a force of 0.3 N must cause a torque message, but the cell sent none"
            .to_owned()
    });
    send_reading(session, 0, TEMPERATURE_25_C, 2)?;
    Ok(())
}

fn check_first_tare(session: &mut Session<'_>) -> Result<(), StopReason> {
    write_rule(session, HELD_ZERO_RULE)?;
    let first = send_reading(session, 307, TEMPERATURE_25_C, 1)?;
    session.check("BASE-2", first.torque.is_none_or(|torque| torque.is_zero()), || {
        "a force of 0.3 N before the first tare is within the limit of 0.5 N and must not cause a torque \
         message, but the cell sent one"
            .to_owned()
    });
    send_reading(session, 307, TEMPERATURE_25_C, JOINTS_BEFORE_TARE)?;
    if let Some((sum, zero, _)) = request_baseline(session)? {
        let is_so = zero.tared && is_near(zero.zero.to_bits().into(), 307, 1) && is_near(sum, 0, 1);
        session.check("BASE-2", is_so, || {
            format!(
                "after {JOINTS_BEFORE_TARE} joints messages at 0.3 N, sensors page 3 must report a tared \
                 zero of 307 steps and the contact words of page 0 must add up to 0, but page 3 is {} and \
                 the sum is {sum}",
                format_baseline(zero)
            )
        });
    }
    let raw = skin_reading(307 + TOUCH_SUM, TEMPERATURE_25_C);
    let step = send_reading(session, 307 + TOUCH_SUM, TEMPERATURE_25_C, 1)?;
    session.check("BASE-8", step.torque.is_some(), || {
        "a force of 1 N above the zero must cause a torque message, but the cell sent none".to_owned()
    });
    if let Some((_, zero, skin)) = request_baseline(session)? {
        let zero = i32::from(zero.zero.to_bits());
        let third = (zero * 21_845) >> 16;
        let expected: Vec<_> = raw
            .contact
            .iter()
            .zip([third, third, zero - 2 * third])
            .map(|(word, part)| i32::from(word.to_bits()) - part)
            .collect();
        let got: Vec<_> = skin.contact.iter().map(|word| i32::from(word.to_bits())).collect();
        session.check("BASE-8", got == expected, || {
            format!(
                "with a zero of {zero} steps, the contact words of sensors page 0 must be {expected:?}, but \
                 they are {got:?}"
            )
        });
    }
    // A reading beyond the limit is a touch from the start.
    write_rule(session, HELD_ZERO_RULE)?;
    let step = send_reading(session, 700, TEMPERATURE_25_C, JOINTS_BEFORE_TARE)?;
    session.check("BASE-2", step.torque.is_some(), || {
        "a force of 0.68 N from the start is beyond the limit of 0.5 N and must cause a torque message, but \
         the cell sent none"
            .to_owned()
    });
    if let Some((sum, zero, _)) = request_baseline(session)? {
        session.check("BASE-2", !zero.tared && sum == 700, || {
            format!(
                "a force of 0.68 N from the start must not be tared, and the contact words of sensors page 0 \
                 must add up to 700, but page 3 is {} and the sum is {sum}",
                format_baseline(zero)
            )
        });
    }
    Ok(())
}

fn format_baseline(zero: BaselinePage) -> String {
    arm::format_page(SensorPage::Baseline(zero))
}

fn check_zero_held(session: &mut Session<'_>) -> Result<(), StopReason> {
    write_rule_and_tare(session, TRACKING_ZERO_RULE, 0)?;
    for joints in [1, 60] {
        send_reading(session, TOUCH_SUM, TEMPERATURE_25_C, joints)?;
        if let Some((sum, zero, _)) = request_baseline(session)? {
            session.check(
                "BASE-3",
                is_near(sum, TOUCH_SUM, 1) && is_near(zero.zero.to_bits().into(), 0, 1),
                || {
                    format!(
                        "after {joints} joints messages at 1 N, the zero must be 0 and the contact words of \
                     sensors page 0 must add up to {TOUCH_SUM}, but page 3 is {} and the sum is {sum}",
                        format_baseline(zero)
                    )
                },
            );
        }
    }
    send_reading(session, 0, TEMPERATURE_25_C, 2)?;
    Ok(())
}

fn check_zero_tracking(session: &mut Session<'_>) -> Result<(), StopReason> {
    const JOINTS_MESSAGES: usize = 30;
    for (rate, min, max) in [(-1, 15, 34), (1_000, -1, 2)] {
        let mut rule = TRACKING_ZERO_RULE;
        rule.iter_mut().skip(3).take(1).for_each(|word| *word = rate);
        write_rule_and_tare(session, rule, 0)?;
        let skips = session.skips;
        send_reading(session, 80, TEMPERATURE_25_C, JOINTS_MESSAGES)?;
        let Some((_, zero, _)) = request_baseline(session)? else { continue };
        let steps = i32::from(zero.zero.to_bits());
        let is_so = (min..=max).contains(&steps) || skips != session.skips;
        session.check("BASE-4", is_so, || {
            format!(
                "after {JOINTS_MESSAGES} joints messages with a reading of 80 steps and a rate of {} uN/s, \
                 the zero must be {min} to {max} steps, but it is {steps}",
                rate.cast_unsigned()
            )
        });
    }
    Ok(())
}

fn check_temperature(session: &mut Session<'_>) -> Result<(), StopReason> {
    let mut rule = HELD_ZERO_RULE;
    rule.iter_mut().skip(5).take(1).for_each(|word| *word = TEMPERATURE_SLOPE);
    write_rule_and_tare(session, rule, 0)?;
    // 5 °C more, in contact, shift the zero by 0.1 N; 5 °C less shift it back.
    for (degrees, expected) in [(5, 102), (-5, -102)] {
        send_reading(session, TOUCH_SUM, TEMPERATURE_25_C + (degrees << 6), 1)?;
        if let Some((sum, zero, _)) = request_baseline(session)? {
            session.check("BASE-5", is_near(sum, TOUCH_SUM - expected, 2), || {
                format!(
                    "after a temperature change of {degrees} °C with a slope of 0.02 N/°C, sensors page 3 is \
                     {} and the contact words of page 0 add up to {sum}, but they must add up to {}",
                    format_baseline(zero),
                    TOUCH_SUM - expected
                )
            });
        }
    }
    send_reading(session, 0, TEMPERATURE_25_C, 2)?;
    Ok(())
}

fn check_tare_requests(session: &mut Session<'_>) -> Result<(), StopReason> {
    write_rule_and_tare(session, HELD_ZERO_RULE, 0)?;
    let tare = |session: &mut Session<'_>, word: i16, expected: Reply, what: &str| {
        let reply = session.write_first_words(TARE_PARAMETER, [word])?;
        session.check("BASE-6", reply == expected, || {
            format!("a write of {word} to parameter 12 ({what}) must be answered with {expected}, but the answer was {reply}")
        });
        Ok::<_, StopReason>(())
    };
    let zero_is = |session: &mut Session<'_>, expected: i32, refused: Option<u16>, what: &str| {
        if let Some((_, zero, _)) = request_baseline(session)? {
            let is_counted = refused.is_none_or(|refused| zero.refused == refused);
            let is_so = is_near(zero.zero.to_bits().into(), expected, 2) && is_counted;
            session.check("BASE-6", is_so, || {
                format!(
                    "{what}, sensors page 3 must report a zero offset of {expected} steps and the number of refused tares, but \
                     it reports {}",
                    format_baseline(zero)
                )
            });
        }
        Ok::<_, StopReason>(())
    };
    send_reading(session, 300, TEMPERATURE_25_C, 40)?;
    let before = request_baseline(session)?.map(|(_, zero, _)| zero.refused.wrapping_add(1));
    tare(session, 1, Reply::Refused(REFUSAL_REASON_TOUCHED), "tare of a cell that is touched with 0.3 N")?;
    zero_is(session, 0, before, "after a refused tare")?;
    tare(session, 2, Reply::Value(padded_words([1])), "forced tare of a touched cell")?;
    zero_is(session, 300, None, "after a forced tare at 0.3 N")?;
    send_reading(session, 250, TEMPERATURE_25_C, 40)?;
    tare(session, 1, Reply::Value(padded_words([1])), "tare of a cell that is not touched")?;
    zero_is(session, 250, None, "after a tare at 0.24 N")?;
    send_reading(session, 800, TEMPERATURE_25_C, 40)?;
    tare(session, 2, Reply::Refused(REFUSAL_REASON_BEYOND_LIMIT), "forced tare beyond the limit of 0.5 N")?;
    zero_is(session, 250, None, "after a tare beyond the limit")?;
    tare(session, 0, Reply::Value([0; WORDS]), "discard the zero")?;
    let reply = session.read_parameter(TARE_PARAMETER)?;
    session.check("BASE-6", reply == Reply::Value([0; WORDS]), || {
        format!("after the zero is discarded, parameter 12 must read as 0, but it reads as {reply}")
    });
    Ok(())
}

fn check_baseline_pages(session: &mut Session<'_>) -> Result<(), StopReason> {
    write_rule_and_tare(session, HELD_ZERO_RULE, 0)?;
    for (sum, touched) in [(TOUCH_SUM, true), (0, false)] {
        session.wait_for_heartbeat_gap(Span::from_millis(60))?;
        let step = send_reading(session, sum, TEMPERATURE_25_C, 1)?;
        let mut pages = step.exchange.answers.iter().filter_map(CellPacket::sensors);
        let came = pages.find_map(|(_, page)| baseline_page(page));
        session.check("BASE-7", came.is_some_and(|page| page.touched == touched), || {
            let came = came.map_or_else(|| "none".to_owned(), format_baseline);
            format!(
                "when a touch starts or ends, the cell must send sensors page 3 with the new touch state, \
                 but it sent {came}"
            )
        });
    }
    session.wait_for_heartbeat_gap(Span::from_millis(60))?;
    session.begin_exchange();
    session.begin_expected_exchange();
    session.receive_for(Span::from_millis(2_050))?;
    let beats = session.answers().iter().filter(|it| it.heartbeat_and_epoch().is_some()).count();
    let pages = session.answers().iter().filter_map(CellPacket::sensors);
    let count = pages.filter(|(_, page)| baseline_page(page).is_some()).count();
    session.mark_packets_expected();
    session.check("BASE-7", count >= beats / 4 && count <= beats / 4 + 1, || {
        format!(
            "the cell must send sensors page 3 with every fourth heartbeat, but it sent the page {count} \
             times in {beats} heartbeats"
        )
    });
    Ok(())
}
