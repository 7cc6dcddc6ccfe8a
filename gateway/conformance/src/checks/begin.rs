//! The checks that run first: the identity of the cell, and the options that it has.

use protocol::message::{Message, VERSION};
use protocol::parameters::Parameter;
use protocol::time::Span;

use super::{baseline, unconfigured};
use crate::arm;
use crate::bus::StopReason;
use crate::session::{Reply, Session};

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.begin_exchange();
    session.send_messages(&[Message::Resume])?;
    // Stops sensor values without a request.
    session.known.senses = true;
    session.write_first_words(Parameter::Sensing.number(), [0])?;
    session.write_first_words(Parameter::Reply.number(), [0])?;
    session.receive_for(Span::from_millis(20))?;
    session.begin_exchange();
    session.known.senses = false;
    session.measure_round_trip()?;
    check_identity(session)?;
    session.about.ports = session.has_ports()?;
    check_options(session)?;
    if session.known.hash == Some(0) {
        unconfigured::run(session)?;
    } else {
        let why = "joints messages to an unconfigured cell, because this cell has a configuration";
        session.findings.mark_not_tested("JOINTS-2", why);
    }
    let document = arm::example_parameters(2);
    session.about.committed = session.commit_parameters(&document)?;
    session.known.halted = Some(false);
    // Before the commit the hash may have been 0.
    if session.about.committed { check_identity(session) } else { Ok(()) }
}

fn check_identity(session: &mut Session<'_>) -> Result<(), StopReason> {
    let reply = session.read_parameter(Parameter::Identity.number())?;
    let Reply::Value([.., version, hash, state, _]) = reply else {
        session.check("CONF-1", false, || {
            format!("a read of the identity (parameter 0) must return its words, but the answer was {reply}")
        });
        return Ok(());
    };
    session.check("CONF-1", version == i16::from(VERSION), || {
        format!("the identity (parameter 0) must have protocol version 1, but it has {version}")
    });
    let exchange = session.exchange_messages(&[])?;
    let Some((beat, _)) = exchange.beat else { return Ok(()) };
    session.check("CONF-1", hash.cast_unsigned() == beat.configuration, || {
        format!(
            "the identity and the heartbeat must report the same configuration, but they report {hash:04X} \
             and {:04X}",
            beat.configuration
        )
    });
    session.check("CONF-1", state.cast_unsigned() == beat.state.0, || {
        format!(
            "the identity and the heartbeat must report the same state, but they report {state:04X} and \
             {:04X}",
            beat.state.0
        )
    });
    session.known.hash = Some(beat.configuration);
    Ok(())
}

fn check_options(session: &mut Session<'_>) -> Result<(), StopReason> {
    let reply = session.write_first_words(Parameter::Mode.number(), [1])?;
    let words = reply.words().map(|[first, ..]| first);
    session.about.test_mode = words == Some(1);
    session.known.test_mode = Some(words == Some(1));
    let is_known = words == Some(1) || reply == Reply::Refused(19);
    session.check("OPT-1", is_known, || format!("a write of 1 to parameter 5 must be accepted, or refused with reason 19 (invalid value), but the answer was {reply}"));
    if session.about.test_mode {
        session.switch_test_mode(true)?;
    }
    session.known.senses = true;
    let reply = session.write_first_words(Parameter::Sensing.number(), [2])?;
    session.about.sensing = reply.words().is_some();
    session.check("OPT-1", session.about.sensing || reply == Reply::Refused(19), || {
        format!("a write of 2 to parameter 7 must be accepted, or refused with reason 19 (invalid value), but the answer was {reply}")
    });
    session.write_first_words(Parameter::Sensing.number(), [0])?;
    let reply = session.write_parameter(Parameter::Baseline.number(), baseline::HELD_ZERO_RULE)?;
    session.about.baseline = reply.words().is_some();
    // A cell that implements the protocol without baselines refuses with 18.
    let is_known = session.about.baseline || matches!(reply, Reply::Refused(18 | 19));
    session.check("OPT-1", is_known, || format!("a write of parameter 11 must be accepted, or refused with reason 18 (unknown parameter) or 19 (invalid value), but the answer was {reply}"));
    session.write_first_words(Parameter::Baseline.number(), [0])?;
    session.wait_for_late_packets()?;
    session.known.senses = false;
    Ok(())
}
