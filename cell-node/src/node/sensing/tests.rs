use protocol::can::Format;
use protocol::fixed::{Q1_14, Q3_12, Q5_10, Q9_6};
use protocol::id::{CellId, Kind, Node as Address};
use protocol::message::{Joints, Message, Request, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::{Epoch, WORDS};
use protocol::parameters::{Contact, Events, Parameter, Parameters, Pose, Sensing as Mode};
use protocol::time::{Micros, Span};

use crate::flash::FlashState;
use crate::identity::Identity;
use crate::node::claim::ClaimStage;
use crate::node::{HEARTBEAT_INTERVAL, Node};

const NODE: u8 = 51;
/// Period of continuous mode. Node 51 sends after one fifth of it.
const PERIOD: Span = Span::from_millis(10);
const JOINTS: Span = Span::from_millis(16);

/// A cell in a test, with the present time.
struct Cell {
    node: Node,
    format: Format,
    now: Micros,
    epoch: Epoch,
}

impl Cell {
    /// Creates a cell that owns its node id and uses this sensing mode.
    fn new(mode: Mode) -> Self {
        Self::of(Format::Fd, mode)
    }

    fn of(format: Format, mode: Mode) -> Self {
        let parameters = Parameters {
            joint: 1,
            joints: 1,
            pose: Pose {
                position: [Q1_14::ZERO; 3],
                normal: [Q1_14::nearest(1.0), Q1_14::ZERO, Q1_14::ZERO],
            },
            contact: Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() },
            period_us: 16_000,
            ..Parameters::default()
        };
        let identity = Identity { cell: Some(CellId::new(NODE.into()).unwrap()), serial: 0 };
        let node = Node::new(identity, format, &FlashState::Valid(parameters), true, Micros(0));
        let mut cell = Self { node, format, now: Micros(0), epoch: Epoch(0) };
        cell.waits();
        cell.waits();
        cell.switches(mode);
        cell
    }

    /// Returns the sensor pages that the cell has sent.
    fn sends(&mut self) -> Vec<SensorPage> {
        let packets = core::iter::from_fn(|| self.node.poll_transmit().copied());
        let page = |packet| {
            if let Message::Sensors { page, .. } = Message::decode(&packet).unwrap() {
                Some(page)
            } else {
                None
            }
        };
        packets.filter_map(page).collect()
    }

    fn hears(&mut self, message: &Message, age: Span) -> Vec<SensorPage> {
        for frame in message.encode().frames(self.format) {
            self.node.handle_frame(self.now, age, &frame);
        }
        self.sends()
    }

    fn write(&mut self, parameter: Parameter, words: [i16; WORDS]) -> Vec<SensorPage> {
        let request = Request::Write { number: parameter.number(), words };
        self.hears(&Message::Configure { to: Address::Everyone, tag: 0, request }, Span(0))
    }

    fn switches(&mut self, mode: Mode) -> Vec<SensorPage> {
        self.write(Parameter::Sensing, mode.words())
    }

    /// Sends the next joints to the cell at the present time and returns its sensor pages. Sensor values change only
    /// with joints.
    fn joints(&mut self) -> Vec<SensorPage> {
        self.joints_aged(Span(0))
    }

    fn joints_aged(&mut self, age: Span) -> Vec<SensorPage> {
        self.epoch = self.epoch.next();
        let joints = Joints { in_use: 1, ..Joints::default() };
        self.hears(&Message::Joints { epoch: self.epoch, joints }, age)
    }

    /// Sends a stimulus and then joints, which apply it. Returns the sensor pages that the cell sends.
    fn feels(&mut self, page: SensorPage) -> Vec<SensorPage> {
        let to = Address::Everyone;
        assert_eq!(self.hears(&Message::Stimulus { to, from: StimulusStart::Next, page }, Span(0)), []);
        self.joints()
    }

    /// Sets one contact word by a stimulus. Returns true if the cell sends exactly a page with this word.
    fn says(&mut self, bits: i16) -> bool {
        let page = pressed(bits);
        match self.feels(page).as_slice() {
            [] => false,
            [said] if *said == page => true,
            other => panic!("{other:?}"),
        }
    }

    /// Advances the time to the cell's next timer. Returns the time, and the sensor pages that the cell sends.
    fn waits(&mut self) -> (Micros, Vec<SensorPage>) {
        self.now = self.node.poll_timeout();
        self.node.handle_timeout(self.now);
        (self.now, self.sends())
    }

    /// Returns the times of the next `count` pages 0 that the cell sends without a request.
    fn times(&mut self, count: usize) -> Vec<u64> {
        let mut times = Vec::new();
        while times.len() < count {
            let (at, pages) = self.waits();
            times.extend(pages.iter().filter(|page| matches!(page, SensorPage::Skin(_))).map(|_| at.0));
        }
        times
    }
}

fn pressed(bits: i16) -> SensorPage {
    let contact = [Q5_10::from_bits(bits), Q5_10::ZERO, Q5_10::ZERO];
    SensorPage::Skin(SkinSensors { contact, ..SkinSensors::default() })
}

const NOTHING: SensorPage = SensorPage::Acceleration([Q3_12::ZERO; 3]);

/// Returns thresholds of 100 steps, with release below 50 steps.
fn events() -> Events {
    Events {
        contact: Q5_10::from_bits(100),
        proximity: Q1_14::from_bits(100),
        temperature: Q9_6::from_bits(100),
        acceleration: Q3_12::from_bits(100),
        hysteresis: Q1_14::nearest(0.5),
    }
}

fn eventful() -> Cell {
    let mut cell = Cell::new(Mode::Off);
    assert_eq!(cell.write(Parameter::Events, events().words()), [], "no mode, no frame");
    assert_eq!(cell.switches(Mode::Event), [pressed(0), NOTHING], "the present state, at once");
    cell
}

// SENSE-1, SENSE-2
#[test]
fn off_sends_nothing_whatever_is_sensed() {
    let mut cell = Cell::new(Mode::Off);
    assert!(!cell.says(2_000) && !cell.says(0));
    for _ in 0..8 {
        assert_eq!(cell.waits().1, [], "nor with a heartbeat");
    }
}

// SENSE-9
#[test]
fn touch_and_release_have_two_thresholds() {
    let mut cell = eventful();
    let course = [99, 100, 150, 60, 50, 49, 20, 99, 100, 51, 52, 0, 0];
    let said = course.map(|bits| cell.says(bits));
    //               99     touch  150    60     50     release fading 99     touch  51     52     zero  zero
    let expected = [false, true, false, false, false, true, false, false, true, false, false, true, false];
    assert_eq!(said, expected, "{course:?}");
}

#[test]
fn noise_below_the_threshold_sends_nothing() {
    let mut cell = eventful();
    for bits in [10, 0, 99, 3, 0, 98, 0, 99, 0] {
        assert!(!cell.says(bits), "{bits}");
    }
}

// SENSE-9
#[test]
fn a_slow_release_and_the_zero_after_it_are_sent() {
    let mut cell = eventful();
    assert!(cell.says(100));
    let said: Vec<_> = (0..100).rev().filter(|&bits| cell.says(bits)).collect();
    assert_eq!(said, [49, 0], "neither moved by a threshold from what was sent");
}

// SENSE-8
#[test]
fn a_slow_drift_is_seen_because_it_is_measured_from_what_was_sent() {
    let mut cell = eventful();
    let said: Vec<_> = (1..=450).filter(|&bits| cell.says(bits)).collect();
    assert_eq!(said, [100, 200, 300, 400]);
    let said: Vec<_> = (150..450).rev().filter(|&bits| cell.says(bits)).collect();
    assert_eq!(said, [300, 200]);
}

#[test]
fn a_touch_is_the_sum_of_the_three_contact_words() {
    let mut cell = eventful();
    let of = |bits: [i16; 3]| {
        SensorPage::Skin(SkinSensors { contact: bits.map(Q5_10::from_bits), ..SkinSensors::default() })
    };
    assert_eq!(cell.feels(of([33, 33, 33])), []);
    assert_eq!(cell.feels(of([33, 33, 34])), [of([33, 33, 34])], "no word has moved by the threshold");
    assert_eq!(cell.feels(of([16, 16, 17])), [of([16, 16, 17])]);
}

// SENSE-7
#[test]
fn every_sensor_has_its_threshold() {
    let mut cell = eventful();
    let none = SkinSensors::default();
    let near = |bits| SensorPage::Skin(SkinSensors { proximity: Q1_14::from_bits(bits), ..none });
    let warm =
        |bits| SensorPage::Skin(SkinSensors { temperature: [Q9_6::ZERO, Q9_6::from_bits(bits)], ..none });
    let tilted = |bits| SensorPage::Acceleration([Q3_12::ZERO, Q3_12::from_bits(bits), Q3_12::ZERO]);
    for of in [&near as &dyn Fn(i16) -> SensorPage, &warm, &tilted] {
        assert_eq!(cell.feels(of(99)), []);
        assert_eq!(cell.feels(of(100)), [of(100)]);
        assert_eq!(cell.feels(of(101)), [], "said already");
        assert_eq!(cell.feels(of(0)), [of(0)]);
    }
    assert_eq!(cell.feels(near(100)), [near(100)]);
    assert_eq!(cell.feels(near(50)), []);
    assert_eq!(cell.feels(near(49)), [near(49)], "a release of what came near");
}

// SENSE-10
#[test]
fn a_heartbeat_in_event_mode_carries_the_present_state_and_every_fourth_the_acceleration() {
    let mut cell = eventful();
    assert!(!cell.says(60));
    let beats: Vec<_> = (0..8).map(|_| cell.waits()).collect();
    for (beat, (_, pages)) in beats.iter().enumerate() {
        let both = [pressed(60), NOTHING];
        assert_eq!(pages.as_slice(), &both[..if beat % 4 == 3 { 2 } else { 1 }], "{beat}");
    }
    assert!(beats.windows(2).all(|pair| pair[1].0.elapsed_since(pair[0].0) == HEARTBEAT_INTERVAL));
    // A page counts as sent for whatever reason it was sent.
    assert!(!cell.says(60) && cell.says(160));
}

// SENSE-10
#[test]
fn a_heartbeat_with_an_event_does_not_send_it_twice() {
    let mut cell = eventful();
    cell.now = cell.node.poll_timeout() - Span(1_000);
    let to = Address::Everyone;
    cell.hears(&Message::Stimulus { to, from: StimulusStart::Next, page: pressed(500) }, Span(0));
    cell.epoch = cell.epoch.next();
    let joints = Joints { in_use: 1, ..Joints::default() };
    for frame in (Message::Joints { epoch: cell.epoch, joints }).encode().frames(Format::Fd) {
        cell.node.handle_frame(cell.now, Span(0), &frame);
    }
    let said: Vec<_> =
        core::iter::from_fn(|| cell.node.poll_transmit().copied()).map(|packet| packet.id.kind).collect();
    let expected = [Kind::Torque, Kind::Sensors, Kind::Network];
    assert_eq!(said, expected, "the torque first");
}

// SENSE-5
#[test]
fn continuous_keeps_its_period_and_the_phase_of_its_node_id() {
    let mut cell = Cell::new(Mode::Off);
    let switched = cell.now;
    let said = cell.switches(Mode::Continuous { period_ms: 10 });
    assert_eq!(said, [pressed(0), NOTHING], "the present state, at once");
    // 51/255 of a period after the period.
    let first = switched.0 + PERIOD.0 + PERIOD.0 / 5;
    let expected: Vec<_> = (0..60).map(|n| first + n * PERIOD.0).collect();
    assert_eq!(cell.times(60), expected, "heartbeats shift none of them");
    // An early call is harmless and sends nothing.
    cell.node.handle_timeout(cell.node.poll_timeout() - Span(1));
    assert_eq!(cell.sends(), []);
}

// SENSE-5
#[test]
fn a_hang_skips_overdue_periods_and_keeps_the_phase() {
    let mut cell = Cell::new(Mode::Continuous { period_ms: 10 });
    let last = cell.times(3)[2];
    cell.now = Micros(last + 95_000);
    cell.node.handle_timeout(cell.now);
    let skins = cell.sends().into_iter().filter(|page| matches!(page, SensorPage::Skin(_))).count();
    assert_eq!(skins, 1, "one for all overdue periods");
    assert_eq!(cell.times(2), [last + 100_000, last + 110_000]);
}

// SENSE-11
#[test]
fn what_is_sensed_during_a_hang_is_sent_with_the_next_joints() {
    let mut cell = eventful();
    let to = Address::Everyone;
    for bits in [500, 700, 900] {
        cell.hears(&Message::Stimulus { to, from: StimulusStart::Next, page: pressed(bits) }, Span(0));
        assert_eq!(cell.joints_aged(Span(16_001)), [], "too old");
    }
    assert_eq!(cell.joints(), [pressed(900)]);
}

// SENSE-6
#[test]
fn a_long_period_comes_with_the_answer_before_it_and_a_short_one_keeps_its_own_time() {
    let mut cell = Cell::new(Mode::Continuous { period_ms: 100 });
    let due = cell.times(1)[0] + 100_000;
    let joints_at = |cell: &mut Cell, at: u64| {
        cell.now = Micros(at);
        cell.joints().into_iter().filter(|page| matches!(page, SensorPage::Skin(_))).count()
    };
    assert_eq!(joints_at(&mut cell, due - JOINTS.0), 0, "the next joints come in time for it");
    assert_eq!(joints_at(&mut cell, due - JOINTS.0 + 1), 1);
    assert_eq!(cell.times(1), [due + 100_000], "neither drifts nor comes twice");

    let mut cell = Cell::new(Mode::Continuous { period_ms: 16 });
    let due = cell.times(1)[0] + 16_000;
    assert_eq!(joints_at(&mut cell, due - 1), 0, "or all would speak at once, each time");
    assert_eq!(cell.times(1), [due]);
}

// SENSE-4
#[test]
fn switching_starts_again_and_the_same_again_changes_nothing() {
    let mut cell = eventful();
    assert!(cell.says(500));
    assert_eq!(cell.switches(Mode::Event), [], "no other mode");
    assert_eq!(cell.switches(Mode::Continuous { period_ms: 10 }), [pressed(500), NOTHING]);
    assert!(!cell.says(900), "no event");
    let times = cell.times(2);
    assert_eq!(cell.switches(Mode::Continuous { period_ms: 10 }), []);
    assert_eq!(cell.times(1), [times[1] + 10_000], "nor another phase");
    assert_eq!(cell.switches(Mode::Continuous { period_ms: 20 }), [pressed(900), NOTHING]);
    assert_eq!(cell.switches(Mode::Event), [pressed(900), NOTHING]);
    // It knows that this is a touch.
    let said: Vec<_> = (0..60).rev().filter(|&bits| cell.says(bits)).collect();
    assert_eq!(said, [59, 49, 0], "a fall, a release, and nothing any more");
    assert_eq!(cell.switches(Mode::Off), []);
    assert!(!cell.says(900));
}

// SENSE-8
#[test]
fn a_threshold_of_zero_makes_every_change_an_event() {
    let mut cell = eventful();
    cell.write(Parameter::Events, [0; WORDS]);
    assert_eq!(
        [1, 2, 2, 3, 1, 0, 0].map(|bits| cell.says(bits)),
        [true, true, false, true, true, true, false]
    );
}

// SENSE-11
#[test]
fn nothing_is_sent_before_the_address_claim_is_settled() {
    let mut cell = eventful();
    cell.node.claim.stage = ClaimStage::Sent;
    assert!(!cell.says(500));
    cell.node.claim.stage = ClaimStage::Settled;
    assert_eq!(cell.joints(), [pressed(500)]);

    let mut cell = Cell::new(Mode::Continuous { period_ms: 10 });
    cell.node.claim.stage = ClaimStage::Sent;
    let heartbeat = cell.node.claim.next_heartbeat;
    assert_eq!(cell.node.poll_timeout(), heartbeat, "it is not woken for it");
    cell.now = heartbeat - Span(1);
    cell.node.handle_timeout(cell.now);
    assert_eq!(cell.sends(), []);
}

// SENSE-7, CONF-9
#[test]
fn other_thresholds_apply_at_once() {
    let mut cell = eventful();
    assert!(!cell.says(60));
    let finer = Events { contact: Q5_10::from_bits(50), ..events() };
    assert_eq!(cell.write(Parameter::Events, finer.words()), [pressed(60)]);
}

// STIM-2, SENSE-7
#[test]
fn leaving_test_mode_is_a_release() {
    let mut cell = eventful();
    assert!(cell.says(500));
    assert_eq!(cell.write(Parameter::Mode, [0; WORDS]), [pressed(0)]);
}

// SENSE-11, CMD-1
#[test]
fn a_halted_cell_keeps_sending_its_contact_state() {
    let mut cell = eventful();
    assert_eq!(cell.hears(&Message::Halt, Span(0)), []);
    assert!(cell.says(500) && cell.says(0));
}

#[test]
fn on_a_classic_bus_it_is_the_same() {
    let course = [99, 100, 150, 250, 40, 0];
    let said = [Format::Fd, Format::Classic].map(|format| {
        let mut cell = Cell::of(format, Mode::Off);
        cell.write(Parameter::Events, events().words());
        assert_eq!(cell.switches(Mode::Event), [pressed(0), NOTHING]);
        course.map(|bits| cell.says(bits))
    });
    assert_eq!(said[0], [false, true, false, true, true, true]);
    assert_eq!(said[0], said[1]);
}

#[test]
fn the_same_inputs_make_the_same_frames() {
    use proptest::prelude::*;
    let steps = proptest::collection::vec((0_u8..4, any::<i16>(), 0_u64..60_000), 0..60);
    proptest!(|(steps in steps)| {
        let run = || {
            let mut cell = eventful();
            let mut said = Vec::new();
            for &(what, bits, later) in &steps {
                // Never later than its next timer, as a shell ensures.
                let until = cell.now + Span(later);
                while cell.node.poll_timeout() <= until {
                    said.push(cell.waits());
                }
                cell.now = until;
                let pages = match what {
                    0 | 1 => cell.feels(pressed(bits)),
                    2 => cell.feels(SensorPage::Acceleration([Q3_12::from_bits(bits); 3])),
                    _ => cell.switches(match bits % 3 {
                        0 => Mode::Off,
                        1 => Mode::Continuous { period_ms: bits.unsigned_abs() % 200 + 1 },
                        _ => Mode::Event,
                    }),
                };
                said.push((cell.now, pages));
            }
            said
        };
        prop_assert_eq!(run(), run());
    });
}
