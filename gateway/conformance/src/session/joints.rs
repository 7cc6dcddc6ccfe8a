//! Sends joints and stimuli, and checks the answers of the cell.

use protocol::id::Node;
use protocol::message::{Message, Request, SensorPage, SkinSensors, State, StimulusStart};
use protocol::packet::{Epoch, Length, Words, padded_words};
use protocol::parameters::{MAX_JOINTS, Parameter};

use super::{CellPacket, Exchange, Session};
use crate::arm;
use crate::bus::StopReason;

/// The result of one joints message.
#[derive(Clone, Debug)]
pub(crate) struct JointsResult {
    pub(crate) exchange: Exchange,
    /// The torque, if one came.
    pub(crate) torque: Option<Words>,
}

impl JointsResult {
    /// Returns the words of the torque, or zeros if no torque came.
    pub(crate) fn words(&self) -> [i16; MAX_JOINTS] {
        self.torque.map_or([0; MAX_JOINTS], |torque| torque.padded())
    }
}

/// The expected answer to joints.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum ExpectedAnswer {
    Torque,
    Zeros,
    Nothing,
}

impl Session<'_> {
    /// Advances the epoch by one, and returns it.
    pub(crate) fn next_epoch(&mut self) -> u8 {
        self.known.last_epoch = self.known.last_epoch.wrapping_add(1);
        self.known.last_epoch
    }

    /// Sends a stimulus for the next joints.
    pub(crate) fn send_stimulus(&mut self, skin: SkinSensors) -> Result<(), StopReason> {
        self.known.pending = Some(skin);
        let to = Node::Cell(self.cell);
        self.send_messages(&[Message::Stimulus {
            to,
            from: StimulusStart::Next,
            page: SensorPage::Skin(skin),
        }])?;
        Ok(())
    }

    /// Sends a stimulus for the joints of an epoch.
    pub(crate) fn send_stimulus_at_epoch(&mut self, first: u8, skin: SkinSensors) -> Result<(), StopReason> {
        let to = Node::Cell(self.cell);
        self.send_messages(&[Message::Stimulus {
            to,
            from: StimulusStart::Epoch(Epoch(first)),
            page: SensorPage::Skin(skin),
        }])?;
        Ok(())
    }

    /// Sends joints of the next epoch, and repeats them if the cell processed them too late.
    pub(crate) fn send_next_joints(
        &mut self,
        positions: &[i16; MAX_JOINTS],
    ) -> Result<JointsResult, StopReason> {
        const MAX_SEND_ATTEMPTS: usize = 6;
        let mut attempt = 1;
        loop {
            let epoch = self.next_epoch();
            let step = self.send_joints_at_epoch(epoch, positions)?;
            if !self.clock.skipped || attempt == MAX_SEND_ATTEMPTS {
                return Ok(step);
            }
            attempt += 1;
        }
    }

    /// Sends a stimulus for the next joints, then sends those joints, and returns their result.
    pub(crate) fn stimulate_and_send_joints(
        &mut self,
        positions: &[i16; MAX_JOINTS],
        skin: SkinSensors,
    ) -> Result<JointsResult, StopReason> {
        self.send_stimulus(skin)?;
        self.send_next_joints(positions)
    }

    /// Sends joints of an epoch other than the last one, and checks the answers.
    pub(crate) fn send_joints_at_epoch(
        &mut self,
        epoch: u8,
        positions: &[i16; MAX_JOINTS],
    ) -> Result<JointsResult, StopReason> {
        let joints = self.joints_message(epoch, positions);
        if let Some(skin) = self.known.pending.take() {
            self.known.skin = Some(skin);
        }
        let due = self.expected_answer();
        (self.known.epoch, self.known.last_epoch) = (Some(epoch), epoch);
        // After joints without a force the cell is not active, whatever it was before.
        self.known.active = match due {
            Some(due) => Some(due == ExpectedAnswer::Torque),
            None => self.latched_force().map(|force| force > 0),
        };
        let active = self.known.active.take();
        let exchange = self.exchange_messages(&[joints])?;
        let step = self.check_torques(epoch, due, exchange)?;
        self.known.active = active;
        self.check_reported_state(&step.exchange);
        if self.clock.skipped {
            // The cell is as it was before the skipped joints.
            self.known.active = None;
        }
        Ok(step)
    }

    /// Returns the expected answer to the next joints, if it is known.
    fn expected_answer(&self) -> Option<ExpectedAnswer> {
        let known = &self.known;
        if known.halted == Some(true) {
            return Some(ExpectedAnswer::Nothing);
        }
        match (self.latched_force()? > 0, known.active) {
            (true, _) => Some(ExpectedAnswer::Torque),
            (false, Some(true)) => Some(ExpectedAnswer::Zeros),
            (false, Some(false)) => Some(ExpectedAnswer::Nothing),
            (false, None) => None,
        }
    }

    /// Returns F_z of the latched values, if they are known.
    fn latched_force(&self) -> Option<i64> {
        let skin = self.known.skin.filter(|_| !self.known.adapts)?;
        Some(arm::expected_force(&self.known.parameters?.contact, &skin))
    }

    /// Checks the answers to joints.
    fn check_torques(
        &mut self,
        epoch: u8,
        due: Option<ExpectedAnswer>,
        exchange: Exchange,
    ) -> Result<JointsResult, StopReason> {
        let torques: Vec<_> =
            exchange.answers.iter().filter(|heard| heard.torque().is_some()).copied().collect();
        let count = torques.len();
        self.check("JOINTS-6", count <= 1, || {
            format!(
                "the cell must answer the joints message of epoch {epoch} with at most one torque message, but \
                 it sent {count}"
            )
        });
        for other in exchange.answers.iter().filter(|heard| heard.torque().is_none()) {
            if let Some(id) = self.known.violated_requirement(&other.message) {
                let kind = other.message.id().kind.name();
                self.check(id, false, || {
                    format!("the cell must not answer a joints message with a {kind} packet, but it sent one")
                });
            }
        }
        let first = torques.first().and_then(|heard| Some((heard.at, heard.torque()?.0, *heard.torque()?.1)));
        self.clock.skipped = first.is_none() && self.were_joints_late(&exchange);
        self.skips = self.skips.wrapping_add(u16::from(self.clock.skipped));
        let expected = match due {
            Some(ExpectedAnswer::Torque) => Some(true),
            Some(ExpectedAnswer::Zeros) => Some(true),
            Some(ExpectedAnswer::Nothing) => Some(false),
            None => None,
        };
        if let Some(expected) = expected {
            let halted = self.known.halted == Some(true);
            let id = if halted { "CMD-1" } else { "JOINTS-6" };
            self.check(id, first.is_some() == expected, || {
                let what = match due {
                    Some(ExpectedAnswer::Torque) => {
                        "the cell is in contact and must answer with a torque message, but it sent none"
                    }
                    Some(ExpectedAnswer::Zeros) => {
                        "the touch has ended and a torque message of zeros was due, but the cell sent none"
                    }
                    _ if halted => "the cell is halted and must not send a torque message, but it sent one",
                    _ => "the cell is not in contact and must not answer, but it sent a torque message",
                };
                format!("joints message of epoch {epoch}: {what}")
            });
        }
        if let Some((at, of, words)) = first {
            // The limit is a quarter of the period, and the test's period is long except where times are measured.
            if self
                .known
                .parameters
                .is_some_and(|it| it.period_us == arm::fast_example_parameters(1).period_us)
            {
                self.record_answer_time("torque", exchange.at, at);
            }
            self.check("JOINTS-6", of.0 == epoch, || {
                format!(
                    "the torque message that answers the joints message of epoch {epoch} must have this epoch, \
                     but it has {of}"
                )
            });
            if due == Some(ExpectedAnswer::Zeros) {
                self.check("JOINTS-6", words.is_zero(), || {
                    "after a touch has ended, all words of the torque message must be 0, but they are not"
                        .to_owned()
                });
            }
            self.check_torque_shape(&words);
            self.check_saturated_flag(&words);
        } else {
            self.check_saturated_flag(&Words::zeros(Length::Six));
        }
        Ok(JointsResult { torque: first.map(|(.., words)| words), exchange })
    }

    /// Returns true if the cell processed the joints when they were older than a period, as the answer to the sync
    /// shows. It then skipped them, and their consequences cannot be expected.
    fn were_joints_late(&self, exchange: &Exchange) -> bool {
        let period = self.known.parameters.map_or(u64::MAX, |it| it.period_us.into());
        let beat = self.answers().iter().rev().find(|heard| heard.heartbeat_and_epoch().is_some());
        beat.is_some_and(|heard| heard.at.elapsed_since(exchange.at).0 > period && period > 1_000)
    }

    fn check_torque_shape(&mut self, words: &Words) {
        let Some(parameters) = self.known.parameters else { return };
        let length = Length::for_joints(parameters.joints.into());
        self.check("SEND-1", words.length() == length, || {
            format!(
                "a torque message has {} words, but it must have {}",
                words.length().words(),
                length.words()
            )
        });
        let beyond = words.padded().iter().skip(parameters.joint.into()).all(|word| *word == 0);
        self.check("J-1", beyond, || {
            format!(
                "torque words beyond joint {} must be 0, but the words are {}",
                parameters.joint,
                arm::format_words(words.as_slice())
            )
        });
    }

    /// Checks that SATURATED is set in the next heartbeat and in no other.
    fn check_saturated_flag(&mut self, words: &Words) {
        let expected = words.is_saturated();
        let after = |heard: &[CellPacket]| {
            let torque = heard.iter().rposition(|it| it.torque().is_some()).unwrap_or(0);
            let beats = heard.iter().skip(torque).filter_map(CellPacket::heartbeat_and_epoch);
            beats.map(|(beat, _)| beat.state.has(State::SATURATED)).collect::<Vec<_>>()
        };
        let beats = after(self.answers());
        if let [first, rest @ ..] = beats.as_slice() {
            // A flag that stays set from the heartbeat before does not concern this torque.
            let stays = *first && !expected && self.life.saturated;
            self.check(if stays { "STATE-2" } else { "TORQUE-2" }, *first == expected, || {
                let (set, words) = (if *first { "" } else { "not " }, arm::format_words(words.as_slice()));
                format!(
                    "SATURATED must be set after torque words at a limit of their range, and only then, but \
                     it is {set}set after {words}"
                )
            });
            let again = expected && rest.contains(&true);
            self.check("STATE-2", !again, || {
                "SATURATED must be set in one heartbeat only, but it is set in two".to_owned()
            });
            self.life.saturated = expected;
        }
    }

    /// Requests a report, and returns its skin page, which has the latched values.
    pub(crate) fn read_latched_skin(&mut self) -> Result<Option<SkinSensors>, StopReason> {
        let pages = self.request_report()?;
        Ok(pages.iter().find_map(|heard| match heard.sensors() {
            Some((_, SensorPage::Skin(skin))) => Some(*skin),
            _ => None,
        }))
    }

    /// Switches test mode on or off, which clears all stimuli.
    pub(crate) fn switch_test_mode(&mut self, on: bool) -> Result<(), StopReason> {
        self.set_test_mode(Node::Cell(self.cell), on)
    }

    /// Switches test mode on or off, for this cell or for everyone.
    pub(crate) fn set_test_mode(&mut self, to: Node, on: bool) -> Result<(), StopReason> {
        let (number, words) = (Parameter::Mode.number(), padded_words([on.into()]));
        let reply = self.request(to, Request::Write { number, words })?;
        self.known.test_mode = reply.words().map(|words| words.first() == Some(&1));
        (self.known.skin, self.known.pending) = (on.then(SkinSensors::default), None);
        Ok(())
    }

    /// Commits parameters, and puts the cell in test mode, not in contact and not halted. Returns true if the commit
    /// succeeded.
    pub(crate) fn prepare_cell(
        &mut self,
        parameters: &protocol::parameters::Parameters,
    ) -> Result<bool, StopReason> {
        self.begin_exchange();
        self.send_messages(&[Message::Resume])?;
        self.known.halted = Some(false);
        let done = self.commit_parameters(parameters)?;
        if self.about.test_mode {
            self.switch_test_mode(true)?;
        } else {
            (self.known.skin, self.known.pending) = (None, None);
        }
        self.known.active = None;
        self.send_next_joints(&[0; MAX_JOINTS])?;
        self.known.active = Some(false);
        Ok(done)
    }
}
