use super::*;
use proptest::prelude::*;
use protocol::can::ERROR;

const NOW: Duration = Duration::from_secs(1);

fn frame(number: u8) -> Frame {
    Frame::classic(0x123, &[number]).unwrap()
}

/// Returns an opening that may be written at once.
fn opening(text: &[u8]) -> Vec<OpeningStep> {
    vec![OpeningStep { bytes: text.to_vec(), gap: Duration::ZERO, stage: OpeningStage::Open }]
}

/// Writes as much as may be written at the time `now`. Returns the written bytes.
fn drain(outgoing: &mut BusToLineQueue, now: Duration) -> Vec<u8> {
    let mut all = Vec::new();
    loop {
        let (bytes, _) = outgoing.ready_bytes(now);
        if bytes.is_empty() {
            return all;
        }
        let count = bytes.len();
        all.extend_from_slice(bytes);
        outgoing.remove_written(count);
    }
}

#[test]
fn frames_follow_the_opening_in_order() {
    let mut outgoing = BusToLineQueue::new(false, LinePace::default());
    outgoing.push_frame(&frame(0));
    outgoing.handle_line_opened(&opening(b"\rC\rO\r"));
    outgoing.push_frame(&frame(1));
    outgoing.push_frame(&Frame::fd(1, 1, &[2]).unwrap());
    outgoing.push_frame(&Frame::classic(ERROR | 4, &[0; 8]).unwrap());
    assert_eq!(drain(&mut outgoing, NOW), b"\rC\rO\rt123101\rb001102\r");
    let BusToLineCounts { received, sent, dropped, .. } = outgoing.account;
    assert_eq!((received, sent, dropped.line_away, dropped.error_frame), (4, 2, 1, 1));
    assert_eq!(dropped.total(), 2);
}

#[test]
fn the_commands_of_an_opening_leave_one_by_one() {
    let options: LineOptions = "/dev/x,rates=1M/5M".parse().unwrap();
    let mut outgoing = BusToLineQueue::from_options(&options);
    outgoing.handle_line_opened(&options.opening_steps());
    outgoing.push_frame(&frame(1));
    let (mut now, mut written) = (NOW, Vec::new());
    loop {
        let text = drain(&mut outgoing, now);
        if !text.is_empty() {
            written.push((text, now - NOW, outgoing.opening_stage()));
        }
        let Some(again) = outgoing.ready_bytes(now).1 else { break };
        now = again;
    }
    let millis = |at: u64| Duration::from_millis(at);
    let expected = [
        (b"\r".to_vec(), millis(0), OpeningStage::Away),
        (b"C\r".to_vec(), millis(10), OpeningStage::Closed),
        (b"S8\r".to_vec(), millis(40), OpeningStage::Setting),
        (b"Y5\r".to_vec(), millis(50), OpeningStage::Setting),
        (b"O\r".to_vec(), millis(60), OpeningStage::Open),
        (b"t123101\r".to_vec(), millis(70), OpeningStage::Open),
    ];
    let at = |(text, at, stage): (Vec<u8>, Duration, OpeningStage)| (text, at.as_millis() / 10, stage);
    assert_eq!(written.into_iter().map(at).collect::<Vec<_>>(), expected.map(at));
}

#[test]
fn before_the_first_frame_a_refusal_is_of_a_setting_if_there_is_one() {
    for (line, expected) in [("/dev/x,rates=1M/5M", OpeningStage::Setting), ("/dev/x", OpeningStage::Open)] {
        let options: LineOptions = line.parse().unwrap();
        let mut outgoing = BusToLineQueue::from_options(&options);
        outgoing.handle_line_opened(&options.opening_steps());
        let mut now = NOW;
        // Also after a frame, when the adapter is opened again.
        for _ in 0..2 {
            while outgoing.opening_stage() != OpeningStage::Open {
                now += Duration::from_millis(10);
                drain(&mut outgoing, now);
            }
            assert_eq!(outgoing.refused_stage(), expected, "{line}");
            outgoing.push_frame(&frame(1));
            now += Duration::from_secs(1);
            drain(&mut outgoing, now);
            assert_eq!(outgoing.refused_stage(), OpeningStage::Open, "{line}");
            outgoing.queue_reopening(&options.opening_steps());
        }
    }
}

#[test]
fn frames_switch_to_no_bit_rate_that_equals_the_nominal_one() {
    let frames = [Frame::fd(0x123, 1, &[2]).unwrap(), Frame::fd(0x123, 0, &[2]).unwrap(), frame(3)];
    for (rates, expected) in [
        ("", "b123102\rd123102\rt123103\r"),
        (",rates=1M/2M", "b123102\rd123102\rt123103\r"),
        (",rates=1M/1M", "d123102\rd123102\rt123103\r"),
        (",rates=250k", "d123102\rd123102\rt123103\r"),
    ] {
        let mut outgoing = BusToLineQueue::from_options(&format!("/dev/x{rates}").parse().unwrap());
        for _ in 0..2 {
            outgoing.handle_line_opened(&[]);
            frames.iter().for_each(|frame| outgoing.push_frame(frame));
            assert_eq!(drain(&mut outgoing, NOW), expected.as_bytes(), "{rates}");
        }
    }
}

#[test]
fn a_frame_that_the_adapter_refused_was_not_sent() {
    let mut outgoing = BusToLineQueue::new(false, LinePace::default());
    outgoing.handle_line_opened(&opening(b"O\r"));
    (0..5).for_each(|number| outgoing.push_frame(&frame(number)));
    drain(&mut outgoing, NOW);
    outgoing.count_refused(2);
    assert_eq!((outgoing.account.sent, outgoing.account.dropped.refused), (3, 2));
    // A frame that is being written is completed before the adapter is opened again. The queued frames follow.
    (5..7).for_each(|number| outgoing.push_frame(&frame(number)));
    outgoing.ready_bytes(NOW);
    outgoing.remove_written(3);
    outgoing.queue_reopening(&opening(b"C\rO\r"));
    assert_eq!(outgoing.opening_stage(), OpeningStage::Away);
    assert_eq!(drain(&mut outgoing, NOW + MAX_WRITE_AHEAD), b"3105\rC\rO\rt123106\r");
    assert_eq!(outgoing.opening_stage(), OpeningStage::Open);
    // If more lines are refused than frames were sent since the opening, the others were commands.
    outgoing.count_refused(9);
    let BusToLineCounts { received, sent, dropped, .. } = outgoing.account;
    assert_eq!((received, sent, dropped.refused, dropped.total()), (7, 4, 3, 3));
}

#[test]
fn a_classic_line_gets_no_fd_frames() {
    let mut outgoing = BusToLineQueue::new(true, LinePace::default());
    outgoing.handle_line_opened(&[]);
    outgoing.push_frame(&Frame::fd(1, 1, &[2]).unwrap());
    outgoing.push_frame(&frame(1));
    assert_eq!(drain(&mut outgoing, NOW), b"t123101\r");
    assert_eq!(outgoing.account.dropped.not_classic, 1);
}

#[test]
fn what_is_cut_off_is_not_sent_and_what_comes_back_begins_afresh() {
    let mut outgoing = BusToLineQueue::new(false, LinePace::default());
    outgoing.handle_line_opened(&opening(b"O\r"));
    for number in 0..3 {
        outgoing.push_frame(&frame(number));
    }
    outgoing.ready_bytes(NOW);
    outgoing.remove_written(2 + 8 + 3);
    assert_eq!(outgoing.account.sent, 1);
    outgoing.handle_line_lost();
    assert_eq!(outgoing.account.dropped.line_away, 2);
    outgoing.handle_line_opened(&opening(b"\rO\r"));
    outgoing.push_frame(&frame(9));
    assert_eq!(drain(&mut outgoing, NOW), b"\rO\rt123109\r");
}

#[test]
fn the_end_finishes_the_line_that_was_begun_and_closes() {
    let mut outgoing = BusToLineQueue::new(false, LinePace::default());
    outgoing.handle_line_opened(&[]);
    outgoing.push_frame(&frame(1));
    outgoing.push_frame(&frame(2));
    outgoing.ready_bytes(NOW);
    outgoing.remove_written(3);
    outgoing.queue_closing_bytes(&closing_command());
    assert_eq!(drain(&mut outgoing, NOW), b"3101\rC\r");
    assert_eq!((outgoing.account.sent, outgoing.account.dropped.ended), (1, 1));
    // A frame of which only a part was written is not counted as sent.
    let mut stuck = BusToLineQueue::new(false, LinePace::default());
    stuck.handle_line_opened(&[]);
    stuck.push_frame(&frame(1));
    stuck.ready_bytes(NOW);
    stuck.remove_written(3);
    stuck.queue_closing_bytes(&closing_command());
    stuck.drop_unfinished_frame();
    assert_eq!((stuck.account.sent, stuck.account.dropped.ended, stuck.is_empty()), (0, 1, true));
    // A line that is not open gets no command to close its adapter.
    let mut away = BusToLineQueue::new(false, LinePace::default());
    away.queue_closing_bytes(&closing_command());
    assert!(away.is_empty());
}

#[test]
fn a_bus_at_125k_gets_no_more_than_it_carries() {
    let pace = LinePace { bit_rates: Some("125k".parse().unwrap()), baud: None };
    let mut outgoing = BusToLineQueue::new(true, pace);
    outgoing.handle_line_opened(&[]);
    // The frame has 34 + 8 + 13 bits, and stuff bits in addition.
    let cost = Duration::from_nanos(
        FrameBits::from_frame(&frame(0xAA)).unwrap().nanoseconds("125k".parse().unwrap()),
    );
    let (mut now, mut sent) = (NOW, 0);
    while now < NOW + Duration::from_secs(1) {
        outgoing.push_frame(&frame(0xAA));
        sent += drain(&mut outgoing, now).len() / 8;
        now += Duration::from_micros(100);
    }
    let carried =
        usize::try_from((Duration::from_secs(1) + MAX_WRITE_AHEAD).as_nanos() / cost.as_nanos()).unwrap();
    assert!((carried..=carried + 1).contains(&sent), "{sent} of {carried}");
    let BusToLineCounts { received, sent, dropped, .. } = outgoing.account;
    assert_eq!(received, sent + dropped.queue_full + outgoing.entries.len() as u64);
    assert!(dropped.queue_full > 5_000);
    let (_, again) = outgoing.ready_bytes(now);
    assert!(again.unwrap() <= now + cost, "it says when to come again");
}

#[test]
fn a_wire_at_9600_baud_is_the_slower_one() {
    let pace = LinePace { bit_rates: Some("1M".parse().unwrap()), baud: Some(9_600) };
    assert_eq!(pace.sending_time(&frame(1), 8), Duration::from_nanos(8_333_333));
    assert_eq!(LinePace { baud: None, ..pace }.sending_time(&frame(1), 8), Duration::from_nanos(58_000));
}

proptest! {
    #[test]
    fn every_frame_is_sent_or_dropped_for_a_reason(
        steps in proptest::collection::vec((0_u8..10, 0_usize..100), 0..100), slow: bool
    ) {
        let pace = LinePace { bit_rates: slow.then(|| "10k".parse().unwrap()), baud: None };
        let mut outgoing = BusToLineQueue::new(false, pace);
        let mut now = NOW;
        for (kind, amount) in steps {
            match kind {
                0 => outgoing.handle_line_opened(&opening(b"\rC\rO\r")),
                1 => outgoing.handle_line_lost(),
                2 => now += Duration::from_millis(amount as u64),
                3 | 4 => {
                    let bytes = outgoing.ready_bytes(now).0.len().min(amount);
                    outgoing.remove_written(bytes);
                }
                _ => (0..amount).for_each(|_| outgoing.push_frame(&frame(1))),
            }
            let waiting = outgoing.entries.iter().filter(|entry| entry.is_frame()).count() as u64;
            let BusToLineCounts { received, sent, dropped, .. } = outgoing.account;
            prop_assert_eq!(received, sent + dropped.total() + waiting);
            let text: usize = outgoing.entries.iter().map(|entry| entry.bytes).sum();
            prop_assert_eq!(text, outgoing.text.len() + outgoing.written);
            prop_assert!(waiting <= MAX_WAITING_FRAMES as u64);
        }
        outgoing.queue_closing_bytes(b"C\r");
        let rest = drain(&mut outgoing, now);
        prop_assert!(rest.is_empty() || rest.ends_with(b"C\r"));
        let BusToLineCounts { received, sent, dropped, .. } = outgoing.account;
        prop_assert_eq!(received, sent + dropped.total());
    }
}
