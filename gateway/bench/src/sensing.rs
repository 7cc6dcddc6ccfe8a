//! Switches the sensor frames of the cells of a running bench until all present cells have confirmed it.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use model::repeat::RepeatedRequests;
use protocol::bus::{Bus, BusError, BusOptions, Filter, KindChoice};
use protocol::can::Format;
use protocol::id::{CellId, Kind, Node};
use protocol::message::{Answer, Message, Request};
use protocol::parameters::{Parameter, Sensing};
use protocol::time::{Micros, Span};
use thiserror::Error;

use crate::answers::ReceivedAnswers;
use crate::bus::listen::{self, Listener, send_message};

/// Time to find the cells on a bus: two heartbeats and a margin.
const DISCOVERY_TIME: Duration = Duration::from_millis(600);
/// Interval after which a request is sent again to a cell that does not answer.
const RETRY_INTERVAL: Span = Span::from_millis(250);
/// Maximum time until all cells have answered.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);
/// Tag of the requests, by which their answers are told from answers to other senders.
const SENSING_REQUEST_TAG: u8 = 0x57;

/// Opens a bus whose cells are to be switched and whose packets have this format.
///
/// # Errors
/// Returns [`BusError`] if the bus cannot be opened.
pub fn open_bus(name: &str, kind: KindChoice, format: Format) -> Result<Bus, BusError> {
    let filters = [Kind::Network, Kind::Configured].map(Filter::for_kind).to_vec();
    listen::open_bus(name, kind, Some(format), BusOptions { filters, ..BusOptions::default() })
}

/// An error that keeps cells from being switched.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SensingError {
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// No cell answered.
    #[error(
        "{who} on {bus} sent no answer: start the cell, or give the frame format of the bus with --format \
         {other}"
    )]
    NoAnswer {
        /// Description of the addressed cells.
        who: String,
        /// Name of the bus.
        bus: String,
        /// The other frame format, which the bus may have instead.
        other: &'static str,
    },
    /// Some cells refused.
    #[error(
        "{cells} on {bus} refused the command with reason {reason}: docs/reference/protocol.md lists the reasons"
    )]
    Refused {
        /// The cells as text.
        cells: String,
        /// Name of the bus.
        bus: String,
        /// Reason of the first refusal.
        reason: i16,
    },
    /// Some cells are present but did not answer.
    #[error("{cells} on {bus} did not answer ({done} did): repeat the command when all cells send")]
    Silent {
        /// The cells as text.
        cells: String,
        /// Name of the bus.
        bus: String,
        /// Number of cells that answered.
        done: usize,
    },
}

/// Switches the sensor frames of one cell, or of all cells that send, on a bus from [`open_bus`]. Returns the names of
/// the switched cells.
///
/// # Errors
/// Returns [`SensingError`] if a cell does not confirm, or the bus fails.
pub fn switch_sensing(
    bus: Bus,
    format: Format,
    only: Option<CellId>,
    mode: Sensing,
) -> Result<String, SensingError> {
    let mut answers = ReceivedAnswers::new(only, Some(SENSING_REQUEST_TAG));
    let mut listener = Listener::new(bus, Some(format));
    let request = |bus: &Bus, to| {
        let request = Request::Write { number: Parameter::Sensing.number(), words: mode.words() };
        send_message(bus, &Message::Configure { to, tag: SENSING_REQUEST_TAG, request }, format)
    };
    request(listener.bus(), only.map_or(Node::Everyone, Node::Cell))?;
    let began = Instant::now();
    let mut requests = RepeatedRequests::new(RETRY_INTERVAL);
    requests.mark_all_sent(Micros::from_elapsed(began.elapsed()));
    while began.elapsed() < ANSWER_TIMEOUT
        && !have_all_cells_answered(&answers, only, began.elapsed() >= DISCOVERY_TIME)
    {
        answers.receive(&mut listener)?;
        for cell in requests.due_requests(Micros::from_elapsed(began.elapsed()), answers.missing_cells()) {
            request(listener.bus(), Node::Cell(cell))?;
        }
    }
    switch_result(&answers, only, listener.bus().name(), format)
}

/// Returns true if all expected cells have answered. Before `listened` is true, further cells may appear.
fn have_all_cells_answered(answers: &ReceivedAnswers, only: Option<CellId>, listened: bool) -> bool {
    answers.missing_cells().is_empty()
        && (only.is_some() || (listened && !answers.present_cells().is_empty()))
}

/// Returns the switched cells as text, or an error if some were not switched.
fn switch_result(
    answers: &ReceivedAnswers,
    only: Option<CellId>,
    bus: &str,
    format: Format,
) -> Result<String, SensingError> {
    let (bus, missing) = (bus.to_owned(), answers.missing_cells());
    if answers.received_answers().is_empty() {
        let who = only.map_or_else(|| "any cell".to_owned(), |cell| format!("cell {cell}"));
        return Err(SensingError::NoAnswer { who, bus, other: format.other_format().name() });
    }
    let (mut confirmed, mut refused) = (BTreeSet::new(), BTreeMap::new());
    for &(cell, answer) in answers.received_answers() {
        match answer {
            Answer::Value { .. } => _ = confirmed.insert(cell),
            Answer::Refused { reason, .. } => _ = refused.insert(cell, reason),
        }
    }
    if let Some((_, &reason)) = refused.first_key_value() {
        return Err(SensingError::Refused { cells: cell_names(refused.keys()), bus, reason });
    }
    if !missing.is_empty() {
        let (cells, done) = (cell_names(missing.iter()), confirmed.len());
        return Err(SensingError::Silent { cells, bus, done });
    }
    Ok(match confirmed.len() {
        1 => cell_names(confirmed.iter()),
        count => format!("{count} cells"),
    })
}

fn cell_names<'a>(cells: impl Iterator<Item = &'a CellId>) -> String {
    let names: Vec<_> = cells.map(ToString::to_string).collect();
    match names.as_slice() {
        [one] => format!("cell {one}"),
        [first, .., last] if names.len() > 12 => format!("{} cells ({first} to {last})", names.len()),
        several => format!("cells {}", several.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::message::{Heartbeat, NetworkPage};
    use protocol::packet::{Epoch, WORDS};

    /// Final verdict on an FD bus, as text.
    fn says(answers: &ReceivedAnswers, only: Option<CellId>) -> Result<String, String> {
        switch_result(answers, only, "vcan0", Format::Fd).map_err(|error| error.to_string())
    }

    fn cell(node: i64) -> CellId {
        CellId::new(node).unwrap()
    }

    fn beat(node: i64) -> Message {
        let page = NetworkPage::Heartbeat(Heartbeat::default());
        Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(0), page }
    }

    fn confirms(node: i64, tag: u8) -> Message {
        let answer = Answer::Value { number: 7, written: true, words: [0; WORDS] };
        Message::Configured { from: cell(node), tag, answer }
    }

    #[test]
    fn all_cells_that_send_have_to_answer() {
        let mut answers = ReceivedAnswers::new(None, Some(SENSING_REQUEST_TAG));
        assert!(!have_all_cells_answered(&answers, None, true), "no cell is there yet");
        for message in [
            beat(1),
            confirms(1, SENSING_REQUEST_TAG),
            confirms(2, SENSING_REQUEST_TAG),
            beat(3),
            confirms(3, SENSING_REQUEST_TAG ^ 1),
        ] {
            answers.record_message(&message);
        }
        assert!(!have_all_cells_answered(&answers, None, true));
        assert_eq!(answers.missing_cells(), [cell(3)].into(), "the answer to another sender does not count");
        let why = "cell 3 on vcan0 did not answer (2 did): repeat the command when all cells send";
        assert_eq!(says(&answers, None), Err(why.to_owned()));
        answers.record_message(&confirms(3, SENSING_REQUEST_TAG));
        assert!(
            !have_all_cells_answered(&answers, None, false) && have_all_cells_answered(&answers, None, true)
        );
        assert_eq!(says(&answers, None), Ok("3 cells".to_owned()));
    }

    #[test]
    fn one_cell_is_requested_and_waited_for_alone() {
        let only = Some(cell(7));
        let mut answers = ReceivedAnswers::new(only, Some(SENSING_REQUEST_TAG));
        answers.record_message(&confirms(1, SENSING_REQUEST_TAG));
        assert_eq!(answers.missing_cells(), [cell(7)].into());
        let why = "cell 7 on vcan0 sent no answer: start the cell, or give the frame format of the bus with \
             --format classic";
        assert_eq!(says(&answers, only), Err(why.to_owned()));
        answers.record_message(&confirms(7, SENSING_REQUEST_TAG));
        assert!(have_all_cells_answered(&answers, only, false));
        assert_eq!(says(&answers, only), Ok("cell 7".to_owned()));
    }

    #[test]
    fn a_cell_that_refuses_is_named() {
        let mut answers = ReceivedAnswers::new(None, Some(SENSING_REQUEST_TAG));
        let answer = Answer::Refused { number: 7, reason: Answer::REFUSED_UNKNOWN_PARAMETER };
        answers.record_message(&Message::Configured { from: cell(9), tag: SENSING_REQUEST_TAG, answer });
        let why = "cell 9 on vcan0 refused the command with reason 18: docs/reference/protocol.md lists the reasons";
        assert_eq!(says(&answers, None), Err(why.to_owned()));
    }
}
