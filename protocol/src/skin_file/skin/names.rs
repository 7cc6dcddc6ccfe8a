//! Checks of names in a skin file. Names appear on terminals and in URDF, SVG and topics, and must not be
//! misleading there.

use super::raw;
use crate::document::{Checked, Place};
use crate::usage::{is_unprintable, shown};

/// Maximum length of a name in characters.
const MAX_CHARACTERS: usize = 200;

/// Refuses names that are empty, too long, or contain characters that control a terminal, change the
/// direction of text, or are not allowed in XML.
pub(super) fn check(skin: &raw::Skin) -> Checked<()> {
    let robot = Place::named("robot");
    for (at, given) in [(Place::named("name"), &skin.name), (robot.key("name"), &skin.robot.name)] {
        if given.is_empty() {
            return Err(at.fault("\"\"", "a name has at least one character"));
        }
        name(&at, given)?;
    }
    for (index, joint) in skin.robot.joint.iter().enumerate() {
        name(&robot.key("joint").nth(index).key("name"), &joint.name)?;
    }
    for (index, chain) in skin.robot.chain.iter().enumerate() {
        name(&robot.key("chain").nth(index).key("name"), &chain.name)?;
    }
    Ok(())
}

fn name(at: &Place, name: &str) -> Checked<()> {
    let count = name.chars().count();
    if count > MAX_CHARACTERS {
        return Err(at.fault(format!("{count} characters"), format!("a name has at most {MAX_CHARACTERS}")));
    }
    if let Some(character) = name.chars().find(|&character| is_unprintable(character)) {
        let value = format!("\"{}\"", shown(name));
        let why = format!("U+{:04X} is not a printable character: remove it", u32::from(character));
        return Err(at.fault(value, why));
    }
    Ok(())
}

/// Escapes unprintable characters in names like `\u{1b}`, so that every recording can be read. Different
/// names stay different.
pub(super) fn escape(skin: &mut raw::Skin) {
    let robot = &mut skin.robot;
    let named = [&mut skin.name, &mut robot.name].into_iter();
    let joints = robot.joint.iter_mut().map(|joint| &mut joint.name);
    let chains = robot.chain.iter_mut().flat_map(|chain| {
        let rows = chain.rows.iter_mut().filter_map(|row| row.joint.as_mut());
        rows.chain([&mut chain.name])
    });
    let buses = skin.bus.iter_mut().filter_map(|bus| bus.chain.as_mut());
    for name in named.chain(joints).chain(chains).chain(buses) {
        *name = shown(name).into_owned();
    }
}
