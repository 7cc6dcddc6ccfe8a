//! The packets.

use super::field::{Absent, Field, Format};
use super::{ALWAYS, Layout, PacketSchema};
use crate::id::{Command, Kind};
use crate::message::{Answer, REFUSED};
use crate::packet::WORDS;

/// What a word of each joint is called.
const JOINTS: [&str; WORDS] = ["1", "2", "3", "4", "5", "6"];
/// Joints that a robot can have.
#[expect(clippy::cast_possible_truncation, reason = "a packet has few words")]
const IN_USE: u16 = WORDS as u16;
const THREE: &[&str] = &["1", "2", "3"];
const TWO: &[&str] = &["1", "2"];
const AXES: &[&str] = &["x", "y", "z"];
const PORTS: &[&str] = &["0", "1", "2", "3"];
/// Where byte 12, byte 13 and the highest bit of byte 13 begin.
#[expect(clippy::cast_possible_truncation, reason = "a packet has few words")]
const EPOCH: u8 = WORDS as u8 * 16;
const COUNT: u8 = EPOCH + 8;
const FLAG: u8 = COUNT + 7;

const EPOCH_ANSWERED: Field = Field::bits("epoch", EPOCH, 8, "the joints that it answers");
const LAST_EPOCH: Field = Field::bits("epoch", EPOCH, 8, "the last joints taken, 0 before the first");
const TAG: Field = Field::bits("tag", EPOCH, 8, "comes back in the answer");
const PARAMETER: Field = Field::new("parameter", COUNT, Format::Parameter(7), "the parameter");
const SENSOR_PAGE: Field = Field::new("page", COUNT, Format::Page(8), "the page").within(0, 1);

/// The words as they are.
pub(super) const WORDS_AS_THEY_ARE: Field =
    Field::word("words", 0, Format::Signed, "what they say is not known").each(&JOINTS);

/// Every kind of packet and every command, by identifier.
pub const PACKETS: &[PacketSchema] = &[
    bare(Command::Halt, "Stop answering joints until a resume."),
    PacketSchema {
        end: &[
            Field::bits("epoch", EPOCH, 8, "the number of this broadcast"),
            Field::bits("", COUNT, 8, "joints in use").signal("count").within(1, IN_USE),
        ],
        layouts: &[only(&[Field::word(
            "position_rad",
            0,
            Format::Position,
            "position of each joint; of those beyond the joints in use 0",
        )
        .unit("rad")
        .each(&JOINTS)])],
        text: &[(ALWAYS, "epoch {epoch}: {position_rad:4} rad")],
        ..bare(
            Command::Joints,
            "The robot's joint positions; count is the joints in use, the others are 0. Cells in contact answer \
             with their torque.",
        )
    },
    bare(Command::Sync, "Every cell answers with a heartbeat when all that the last joints asked is done."),
    bare(Command::Resume, "Leave the halted state."),
    bare(Command::Report, "Every cell answers with its pages of counters and sensors."),
    PacketSchema {
        kind: Kind::Sum,
        command: None,
        meaning: "The cell's torques and those of the cells below it in the tree, answering the joints of this epoch, \
                  where a bus replies with sums. count is the cells in it that feel something, 0 the end of a contact; \
                  of two for one epoch the one with more cells counts.",
        end: &[EPOCH_ANSWERED],
        layouts: &[only(&[
            Field::word(
                "torque_nm",
                0,
                Format::Saturating(8),
                "torques of the sender and of all cells below it",
            )
            .signal("sum")
            .unit("Nm")
            .each(&JOINTS),
            Field::bits(
                "cells",
                COUNT,
                8,
                "cells in it that feel a force; 0, with words of 0: none does any more",
            )
            .signal("count"),
        ])],
        text: &[(ALWAYS, "epoch {epoch}: {torque_nm:3} Nm, cells {cells}")],
    },
    PacketSchema {
        kind: Kind::Torque,
        command: None,
        meaning: "The cell's torques about joints 1 to 6, answering the joints of this epoch; sent while in contact, and \
                  once with zeros when the contact ends.",
        end: &[EPOCH_ANSWERED, Field::bits("", COUNT, 8, "1").signal("count").within(1, 1)],
        layouts: &[only(&[Field::word(
            "torque_nm",
            0,
            Format::Saturating(12),
            "torque about each joint; of those beyond the one that moves the cell 0",
        )
        .unit("Nm")
        .each(&JOINTS)])],
        text: &[(ALWAYS, "epoch {epoch}: {torque_nm:4} Nm")],
    },
    PacketSchema {
        kind: Kind::Sensors,
        command: None,
        meaning: "What the cell measures, by page.",
        end: &[LAST_EPOCH, SENSOR_PAGE],
        layouts: SENSORS,
        text: &[(ALWAYS, "epoch {epoch}: {}")],
    },
    PacketSchema {
        kind: Kind::Network,
        command: None,
        meaning: "Page 0: heartbeat, four times a second and after each sync. Pages 1 to 4: counters modulo 65536, the \
                  place in the tree, the ports; on report, and page 3 when the parent changes. epoch is that of the \
                  last joints taken.",
        end: &[LAST_EPOCH, Field::new("page", COUNT, Format::Page(8), "the page").within(0, 4)],
        layouts: NETWORK,
        text: &[(ALWAYS, "epoch {epoch} {page}: {}")],
    },
    PacketSchema {
        kind: Kind::Configure,
        command: None,
        meaning: "Reads a parameter, or writes its staged copy, which a commit with the right hash takes into use. The \
                  tag comes back in the answer.",
        end: &[
            TAG,
            PARAMETER,
            Field::new("write", FLAG, Format::Flag(1), "whether it is written")
                .names(&[(0, "read"), (1, "write")]),
        ],
        layouts: PARAMETERS,
        text: &[([0, 127], "tag {tag}: read {parameter}"), ([128, 255], "tag {tag}: write {parameter}: {}")],
    },
    PacketSchema {
        kind: Kind::Configured,
        command: None,
        meaning: "The answer to configure: the value in force or written, or a refusal.",
        end: &[
            TAG,
            PARAMETER,
            Field::new("written", FLAG, Format::Flag(1), "whether it was written")
                .names(&[(0, "has"), (1, "written")]),
        ],
        layouts: ANSWERS,
        text: &[
            ([0, 125], "tag {tag}: has {parameter}: {}"),
            ([126, 126], "tag {tag}: {}"),
            ([127, 127], "tag {tag}: has {parameter}: {}"),
            ([128, 255], "tag {tag}: wrote {parameter}: {}"),
        ],
    },
    PacketSchema {
        kind: Kind::Stimulus,
        command: None,
        meaning: "What a cell in test mode shall feel, from the joints of this epoch on or from the next ones.",
        end: &[
            Field::bits("epoch", EPOCH, 8, "the first joints that it holds for"),
            Field::new("from_next", FLAG, Format::Flag(1), "from the next joints on, whatever their epoch")
                .names(&[(0, "from this epoch on"), (1, "from the next joints on")]),
            Field::new("page", COUNT, Format::Page(7), "the page").within(0, 1),
        ],
        layouts: SENSORS,
        text: &[([0, 127], "from epoch {epoch} on: {}"), ([128, 255], "from the next joints on: {}")],
    },
];

/// A command without anything in it.
const fn bare(command: Command, meaning: &'static str) -> PacketSchema {
    PacketSchema { kind: Kind::Command, command: Some(command), meaning, end: &[], layouts: &[], text: &[] }
}

/// The only layout of a kind.
const fn only(fields: &'static [Field]) -> Layout {
    Layout { number: 0, name: "", prefix: "", fields, text: &[] }
}

const SENSORS: &[Layout] = &[
    Layout {
        number: 0,
        name: "skin",
        prefix: "",
        fields: &[
            Field::word("force_n", 0, Format::Total(10), "the touch: the sum of the contact words").unit("N"),
            Field::word("contact_n", 0, Format::Fixed(10), "capacitive contact forces").unit("N").each(THREE),
            Field::word("proximity", 3, Format::Fixed(14), "0, nothing near, to 1")
                .within(0, 1)
                .allowed("proximity is 0 to 1"),
            Field::word("temperature_c", 4, Format::Fixed(6), "temperatures").unit("°C").each(TWO),
        ],
        text: &[(
            ALWAYS,
            "force {force_n:3} N ({contact_n:3}), proximity {proximity:4}, temperature {temperature_c:2} °C",
        )],
    },
    Layout {
        number: 1,
        name: "acceleration",
        prefix: "",
        fields: &[Field::word("acceleration_g", 0, Format::Fixed(12), "accelerometer").unit("g").each(AXES)],
        text: &[(ALWAYS, "acceleration {acceleration_g:4} g")],
    },
];

const NETWORK: &[Layout] = &[
    Layout {
        number: 0,
        name: "heartbeat",
        prefix: "",
        fields: &[
            Field::bits("serial", 0, 32, "serial number"),
            Field::word("configuration", 2, Format::Hex, "configuration hash; 0 without a configuration"),
            Field::counter("sent", 3, "packets sent before this one"),
            Field::counter("refused", 4, "frames refused: the sum of page 2").signal("rejected"),
            Field::word("state", 5, Format::State, "how the cell is, below"),
        ],
        text: &[(ALWAYS, "serial {serial}, hash {configuration}, sent {sent}, refused {refused}, {state}")],
    },
    Layout {
        number: 1,
        name: "heard",
        prefix: "heard_",
        fields: &[
            Field::counter("joints", 0, "joints taken"),
            Field::counter("joints_skipped", 1, "joints skipped: older than one period"),
            Field::counter("joints_repeated", 2, "joints of the epoch that was the last already"),
            Field::counter("stimuli", 3, "stimuli taken"),
            Field::counter("stimuli_late", 4, "of these, late"),
            Field::counter("torques", 5, "torques sent"),
        ],
        text: &[(
            ALWAYS,
            "joints {joints}, skipped {joints_skipped}, repeated {joints_repeated}, stimuli {stimuli}, late \
             {stimuli_late}, torques {torques}",
        )],
    },
    Layout {
        number: 2,
        name: "refused",
        prefix: "refused_",
        fields: &[
            Field::counter("length", 0, "wrong length or format"),
            Field::counter("crc", 1, "wrong CRC"),
            Field::counter("foreign", 2, "remote frames, error frames, 29-bit identifiers"),
            Field::counter("meaning", 3, "a page that does not exist, a count that cannot be"),
            Field::counter("incomplete", 4, "first halves without their second one"),
            Field::counter("stimuli", 5, "stimuli outside test mode, or without room"),
        ],
        text: &[(
            ALWAYS,
            "length {length}, CRC {crc}, foreign {foreign}, meaning {meaning}, incomplete {incomplete}, stimuli \
             {stimuli}",
        )],
    },
    Layout {
        number: 3,
        name: "tree",
        prefix: "",
        fields: &[
            Field::bits(
                "parent",
                0,
                8,
                "the parent's number, 0 for the gateway's side, 255 without a way up",
            )
            .names(&[(0, "gateway"), (255, "no way up")])
            .when(0, 254, Absent::Null),
            Field::new(
                "up",
                8,
                Format::Port,
                "the port that leads there; 4 is a root's wire to the gateway's side",
            )
            .within(0, 4)
            .names(&[(4, "uplink")])
            .when(0, 254, Absent::Null),
            Field::bits("depth", 16, 8, "wires to the root of the tree, which itself is at 0").when(
                0,
                254,
                Absent::Null,
            ),
            Field::bits("round", 24, 8, "the exploration from which the depth is"),
            Field::new("children", 32, Format::Ports(8, 4), "bit p: the cell at port p is a child")
                .signal("child_at_{}"),
            Field::new("works", 40, Format::Ports(8, 5), "bit p: port p works in both directions")
                .signal("port_{}_works"),
            Field::counter("sent", 3, "sums sent").signal("sums_sent"),
            Field::counter("taken", 4, "sums taken from children").signal("sums_taken"),
            Field::counter("dropped", 5, "sums of children that were not taken").signal("sums_dropped"),
        ],
        text: &[
            ([255, 255], "no way up (last round {round}), "),
            ([0, 0], "root by {up}, depth {depth} of round {round}, "),
            ([1, 254], "child of {parent} by {up}, depth {depth} of round {round}, "),
            (
                ALWAYS,
                "children at ports {children}, working ports {works}, sums sent {sent}, taken {taken}, not taken \
                 {dropped}",
            ),
        ],
    },
    Layout {
        number: 4,
        name: "ports",
        prefix: "",
        fields: &[
            Field::word("ports", 0, Format::Group(PORT), "what each port leads to").each(PORTS),
            Field::counter("changes", 4, "how often the parent changed").signal("parent_changes"),
        ],
        text: &[(ALWAYS, "{ports}; parent changed {changes} times")],
    },
];

/// What a port leads to.
const PORT: &[Field] = &[
    Field::bits("node", 0, 8, "the cell at the other end; 0: none is heard, or it has no number")
        .signal("port_{}_leads_to")
        .names(&[(0, "nobody with a number")]),
    Field::bits("port", 8, 3, "the other end's port").signal("port_{}_leads_to_port"),
    Field::new("hears", 12, Format::Flag(1), "something is heard from there").signal("port_{}_hears"),
    Field::new("works", 13, Format::Flag(1), "it hears this cell too").signal("port_{}_both_ways"),
    Field::new("other_version", 14, Format::Flag(1), "it speaks another version of this protocol")
        .signal("port_{}_other_version"),
];

const ROW: &[Field] = &[
    Field::word("a_m", 0, Format::Fixed(14), "length of the link").unit("m"),
    Field::word("d_m", 1, Format::Fixed(14), "offset along the joint's axis").unit("m"),
    Field::word("alpha_rad", 2, Format::Angle, "twist").unit("rad"),
    Field::word("theta_offset_rad", 3, Format::Angle, "what is added to the joint's position").unit("rad"),
];

/// A row of the robot's table.
const fn row(number: u8, name: &'static str, prefix: &'static str) -> Layout {
    Layout {
        number,
        name,
        prefix,
        fields: ROW,
        text: &[(
            ALWAYS,
            "a {a_m:4} m, d {d_m:4} m, alpha {alpha_rad:4} rad, theta offset {theta_offset_rad:4} rad",
        )],
    }
}

const IDENTITY: Layout = Layout {
    number: 0,
    name: "identity",
    prefix: "",
    fields: &[
        Field::bits("serial", 0, 32, "serial number"),
        Field::counter("identity_version", 2, "the protocol's version").signal("version"),
        Field::word("configuration", 3, Format::Hex, "configuration hash"),
        Field::word("state", 4, Format::State, "as in a heartbeat"),
    ],
    text: &[(ALWAYS, "serial {serial}, version {identity_version}, hash {configuration}, {state}")],
};
const MOUNT: Layout = Layout {
    number: 1,
    name: "mount",
    prefix: "mount_",
    fields: &[
        Field::word("joint", 0, Format::Signed, "joint k that moves the cell, 1 to joints")
            .within(1, IN_USE)
            .allowed("joints are 1 to 6"),
        Field::word("joints", 1, Format::Signed, "joints of the robot")
            .within(1, IN_USE)
            .allowed("joints are 1 to 6"),
    ],
    text: &[(ALWAYS, "joint {joint} of {joints}")],
};
const POSE: Layout = Layout {
    number: 2,
    name: "pose",
    prefix: "",
    fields: &[
        Field::word("position_m", 0, Format::Fixed(14), "position in frame k")
            .signal("pose")
            .unit("m")
            .each(AXES),
        Field::word("normal", 3, Format::Fixed(14), "outward normal, of length 1").each(AXES),
    ],
    text: &[(ALWAYS, "position {position_m:4} m, normal {normal:4}")],
};
const CONTACT: Layout = Layout {
    number: 3,
    name: "contact",
    prefix: "",
    fields: &[
        Field::word("alpha_c", 0, Format::Fixed(12), "weight of the contact force").checked_at_commit(),
        Field::word("alpha_p_n", 1, Format::Fixed(10), "weight of the proximity")
            .unit("N")
            .checked_at_commit(),
        Field::word("contact_threshold_n", 2, Format::Threshold(10), "F_c,th: forces below it count as none")
            .unit("N")
            .checked_at_commit(),
        Field::word(
            "proximity_threshold",
            3,
            Format::Threshold(14),
            "F_p,th: proximities below it count as none",
        )
        .checked_at_commit(),
        Field::word(
            "force_threshold_n",
            4,
            Format::Threshold(10),
            "F_z,th: fused forces below it count as none",
        )
        .unit("N")
        .checked_at_commit(),
    ],
    text: &[(
        ALWAYS,
        "alpha_c {alpha_c:4}, alpha_p {alpha_p_n:3} N, contact threshold {contact_threshold_n:3} N, proximity \
         threshold {proximity_threshold:4}, force threshold {force_threshold_n:3} N",
    )],
};
const TIMING: Layout = Layout {
    number: 4,
    name: "timing",
    prefix: "",
    fields: &[Field::counter("period_us", 0, "period of the joint broadcast")
        .unit("us")
        .within(1, u16::MAX)
        .allowed("a period is 1 to 65535 us")],
    text: &[(ALWAYS, "period {period_us} us")],
};
const MODE: Layout = Layout {
    number: 5,
    name: "mode",
    prefix: "",
    fields: &[Field::word("mode", 0, Format::Signed, "1: obey stimuli; else: measure")
        .names(&[(0, "measure"), (1, "obey stimuli")])
        .allowed("0 measures, 1 obeys stimuli")],
    text: &[(ALWAYS, "{mode}, {mode?measure|obey stimuli}")],
};
const REPLY: Layout = Layout {
    number: 6,
    name: "reply",
    prefix: "reply_",
    fields: &[
        Field::word("reply", 0, Format::Choice, "what joints are answered with")
            .signal("reply")
            .within(0, 1)
            .names(&[(0, "torque"), (1, "sum")])
            .allowed("torque is, and sum SLOT_US DEEPEST CARRY"),
        Field::counter("slot_us", 1, "width of a slot, not 0")
            .unit("us")
            .when(1, 1, Absent::Omitted)
            .allowed("it is 1 to 65535"),
        Field::word("deepest", 2, Format::Signed, "depth of the deepest cell")
            .within(0, 253)
            .when(1, 1, Absent::Omitted)
            .allowed("a depth is 0, a root's, to 253"),
        Field::word("carry", 3, Format::Flag(16), "1: carry what rounding took away")
            .within(0, 1)
            .when(1, 1, Absent::Omitted)
            .allowed("0 drops what rounding took away, 1 carries it"),
    ],
    text: &[
        ([0, 0], "torque"),
        ([1, 1], "sum, slot {slot_us} us, deepest {deepest}, {carry?no carry|carry}"),
    ],
};
const SENSING: Layout = Layout {
    number: 7,
    name: "sensing",
    prefix: "sensing_",
    fields: &[
        Field::word("sensing", 0, Format::Choice, "when a cell sends what it measures without being asked")
            .signal("sensing")
            .within(0, 2)
            .names(&[(0, "off"), (1, "continuous"), (2, "event")])
            .allowed("off and event are, and continuous PERIOD_MS"),
        Field::counter("period_ms", 1, "from one to the next, not 0 if continuous")
            .unit("ms")
            .when(1, 1, Absent::Omitted)
            .allowed("it is 1 to 65535"),
    ],
    text: &[(ALWAYS, "{sensing}"), ([1, 1], ", every {period_ms} ms")],
};
const EVENTS: Layout = Layout {
    number: 8,
    name: "events",
    prefix: "events_",
    fields: &[
        Field::word("contact_n", 0, Format::Fixed(10), "threshold of each contact word")
            .unit("N")
            .not_negative(),
        Field::word("proximity", 1, Format::Fixed(14), "of the proximity").not_negative(),
        Field::word("temperature_c", 2, Format::Fixed(6), "of each temperature").unit("°C").not_negative(),
        Field::word("acceleration_g", 3, Format::Fixed(12), "of each axis' acceleration")
            .unit("g")
            .not_negative(),
        Field::word("hysteresis", 4, Format::Fixed(14), "a part of each, for a release")
            .within(0, 1)
            .allowed("a part of the threshold is 0 to 1"),
    ],
    text: &[(
        ALWAYS,
        "contact {contact_n:3} N, proximity {proximity:4}, temperature {temperature_c:2} °C, acceleration \
         {acceleration_g:4} g, hysteresis {hysteresis:4}",
    )],
};
const CUTS: Layout = Layout {
    number: 9,
    name: "cuts",
    prefix: "",
    fields: &[Field::new("deaf_ports", 0, Format::Ports(5, 5), "bit p: port p hears nothing")
        .signal("cut_port_{}")
        .allowed("none is, or ports 0 to 3 and uplink with a plus between them: 0+2")],
    text: &[(ALWAYS, "deaf ports {deaf_ports}")],
};
const COMMIT: Layout = Layout {
    number: 127,
    name: "commit",
    prefix: "commit_",
    fields: &[Field::word("hash", 0, Format::Hex, "the hash that the staged copy must have")
        .allowed("a hash has up to 4 hexadecimal digits")],
    text: &[(ALWAYS, "hash {hash}")],
};
/// The answer of a cell that refuses.
pub const REFUSAL: Layout = Layout {
    number: REFUSED,
    name: "refusal",
    prefix: "",
    fields: &[
        Field::new("parameter", 0, Format::Parameter(16), "the parameter that was refused")
            .within(0, 127)
            .signal("refused_parameter"),
        Field::word("refusal", 1, Format::Reason, "why").signal("refused_reason"),
    ],
    text: &[(ALWAYS, "refuses {parameter}: {refusal}")],
};

/// What `configured` can answer: the parameters, by number, and a refusal.
const ANSWERS: &[Layout] = &[
    IDENTITY,
    MOUNT,
    POSE,
    CONTACT,
    TIMING,
    MODE,
    REPLY,
    SENSING,
    EVENTS,
    CUTS,
    row(16, "row1", "row1_"),
    row(17, "row2", "row2_"),
    row(18, "row3", "row3_"),
    row(19, "row4", "row4_"),
    row(20, "row5", "row5_"),
    row(21, "row6", "row6_"),
    COMMIT,
    REFUSAL,
];
/// The parameters, by number.
pub const PARAMETERS: &[Layout] = ANSWERS.split_at(ANSWERS.len() - 1).0;

/// Why a parameter was refused, by the number that stands for it.
pub const REASONS: &[(i16, &str)] = &[
    (1, "it cannot be written"),
    (2, "the robot's joints are not 1 to 6"),
    (3, "joint k is not 1 to the robot's joints"),
    (4, "the normal is not of length 1"),
    (5, "a gain or a threshold is below zero"),
    (6, "the period is 0"),
    (Answer::WRONG_HASH, "the hash is not that of the staged copy"),
    (Answer::FLASH_FAILED, "flash could not be written"),
    (Answer::UNKNOWN, "there is no such parameter"),
    (Answer::CANNOT_BE, "it cannot be that, or ports are cut outside test mode"),
];
