//! What stands in the packets of each kind.

use protocol::message::{Answer, State};
use protocol::parameters::Parameter;

use super::signal::Signal;
use model::decode::parameter::{Name, reason};

/// The number that stands for a refusal.
const REFUSAL: u8 = 126;

/// Halt, sync, resume, report.
pub(super) fn bare() -> Vec<Signal> {
    vec![Signal::crc()]
}

pub(super) fn joints() -> Vec<Signal> {
    let words = numbered(|joint, index| Signal::angle(format!("position_{joint}"), index));
    ended(words, [Signal::epoch(), Signal::count(1, 6)])
}

pub(super) fn sum() -> Vec<Signal> {
    let words = numbered(|joint, index| Signal::fixed::<8>(format!("sum_{joint}"), index, "Nm").saturating());
    ended(words, [Signal::epoch(), Signal::count(0, 255)])
}

pub(super) fn torque() -> Vec<Signal> {
    let words =
        numbered(|joint, index| Signal::fixed::<12>(format!("torque_{joint}"), index, "Nm").saturating());
    ended(words, [Signal::epoch(), Signal::count(1, 1)])
}

pub(super) fn sensors() -> Vec<Signal> {
    ended(felt(), [Signal::epoch(), sensor_page(8)])
}

pub(super) fn stimulus() -> Vec<Signal> {
    let flag = Signal::flag("from_next").naming([(0, "from this epoch on"), (1, "from the next joints on")]);
    ended(felt(), [Signal::epoch(), sensor_page(7), flag])
}

pub(super) fn network() -> Vec<Signal> {
    let mut signals = vec![
        Signal::bits("serial", 0, 32).on(0),
        Signal::word("configuration", 2).on(0),
        Signal::word("sent", 3).on(0),
        Signal::word("rejected", 4).on(0),
    ];
    signals.extend(state(5).into_iter().map(|signal| signal.on(0)));
    let heard = ["joints", "joints_skipped", "joints_repeated", "stimuli", "stimuli_late", "torques"];
    let refused = ["length", "crc", "foreign", "meaning", "incomplete", "stimuli"];
    signals.extend((0..).zip(heard).map(|(index, name)| Signal::word(format!("heard_{name}"), index).on(1)));
    signals
        .extend((0..).zip(refused).map(|(index, name)| Signal::word(format!("refused_{name}"), index).on(2)));
    signals.extend(tree().into_iter().map(|signal| signal.on(3)));
    signals.extend(ports().into_iter().map(|signal| signal.on(4)));
    let names = [(0, "heartbeat"), (1, "heard"), (2, "refused"), (3, "tree"), (4, "ports")];
    let page = Signal::page_number("page", 8).naming(names);
    ended(signals, [Signal::epoch(), page.within(0.0, 4.0)])
}

/// A cell's place in the tree, and what became of sums.
fn tree() -> Vec<Signal> {
    let mut signals = vec![
        Signal::bits("parent", 0, 8).naming([(0, "gateway"), (255, "no way up")]),
        Signal::bits("up", 8, 8).within(0.0, 4.0).naming([(4, "uplink")]),
        Signal::bits("depth", 16, 8),
        Signal::bits("round", 24, 8),
    ];
    signals.extend((0..4).map(|port| Signal::bits(format!("child_at_{port}"), 32 + port, 1)));
    signals.extend((0..5).map(|port| Signal::bits(format!("port_{port}_works"), 40 + port, 1)));
    let counters = ["sums_sent", "sums_taken", "sums_dropped"];
    signals.extend((3..).zip(counters).map(|(index, name)| Signal::word(name, index)));
    signals
}

/// What a cell's ports lead to.
fn ports() -> Vec<Signal> {
    let port = |port: u8| {
        let name = |of: &str| format!("port_{port}_{of}");
        let at = port * 16;
        [
            Signal::bits(name("leads_to"), at, 8).naming([(0, "nobody with a number")]),
            Signal::bits(name("leads_to_port"), at + 8, 3),
            Signal::bits(name("hears"), at + 12, 1),
            Signal::bits(name("both_ways"), at + 13, 1),
            Signal::bits(name("other_version"), at + 14, 1),
        ]
    };
    (0..4).flat_map(port).chain([Signal::word("parent_changes", 4)]).collect()
}

pub(super) fn configure() -> Vec<Signal> {
    let write = Signal::flag("write").naming([(0, "read"), (1, "write")]);
    ended(parameters(), [Signal::tag(), number(parameter_names()), write])
}

pub(super) fn configured() -> Vec<Signal> {
    let mut signals = parameters();
    signals
        .push(Signal::word("refused_parameter", 0).within(0.0, 127.0).on(REFUSAL).naming(parameter_names()));
    let reasons =
        [1, 2, 3, 4, 5, 6, Answer::WRONG_HASH, Answer::FLASH_FAILED, Answer::UNKNOWN, Answer::CANNOT_BE];
    let reasons = reasons.map(|number| (i64::from(number), reason(number)));
    signals.push(Signal::fixed::<0>("refused_reason", 1, "").on(REFUSAL).naming(reasons));
    let mut names = parameter_names();
    names.push((i64::from(REFUSAL), "refusal".to_owned()));
    let written = Signal::flag("written").naming([(0, "has"), (1, "written")]);
    ended(signals, [Signal::tag(), number(names), written])
}

/// The pages of sensors.
fn felt() -> Vec<Signal> {
    let contact = (0..3).map(|index| Signal::fixed::<10>(format!("contact_{}", index + 1), index, "N").on(0));
    let temperature =
        (0..2).map(|index| Signal::fixed::<6>(format!("temperature_{}", index + 1), 4 + index, "degC").on(0));
    let acceleration = (0..).zip(["x", "y", "z"]);
    let acceleration = acceleration
        .map(|(index, axis)| Signal::fixed::<12>(format!("acceleration_{axis}"), index, "g").on(1));
    let proximity = Signal::fixed::<14>("proximity", 3, "").within(0.0, 1.0).on(0);
    contact.chain([proximity]).chain(temperature).chain(acceleration).collect()
}

fn sensor_page(bits: u8) -> Signal {
    Signal::page_number("page", bits).within(0.0, 1.0).naming([(0, "skin"), (1, "acceleration")])
}

/// A state word, bit by bit.
fn state(word: u8) -> Vec<Signal> {
    let at = word * 16;
    let bit = |(bit, name): (State, &str)| {
        let index = u8::try_from(bit.0.trailing_zeros()).unwrap_or_default();
        Signal::bits(format!("state_{}", name.replace('-', "_")), at + index, 1)
    };
    let mut signals: Vec<_> = State::NAMES.into_iter().map(bit).collect();
    signals.push(Signal::bits("state_joint", at + 8, 4));
    signals.push(Signal::bits("state_version", at + 12, 4));
    signals
}

fn number(names: Vec<(i64, String)>) -> Signal {
    Signal::page_number("parameter", 7).naming(names)
}

/// Every parameter's number and name.
fn parameter_names() -> Vec<(i64, String)> {
    let known = (0..=127).filter(|&number| Parameter::from_number(number).is_some());
    known.map(|number| (i64::from(number), Name(number).to_string())).collect()
}

/// The words of every parameter.
fn parameters() -> Vec<Signal> {
    let known = (0..=127).filter_map(Parameter::from_number);
    known
        .flat_map(|parameter| words(parameter).into_iter().map(move |signal| signal.on(parameter.number())))
        .collect()
}

fn words(parameter: Parameter) -> Vec<Signal> {
    match parameter {
        Parameter::Identity => {
            let mut signals = vec![
                Signal::bits("serial", 0, 32),
                Signal::word("version", 2),
                Signal::word("configuration", 3),
            ];
            signals.extend(state(4));
            signals
        }
        Parameter::Mount => vec![
            Signal::fixed::<0>("mount_joint", 0, "").within(1.0, 6.0),
            Signal::fixed::<0>("mount_joints", 1, "").within(1.0, 6.0),
        ],
        Parameter::Pose => {
            let axes = || ["x", "y", "z"].into_iter();
            let position = (0..)
                .zip(axes())
                .map(|(index, axis)| Signal::fixed::<14>(format!("pose_{axis}"), index, "m"));
            let normal = (3..)
                .zip(axes())
                .map(|(index, axis)| Signal::fixed::<14>(format!("normal_{axis}"), index, ""));
            position.chain(normal).collect()
        }
        Parameter::Contact => vec![
            Signal::fixed::<12>("alpha_c", 0, "").not_negative(),
            Signal::fixed::<10>("alpha_p", 1, "N").not_negative(),
            Signal::fixed::<10>("contact_threshold", 2, "N").not_negative(),
            Signal::fixed::<14>("proximity_threshold", 3, "").not_negative(),
            Signal::fixed::<10>("force_threshold", 4, "N").not_negative(),
        ],
        Parameter::Timing => vec![Signal::word("period", 0).in_unit("us").within(1.0, 65_535.0)],
        Parameter::Mode => {
            vec![Signal::fixed::<0>("mode", 0, "").naming([(0, "measure"), (1, "obey stimuli")])]
        }
        Parameter::Reply => vec![
            Signal::fixed::<0>("reply", 0, "").within(0.0, 1.0).naming([(0, "torque"), (1, "sum")]),
            Signal::word("reply_slot", 1).in_unit("us"),
            Signal::fixed::<0>("reply_deepest", 2, "").within(0.0, 253.0),
            Signal::fixed::<0>("reply_carry", 3, "").within(0.0, 1.0),
        ],
        Parameter::Sensing => vec![
            Signal::fixed::<0>("sensing", 0, "").within(0.0, 2.0).naming([
                (0, "off"),
                (1, "continuous"),
                (2, "event"),
            ]),
            Signal::word("sensing_period", 1).in_unit("ms"),
        ],
        Parameter::Events => vec![
            Signal::fixed::<10>("events_contact", 0, "N").not_negative(),
            Signal::fixed::<14>("events_proximity", 1, "").not_negative(),
            Signal::fixed::<6>("events_temperature", 2, "degC").not_negative(),
            Signal::fixed::<12>("events_acceleration", 3, "g").not_negative(),
            Signal::fixed::<14>("events_hysteresis", 4, "").within(0.0, 1.0),
        ],
        Parameter::Cuts => (0..5).map(|port| Signal::bits(format!("cut_port_{port}"), port, 1)).collect(),
        Parameter::Row(row) => {
            let name = |field: &str| format!("row{}_{field}", row + 1);
            vec![
                Signal::fixed::<14>(name("a"), 0, "m"),
                Signal::fixed::<14>(name("d"), 1, "m"),
                Signal::angle(name("alpha"), 2),
                Signal::angle(name("theta_offset"), 3),
            ]
        }
        Parameter::Commit => vec![Signal::word("commit_hash", 0)],
    }
}

/// One signal for each of the six joints.
fn numbered(signal: impl Fn(u8, u8) -> Signal) -> Vec<Signal> {
    (0..6).map(|index| signal(index + 1, index)).collect()
}

/// The words, what byte 12 and byte 13 say, and the CRC.
fn ended<const N: usize>(mut words: Vec<Signal>, end: [Signal; N]) -> Vec<Signal> {
    words.extend(end);
    words.push(Signal::crc());
    words
}
