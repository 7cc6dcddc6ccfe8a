//! Checks that the schema file is consistent.

use super::*;
use crate::packet::{Epoch, MAX_WORDS};

/// Returns every layout, together with the fields of bytes 12 and 13 that are defined for it.
fn all() -> impl Iterator<Item = (&'static [Field], &'static Layout)> {
    let packets = packet_schemas()
        .iter()
        .flat_map(|schema| schema.layouts.iter().map(move |layout| (&schema.end[..], layout)));
    packets.chain(wire_layouts().iter().map(|layout| (&[][..], layout)))
}

#[test]
fn fields_stand_side_by_side_within_the_packet() {
    for (end, layout) in all() {
        let mut taken = [false; MAX_WORDS * 16 + 16];
        let real = |field: &&Field| !matches!(field.format, FieldFormat::Total(_));
        for field in end.iter().chain(&layout.fields).filter(real) {
            for element in 0..field.element_count() {
                // Epoch and count follow the sixth word.
                let at = field.first_bit() + (element + usize::from(element >= 6)) * 16;
                for bit in &mut taken[at..at + usize::from(field.bit_width())] {
                    assert!(!*bit, "{} {}", layout.name, field.name);
                    *bit = true;
                }
            }
        }
    }
}

#[test]
fn texts_name_fields_that_are_there() {
    let names = |text: &'static [TextAlternative]| {
        let name = |piece: &'static TextPiece| match piece {
            TextPiece::Literal(_) => None,
            TextPiece::Field { name, .. } | TextPiece::Either { name, .. } => Some(name.as_str()),
        };
        text.iter().flat_map(|part| &part.pieces).filter_map(name).collect::<Vec<_>>()
    };
    for (_, layout) in all() {
        for name in names(&layout.text) {
            assert!(layout.fields.iter().any(|field| field.name == name), "{}: {name}", layout.name);
        }
    }
    for schema in packet_schemas() {
        let fields = || schema.end.iter().chain(schema.layouts.iter().flat_map(|layout| &layout.fields));
        for name in names(&schema.text) {
            assert!(
                name.is_empty() || fields().any(|field| field.name == name),
                "{}: {name}",
                schema.kind.name()
            );
        }
    }
}

#[test]
fn whatever_is_a_message_has_a_layout() {
    for (bits, count) in (0..0x800).flat_map(|bits| (0..=u8::MAX).map(move |count| (bits, count))) {
        let packet = Packet { id: Id::from_bits(bits), words: Default::default(), epoch: Epoch(0), count };
        let Ok(message) = Message::decode(&packet) else { continue };
        let packet = message.encode();
        let layout = layout(&message, &packet);
        let says_nothing = matches!(packet.id.kind, Kind::Command | Kind::Configure);
        assert!(says_nothing || !layout.fields.is_empty(), "{bits:03X} {count}");
    }
}

#[test]
fn a_field_gives_its_bits_with_their_sign() {
    let bytes = [0x34, 0x12, 0xFF, 0xFF, 0x21];
    let raw = |text: &str, element| toml::from_str::<Field>(text).unwrap().raw_value(&bytes, element);
    assert_eq!(raw("word = 0", 0), 0x1234);
    assert_eq!(raw("word = 1", 0), 0xFFFF);
    assert_eq!(raw("format = { fixed = 8 }", 1), -1);
    assert_eq!(raw("format = { unsigned = 32 }", 0), 0xFFFF_1234);
    assert_eq!(raw("byte = 4\nbit = 1\nformat = { unsigned = 3 }", 0), 0);
    assert_eq!(raw("byte = 4\nbit = 5\nformat = { unsigned = 3 }", 0), 1);
    assert_eq!(raw("word = 7", 0), 0, "what is not there");
}

#[test]
fn names_are_of_fields_of_labels_and_of_units() {
    let field = |parameter: &str, place: usize| &find_parameter(parameter).unwrap().fields[place];
    assert_eq!(field("pose", 0).command_line_names(), ["x_m", "y_m", "z_m"]);
    assert_eq!(field("pose", 1).command_line_names(), ["normal_x", "normal_y", "normal_z"]);
    assert_eq!(field("timing", 0).command_line_names(), ["period_us"]);
    assert_eq!(field("pose", 0).signal_name("", "x"), "pose_x", "it has another name as a signal");
    assert_eq!(field("timing", 0).signal_name("timing_", ""), "timing_period", "the unit stands elsewhere");
    assert_eq!(field("mount", 0).signal_name("mount_", ""), "mount_joint");
    let port = toml::from_str::<Field>("name = \"node\"\nsignal = \"port_{}_leads_to\"").unwrap();
    assert_eq!(port.signal_name("", "2"), "port_2_leads_to");
}

#[test]
fn a_refusal_has_no_tag_and_no_parameter_beside_its_layout() {
    let schema = |kind| packet_schemas().iter().find(|schema| schema.kind == kind).unwrap();
    let configured = schema(Kind::Configured);
    let refusal = configured.layouts.iter().find(|layout| layout.number == REFUSAL_NUMBER).unwrap();
    assert_eq!(configured.trailing_fields(refusal), []);
    assert_eq!(configured.trailing_fields(parameter_layout(5, [0; WORDS])), configured.end);
    assert_eq!(schema(Kind::Configure).trailing_fields(refusal), schema(Kind::Configure).end);
}
