//! Checks of the buses in a skin file.

use std::collections::HashSet;

use super::{BusTime, JointKind, Robot, SkinBus, SkinReply, raw, sensing};
use crate::can::Format;
use crate::document::{Checked, KeyPath};
use crate::fixed::TorqueFormat;
use crate::wire_time::BitRates;

/// Maximum number of buses in a skin.
const MAX_BUSES: usize = 64;

pub(super) fn check_buses(raw: &[raw::RawBus], robot: &Robot) -> Checked<Vec<SkinBus>> {
    if raw.is_empty() {
        return Err(KeyPath::top_level_key("bus").fault("[]", "a skin must have at least one bus"));
    }
    if raw.len() > MAX_BUSES {
        let why = format!("a skin can have at most {MAX_BUSES} buses");
        return Err(KeyPath::top_level_key("bus").fault(format!("{} buses", raw.len()), why));
    }
    let mut seen = HashSet::new();
    let bus = |(index, bus): (usize, &raw::RawBus)| {
        let at = KeyPath::top_level_key("bus").with_index(index);
        let name = bus.name.clone();
        if !crate::bus::is_plain_name(&name) || name.starts_with('.') {
            let why = "a bus name must have 1 to 15 letters, digits, `-`, `_` or `.`";
            return Err(at.with_key("name").fault(format_args!("{name:?}"), why));
        }
        if !seen.insert(name.clone()) {
            let why = "another bus already has this name";
            return Err(at.with_key("name").fault(format_args!("{name:?}"), why));
        }
        let reply = check_reply(&at, bus)?;
        let format = at
            .with_key("format")
            .parse_choice(&bus.format, &[("fd", Format::Fd), ("classic", Format::Classic)])?;
        let (bitrate, data_bitrate) = check_bit_rates(&at, bus, format)?;
        let time = check_time(&at, bus)?;
        let chain = chain_index(&at, bus, robot)?;
        let torque_format = torque_format(&at, bus, robot, chain)?;
        let sensing = sensing::bus_sensing(&at, bus)?;
        Ok(SkinBus { name, reply, format, chain, torque_format, bitrate, data_bitrate, sensing, time })
    };
    raw.iter().enumerate().map(bus).collect()
}

/// Returns the index of the chain that carries a bus. The file may omit the name if there is only one chain.
fn chain_index(at: &KeyPath, bus: &raw::RawBus, robot: &Robot) -> Checked<usize> {
    let names =
        || robot.chains.iter().map(|chain| format!("{:?}", chain.name)).collect::<Vec<_>>().join(", ");
    let at = at.with_key("chain");
    match &bus.chain {
        Some(name) => robot.chains.iter().position(|chain| chain.name == *name).ok_or_else(|| {
            let why = format!("the robot has no such chain; its chains are {}", names());
            at.fault(format_args!("{name:?}"), why)
        }),
        None if robot.chains.len() == 1 => Ok(0),
        None => Err(at.fault("", format_args!("must name the chain of this bus: one of {}", names()))),
    }
}

/// Returns the torque format of a bus. The default is Q3.12, the finest, but Q5.10 for a chain with prismatic joints,
/// because forces exceed the range of 8 N.
fn torque_format(at: &KeyPath, bus: &raw::RawBus, robot: &Robot, chain: usize) -> Checked<TorqueFormat> {
    if let Some(name) = &bus.torque_format {
        let formats = TorqueFormat::ALL.map(|format| (format.name(), format));
        return at.with_key("torque_format").parse_choice(name, &formats);
    }
    let joints = robot.chains.get(chain).map_or(&[][..], |chain| &chain.joints);
    let slides = |&joint: &usize| robot.joints.get(joint).is_some_and(|it| it.kind == JointKind::Prismatic);
    Ok(if joints.iter().any(slides) { TorqueFormat::Q5_10 } else { TorqueFormat::Q3_12 })
}

/// Checks the reply of the cells of a bus to joints.
fn check_reply(at: &KeyPath, bus: &raw::RawBus) -> Checked<SkinReply> {
    let sums = at.with_key("reply").parse_choice(&bus.reply, &[("torque", false), ("sum", true)])?;
    let only_sum = "allowed only with reply = \"sum\"";
    match (sums, bus.slot_us, bus.carry) {
        (false, None, None) => Ok(SkinReply::Torque),
        (false, Some(got), _) => Err(at.with_key("slot_us").fault(got, only_sum)),
        (false, None, Some(got)) => Err(at.with_key("carry").fault(got, only_sum)),
        (true, Some(got), carry) => match u32::try_from(got) {
            Ok(slot_us @ 1..) => Ok(SkinReply::Sum { slot_us, carry: carry.unwrap_or(true) }),
            Ok(0) | Err(_) => Err(at.with_key("slot_us").fault(got, "must be above 0")),
        },
        (true, None, _) => Err(at.with_key("reply").fault("\"sum\"", "this reply needs the key slot_us too")),
    }
}

/// Checks whether frames take time on the bus, for which it must have a bit rate.
fn check_time(at: &KeyPath, bus: &raw::RawBus) -> Checked<BusTime> {
    let Some(time) = &bus.time else { return Ok(BusTime::None) };
    let at = at.with_key("time");
    let time = at.parse_choice(time, &[("none", BusTime::None), ("real", BusTime::Real)])?;
    if time == BusTime::Real && bus.bitrate.is_none() {
        return Err(at.fault("\"real\"", "this bus needs the key bitrate too"));
    }
    Ok(time)
}

/// Checks the nominal and data bit rates of a bus, which are optional and only needed for real hardware.
fn check_bit_rates(at: &KeyPath, bus: &raw::RawBus, format: Format) -> Checked<(Option<u32>, Option<u32>)> {
    let within = |key, got, min, max| at.with_key(key).check_range(got, min..=max, " bit/s");
    let (min, max) = (BitRates::MIN_NOMINAL_BIT_RATE, BitRates::MAX_NOMINAL_BIT_RATE);
    let bitrate = bus.bitrate.map(|got| within("bitrate", got, min, max)).transpose()?;
    let data_bitrate = match (bus.data_bitrate, format, bitrate) {
        (None, _, _) => None,
        (Some(got), Format::Classic, _) => {
            return Err(at.with_key("data_bitrate").fault(got, "allowed only with format = \"fd\""));
        }
        (Some(got), Format::Fd, None) => {
            return Err(at.with_key("data_bitrate").fault(got, "allowed only together with bitrate"));
        }
        (Some(got), Format::Fd, Some(min)) => {
            Some(within("data_bitrate", got, min, BitRates::MAX_DATA_BIT_RATE)?)
        }
    };
    Ok((bitrate, data_bitrate))
}
