//! Writes the text of a DBC file.

use core::fmt::{self, Write};

use protocol::message::VERSION;
use protocol::skin::{Skin, SkinBus};

use super::signal::{Signal, SignalPage};
use super::{DbcMessage, DbcNode, SendSchedule, describes_packets};

/// The format's placeholder for an unnamed sender or receiver.
const UNNAMED_NODE: &str = "Vector__XXX";
/// The sections of the DBC format that the text may contain.
const DBC_SECTIONS: [&str; 6] = ["CM_", "BA_DEF_", "BA_", "VAL_", "BA_DEF_DEF_", "SIG_VALTYPE_"];
/// The values of `VFrameFormat`; the last but one is an FD frame with an 11-bit identifier.
const FRAME_FORMATS: [&str; 16] = [
    "StandardCAN",
    "ExtendedCAN",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "reserved",
    "StandardCAN_FD",
    "ExtendedCAN_FD",
];
const STANDARD_CAN_FD_FORMAT: u8 = 14;
/// The values of `GenMsgSendType`.
const SEND_TYPES: [&str; 3] = ["NoMsgSendType", "Cyclic", "CyclicIfActive"];

pub(super) fn write_dbc(
    out: &mut impl Write,
    skin: &Skin,
    index: usize,
    bus: &SkinBus,
    messages: &[DbcMessage],
) -> fmt::Result {
    writeln!(out, "VERSION \"{VERSION}\"\n\nNS_ :")?;
    for section in DBC_SECTIONS {
        writeln!(out, "\t{section}")?;
    }
    write!(out, "\nBS_:\n\nBU_: gateway")?;
    let mut cells: Vec<_> = skin.cells_on_bus(index).collect();
    cells.sort_unstable_by_key(|cell| cell.node);
    for cell in &cells {
        write!(out, " cell_{}", cell.node)?;
    }
    writeln!(out, "\n")?;
    let everyone: Vec<_> = cells.iter().map(|cell| cell.node.get()).collect();
    for message in messages {
        write_message(out, message, &everyone)?;
    }
    write_file_comment(out, skin, bus)?;
    for cell in &cells {
        let (serial, joint, hash) = (cell.serial, cell.joint, skin.parameters(cell).hash());
        let text = format!("Serial number {serial}, moved by joint {joint}, configuration hash {hash:04X}.");
        writeln!(out, "CM_ BU_ cell_{} \"{text}\";", cell.node)?;
    }
    for message in messages {
        writeln!(out, "CM_ BO_ {} \"{}\";", message.id.to_bits(), message.comment)?;
    }
    write_attributes(out, bus, messages)?;
    for message in messages {
        for signal in message.signals.iter().filter(|signal| !signal.names.is_empty()) {
            write!(out, "VAL_ {} {}", message.id.to_bits(), signal.name)?;
            for (value, name) in &signal.names {
                write!(out, " {value} \"{name}\"")?;
            }
            writeln!(out, " ;")?;
        }
    }
    Ok(())
}

/// Writes a message and its signals.
fn write_message(out: &mut impl Write, message: &DbcMessage, everyone: &[u8]) -> fmt::Result {
    let DbcMessage { id, name, from, .. } = message;
    write!(out, "BO_ {} {name}: {} ", id.to_bits(), message.length.bytes())?;
    write_nodes(out, *from, everyone)?;
    writeln!(out)?;
    for signal in &message.signals {
        let Signal { name, page, start, bits, signed, factor, range: [min, max], unit, names: _ } = signal;
        write!(out, " SG_ {name} ")?;
        match page {
            SignalPage::Every => {}
            SignalPage::Number => write!(out, "M ")?,
            SignalPage::Only(page) => write!(out, "m{page} ")?,
        }
        let sign = if *signed { '-' } else { '+' };
        // `@1` means little-endian.
        write!(out, ": {start}|{bits}@1{sign} ({factor},0) [{min}|{max}] \"{unit}\" ")?;
        write_nodes(out, message.to, everyone)?;
        writeln!(out)?;
    }
    writeln!(out)
}

fn write_nodes(out: &mut impl Write, party: DbcNode, everyone: &[u8]) -> fmt::Result {
    match party {
        DbcNode::Gateway => write!(out, "gateway"),
        DbcNode::Cell(node) => write!(out, "cell_{node}"),
        DbcNode::Unnamed => write!(out, "{UNNAMED_NODE}"),
        DbcNode::Cells if everyone.is_empty() => write!(out, "{UNNAMED_NODE}"),
        DbcNode::Cells => {
            for (index, node) in everyone.iter().enumerate() {
                write!(out, "{}cell_{node}", if index == 0 { "" } else { "," })?;
            }
            Ok(())
        }
    }
}

/// Writes the comment on the whole file: its skin, bus and limits.
fn write_file_comment(out: &mut impl Write, skin: &Skin, bus: &SkinBus) -> fmt::Result {
    // A quotation mark would end the comment.
    let [skin, bus_name] = [&skin.name, &bus.name].map(|name| name.replace('"', "'"));
    let travels = if describes_packets(bus) {
        "Classic: a packet travels in frames of up to 8 bytes under one identifier; this file describes the joined \
         bytes, which no single frame on the bus contains."
    } else {
        "A packet is one CAN FD frame with bit-rate switch."
    };
    writeln!(
        out,
        "CM_ \"Skin {skin}, bus {bus_name}, protocol version {VERSION}. {travels} The crc is CRC-16/CCITT-FALSE over \
         the identifier (2 bytes, little-endian) and all bytes before it. Epochs and counters wrap.\";"
    )
}

fn write_attributes(out: &mut impl Write, bus: &SkinBus, messages: &[DbcMessage]) -> fmt::Result {
    let choices =
        |names: &[&str]| names.iter().map(|name| format!("\"{name}\"")).collect::<Vec<_>>().join(",");
    writeln!(out, "BA_DEF_ \"BusType\" STRING ;")?;
    writeln!(out, "BA_DEF_ \"DBName\" STRING ;")?;
    let rates = [("Baudrate", bus.bitrate), ("BaudrateCANFD", bus.data_bitrate)];
    let rates = rates.into_iter().filter_map(|(name, rate)| Some((name, rate?)));
    for (name, _) in rates.clone() {
        writeln!(out, "BA_DEF_ \"{name}\" INT 0 20000000;")?;
    }
    writeln!(out, "BA_DEF_ BO_ \"VFrameFormat\" ENUM {};", choices(&FRAME_FORMATS))?;
    writeln!(out, "BA_DEF_ BO_ \"CANFD_BRS\" ENUM \"0\",\"1\";")?;
    writeln!(out, "BA_DEF_ BO_ \"GenMsgSendType\" ENUM {};", choices(&SEND_TYPES))?;
    writeln!(out, "BA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 65535;")?;
    writeln!(out, "BA_DEF_DEF_ \"BusType\" \"CAN FD\";")?;
    writeln!(out, "BA_DEF_DEF_ \"DBName\" \"\";")?;
    for (name, _) in rates.clone() {
        writeln!(out, "BA_DEF_DEF_ \"{name}\" 0;")?;
    }
    writeln!(out, "BA_DEF_DEF_ \"VFrameFormat\" \"StandardCAN_FD\";")?;
    writeln!(out, "BA_DEF_DEF_ \"CANFD_BRS\" \"1\";")?;
    writeln!(out, "BA_DEF_DEF_ \"GenMsgSendType\" \"NoMsgSendType\";")?;
    writeln!(out, "BA_DEF_DEF_ \"GenMsgCycleTime\" 0;")?;
    writeln!(out, "BA_ \"BusType\" \"CAN FD\";")?;
    writeln!(out, "BA_ \"DBName\" \"{}\";", bus.name.replace('"', "'"))?;
    for (name, rate) in rates {
        writeln!(out, "BA_ \"{name}\" {rate};")?;
    }
    for message in messages {
        let id = message.id.to_bits();
        writeln!(out, "BA_ \"VFrameFormat\" BO_ {id} {STANDARD_CAN_FD_FORMAT};")?;
        writeln!(out, "BA_ \"CANFD_BRS\" BO_ {id} 1;")?;
        let (kind, ms) = match message.rhythm {
            SendSchedule::OnEvent => continue,
            SendSchedule::Cyclic(ms) => (1, ms),
            SendSchedule::WhileActive(ms) => (2, ms),
        };
        writeln!(out, "BA_ \"GenMsgSendType\" BO_ {id} {kind};")?;
        writeln!(out, "BA_ \"GenMsgCycleTime\" BO_ {id} {ms};")?;
    }
    Ok(())
}
