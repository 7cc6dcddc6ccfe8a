//! The state that a commit, a resume and a write of the mode leave unchanged.

use protocol::id::Node;
use protocol::message::{From, Message, SensorPage};
use protocol::packet::{Epoch, words};
use protocol::parameters::{MAX_JOINTS, Parameter, Parameters};

use crate::arm;
use crate::bus::Stop;
use crate::session::{Reply, Session};

const POSITIONS: [i16; MAX_JOINTS] =
    [0x0200, -0x1100, 0x0700, -0x0300, 0x1900, 0x0100, 0, 0, 0, 0, 0, 0, 0, 0];
const HELD: i32 = 4_444;
const LATER: i32 = 5_555;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), Stop> {
    if !session.ready(&arm::document(6))? {
        return Ok(());
    }
    commit(session)?;
    resume(session)?;
    mode(session)?;
    session.ready(&arm::document(6))?;
    Ok(())
}

/// Puts the cell in contact with a pending stimulus, and returns the epoch of that stimulus.
fn touched(session: &mut Session<'_>) -> Result<u8, Stop> {
    session.pressed(&POSITIONS, arm::press(HELD))?;
    let later = session.known.last_epoch.wrapping_add(20);
    let to = Node::Cell(session.cell);
    let page = SensorPage::Skin(arm::press(LATER));
    session.say(&[Message::Stimulus { to, from: From::Epoch(Epoch(later)), page }])?;
    Ok(later)
}

/// Checks that the latched and the pending stimulus are still there.
fn is_touched(session: &mut Session<'_>, later: u8, id: &'static str, what: &str) -> Result<(), Stop> {
    let is_there = session.step(&POSITIONS)?.torque.is_some();
    session.check(id, is_there, || format!("{what} forgot the stimulus that was latched"));
    session.known.skin = Some(arm::press(LATER));
    session.step_at(later, &POSITIONS)?;
    let skin = session.latched()?;
    session.check(id, skin == Some(arm::press(LATER)), || {
        format!("{what} forgot a stimulus that was pending: {} is latched", arm::skin(skin))
    });
    Ok(())
}

fn commit(session: &mut Session<'_>) -> Result<(), Stop> {
    let later = touched(session)?;
    let events = [101, 102, 103, 104, 105, 0];
    let (sensing, thresholds) = (Parameter::Sensing.number(), Parameter::Events.number());
    if session.about.sensing {
        session.known.senses = true;
        session.write(thresholds, events)?;
        // Only the two pages of the switch come meanwhile.
        session.set(sensing, [1, i16::MAX])?;
        session.settle()?;
    }
    let before = session.counters()?;
    session.commit(&Parameters { period_us: 47_250, ..arm::document(6) })?;
    // The cell stays in contact until the next joints.
    session.exchange_all(&[])?;
    let after = session.counters()?;
    session
        .check("CONF-7", before == after, || format!("a commit changed counters: {after}; before: {before}"));
    if session.about.sensing {
        for (number, expected) in [(thresholds, events), (sensing, words([1, i16::MAX]))] {
            let reply = session.read(number)?;
            session.check("CONF-7", reply == Reply::Value(expected), || {
                format!("a commit changed parameter {number} to {reply}")
            });
        }
        session.set(sensing, [0])?;
        session.write(thresholds, protocol::parameters::Events::default().words())?;
        session.settle()?;
        session.known.senses = false;
    }
    // The epoch does not begin again either.
    let joints = session.joints(session.known.last_epoch, &POSITIONS);
    let again = session.exchange_all(&[joints])?;
    session.check("CONF-7", again.is_silent(), || {
        "after a commit the last joints are answered again".to_owned()
    });
    is_touched(session, later, "CONF-7", "a commit")?;
    // A halted cell stays halted.
    session.say(&[Message::Halt])?;
    (session.known.halted, session.known.active) = (Some(true), Some(false));
    session.commit(&arm::document(6))?;
    session.exchange_all(&[])?;
    session.say(&[Message::Resume])?;
    session.known.halted = Some(false);
    Ok(())
}

fn resume(session: &mut Session<'_>) -> Result<(), Stop> {
    for is_halted in [true, false] {
        let later = touched(session)?;
        if is_halted {
            session.say(&[Message::Halt])?;
            session.known.active = Some(false);
        }
        session.say(&[Message::Resume])?;
        session.exchange_all(&[])?;
        is_touched(session, later, "CMD-2", "a resume")?;
    }
    Ok(())
}

/// Checks that a write of parameter 5 forgets stimuli and changes nothing else, also when it is sent to everyone.
fn mode(session: &mut Session<'_>) -> Result<(), Stop> {
    for to in [Node::Cell(session.cell), Node::Everyone] {
        touched(session)?;
        session.say(&[Message::Halt])?;
        (session.known.halted, session.known.active) = (Some(true), Some(false));
        for on in [0, 1] {
            session.switch(to, on != 0)?;
            let is_on = session.exchange_all(&[])?.state().has(protocol::message::State::TEST_MODE);
            session.check("CONF-11", is_on == (on != 0), || {
                format!("a write of parameter 5 with {on} to {to} had no effect")
            });
        }
        let joints = session.joints(session.known.last_epoch, &POSITIONS);
        session.exchange_all(&[joints])?;
        session.say(&[Message::Resume])?;
        session.known.halted = Some(false);
        let step = session.step(&POSITIONS)?;
        session.check("STIM-2", step.torque.is_none(), || {
            format!("a write of parameter 5 to {to} forgot no stimulus")
        });
    }
    Ok(())
}
