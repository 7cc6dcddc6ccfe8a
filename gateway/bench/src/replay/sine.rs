//! The sine with which the cells of a capture computed. Cells of a replay need the same one for the same words.
//!
//! Recordings of runs state it. A capture without it, such as a log of candump, is compared with both: the torques of a
//! single cell fix the ratios of its J, so that a different sine shows where the torques are large. Where they are too
//! small for that, the replay is repeated with the other sine if torques differ.

use std::cmp::Ordering;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, VecDeque};

use model::decode::{Decoded, Decoder};
use protocol::id::CellId;
use protocol::message::{Joints, Message};
use protocol::packet::Epoch;
use protocol::sine::SineMethod;
use protocol::skin::Skin;
use protocol::time::Micros;
use reference::ReferenceCell;
use trace::capture::{CaptureEntry, Reader, RecordingExtras};

use super::{ReplayError, ReplayOptions};

/// The number of joint positions of a bus that torques may answer.
const RECENT_JOINTS: usize = 8;
/// The lead in torques that only one sine explains, after which the decision is made.
const DECISIVE_LEAD: u32 = 4;
/// The maximum number of frames that are read for the decision.
const MAX_FRAMES: u64 = 2_000_000;

/// The sine with which the cells of a capture computed.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum RecordedSine {
    /// The capture states or shows it.
    Known(SineMethod),
    /// The capture neither states nor shows it. It is taken for one of an earlier build.
    Assumed(SineMethod),
}

impl RecordedSine {
    pub(super) const fn method(self) -> SineMethod {
        let (Self::Known(sine) | Self::Assumed(sine)) = self;
        sine
    }
}

/// Finds the sine with which the cells of a capture computed.
pub(super) fn recorded_sine(
    options: &ReplayOptions,
    extras: &RecordingExtras,
    skin: &Skin,
) -> Result<RecordedSine, ReplayError> {
    if let Some(name) = extras.sine_name() {
        return name.parse().map(RecordedSine::Known).map_err(|error| ReplayError::Sine { error });
    }
    let mut evidence = Evidence::new(skin);
    let mut reader = Reader::open_all(&options.files).map_err(ReplayError::Open)?;
    let mut frames = 0;
    while let Some(entry) = reader.next().map_err(ReplayError::Read)? {
        let CaptureEntry::Frame(record) = entry else { continue };
        frames += 1;
        let route = options.map.iter().find(|(from, _)| from == record.interface);
        let bus = route.map_or(record.interface, |(_, to)| to.as_str());
        let now = Micros(record.time.nanos / 1_000);
        if let Decoded::Message(message) = evidence.decoder.decode(now, record.interface, &record.frame) {
            evidence.add_message(bus, &message);
        }
        if evidence.lead() >= DECISIVE_LEAD || frames == MAX_FRAMES {
            break;
        }
    }
    let sine = evidence.decision().unwrap_or(SineMethod::SeventhOrder);
    Ok(if evidence.lead() >= DECISIVE_LEAD { RecordedSine::Known(sine) } else { RecordedSine::Assumed(sine) })
}

/// Counts of the torques that only one of two sines explains.
struct Evidence<'s> {
    skin: &'s Skin,
    decoder: Decoder,
    /// The arithmetic of each cell with each sine, from its first torque on.
    cells: BTreeMap<(usize, CellId), [ReferenceCell; 2]>,
    joints: BTreeMap<usize, VecDeque<(Epoch, Joints)>>,
    votes: [u32; 2],
}

impl<'s> Evidence<'s> {
    fn new(skin: &'s Skin) -> Self {
        let (cells, joints) = (BTreeMap::new(), BTreeMap::new());
        Self { skin, decoder: Decoder::new(None), cells, joints, votes: [0; 2] }
    }

    fn lead(&self) -> u32 {
        let [first, second] = self.votes;
        first.abs_diff(second)
    }

    /// Returns the sine that explains more torques, if one does.
    fn decision(&self) -> Option<SineMethod> {
        let ([first, second], [eighths, seventh_order]) = (self.votes, SineMethod::ALL);
        match first.cmp(&second) {
            Ordering::Greater => Some(eighths),
            Ordering::Less => Some(seventh_order),
            Ordering::Equal => None,
        }
    }

    fn add_message(&mut self, bus: &str, message: &Message) {
        let Some(bus) = self.skin.bus_index(bus) else { return };
        if let Message::Joints { epoch, joints } = message {
            let recent = self.joints.entry(bus).or_default();
            recent.push_back((*epoch, *joints));
            if recent.len() > RECENT_JOINTS {
                recent.pop_front();
            }
        } else if let Message::Torque { from, epoch, torque } = message {
            let recent = self.joints.get(&bus).into_iter().flatten().rev();
            let Some((_, joints)) = recent.into_iter().find(|(number, _)| number == epoch) else { return };
            let cells = match self.cells.entry((bus, *from)) {
                Entry::Occupied(there) => there.into_mut(),
                Entry::Vacant(free) => {
                    let mut on_bus = self.skin.cells_on_bus(bus);
                    let Some(cell) = on_bus.find(|cell| cell.node == *from) else { return };
                    let parameters = self.skin.parameters(cell);
                    free.insert(SineMethod::ALL.map(|sine| ReferenceCell::new(&parameters).with_sine(sine)))
                }
            };
            let [votes_for_eighths, votes_for_seventh_order] = &mut self.votes;
            match cells.each_ref().map(|cell| cell.can_send(&joints.positions, torque.as_slice())) {
                [true, false] => *votes_for_eighths += 1,
                [false, true] => *votes_for_seventh_order += 1,
                [true, true] | [false, false] => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use protocol::fixed::Q1_14;
    use protocol::id::CellId;
    use protocol::packet::{Length, Words};
    use protocol::parameters::MAX_JOINTS;

    use super::*;

    const EPOCHS: u8 = 200;

    /// Returns the evidence of a run in which cell 200 is pressed with this force.
    fn evidence(skin: &Skin, sine: SineMethod, newtons: f64) -> Evidence<'_> {
        let from = CellId::new(200).unwrap();
        let cell = skin.cells_on_bus(0).find(|cell| cell.node == from).unwrap();
        let pressed = ReferenceCell::new(&skin.parameters(cell)).with_sine(sine);
        let mut evidence = Evidence::new(skin);
        for number in 0..EPOCHS {
            let mut positions = [Q1_14::ZERO; MAX_JOINTS];
            for (joint, position) in (1..).zip(positions.iter_mut().take(6)) {
                *position = Q1_14::from_bits(i16::from(number).wrapping_mul(151 * joint));
            }
            let epoch = Epoch(number);
            evidence
                .add_message("vcan0", &Message::Joints { epoch, joints: Joints { positions, in_use: 6 } });
            let mut words = [0; MAX_JOINTS];
            words.copy_from_slice(&pressed.torque_for_force(&positions, newtons));
            let torque = Words::new(Length::for_joints(6), words);
            evidence.add_message("vcan0", &Message::Torque { from, epoch, torque });
        }
        evidence
    }

    #[test]
    fn large_torques_show_the_sine_and_small_ones_leave_it_open() {
        let skin = Skin::parse("ur5-253.toml", include_str!("../../../examples/ur5-253.toml")).unwrap();
        for sine in SineMethod::ALL {
            let seen = evidence(&skin, sine, 9.0);
            assert_eq!(seen.decision(), Some(sine), "{:?}", seen.votes);
            assert!(seen.lead() >= DECISIVE_LEAD && seen.votes.contains(&0), "{:?}", seen.votes);
            assert_eq!(evidence(&skin, sine, 0.0).decision(), None);
        }
    }
}
