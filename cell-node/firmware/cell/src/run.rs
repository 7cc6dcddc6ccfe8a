//! The main loop of a cell. It passes frames and times to the node, sends the node's packets and writes the node's
//! parameters to flash. All decisions are in `cell_node::node`.

use core::convert::Infallible;

use cell_node::flash::{self, FlashContent, FlashState};
use cell_node::identity::Identity;
use cell_node::node::Node;
use protocol::can::{Format, Frame};
use protocol::factory::FactoryRecord;
use protocol::id::CellId;
use protocol::port::LinkId;
use protocol::time::{Micros, Span};

use crate::board::{Board, MAX_SLEEP};
use crate::store::{self, StoredImage};

/// A cell that runs on a board.
#[derive(Debug)]
pub struct RunningCell<'a, B> {
    board: B,
    factory: FactoryRecord,
    node: &'a mut Node,
}

/// The initial state of a cell: the factory record and the contents of flash.
#[derive(Debug)]
pub struct InitialState {
    factory: FactoryRecord,
    identity: Identity,
    held: FlashState,
}

impl InitialState {
    /// Reads the factory record and flash of a board. Returns `None` for a blank factory record, without which a cell
    /// must not send.
    // Not inlined, so that its buffers are off the stack when the cell runs.
    #[inline(never)]
    pub fn read<B: Board>(board: &mut B) -> Option<Self> {
        let factory = board.factory()?;
        let identity = Identity { cell: factory.node, serial: factory.serial };
        restore(board);
        let (number, held) = read(board, identity);
        let identity = Identity { cell: identity.cell.or(number), ..identity };
        Some(Self { factory, identity, held })
    }

    /// Returns the factory record.
    #[must_use]
    pub const fn factory(&self) -> &FactoryRecord {
        &self.factory
    }

    /// Returns the node of the cell as it starts, without the contents of flash. The caller must call
    /// [`restore`](Self::restore) next.
    #[must_use]
    pub fn node(&self, now: Micros) -> Node {
        // These boards have no sensors: contacts come as stimuli.
        Node::unconfigured(self.identity, self.factory.format, true, now)
    }

    /// Passes the contents of flash to the node.
    pub fn restore(&self, node: &mut Node) {
        node.restore(&self.held);
    }
}

impl<'a, B: Board> RunningCell<'a, B> {
    /// Starts a cell and joins its bus.
    pub fn start(mut board: B, factory: FactoryRecord, node: &'a mut Node) -> Self {
        board.open(&factory);
        let wired = factory.link_ids.iter().enumerate();
        let wired = wired.fold(0, |wired, (port, link_id)| wired | u8::from(link_id.is_some()) << port);
        if wired != 0 {
            node.set_wired_ports(wired);
        }
        board.filter(node, &factory);
        Self { board, factory, node }
    }

    /// Runs the loop forever.
    pub fn run(&mut self) -> Infallible {
        loop {
            self.run_once();
        }
    }

    /// Runs one iteration of the loop: handles received frames and due timers, then sleeps. A cell that lost its node
    /// id to another cell receives but does not send.
    pub fn run_once(&mut self) {
        self.board.feed();
        while let Some((frame, at)) = self.board.receive() {
            if self.node.other_owner().is_some() {
                continue;
            }
            let now = self.board.now();
            self.deliver(now, now.elapsed_since(at), &frame);
            self.flush();
        }
        let now = self.board.now();
        let longest = now + Span(MAX_SLEEP);
        if self.node.other_owner().is_some() {
            return self.board.sleep_until(longest);
        }
        if self.node.poll_timeout() <= now {
            self.node.handle_timeout(now);
            self.flush();
            return;
        }
        self.board.sleep_until(self.node.poll_timeout().min(longest));
    }

    /// Passes a frame to the node. A frame of a simulated wire goes to the port at the end of that wire.
    fn deliver(&mut self, now: Micros, age: Span, frame: &Frame) {
        let Some(link_id) = LinkId::from_raw_id(frame.raw_id()) else {
            return self.node.handle_frame(now, age, frame);
        };
        let ours = Some(link_id.reversed());
        let port = self.factory.link_ids.iter().position(|link_id| *link_id == ours);
        if let (Some(port), Some(message)) = (port, link_id.decode_frame(frame)) {
            self.node.handle_port(now, age, port, message);
        }
    }

    /// Writes the node's pending parameters to flash and reports the result to the node.
    fn store_pending(&mut self) {
        if let Some(written) = self.write() {
            self.node.handle_stored(written);
        }
    }

    /// Encodes the node's pending parameters as a flash image. Returns false if there are none.
    // Not inlined, so that the parameters are off the stack when the image is written.
    #[inline(never)]
    fn image(&self, into: &mut flash::FlashImage) -> bool {
        let Some(kept) = self.node.poll_store() else { return false };
        flash::encode_into(into, self.node.identity().serial, &kept);
        true
    }

    /// Writes the node's pending parameters to flash. Returns true on success, false on failure, and `None` if there
    /// are none.
    // Not inlined, so that the image is off the stack when the node activates its parameters.
    #[inline(never)]
    fn write(&mut self) -> Option<bool> {
        let mut image = flash::FlashImage::new();
        if !self.image(&mut image) {
            return None;
        }
        let written = store::write(self.board.flash(), &image).is_ok();
        Some(written && self.board.store_external(&image))
    }

    /// Writes the node's pending parameters to flash and sends its pending packets.
    fn flush(&mut self) {
        if self.node.other_owner().is_some() {
            return;
        }
        self.store_pending();
        while let Some((port, message)) = self.node.poll_port_transmit() {
            if let Some(link_id) = self.factory.link_ids.get(port).copied().flatten() {
                self.board.send(&link_id.encode_frame(message));
            }
        }
        let format: Format = self.factory.format;
        while let Some(packet) = self.node.poll_transmit() {
            packet.frames(format).for_each(|frame| self.board.send(&frame));
        }
        if self.node.poll_received_ids() {
            self.board.filter(self.node, &self.factory);
        }
    }
}

/// Copies the image outside the microcontroller, if there is one, to flash if they differ.
#[inline(never)]
fn restore<B: Board>(board: &mut B) {
    let mut theirs = [0; flash::MAX_BYTES];
    let Some(theirs) = board.load_external(&mut theirs).and_then(|count| theirs.get(..count)) else {
        return;
    };
    let mut ours = [0; flash::MAX_BYTES];
    let same = matches!(store::read(board.flash(), &mut ours), StoredImage::Image(count) if ours.get(..count) == Some(theirs));
    if !same {
        // A failed write is noticed when the image is read.
        let _ = store::write(board.flash(), theirs);
    }
}

/// Reads from flash the node id that the network assigned, if any, and the parameters.
#[inline(never)]
fn read<B: Board>(board: &mut B, identity: Identity) -> (Option<CellId>, FlashState) {
    let mut image = [0; flash::MAX_BYTES];
    let image = match store::read(board.flash(), &mut image) {
        StoredImage::Nothing => return (None, FlashState::Empty),
        StoredImage::Damaged => return (None, FlashState::Damaged),
        StoredImage::Image(count) => image.get(..count).unwrap_or_default(),
    };
    match flash::decode(identity, image) {
        Ok(FlashContent { number, parameters }) => {
            (number, parameters.map_or(FlashState::Empty, FlashState::Valid))
        }
        Err(_) => (None, FlashState::Damaged),
    }
}
