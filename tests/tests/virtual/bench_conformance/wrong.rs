//! Faulty cells: this project's cell, with its input and output changed.

use cell_node::flash::FlashState;
use cell_node::kernel::{Kernel, Wrench};
use protocol::can::{Format, Frame};
use protocol::fixed::Q1_14;
use protocol::id::CellId;
use protocol::message::{
    Answer, Heartbeat, Joints, Message, NetworkPage, Request, SensorPage, SkinSensors, State, StimulusStart,
};
use protocol::packet::{Epoch, Length, Lengths, Packet, Reassembler, Reassembly, WORDS, Words};
use protocol::parameters::{MAX_JOINTS, Parameter, Parameters};
use protocol::time::{Micros, Span};

use super::cell::Mutant;

/// The state that a faulty cell tracks.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    pub(crate) now: Micros,
    /// The message that it is answering; `None` while only time passes.
    pub(crate) heard: Option<Message>,
    /// The number of joints messages, and the last positions.
    pub(crate) joints: usize,
    pub(crate) last: Option<(Epoch, Joints)>,
    pub(crate) latched: SkinSensors,
    pub(crate) pending: Vec<(StimulusStart, SensorPage)>,
    pub(crate) staged: Parameters,
    pub(crate) commits: Vec<Parameters>,
    pub(crate) test_mode: bool,
    pub(crate) halted: bool,
    pub(crate) settled: bool,
    pub(crate) starts: usize,
    /// The last torque.
    pub(crate) torque: Option<Words>,
    /// A counter for the use of a mutant.
    pub(crate) count: u64,
    pub(crate) at: Micros,
    pub(crate) kept: Vec<[i16; WORDS]>,
    pub(crate) frame: Option<Frame>,
    /// True if it is not in test mode at a start.
    pub(crate) measures: bool,
    segments: Vec<(u16, Reassembler)>,
    /// The number of packets that were sent, and of those that the correct cell inside sent before its present one.
    sent: [u16; 2],
}

impl Memory {
    /// Returns the parameters in use.
    pub(crate) fn in_use(&self) -> Parameters {
        self.commits.last().copied().unwrap_or_default()
    }

    /// Computes the words of a torque with these parameters for the last joints, with a given arithmetic.
    pub(crate) fn torque_of(
        &self,
        parameters: &Parameters,
        force: impl Fn(&Parameters, &SkinSensors) -> i64,
        word: impl Fn(i64, u32) -> i64,
    ) -> (i64, Words) {
        let joints = self.last.map(|(_, joints)| joints).unwrap_or_default();
        let j: [Q1_14; MAX_JOINTS] = Wrench::new(parameters).jacobian(&joints.positions);
        let force = force(parameters, &self.latched);
        let bits = 30 - parameters.torque_format.fraction_bits();
        let words = j.map(|j| {
            let word = word(i64::from(j.to_bits()) * force, bits);
            i16::from_le_bytes([word.to_le_bytes()[0], word.to_le_bytes()[1]])
        });
        (force, Words::new(Length::for_joints(parameters.joints.into()), words))
    }

    /// Tracks an incoming message.
    fn follow(&mut self, message: &Message, cell: CellId) {
        match *message {
            Message::Joints { epoch, joints } => {
                if self.last.is_some_and(|(last, _)| last == epoch) {
                    return;
                }
                let in_use = self.in_use();
                if in_use.joints != 0 && in_use.joints != joints.in_use {
                    return;
                }
                self.joints += 1;
                self.last = Some((epoch, joints));
                let latched = &mut self.latched;
                self.pending.retain(|(from, page)| {
                    let waits = matches!(from, StimulusStart::Epoch(first) if epoch.epochs_since(*first) < 0);
                    if let (false, SensorPage::Skin(skin)) = (waits, page) {
                        *latched = *skin;
                    }
                    waits
                });
            }
            Message::Halt => self.halted = true,
            Message::Resume => self.halted = false,
            Message::Stimulus { to, from, page }
                if to.addresses_cell(cell) && self.test_mode && self.pending.len() < 8 =>
            {
                let from = match (from, self.last) {
                    (StimulusStart::Epoch(first), Some((last, _))) if last.epochs_since(first) >= 0 => {
                        StimulusStart::Next
                    }
                    (from, _) => from,
                };
                self.pending.push((from, page));
            }
            Message::Configure { to, request: Request::Write { number, words }, .. }
                if to.addresses_cell(cell) && self.settled =>
            {
                if number == Parameter::Mode.number() {
                    self.test_mode = words[0] == 1;
                    self.pending.clear();
                    self.latched = SkinSensors::default();
                }
                if let Some(parameter) = Parameter::from_number(number).filter(|it| it.is_stored()) {
                    let _ = self.staged.set(parameter, words);
                }
            }
            _ => {}
        }
    }
}

pub(crate) type InputChange = fn(&mut Memory, Option<&Message>, Frame) -> Vec<Frame>;
pub(crate) type OutputChange = fn(&mut Memory, Message) -> Vec<(u64, Message)>;
pub(crate) type Addition = fn(&mut Memory) -> Vec<Message>;

/// A faulty cell.
pub(crate) struct FaultyCell {
    pub(crate) hear: InputChange,
    pub(crate) say: OutputChange,
    pub(crate) add: Addition,
    pub(crate) put: fn(&mut Memory, &Packet, Format) -> Vec<Frame>,
    pub(crate) store: fn(&mut Memory, FlashState) -> FlashState,
    pub(crate) ages: bool,
    pub(crate) yields: bool,
    pub(crate) memory: Memory,
    pub(crate) cell: CellId,
    pub(crate) format: Format,
}

impl FaultyCell {
    pub(crate) fn new(format: Format, number: u8) -> Self {
        Self {
            hear: |_, _, frame| vec![frame],
            say: |_, message| vec![(0, message)],
            add: |_| Vec::new(),
            put: |_, packet, format| packet.frames(format).collect(),
            store: |_, flash| flash,
            ages: true,
            yields: true,
            memory: Memory::default(),
            cell: CellId::new(number.into()).unwrap(),
            format,
        }
    }

    fn message(&mut self, frame: &Frame) -> Option<Message> {
        let id = protocol::packet::data_frame_id(frame).ok()?;
        let packet = match self.format {
            Format::Fd => Packet::from_fd(frame).ok()?,
            Format::Classic => {
                let segments = &mut self.memory.segments;
                let place = segments.iter().position(|(of, _)| *of == id.to_bits()).unwrap_or_else(|| {
                    segments.push((id.to_bits(), Reassembler::NONE));
                    segments.len() - 1
                });
                match segments[place].1.push(self.memory.now, id, Lengths::for_id(id), frame.data()).ok()? {
                    Reassembly::Complete(packet) => packet,
                    _ => return None,
                }
            }
        };
        Message::decode(&packet).ok()
    }
}

impl Mutant for FaultyCell {
    fn change_input(&mut self, now: Micros, age: Span, frame: Frame) -> Vec<(Span, Frame)> {
        self.memory.now = now;
        let message = self.message(&frame);
        let frames = (self.hear)(&mut self.memory, message.as_ref(), frame);
        if let Some(message) = message {
            self.memory.follow(&message, self.cell);
        }
        self.memory.heard = message;
        let age = if self.ages { age } else { Span(0) };
        frames.into_iter().map(|frame| (age, frame)).collect()
    }

    fn change_output(&mut self, now: Micros, packet: Packet) -> Vec<(Span, Packet)> {
        self.memory.now = now;
        let Ok(message) = Message::decode(&packet) else { return vec![(Span(0), packet)] };
        if let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = message
            && !beat.state.has(State::CLAIMING_NODE_ID)
        {
            self.memory.settled = true;
        }
        if let Message::Configured { answer: Answer::Value { number: 127, written: true, .. }, .. } = message
        {
            let staged = self.memory.staged;
            self.memory.commits.push(staged);
        }
        let all = (self.say)(&mut self.memory, message);
        if let Message::Torque { torque, .. } = message {
            self.memory.torque = Some(torque);
        }
        // The count of packets stays right, however many are left out or added, unless the count itself is the fault.
        let all = all.into_iter().map(|(delay, message)| (Span(delay), self.counted(message))).collect();
        self.memory.sent[1] = self.memory.sent[1].wrapping_add(1);
        all
    }

    fn additional_packets(&mut self, now: Micros) -> Vec<(Span, Packet)> {
        self.memory.now = now;
        let all = (self.add)(&mut self.memory);
        self.memory.heard = None;
        all.into_iter().map(|message| (Span(0), self.counted(message))).collect()
    }

    fn frames(&mut self, packet: &Packet, format: Format) -> Vec<Frame> {
        (self.put)(&mut self.memory, packet, format)
    }

    fn stores(&mut self, flash: FlashState) -> FlashState {
        (self.store)(&mut self.memory, flash)
    }

    fn starts(&mut self, now: Micros, flash: FlashState) -> FlashState {
        let Memory { commits, starts, kept, count, measures, .. } = core::mem::take(&mut self.memory);
        let staged = commits.last().copied().unwrap_or_default();
        self.memory = Memory {
            now,
            commits,
            staged,
            starts: starts + 1,
            kept,
            count,
            test_mode: !measures,
            measures,
            ..Memory::default()
        };
        flash
    }

    fn obeys_claims(&self) -> bool {
        self.yields
    }
}

impl FaultyCell {
    fn counted(&mut self, mut message: Message) -> Packet {
        if let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = &mut message {
            // The change that a mutant has made to it stays.
            beat.sent = beat.sent.wrapping_sub(self.memory.sent[1]).wrapping_add(self.memory.sent[0]);
        }
        self.memory.sent[0] = self.memory.sent[0].wrapping_add(1);
        message.encode()
    }
}

/// Returns the heartbeat of a message.
pub(crate) fn beat(message: &mut Message) -> Option<&mut Heartbeat> {
    if let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = message { Some(beat) } else { None }
}

/// Sets or clears a bit of the state.
pub(crate) fn with(mut message: Message, bit: State, set: bool) -> Message {
    if let Some(beat) = beat(&mut message) {
        beat.state = beat.state.with_flags(bit, set);
    }
    message
}

/// Returns the frame of a message on an FD bus.
pub(crate) fn fd(message: &Message) -> Frame {
    message.encode().frames(Format::Fd).next().unwrap()
}

/// Computes F_z as the document defines it, except for one step.
pub(crate) fn force(
    parameters: &Parameters,
    skin: &SkinSensors,
    counts: fn(i64, i64) -> bool,
    sum: fn(i64) -> i64,
    round: fn(i64) -> i64,
) -> i64 {
    let contact = &parameters.contact;
    let f_c = sum(skin.contact.iter().map(|word| i64::from(word.to_bits())).sum());
    let f_c = if counts(f_c, contact.contact_threshold.to_bits().into()) { f_c } else { 0 };
    let p = i64::from(skin.proximity.to_bits());
    let f_p = if counts(p, contact.proximity_threshold.to_bits().into()) { p } else { 0 };
    let f_z =
        ((i64::from(contact.alpha_c.to_bits()) * f_c) << 2) + i64::from(contact.alpha_p.to_bits()) * f_p;
    let f_z = if counts(f_z, i64::from(contact.force_threshold.to_bits()) << 14) { f_z.max(0) } else { 0 };
    round(f_z)
}

/// Applies the rounding and the range of a torque word as the document defines them.
pub(crate) fn rounded(exact: i64, bits: u32) -> i64 {
    ((exact + (1 << (bits - 1))) >> bits).clamp(i16::MIN.into(), i16::MAX.into())
}

/// Computes F_z as the document defines it.
pub(crate) fn right_force(parameters: &Parameters, skin: &SkinSensors) -> i64 {
    force(parameters, skin, |value, threshold| value >= threshold, |sum| sum, |f_z| (f_z + 128) >> 8)
}

/// Returns a torque with other words; none if its force is 0 and the right one is not.
pub(crate) fn retorqued(
    memory: &Memory,
    message: Message,
    compute: impl Fn(&Memory, &Parameters) -> (i64, Words),
) -> Vec<(u64, Message)> {
    match message {
        Message::Torque { from, epoch, torque } if !torque.is_zero() => {
            let (force, torque) = compute(memory, &memory.in_use());
            if force <= 0 { Vec::new() } else { vec![(0, Message::Torque { from, epoch, torque })] }
        }
        other => vec![(0, other)],
    }
}

/// Returns the same torque with one word changed.
pub(crate) fn with_word(message: Message, change: impl Fn(&mut [i16; MAX_JOINTS])) -> Vec<(u64, Message)> {
    match message {
        Message::Torque { from, epoch, torque } if !torque.is_zero() => {
            let mut words = torque.padded();
            change(&mut words);
            vec![(0, Message::Torque { from, epoch, torque: Words::new(torque.length(), words) })]
        }
        other => vec![(0, other)],
    }
}
