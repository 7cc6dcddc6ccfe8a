//! Benches with several buses, some of them with CAN FD and some with classic frames.

use protocol::can::Format;
use protocol::candump::{CandumpLine, parse};

/// Returns the skin with classic frames on these buses.
pub fn mixed_skin(skin: &str, classic: &[&str]) -> String {
    let mut text = skin.to_owned();
    for bus in classic {
        let table = format!("name = \"{bus}\"");
        let from = text.find(&table).unwrap_or_else(|| panic!("no {table} in {skin}"));
        let (before, after) = text.split_at(from);
        text = before.to_owned() + &after.replacen("format = \"fd\"", "format = \"classic\"", 1);
    }
    text
}

/// Returns true if a log has torques of a bus, in frames of its format only.
pub fn carries(log: &str, bus: &str, format: Format) -> bool {
    let frames = log.lines().filter_map(|line| match parse(line) {
        Ok(CandumpLine::Frame(record)) if record.interface == bus => Some(record.frame),
        _ => None,
    });
    let frames: Vec<_> = frames.collect();
    let torques = frames.iter().filter(|frame| (0x201..0x300).contains(&frame.id()));
    frames.iter().all(|frame| frame.format() == format) && torques.count() > 0
}
