//! Reads the text with another parser, and compares it with the protocol's own encoding.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use can_dbc::{AttributeValue, ByteOrder, Dbc, MessageId, MultiplexIndicator, ValueDescription, ValueType};
use proptest::prelude::*;
use protocol::message::Message;
use protocol::packet::{Epoch, Packet, WORDS, Words};

mod said;

use super::*;
use model::generate::{self, SkinRequest};

/// The skin with cells 1 to 254 on its only bus.
static FULL_SKIN: LazyLock<Skin> = LazyLock::new(|| {
    let target = SkinRequest { cells: 254, ..SkinRequest::default() };
    Skin::parse("full.toml", &generate::generate(&target).unwrap()).unwrap()
});

/// Its DBC, which takes seconds to parse.
static FULL: LazyLock<Dbc> = LazyLock::new(|| parsed(&FULL_SKIN, 0));

fn parsed(skin: &Skin, bus: usize) -> Dbc {
    Dbc::try_from(dbc_text(skin, bus).as_str()).unwrap()
}

/// Decodes a frame by the DBC alone: the message's name, and the value of each signal that is present.
fn by_dbc(dbc: &can_dbc::Message, bytes: &[u8]) -> (String, BTreeMap<String, f64>) {
    let raw = |signal: &can_dbc::Signal| {
        assert_eq!(signal.byte_order, ByteOrder::LittleEndian);
        let start = usize::try_from(signal.start_bit).unwrap();
        let there = bytes[start / 8..].iter().take(5).rev();
        let whole = there.fold(0_i64, |whole, &byte| whole << 8 | i64::from(byte));
        let bits = (whole >> (start % 8)) & ((1 << signal.size) - 1);
        let negative = signal.value_type == ValueType::Signed && bits >> (signal.size - 1) == 1;
        if negative { bits - (1 << signal.size) } else { bits }
    };
    let switch =
        dbc.signals.iter().find(|signal| signal.multiplexer_indicator == MultiplexIndicator::Multiplexor);
    let page = switch.map(&raw);
    let mut values = BTreeMap::new();
    for signal in &dbc.signals {
        let there = match signal.multiplexer_indicator {
            MultiplexIndicator::Plain | MultiplexIndicator::Multiplexor => true,
            MultiplexIndicator::MultiplexedSignal(on) => page == Some(i64::try_from(on).unwrap()),
            MultiplexIndicator::MultiplexorAndMultiplexedSignal(_) => panic!("one level only"),
        };
        if there {
            #[expect(clippy::cast_precision_loss, reason = "at most 32 bits")]
            let value = raw(signal) as f64 * signal.factor + signal.offset;
            assert!(values.insert(signal.name.clone(), value).is_none(), "{} twice", signal.name);
        }
    }
    (dbc.name.clone(), values)
}

/// Returns the messages of the DBC by identifier.
fn by_id(dbc: &Dbc) -> BTreeMap<u16, &can_dbc::Message> {
    let id = |message: &can_dbc::Message| match message.id {
        MessageId::Standard(id) => id,
        MessageId::Extended(id) => panic!("{id:X} has 29 bits"),
    };
    let all: BTreeMap<_, _> = dbc.messages.iter().map(|message| (id(message), message)).collect();
    assert_eq!(all.len(), dbc.messages.len(), "no identifier twice");
    all
}

#[test]
fn every_message_says_through_the_dbc_what_the_protocol_says() {
    let messages = by_id(&FULL);
    let mut met: BTreeSet<(u16, String)> = BTreeSet::new();
    let counts = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 16, 17, 18, 19, 20, 21, 99, 126, 127];
    let counts = counts.into_iter().flat_map(|count: u8| [count, count + 128]);
    // Small words select a baseline.
    let counts = counts.chain([10, 200, 255, 139, 139, 139]);
    // Joints have one identifier of 2048; give them the same weight as the cells.
    let node = prop_oneof![1 => Just(1_u16), 1 => Just(0xFF), 6 => 0_u16..0x100];
    let cases = (
        (0_u16..8, node).prop_map(|(kind, node)| kind << 8 | node),
        // The kinds of rows are small numbers.
        proptest::array::uniform::<_, WORDS>(prop_oneof![any::<i16>(), 0_i16..4]),
        any::<u8>(),
        proptest::sample::select(counts.collect::<Vec<_>>()),
    );
    let config = ProptestConfig { cases: 40_000, failure_persistence: None, ..ProptestConfig::default() };
    let met = std::cell::RefCell::new(&mut met);
    proptest!(config, |((id, words, epoch, count) in cases)| {
        let packet = Packet { id: Id::from_bits(id), words: words.into(), epoch: Epoch(epoch), count };
        let Ok(message) = Message::decode(&packet) else { return Ok(()) };
        let packet = message.encode();
        let (name, expected) = said::by_protocol(&message, &packet);
        let (named, found) = by_dbc(messages[&id], &packet.encode());
        prop_assert_eq!(named, name);
        prop_assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
        for (signal, value) in &found {
            // The conversion of angles multiplies by pi in another order.
            prop_assert!((value - expected[signal]).abs() < 1e-15, "{}: {} and {}", signal, value, expected[signal]);
            met.borrow_mut().insert((id >> 8, signal.clone()));
        }
    });
    let there: BTreeSet<_> = messages
        .iter()
        .flat_map(|(id, message)| message.signals.iter().map(move |signal| (id >> 8, signal.name.clone())))
        .collect();
    let met = met.into_inner();
    assert_eq!(there.difference(met).collect::<Vec<_>>(), Vec::<&(u16, String)>::new(), "never compared");
}

#[test]
fn every_identifier_of_the_bus_is_there_and_no_other() {
    let messages = by_id(&FULL);
    for id in 0..0x800 {
        let packet =
            |count| Packet { id: Id::from_bits(id), words: Words::default(), epoch: Epoch(0), count };
        let said = (0..=1).any(|count| Message::decode(&packet(count)).is_ok());
        assert_eq!(messages.contains_key(&id), said, "{id:03X}");
    }
    for message in messages.values() {
        assert_eq!(message.size, 16, "{}", message.name);
    }
    let names: BTreeSet<_> = FULL.messages.iter().map(|message| &message.name).collect();
    assert_eq!(names.len(), FULL.messages.len(), "no name twice");
}

#[test]
fn cells_of_the_bus_alone_are_named_and_send_what_is_theirs() {
    let dbc = parsed(&model::testing::one_cell_skin(), 0);
    let names: Vec<_> = dbc.nodes.iter().map(|node| node.0.as_str()).collect();
    assert_eq!(names, ["gateway", "cell_1"]);
    let messages: Vec<_> = dbc
        .messages
        .iter()
        .map(|message| {
            let receivers: BTreeSet<_> =
                message.signals.iter().flat_map(|signal| &signal.receivers).collect();
            let receivers: Vec<_> = receivers.into_iter().map(String::as_str).collect();
            (message.name.as_str(), message.transmitter.as_deref().unwrap_or("-"), receivers.join(" "))
        })
        .collect();
    let expected = [
        // No node of the skin receives it: can-dbc returns no receiver.
        ("halt", "gateway", "cell_1"),
        ("joints", "gateway", "cell_1"),
        ("sync", "gateway", "cell_1"),
        ("resume", "gateway", "cell_1"),
        ("report", "gateway", "cell_1"),
        ("sum_1", "cell_1", "gateway"),
        ("torque_1", "cell_1", "gateway"),
        ("sensors_1", "cell_1", "gateway"),
        ("network_gateway", "gateway", ""),
        ("network_1", "cell_1", "gateway"),
        ("configure_1", "gateway", "cell_1"),
        ("configure_everyone", "gateway", "cell_1"),
        ("configured_1", "cell_1", "gateway"),
        ("stimulus_1", "gateway", "cell_1"),
        ("stimulus_everyone", "gateway", "cell_1"),
    ];
    assert_eq!(messages, expected.map(|(name, from, to)| (name, from, to.to_owned())));
}

#[test]
fn words_have_names_units_and_ranges() {
    let dbc = parsed(&model::testing::one_cell_skin(), 0);
    let signal = |id: u16, name: &str| {
        let signal = dbc.signal_by_name(MessageId::Standard(id), name).unwrap();
        let names = dbc.value_descriptions.iter().find_map(|described| {
            let ValueDescription::Signal {
                message_id: MessageId::Standard(of),
                name: signal,
                value_descriptions,
            } = described
            else {
                return None;
            };
            let names =
                || value_descriptions.iter().map(|value| (value.id, value.description.as_str())).collect();
            (*of == id && signal == name).then(names)
        });
        let limit = |value: can_dbc::NumericValue| match value {
            can_dbc::NumericValue::Uint(value) => value.to_string(),
            can_dbc::NumericValue::Int(value) => value.to_string(),
            can_dbc::NumericValue::Double(value) => value.to_string(),
        };
        let range = format!("{} to {} {}", limit(signal.min), limit(signal.max), signal.unit);
        (range, names.unwrap_or_else(Vec::new))
    };
    let saturated = vec![(32_767, "saturated"), (-32_768, "saturated")];
    assert_eq!(signal(0x201, "torque_6"), ("-8 to 7.999755859375 Nm".to_owned(), saturated.clone()));
    assert_eq!(signal(0x101, "sum_1"), ("-128 to 127.99609375 Nm".to_owned(), saturated));
    let angle = "-3.141592653589793 to 3.1414967797905504 rad";
    assert_eq!(signal(0x001, "position_1"), (angle.to_owned(), vec![]));
    assert_eq!(signal(0x001, "count"), ("1 to 14 ".to_owned(), vec![]));
    assert_eq!(signal(0x301, "proximity"), ("0 to 1 ".to_owned(), vec![]));
    assert_eq!(signal(0x301, "temperature_2"), ("-512 to 511.984375 degC".to_owned(), vec![]));
    assert_eq!(signal(0x301, "page").1, [(0, "skin"), (1, "acceleration"), (3, "baseline")]);
    assert_eq!(signal(0x701, "from_next").1, [(0, "from this epoch on"), (1, "from the next joints on")]);
    assert_eq!(signal(0x501, "parameter").1.len(), 19);
    assert_eq!(signal(0x401, "parent"), ("0 to 255 ".to_owned(), vec![(0, "gateway"), (255, "unreachable")]));
    assert_eq!(signal(0x501, "events_temperature"), ("0 to 511.984375 degC".to_owned(), vec![]));
    let refusal = signal(0x601, "parameter").1;
    assert_eq!(refusal.last(), Some(&(126, "refusal")));
    assert!(signal(0x601, "refused_reason").1.contains(&(16, "the hash is not that of the staged copy")));
}

#[test]
fn frames_are_fd_with_their_rhythm_and_bit_rates_where_they_are_known() {
    let text = model::testing::ONE_CELL_SKIN_TOML
        .replace("\"fd\"", "\"fd\"\nbitrate = 1000000\ndata_bitrate = 5000000");
    let skin = Skin::parse("rates.toml", &text).unwrap();
    let dbc = parsed(&skin, 0);
    let of = |name: &str, id: u16| {
        let values = dbc.attribute_values_message.iter();
        let mut values =
            values.filter(|value| value.name == name && value.message_id == MessageId::Standard(id));
        let value = values.next().map(|value| value.value.clone());
        assert_eq!(values.next(), None);
        value
    };
    let number = |value| Some(AttributeValue::Uint(value));
    for message in &dbc.messages {
        let MessageId::Standard(id) = message.id else { panic!("29 bits") };
        assert_eq!((of("VFrameFormat", id), of("CANFD_BRS", id)), (number(14), number(1)));
    }
    assert_eq!((of("GenMsgCycleTime", 0x001), of("GenMsgSendType", 0x001)), (number(16), number(1)));
    assert_eq!((of("GenMsgCycleTime", 0x201), of("GenMsgSendType", 0x201)), (number(16), number(2)));
    assert_eq!((of("GenMsgCycleTime", 0x401), of("GenMsgSendType", 0x401)), (number(250), number(1)));
    assert_eq!((of("GenMsgCycleTime", 0x501), of("GenMsgSendType", 0x501)), (None, None));
    let whole: BTreeMap<_, _> = dbc
        .attribute_values_database
        .iter()
        .map(|value| (value.name.as_str(), value.value.clone()))
        .collect();
    assert_eq!(whole["DBName"], AttributeValue::String("vcan0".to_owned()));
    assert_eq!(whole["Baudrate"], AttributeValue::Uint(1_000_000));
    assert_eq!(whole["BaudrateCANFD"], AttributeValue::Uint(5_000_000));
}

#[test]
fn what_the_file_and_its_nodes_are_stands_in_comments() {
    let skin = model::testing::one_cell_skin();
    let dbc = parsed(&skin, 0);
    let hash = skin.parameters(&skin.cells[0]).hash();
    let serial = skin.cells[0].serial;
    let cell = dbc.comments.iter().find_map(|comment| {
        if let can_dbc::Comment::Node { name, comment } = comment {
            Some((name.as_str(), comment))
        } else {
            None
        }
    });
    let expected = format!("Serial number {serial}, moved by joint 3, configuration hash {hash:04X}.");
    assert_eq!(cell, Some(("cell_1", &expected)));
    let whole = dbc.comments.iter().find_map(|comment| {
        if let can_dbc::Comment::Plain { comment } = comment { Some(comment) } else { None }
    });
    let begin = "Skin bare, bus vcan0, protocol version 1. A packet is one CAN FD frame";
    assert!(whole.unwrap().starts_with(begin), "{whole:?}");
    for message in &dbc.messages {
        assert!(
            dbc.message_comment(message.id).is_some_and(|comment| comment.ends_with('.')),
            "{}",
            message.name
        );
    }
}

#[test]
fn each_bus_has_its_own_cells_and_one_that_is_not_has_no_text() {
    let target = SkinRequest { cells: 20, buses: 2, ..SkinRequest::default() };
    let skin = Skin::parse("two.toml", &generate::generate(&target).unwrap()).unwrap();
    for bus in 0..2 {
        let cells: BTreeSet<_> = skin.cells_on_bus(bus).map(|cell| format!("cell_{}", cell.node)).collect();
        let nodes: BTreeSet<_> = parsed(&skin, bus).nodes.into_iter().skip(1).map(|node| node.0).collect();
        assert_eq!(nodes, cells);
    }
    assert_eq!(dbc_text(&skin, 2), "");
}

#[test]
fn the_text_is_plain() {
    // Readers differ in the non-ASCII bytes that they accept, and most limit names to 32 characters.
    let text = dbc_text(&FULL_SKIN, 0);
    assert!(text.is_ascii());
    let names = text
        .lines()
        .filter_map(|line| line.trim().strip_prefix("SG_ ").or_else(|| line.strip_prefix("BO_ ")));
    for name in names {
        assert!(name.split(' ').all(|word| word.len() <= 32 || word.contains(['(', '[', ','])), "{name}");
    }
}
