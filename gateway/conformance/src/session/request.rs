//! Requests for parameters and reports, and the checks of all answers to them.

use model::decode::Decoded;
use protocol::id::Node;
use protocol::message::{
    Answer, Message, NetworkPage, ReceivedCounts as HeardPage, RejectedCounts, Request, SensorReadings,
};
use protocol::packet::{Epoch, WORDS, padded_words};
use protocol::parameters::{Parameter, Parameters};
use protocol::time::{Micros, Span};

use super::{ANSWER_TIMEOUT, CellPacket, Session};
use crate::bus::StopReason;

/// The time within which all pages of a report come.
const REPORT_TIMEOUT: Span = Span::from_millis(150);
/// The time within which the right answer may follow an answer with another tag.
const LATE_ANSWER_TIMEOUT: Span = Span::from_millis(30);
/// The time limit of a commit, which writes flash.
const COMMIT_TIMEOUT: Span = Span::from_millis(900);

/// The reply of a cell to a request.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum Reply {
    Value([i16; WORDS]),
    Refused(i16),
    Nothing,
}

impl Reply {
    pub(crate) const fn words(self) -> Option<[i16; WORDS]> {
        if let Self::Value(words) = self { Some(words) } else { None }
    }
}

/// The counters that a cell reports in network pages 1 and 2.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub(crate) struct CellCounters {
    pub(crate) heard: HeardPage,
    pub(crate) refused: RejectedCounts,
}

impl core::fmt::Display for CellCounters {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (from, epoch) = (Node::Gateway, Epoch(0));
        let text = |page| Decoded::Message(Message::Network { from, epoch, page }).to_string();
        let [heard, refused] =
            [NetworkPage::Received(self.heard), NetworkPage::Rejected(self.refused)].map(text);
        let fields =
            |text: &str| text.split_once(": ").map_or_else(String::new, |(_, fields)| fields.to_owned());
        write!(f, "{}; refused: {}", fields(&heard), fields(&refused))
    }
}

/// The network pages that answer a report; the simulated sensors pages follow them.
const REPORT_PAGES: [u8; 2] = [1, 2];
/// The further network pages of a cell with ports.
const PORT_REPORT_PAGES: [u8; 2] = [3, 4];

/// Returns the names of the pages that answer a report, in order.
fn report_page_names(has_ports: bool) -> Vec<String> {
    let network = |pages: &[u8]| pages.iter().map(|page| format!("network {page}")).collect::<Vec<_>>();
    let sensors =
        SensorReadings::default().simulated_pages().map(|page| format!("sensors {}", page.number()));
    let of_ports = if has_ports { network(&PORT_REPORT_PAGES) } else { Vec::new() };
    network(&REPORT_PAGES).into_iter().chain(sensors).chain(of_ports).collect()
}

fn page_name(message: &Message) -> String {
    let kind = message.id().kind.name();
    if let Message::Network { page, .. } = message {
        match page.number() {
            0 => "heartbeat".to_owned(),
            number => format!("{kind} {number}"),
        }
    } else if let Message::Sensors { page, .. } = message {
        format!("{kind} {}", page.number())
    } else {
        kind.to_owned()
    }
}

impl core::fmt::Display for Reply {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Value(words) => {
                for (place, word) in words.iter().enumerate() {
                    write!(f, "{}{word:04X}", if place == 0 { "" } else { " " })?;
                }
                Ok(())
            }
            Self::Refused(reason) => write!(f, "a refusal with reason {reason}"),
            Self::Nothing => f.write_str("nothing"),
        }
    }
}

/// Returns the time, the tag and the content of an answer to a request.
const fn configured_answer(heard: &CellPacket) -> Option<(Micros, u8, Answer)> {
    if let Message::Configured { tag, answer, .. } = heard.message {
        Some((heard.at, tag, answer))
    } else {
        None
    }
}

impl Session<'_> {
    fn cell_node(&self) -> Node {
        Node::Cell(self.cell)
    }

    /// Reads a parameter, and returns the cell's reply.
    pub(crate) fn read_parameter(&mut self, number: u8) -> Result<Reply, StopReason> {
        self.request(self.cell_node(), Request::Read { number })
    }

    /// Writes a parameter, and returns the cell's reply.
    pub(crate) fn write_parameter(&mut self, number: u8, words: [i16; WORDS]) -> Result<Reply, StopReason> {
        self.request(self.cell_node(), Request::Write { number, words })
    }

    /// Writes the first words of a parameter, and zeros for the others.
    pub(crate) fn write_first_words<const N: usize>(
        &mut self,
        number: u8,
        first: [i16; N],
    ) -> Result<Reply, StopReason> {
        self.write_parameter(number, padded_words(first))
    }

    /// Sends a request with the next tag and waits for the answer.
    pub(crate) fn request(&mut self, to: Node, request: Request) -> Result<Reply, StopReason> {
        self.tag = self.tag.wrapping_mul(5).wrapping_add(0x35);
        self.request_with(to, self.tag, request)
    }

    /// Sends a request with this tag and waits for the answer.
    pub(crate) fn request_with(&mut self, to: Node, tag: u8, request: Request) -> Result<Reply, StopReason> {
        let (number, is_write) = match request {
            Request::Read { number } => (number, false),
            Request::Write { number, .. } => (number, true),
        };
        let id = if is_write { "CONF-4" } else { "CONF-1" };
        let is_commit = is_write && number == Parameter::Commit.number();
        self.begin_exchange();
        let at = self.send_messages(&[Message::Configure { to, tag, request }])?;
        let longest = if is_commit { COMMIT_TIMEOUT } else { ANSWER_TIMEOUT };
        self.wait_for_packets(at + longest, |heard| {
            heard.iter().any(|it| matches!(it.message, Message::Configured { .. }))
        })?;
        // The answer to an earlier, interrupted request may come first.
        let is_its = |heard: &CellPacket| {
            heard.message.configuration_tag() == Some(tag) && configured_answer(heard).is_some()
        };
        self.wait_for_packets(self.now() + LATE_ANSWER_TIMEOUT, |heard| {
            heard.iter().any(is_its) || !heard.iter().any(|it| configured_answer(it).is_some())
        })?;
        let place = self.answers().iter().position(is_its);
        let place =
            place.or_else(|| self.answers().iter().position(|heard| configured_answer(heard).is_some()));
        let found = place.and_then(|place| configured_answer(self.answers().get(place)?));
        let Some((answered, came, answer)) = found else {
            self.check(id, false, || {
                format!(
                    "the cell must answer a request for parameter {number} within {} ms, but it did not",
                    longest.0 / 1_000
                )
            });
            return Ok(Reply::Nothing);
        };
        self.record_answer_time(if is_commit { "commit" } else { "configured" }, at, answered);
        self.check("CONF-12", came == tag, || {
            format!("the answer must have the tag of the request, {tag:02X}, but it has {came:02X}")
        });
        let reply = match answer {
            Answer::Value { number: got, written, words } => {
                self.check(id, got == number, || {
                    format!("the answer must name parameter {number}, but it names {got}")
                });
                self.check(id, written == is_write, || {
                    format!(
                        "bit 0x80 must be set in the answer to a write and clear in the answer to a read, \
                         but it is {}set",
                        if written { "" } else { "not " }
                    )
                });
                Reply::Value(words)
            }
            Answer::Refused { number: got, reason } => {
                self.check("CONF-6", got == number, || {
                    format!("the refusal must name parameter {number}, but it names {got}")
                });
                Reply::Refused(reason)
            }
        };
        self.log.ended = self.log.frames.len();
        let place = self.packets.iter().rposition(|it| matches!(it.message, Message::Configured { .. }));
        self.consumed = place.map_or(self.packets.len(), |place| place + 1);
        Ok(reply)
    }

    /// Stages parameters: writes all stored ones that differ from the staged ones.
    pub(crate) fn stage_parameters(&mut self, parameters: &Parameters) -> Result<(), StopReason> {
        let before = self.known.staged.take();
        for parameter in Parameter::stored_for_rows(parameters.all_rows().len()) {
            let words = parameters.words(parameter);
            if before.is_none_or(|before| before.words(parameter) != words) {
                let reply = self.write_parameter(parameter.number(), words)?;
                self.check("CONF-4", reply == Reply::Value(words), || {
                    format!(
                        "a write of parameter {} must be answered with the written words, but the answer was \
                         {reply}",
                        parameter.number()
                    )
                });
            }
        }
        let mut staged = *parameters;
        if let Some(before) = before {
            // Rows beyond the table stay unchanged.
            let rows = staged.rows.iter_mut().zip(before.rows).skip(parameters.all_rows().len().max(6));
            rows.for_each(|(row, before)| *row = before);
        }
        self.known.staged = Some(staged);
        Ok(())
    }

    /// Commits parameters. Returns true if the cell uses them.
    pub(crate) fn commit_parameters(&mut self, parameters: &Parameters) -> Result<bool, StopReason> {
        let is_so = |known: Option<Parameters>| known.is_some_and(|it| it.hash() == parameters.hash());
        if self.known.parameters == Some(*parameters) && is_so(self.known.staged) {
            return Ok(true);
        }
        self.stage_parameters(parameters)?;
        let hash = parameters.hash();
        let reply = self.write_first_words(Parameter::Commit.number(), [hash.cast_signed()])?;
        let done = reply == Reply::Value(padded_words([hash.cast_signed()]));
        self.check("CONF-7", done, || {
            format!("a commit with the right hash {hash:04X} must be accepted, but the answer was {reply}")
        });
        if done {
            self.known.parameters = Some(*parameters);
            (self.known.hash, self.known.joints) = (Some(hash), parameters.joints);
        } else {
            (self.known.parameters, self.known.hash, self.known.staged) = (None, None, None);
        }
        Ok(done)
    }

    /// Requests a report, and returns its packets, without heartbeats.
    pub(crate) fn request_report(&mut self) -> Result<Vec<CellPacket>, StopReason> {
        self.begin_exchange();
        let asked = self.send_messages(&[Message::Report])?;
        self.report_pages(asked)
    }

    /// Returns true if the cell sends the pages of a cell with ports.
    pub(crate) fn has_ports(&mut self) -> Result<bool, StopReason> {
        self.begin_exchange();
        let asked = self.send_messages(&[Message::Report])?;
        let pages = self.collect_report_pages(asked, report_page_names(true).len())?;
        let is_of_ports = |page: &NetworkPage| matches!(page, NetworkPage::Tree(_) | NetworkPage::Ports(_));
        Ok(pages.iter().any(|it| matches!(&it.message, Message::Network { page, .. } if is_of_ports(page))))
    }

    /// Collects a number of pages, or fewer if no more come.
    fn collect_report_pages(
        &mut self,
        asked: Micros,
        expected: usize,
    ) -> Result<Vec<CellPacket>, StopReason> {
        let pages =
            |heard: &[CellPacket]| heard.iter().filter(|it| it.heartbeat_and_epoch().is_none()).count();
        self.wait_for_packets(asked + REPORT_TIMEOUT, |heard| pages(heard) >= expected)?;
        let pages = self.answers().iter().filter(|it| it.heartbeat_and_epoch().is_none()).copied().collect();
        self.mark_packets_expected();
        Ok(pages)
    }

    /// Returns the pages of a report that was requested at a time.
    pub(crate) fn report_pages(&mut self, asked: Micros) -> Result<Vec<CellPacket>, StopReason> {
        let order = report_page_names(self.about.ports);
        let pages = self.collect_report_pages(asked, order.len() + usize::from(self.known.adapts))?;
        if !self.known.senses {
            let names: Vec<_> = pages.iter().map(|it| page_name(&it.message)).collect();
            self.check("CMD-4", names == order, || {
                format!(
                    "the cell answered a report with {}, but it must answer with {}",
                    names.join(", "),
                    order.join(", ")
                )
            });
        }
        Ok(pages)
    }

    /// Requests the counters, and checks that they match the packets sent and received.
    pub(crate) fn counters(&mut self) -> Result<CellCounters, StopReason> {
        let report = self.request_report()?;
        let (mut heard, mut refused) = (None, None);
        for answer in &report {
            if let Message::Network { page, .. } = answer.message {
                if let NetworkPage::Received(page) = page {
                    heard = Some(page);
                } else if let NetworkPage::Rejected(page) = page {
                    refused = Some(page);
                }
            }
        }
        let whole = heard.zip(refused);
        self.check("CMD-4", whole.is_some(), || {
            "the cell must answer a report with network pages 1 and 2, but it did not send both".to_owned()
        });
        if let Some((heard, refused)) = whole {
            for (id, what) in self.life.accounts.compare_counters(heard, refused) {
                self.check(id, false, || what);
            }
        }
        let sync = self.exchange_messages(&[])?;
        if let (Some((beat, _)), Some((_, refused))) = (sync.beat, refused.and(whole)) {
            let RejectedCounts { length, crc, foreign, meaning, incomplete, stimuli } = refused;
            let sum =
                [length, crc, foreign, meaning, incomplete, stimuli].into_iter().fold(0, u16::wrapping_add);
            self.check("BEAT-4", beat.rejected == sum, || {
                format!(
                    "the counter 'refused' in a heartbeat is {}, but it must be {sum}, the sum of the \
                     counters of network page 2",
                    beat.rejected
                )
            });
        }
        let (heard, refused) = whole.unwrap_or_default();
        Ok(CellCounters { heard, refused })
    }

    /// Skips the next comparison of counters, because the cell may have lost packets of a burst.
    pub(crate) const fn forget_counters(&mut self) {
        self.life.accounts.forget_counters();
    }
}
