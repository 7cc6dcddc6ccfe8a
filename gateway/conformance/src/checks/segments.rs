//! Checks of reassembly on a classic bus, row by row of the protocol's table.

use protocol::can::{Format, Frame, FrameError};
use protocol::id::Node;
use protocol::message::{Message, Request, SensorPage, StimulusStart};
use protocol::parameters::MAX_JOINTS;
use protocol::time::{Micros, Span};

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;

/// The two segments of a packet.
type SegmentPair = [Frame; 2];

/// A step of a series: a segment, or a pause in ms.
#[derive(Clone, Copy, Debug)]
enum SeriesStep {
    Send(Frame),
    Wait(u64),
}

use SeriesStep::{Send, Wait};

/// A series of segments, and the expected result.
struct SegmentSeries {
    what: &'static str,
    acts: Vec<SeriesStep>,
    /// The expected number of answers.
    packets: usize,
    incomplete: u16,
}

fn two_segments(session: &Session<'_>, message: &Message) -> SegmentPair {
    let mut frames = session.frames(message).into_iter();
    core::array::from_fn(|_| frames.next().unwrap_or(Frame::EMPTY))
}

fn read_segments(session: &Session<'_>, number: u8, tag: u8) -> SegmentPair {
    let to = Node::Cell(session.cell);
    two_segments(session, &Message::Configure { to, tag, request: Request::Read { number } })
}

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(6))?;
    for series in segment_series(session) {
        run_series(session, &series)?;
    }
    check_seven_segments(session)?;
    if session.about.test_mode && session.about.committed {
        check_joints_segments(session)?;
        if session.about.abilities.max_joints() > 6 {
            check_three_segments(session)?;
        }
    }
    Ok(())
}

/// Checks joints of three segments: each comes in time after the one before, but the first is too old for the last.
fn check_three_segments(session: &mut Session<'_>) -> Result<(), StopReason> {
    let mut dice = arm::TestRandom::new(7);
    let parameters =
        arm::random_parameters(&mut dice, arm::ChainShape { joints: 8, rows: 8, prismatic: false });
    if session.about.abilities.first_missing(&parameters).is_some() || !session.prepare_cell(&parameters)? {
        return Ok(());
    }
    session.stimulate_and_send_joints(&[0x0111; MAX_JOINTS], arm::press_with_sum(4_096))?;
    let epoch = session.next_epoch();
    let frames = session.frames(&session.joints_message(epoch, &[0x0111; MAX_JOINTS]));
    session.begin_exchange();
    for frame in frames {
        session.send(&[frame])?;
        session.receive_for(Span::from_millis(9))?;
    }
    session.receive_for(Span::from_millis(10))?;
    session.mark_packets_expected();
    let came = session.answers().iter().any(|it| it.torque().is_some());
    session.check("COUNT-3", !came, || {
        "if the three segments of a joints message are 9 ms apart, the first is too old when the last arrives, \
         and the cell must not answer, but it did"
            .to_owned()
    });
    session.send_next_joints(&[0x0111; MAX_JOINTS])?;
    session.forget_counters();
    session.prepare_cell(&arm::example_parameters(6))?;
    Ok(())
}

fn segment_series(session: &Session<'_>) -> Vec<SegmentSeries> {
    let [a1, a2] = read_segments(session, 0, 0x11);
    let [b1, b2] = read_segments(session, 2, 0x22);
    let stimulus = Message::Stimulus {
        to: Node::Cell(session.cell),
        from: StimulusStart::Next,
        page: SensorPage::Skin(arm::press_with_sum(0)),
    };
    let [s1, s2] = two_segments(session, &stimulus);
    let [e1, e2] = two_segments(
        session,
        &Message::Configure { to: Node::Everyone, tag: 0x33, request: Request::Read { number: 3 } },
    );
    let bad = with_flipped_bit(&a2);
    let of =
        |what, acts: Vec<SeriesStep>, packets, incomplete| SegmentSeries { what, acts, packets, incomplete };
    vec![
        of("the two segments of a packet", vec![Send(a1), Send(a2)], 1, 0),
        of(
            "segments in the wrong order, then the second one again",
            vec![Send(a2), Send(a1), Send(a2)],
            1,
            1,
        ),
        of(
            "a packet without its second segment, then a complete packet",
            vec![Send(a1), Send(b1), Send(b2)],
            1,
            1,
        ),
        of(
            "a packet without its first segment, then a complete packet",
            vec![Send(a2), Send(b1), Send(b2)],
            1,
            1,
        ),
        of("a first segment twice", vec![Send(a1), Send(a1), Send(a2)], 1, 1),
        of(
            "a second segment twice, then a packet",
            vec![Send(a1), Send(a2), Send(a2), Send(b1), Send(b2)],
            2,
            1,
        ),
        of("a wrong CRC, then a packet", vec![Send(a1), Send(bad), Send(b1), Send(b2)], 1, 1),
        of(
            "interleaved segments of several identifiers",
            vec![Send(a1), Send(s1), Send(e1), Send(a2), Send(e2), Send(s2)],
            2,
            0,
        ),
        of("60 ms between the segments of a request", vec![Send(a1), Wait(60), Send(a2)], 1, 0),
        of(
            "150 ms between the segments of a request, then another",
            vec![Send(a1), Wait(150), Send(a2), Send(b1), Send(b2)],
            1,
            1,
        ),
        of(
            "a lost segment, then another packet 150 ms later",
            vec![Send(a1), Wait(150), Send(b1), Send(b2)],
            1,
            1,
        ),
    ]
}

fn with_flipped_bit(frame: &Frame) -> Frame {
    let mut bytes: Vec<u8> = frame.data().to_vec();
    bytes.iter_mut().take(1).for_each(|byte| *byte ^= 0x10);
    Frame::classic(frame.raw_id(), &bytes).unwrap_or(*frame)
}

/// Checks a series, and repeats it up to three times if the bench was late.
fn run_series(session: &mut Session<'_>, series: &SegmentSeries) -> Result<(), StopReason> {
    for _ in 0..3 {
        let before = session.counters()?.refused;
        session.begin_exchange();
        let mut last: Option<Micros> = None;
        let mut in_time = true;
        let mut pause = 0;
        for act in &series.acts {
            match act {
                Wait(ms) => {
                    session.receive_for(Span::from_millis(*ms))?;
                    pause = *ms;
                }
                Send(frame) => {
                    let at = session.send(&[*frame])?;
                    if let Some(last) = last {
                        let late = at.elapsed_since(last).0.saturating_sub(pause * 1_000);
                        in_time &= late < 30_000;
                    }
                    (last, pause) = (Some(at), 0);
                }
            }
        }
        session.receive_for(Span::from_millis(30))?;
        let answers = session.answers().iter().filter(|heard| heard.heartbeat_and_epoch().is_none()).count();
        session.mark_packets_expected();
        // The next packet under this identifier counts the remaining segments.
        session.read_parameter(1)?;
        let after = session.counters()?.refused;
        if !in_time {
            continue;
        }
        let counted = after.incomplete.wrapping_sub(before.incomplete);
        let expected = (series.packets, series.incomplete);
        let others =
            after.length == before.length && after.meaning == before.meaning && after.crc == before.crc;
        session.check("COUNT-3", (answers, counted) == expected && others, || {
            format!(
                "when it receives {}, the cell must answer {} packets and count {} as incomplete; it answered \
                 {answers} and counted {counted}",
                series.what, series.packets, series.incomplete
            )
        });
        return Ok(());
    }
    session.findings.mark_not_tested("COUNT-3", "this computer was late in every attempt");
    Ok(())
}

/// Checks the document's example: seven segments, no two of which form a packet, and a packet.
fn check_seven_segments(session: &mut Session<'_>) -> Result<(), StopReason> {
    let firsts: Vec<_> = (0..7)
        .map(|index| {
            let to = Node::Cell(session.cell);
            let request = Request::Write { number: 2, words: [index; 6] };
            let [first, _] = two_segments(session, &Message::Configure { to, tag: 1, request });
            Send(first)
        })
        .collect();
    let [a1, a2] = read_segments(session, 0, 0x44);
    let acts = firsts.into_iter().chain([Send(a1), Send(a2)]).collect();
    run_series(
        session,
        &SegmentSeries {
            what: "seven segments that form no packet, then a packet",
            acts,
            packets: 1,
            incomplete: 4,
        },
    )?;
    // A frame of a wrong length or format between two segments does not affect them.
    let [b1, b2] = read_segments(session, 2, 0x55);
    let short = Frame::classic(a1.raw_id(), &[1, 2, 3, 4, 5, 6, 7]);
    check_interleaved_frame(session, "a frame of 7 bytes", [b1, b2], short)?;
    if session.supports_format(Format::Fd) {
        check_interleaved_frame(session, "an FD frame", [b1, b2], Frame::fd(a1.raw_id(), 0, &[0; 16]))?;
    }
    Ok(())
}

/// Checks a frame between two segments of a packet.
fn check_interleaved_frame(
    session: &mut Session<'_>,
    what: &str,
    [first, last]: SegmentPair,
    other: Result<Frame, FrameError>,
) -> Result<(), StopReason> {
    let Ok(other) = other else { return Ok(()) };
    let before = session.counters()?;
    let exchange = session.exchange_frames(&[first, other, last])?;
    let after = session.counters()?;
    // The cell's controller may drop the other format.
    let counted = after.refused.length.wrapping_sub(before.refused.length);
    let is_counted = counted == 1 || counted == 0 && other.format() == Format::Fd;
    let is_so =
        exchange.answers.len() == 1 && is_counted && after.refused.incomplete == before.refused.incomplete;
    session.check("COUNT-3", is_so, || {
        format!(
            "{what} between two segments must not disturb the read: the cell must send one answer, but it \
             sent {}; the counters are {after}; before: {before}",
            exchange.answers.len()
        )
    });
    Ok(())
}

/// Checks that segments of joints wait for 15 ms.
fn check_joints_segments(session: &mut Session<'_>) -> Result<(), StopReason> {
    let positions = [0x0111; MAX_JOINTS];
    session.stimulate_and_send_joints(&positions, arm::press_with_sum(4_096))?;
    for (ms, arrives) in [(5, true), (13, true), (40, false)] {
        for _ in 0..3 {
            let before = session.counters()?;
            let epoch = session.next_epoch();
            let [first, second] = two_segments(session, &session.joints_message(epoch, &positions));
            session.begin_exchange();
            let began = session.send(&[first])?;
            session.receive_for(Span::from_millis(ms))?;
            let ended = session.send(&[second])?;
            session.receive_for(Span::from_millis(10))?;
            session.mark_packets_expected();
            let came = session.answers().iter().any(|heard| heard.torque().is_some());
            let apart = ended.elapsed_since(began);
            if arrives {
                session.known.epoch = Some(epoch);
            }
            // A waiting segment is counted with the next ones.
            let next = session.next_epoch();
            let step = session.send_joints_at_epoch(next, &positions)?;
            let after = session.counters()?;
            // In time for 15 ms; a late computer may exceed that.
            if arrives && apart > Span(14_700) {
                continue;
            }
            let counted = after.refused.incomplete.wrapping_sub(before.refused.incomplete);
            let is_so = came == arrives && counted == u16::from(!arrives) && step.torque.is_some();
            session.check("COUNT-3", is_so, || {
                format!(
                    "a cell must wait 15 ms for the next segment of a joints message, but segments {} us apart \
                     were {}answered, and {counted} packets were counted as incomplete",
                    apart.0,
                    if came { "" } else { "not " }
                )
            });
            break;
        }
    }
    Ok(())
}
