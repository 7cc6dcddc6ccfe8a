//! Stores the decoded frames of the last seconds, and explains how a cell computed the torque in one of them.

use std::collections::VecDeque;

use analysis::explain::{CellExplanation, JointsWatcher, RequestedJoints, explain};
use model::decode::settle::OrderedDecoder;
use model::decode::{Decoded, Decoder};
use model::latched::{LatchedFrame, LatchedPackets};
use protocol::can::Frame;
use protocol::id::{CellId, Kind, Node};
use protocol::message::Message;
use protocol::packet::data_frame_id;
use protocol::schema::BusUnits;
use protocol::skin::Skin;
use protocol::time::Micros;
use serde::Serialize;

/// The time for which frames are stored, in µs: longer than a slow page takes to list a frame and to ask about it.
const RETENTION_US: u64 = 6_000_000;
/// The maximum number of stored frames.
const MAX_FRAMES: usize = 65_536;
/// The maximum number of frames listed for a cell.
const MAX_LISTED_FRAMES: usize = 8;
/// The maximum time from the joints of an epoch to a torque that replies to them, in ns.
const JOINTS_LOOKBACK_NS: u64 = 500_000_000;

/// The frames of all buses in the last seconds.
#[derive(Clone, Debug)]
pub struct RecentFrames {
    frames: VecDeque<RecentFrame>,
    /// The number of frames so far, which is also the number that the next frame gets.
    count: u64,
    /// For each bus, the state that was latched before the oldest stored frame.
    latched: Vec<LatchedPackets>,
}

#[derive(Clone, Copy, Debug)]
struct RecentFrame {
    at: Micros,
    bus: usize,
    frame: Frame,
}

/// A decoded frame, as the page lists it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DecodedFrame {
    /// The number of the frame, by which the page requests an explanation.
    pub number: u64,
    /// The time in s of the run, or in s since the first frame.
    pub at_s: f64,
    /// The frame in candump's notation.
    pub frame: String,
    /// The verdict and the meaning of the frame, as `skinbus dump` prints them.
    pub said: String,
    /// True if the frame is a torque, which can be explained.
    pub is_torque: bool,
}

/// The steps by which a cell computed the torque in a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TorqueExplanation {
    /// The number of the frame.
    pub number: u64,
    /// The epoch to which the torque belongs.
    pub epoch: u8,
    /// The steps of the cell's computation; `None` if inputs are unknown.
    pub cell: Option<CellExplanation>,
    /// The inputs of the computation that are unknown, one line each.
    pub missing: Vec<String>,
}

impl RecentFrames {
    pub(super) fn new(skin: &Skin) -> Self {
        let latched = skin.buses.iter().map(|_| LatchedPackets::default()).collect();
        Self { frames: VecDeque::new(), count: 0, latched }
    }

    pub(super) fn push(&mut self, at: Micros, bus: usize, frame: &Frame) {
        self.frames.push_back(RecentFrame { at, bus, frame: *frame });
        self.count += 1;
        while self.frames.len() > MAX_FRAMES
            || self.frames.front().is_some_and(|first| at.elapsed_since(first.at).0 > RETENTION_US)
        {
            self.drop_oldest_frame();
        }
    }

    /// Drops all stored frames. The latched state stays.
    pub(super) fn clear(&mut self) {
        while !self.frames.is_empty() {
            self.drop_oldest_frame();
        }
        self.frames.shrink_to_fit();
    }

    fn drop_oldest_frame(&mut self) {
        let Some(RecentFrame { at, bus, frame }) = self.frames.pop_front() else { return };
        if let Some(latched) = self.latched.get_mut(bus) {
            latched.receive(LatchedFrame { at_nanos: at.0 * 1_000, from_gateway: false, frame });
        }
    }

    /// Returns the newest frames that a cell sent or received, newest first. `seconds` converts a time to s of the run,
    /// or to s since the first frame.
    pub(super) fn cell_frames(
        &self,
        skin: &Skin,
        (bus, node): (usize, CellId),
        seconds: impl Fn(Micros) -> f64,
    ) -> Vec<DecodedFrame> {
        let format = skin.buses.get(bus).map(|bus| bus.format);
        let mut settler = OrderedDecoder::new(format);
        for (number, kept) in
            (self.first_frame_number()..).zip(&self.frames).filter(|(_, kept)| kept.bus == bus)
        {
            let Ok(id) = data_frame_id(&kept.frame) else { continue };
            // The frame of a command is needed too, because the length of a torque depends on earlier commands.
            let is_command = id.kind == Kind::Command;
            if is_command || Node::from_byte(id.node) == Node::Cell(node) {
                settler.push(kept.at, "", &kept.frame, (number, *kept, is_command));
            }
        }
        settler.finish();
        let units = BusUnits::for_bus(skin, bus);
        let mut all = VecDeque::new();
        while let Some(((number, kept, is_command), decoded)) = settler.pop() {
            if is_command {
                continue;
            }
            if all.len() == MAX_LISTED_FRAMES {
                all.pop_back();
            }
            all.push_front(DecodedFrame {
                number,
                at_s: seconds(kept.at),
                frame: kept.frame.to_string(),
                said: decoded.in_units(units).to_string(),
                is_torque: matches!(decoded, Decoded::Message(Message::Torque { .. })),
            });
        }
        all.into()
    }

    /// Explains the torque in the frame with this number. Returns `None` if the frame is no longer stored.
    pub(super) fn explain_torque(&self, skin: &Skin, number: u64) -> Option<TorqueExplanation> {
        let place = usize::try_from(number.checked_sub(self.first_frame_number())?).ok()?;
        let asked = self.frames.get(place)?;
        let mut decoder = Decoder::new(None);
        let mut found = None;
        for kept in self.frames.iter().take(place + 1).filter(|kept| kept.bus == asked.bus) {
            found = decoder.decode(kept.at, "", &kept.frame).message().copied();
        }
        let Some(Message::Torque { from, epoch, .. }) = found else { return None };
        let first = self.frames.front()?.at;
        let from_ns = (asked.at.elapsed_since(first).0 * 1_000).saturating_sub(JOINTS_LOOKBACK_NS);
        let mut watch = JointsWatcher::new(skin, RequestedJoints { epoch, from_ns, occurrence: 1 });
        let mut decoder = Decoder::new(None);
        let name = |bus: usize| skin.buses.get(bus).map_or("", |bus| bus.name.as_str());
        for (bus, latched) in self.latched.iter().enumerate() {
            for seen in latched.frames() {
                let at = Micros(seen.at_nanos / 1_000);
                if let Decoded::Message(message) = decoder.decode(at, name(bus), &seen.frame) {
                    watch.receive_latched(seen.at_nanos, name(bus), &message);
                }
            }
        }
        for kept in &self.frames {
            let decoded = decoder.decode(kept.at, name(kept.bus), &kept.frame);
            if watch.receive(kept.at.0 * 1_000, name(kept.bus), decoded.message()) {
                break;
            }
        }
        let said = match watch.into_joints() {
            Ok(moments) => explain(skin, &moments),
            Err(error) => {
                return Some(TorqueExplanation {
                    number,
                    epoch: epoch.0,
                    cell: None,
                    missing: vec![error.to_string()],
                });
            }
        };
        let bus = name(asked.bus);
        let cell = said.cells.into_iter().find(|cell| cell.bus == bus && cell.node == from.get());
        let here = [format!("{bus} {from}:"), format!("{bus}:"), format!("{bus} answers")];
        let missing = said.missing.into_iter();
        let missing = missing.filter(|line| here.iter().any(|here| line.starts_with(here))).collect();
        Some(TorqueExplanation { number, epoch: epoch.0, cell, missing })
    }

    fn first_frame_number(&self) -> u64 {
        self.count - self.frames.len() as u64
    }
}
