//! Checks of names in a skin file. Names appear on terminals and in URDF, SVG and topics, so they must not contain
//! characters that mislead a reader or break these formats.

use super::raw;
use crate::document::{Checked, KeyPath};
use crate::usage::{is_unprintable, printable};

/// Maximum length of a name in characters.
const MAX_CHARACTERS: usize = 200;

/// Checks all names of a skin. Returns an error for a name that is empty, too long, or contains characters that control
/// a terminal, change the direction of text, or are not allowed in XML.
pub(super) fn check_names(skin: &raw::RawSkin) -> Checked<()> {
    let robot = KeyPath::top_level_key("robot");
    for (at, given) in
        [(KeyPath::top_level_key("name"), &skin.name), (robot.with_key("name"), &skin.robot.name)]
    {
        if given.is_empty() {
            return Err(at.fault("\"\"", "a name must have at least one character"));
        }
        check_name(&at, given)?;
    }
    for (index, joint) in skin.robot.joint.iter().enumerate() {
        check_name(&robot.with_key("joint").with_index(index).with_key("name"), &joint.name)?;
    }
    for (index, chain) in skin.robot.chain.iter().enumerate() {
        check_name(&robot.with_key("chain").with_index(index).with_key("name"), &chain.name)?;
    }
    Ok(())
}

fn check_name(at: &KeyPath, name: &str) -> Checked<()> {
    let count = name.chars().count();
    if count > MAX_CHARACTERS {
        return Err(at.fault(
            format!("{count} characters"),
            format!("a name can have at most {MAX_CHARACTERS} characters"),
        ));
    }
    if let Some(character) = name.chars().find(|&character| is_unprintable(character)) {
        let value = format!("\"{}\"", printable(name));
        let why = format!("U+{:04X} is not a printable character: remove it", u32::from(character));
        return Err(at.fault(value, why));
    }
    Ok(())
}

/// Escapes unprintable characters in names like `\u{1b}`, so that every recording can be read. Names that differ also
/// differ after escaping.
pub(super) fn escape_names(skin: &mut raw::RawSkin) {
    let robot = &mut skin.robot;
    let named = [&mut skin.name, &mut robot.name].into_iter();
    let joints = robot.joint.iter_mut().map(|joint| &mut joint.name);
    let chains = robot.chain.iter_mut().flat_map(|chain| {
        let rows = chain.rows.iter_mut().filter_map(|row| row.joint.as_mut());
        rows.chain([&mut chain.name])
    });
    let buses = skin.bus.iter_mut().filter_map(|bus| bus.chain.as_mut());
    for name in named.chain(joints).chain(chains).chain(buses) {
        *name = printable(name).into_owned();
    }
}
