//! Input and output for the cells of one process: clock, bus and flash files. The modules of the core make all
//! decisions.

mod clock;
mod flash_file;
mod line;
mod outbox;
mod sockets;
mod subscriptions;

use std::time::{Duration, Instant};

use protocol::bus::{BusError, BusOptions, ReceivedFrame};
use protocol::can::Format;
use protocol::id::{CellId, Kind};
use protocol::packet;
use protocol::port::{LinkId, PORTS};
use protocol::sine::SineMethod;
use protocol::time::{Micros, Span};

use crate::flash::FlashState;
use crate::identity::Identity;
use crate::node::Node;
use clock::Clock;
use outbox::Outbox;
use sockets::{MergedFrame, ReceiveFilters};
use subscriptions::Subscriptions;

pub use flash_file::FlashFile;
pub use line::BusPort;
pub use sockets::Sockets;

/// Retry interval for opening a bus that does not exist yet.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);
/// Retry interval while a network interface is down.
const INTERFACE_DOWN_RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// Maximum age of unsent frames. Older frames are dropped: epochs count modulo 256, so a receiver could take their
/// torques for newer ones.
const MAX_UNSENT_AGE: Duration = Duration::from_millis(250);

/// Maximum number of cells in a process in which joints need not wake untouched cells. With more cells, heartbeats wake
/// the process as often as joints do, so resting saves nothing.
const MAX_RESTING_CELLS: usize = 8;

/// The link ids that a cell sends with, by port; the last one is the uplink to the gateway's side.
pub type PortLinkIds = [Option<LinkId>; PORTS + 1];

/// The cells of one process, which share a socket.
#[derive(Debug)]
pub struct HostedCells {
    cells: Vec<HostedCell>,
    format: Format,
    sine: SineMethod,
    clock: Clock,
    subscriptions: Subscriptions,
    /// True if the identifiers that the cells receive may have changed since the filters were set.
    subscriptions_changed: bool,
    /// True if pending frames have been received since a timer became due. They are handled before the timer.
    received_first: bool,
    filters: ReceiveFilters,
    outbox: Outbox,
    /// The time since which the bus has not accepted the pending frames.
    unsent_since: Option<Instant>,
}

/// A cell with its own resources. The alignment keeps fields that are used together in the same cache lines.
#[derive(Debug)]
#[repr(align(64))]
struct HostedCell {
    node: Node,
    file: FlashFile,
    link_ids: PortLinkIds,
}

/// The reason for which the cells of a process stop.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StopReason {
    /// Another cell uses the node id of a cell.
    #[error(
        "cell {cell} is already on {bus}, with serial number {serial}: stop it, or give this cell another node id"
    )]
    NodeIdTaken {
        /// The name of the bus.
        bus: String,
        /// The node id.
        cell: u8,
        /// The serial number of the other cell.
        serial: u32,
    },
    /// Wires between cells must be simulated, which is not allowed on a real bus.
    #[error(
        "{bus} is real hardware, but cells that answer with sums simulate their wires with frames that \
         must not be sent there: use a vcan or the embedded bus, or reply = \"torque\""
    )]
    Real {
        /// The interface.
        bus: String,
    },
    /// The bus failed.
    #[error(transparent)]
    Bus(#[from] BusError),
}

impl HostedCells {
    /// Creates an empty set of cells for a bus with this frame format. The cells compute with this sine.
    #[must_use]
    pub fn new(format: Format, sine: SineMethod) -> Self {
        Self {
            cells: Vec::new(),
            format,
            sine,
            clock: Clock::new(),
            subscriptions: Subscriptions::default(),
            subscriptions_changed: false,
            received_first: false,
            filters: ReceiveFilters::default(),
            outbox: Outbox::default(),
            unsent_since: None,
        }
    }

    /// Adds a cell that starts with the contents of its flash and has wires with these link ids. A simulated cell has
    /// no sensors, so it uses stimuli.
    pub fn add_cell(
        &mut self,
        identity: Identity,
        flash: &FlashState,
        file: FlashFile,
        link_ids: PortLinkIds,
    ) {
        let mut wired = 0;
        for (port, link_id) in
            link_ids.iter().enumerate().filter_map(|(port, link_id)| Some((port, (*link_id)?)))
        {
            wired |= 1 << port;
            self.subscriptions.subscribe_port(link_id.reversed(), self.cells.len(), port);
        }
        let node = Node::new(identity, self.format, flash, true, self.clock.now())
            .with_sine(self.sine)
            .with_ports(wired);
        self.cells.push(HostedCell { node, file, link_ids });
        self.subscriptions_changed = true;
    }

    /// Opens the bus of the cells.
    ///
    /// Cells that are wired to each other receive each other's sums and wire messages. If they share a socket, the
    /// socket must also return the frames that it sends.
    ///
    /// # Errors
    /// Returns an error if the bus does not exist, is not accessible, or does not support the options.
    pub fn open_sockets(&mut self, line: &BusPort) -> Result<Sockets, StopReason> {
        self.update_subscriptions();
        let options = BusOptions {
            filters: self.filters.at_once.clone(),
            fd: self.format == Format::Fd,
            own_frames: line.wires && self.cells.len() > 1,
            ..BusOptions::default()
        };
        Sockets::open(line, &options, &self.filters.deferred)
    }

    /// Waits until the bus exists, and opens it.
    ///
    /// # Errors
    /// Returns an error if the bus cannot be used, and waiting would not help.
    pub fn reopen_sockets(&mut self, line: &BusPort) -> Result<Sockets, StopReason> {
        loop {
            std::thread::sleep(RETRY_INTERVAL);
            match self.open_sockets(line) {
                Err(StopReason::Bus(error)) if error.may_open_later() => {}
                opened => return opened,
            }
        }
    }

    /// Updates the table of received identifiers if it may be out of date. Returns the previous filters if the filters
    /// have changed.
    fn update_subscriptions(&mut self) -> Option<ReceiveFilters> {
        if !core::mem::take(&mut self.subscriptions_changed) {
            return None;
        }
        let (cells, rest) = (self.cells.iter().enumerate(), self.cells.len() <= MAX_RESTING_CELLS);
        self.subscriptions.replace_subscriptions(cells.flat_map(
            |(place, HostedCell { node, link_ids, .. })| {
                let may_defer = rest || link_ids.iter().any(Option::is_some);
                node.received_ids().map(move |id| (place, id, may_defer && node.may_receive_deferred(id)))
            },
        ));
        let hearing = self.subscriptions.filters();
        (hearing != self.filters).then(|| core::mem::replace(&mut self.filters, hearing))
    }

    /// Runs the cells until the bus fails or another cell has one of their node ids.
    ///
    /// # Errors
    /// Always returns the reason for which the cells stopped.
    pub fn run(
        &mut self,
        mut sockets: Sockets,
        line: &BusPort,
    ) -> Result<core::convert::Infallible, StopReason> {
        let mut now = self.clock.now();
        loop {
            match self.run_once(&mut sockets, now) {
                Ok(()) => {}
                // Frames received before the error have already been processed.
                Err(StopReason::Bus(error)) => {
                    self.recover_bus(error, &mut sockets, line)?;
                    now = self.clock.now();
                    continue;
                }
                Err(error) => return Err(error),
            }
            now = self.clock.now();
            for &MergedFrame { ref received, waited } in sockets.frames() {
                let age = self.clock.age(now, received.at_nanos);
                // A frame that a resting cell only counts is processed as if it had woken the process. With
                // sums, its epoch is as old as its joints.
                let (now, age) = if waited && !line.wires { (now - age, Span(0)) } else { (now, age) };
                self.deliver_frame(received, age, sockets.name(), now)?;
            }
        }
    }

    /// Waits for a bus that does not work, or opens it again. Pending frames are sent afterwards. Frames that are too
    /// old are lost, as on a microcontroller without a bus.
    fn recover_bus(
        &mut self,
        error: BusError,
        sockets: &mut Sockets,
        line: &BusPort,
    ) -> Result<(), StopReason> {
        let since = *self.unsent_since.get_or_insert_with(Instant::now);
        if line.reconnect && error.is_closed() {
            *sockets = self.reopen_sockets(line)?;
        } else if matches!(error, BusError::Down(_)) {
            self.drop_outbox();
            std::thread::sleep(INTERFACE_DOWN_RETRY_INTERVAL);
        } else if !error.is_temporary() {
            return Err(error.into());
        }
        if since.elapsed() > MAX_UNSENT_AGE {
            self.drop_outbox();
        }
        Ok(())
    }

    /// Drops the pending frames and subtracts their packets from the counters of sent packets.
    fn drop_outbox(&mut self) {
        for place in self.outbox.drop_all_frames() {
            if let Some(hosted_cell) = self.cells.get_mut(place) {
                hosted_cell.node.handle_unsent_packet();
            }
        }
    }

    /// Runs one iteration: handles due timers, sends pending frames, and waits for frames.
    fn run_once(&mut self, sockets: &mut Sockets, now: Micros) -> Result<(), StopReason> {
        let timeouts = self.cells.iter().map(|hosted_cell| hosted_cell.node.poll_timeout());
        let due = timeouts.min().filter(|&due| due <= now);
        // Frames that arrived before a timer became due are processed first, once.
        if let Some(due) = due
            && !core::mem::replace(&mut self.received_first, true)
            && sockets.receive_pending(self.clock.wall_clock_nanos(due))?
        {
            return Ok(());
        }
        self.received_first = false;
        let mut next = Micros(u64::MAX);
        for (place, hosted_cell) in self.cells.iter_mut().enumerate() {
            if hosted_cell.node.poll_timeout() <= now {
                hosted_cell.node.handle_timeout(now);
                self.subscriptions_changed |=
                    hosted_cell.collect_outgoing(place, self.format, &mut self.outbox);
            }
            next = next.min(hosted_cell.node.poll_timeout());
        }
        self.clock.measure_offset_if_due(now);
        // Set the filters before the answers to the following frames can arrive.
        if let Some(before) = self.update_subscriptions()
            && let Err(error) = sockets.set_filters(&self.filters, &before)
        {
            self.filters = before;
            self.subscriptions_changed = true;
            return Err(error.into());
        }
        let frames = self.outbox.frames();
        let sent = sockets.send(frames);
        let count = sent.as_ref().map_or_else(|error| error.sent, |()| frames.len());
        self.outbox.mark_sent(count);
        sent.map_err(|error| error.cause)?;
        self.unsent_since = None;
        Ok(sockets.wait_for_frames(Duration::from_micros(next.elapsed_since(now).0))?)
    }

    /// Passes a frame to the cells that receive it, and collects the packets that they answer with.
    fn deliver_frame(
        &mut self,
        received: &ReceivedFrame,
        age: Span,
        bus: &str,
        now: Micros,
    ) -> Result<(), StopReason> {
        let frame = &received.frame;
        if let Some(link_id) = LinkId::from_raw_id(frame.raw_id()) {
            if let Some((place, port)) = self.subscriptions.port_for_link(link_id)
                && let (Some(hosted_cell), Some(message)) =
                    (self.cells.get_mut(place), link_id.decode_frame(frame))
            {
                hosted_cell.node.handle_port(now, age, port, message);
                self.subscriptions_changed |=
                    hosted_cell.collect_outgoing(place, self.format, &mut self.outbox);
            }
            return Ok(());
        }
        let Ok(id) = packet::data_frame_id(frame) else {
            // Each cell counts frames that it cannot use.
            self.cells.iter_mut().for_each(|hosted_cell| hosted_cell.node.handle_frame(now, age, frame));
            return Ok(());
        };
        // The other cells of this process receive only sums from among its own frames. A frame with a cell's own
        // node id is not from another cell.
        if received.own && id.kind != Kind::Sum {
            return Ok(());
        }
        for &place in self.subscriptions.cells_for_id(id) {
            let Some(hosted_cell) = self.cells.get_mut(place) else { continue };
            hosted_cell.node.handle_frame(now, age, frame);
            if let Some(serial) = hosted_cell.node.other_owner() {
                let (bus, cell) = (bus.to_owned(), hosted_cell.node.identity().cell.map_or(0, CellId::get));
                return Err(StopReason::NodeIdTaken { bus, cell, serial });
            }
            self.subscriptions_changed |= hosted_cell.collect_outgoing(place, self.format, &mut self.outbox);
        }
        Ok(())
    }
}

impl HostedCell {
    /// Writes the cell's pending parameters to flash and moves its pending packets to the outbox. Returns true if the
    /// cell now receives other identifiers.
    fn collect_outgoing(&mut self, place: usize, format: Format, outbox: &mut Outbox) -> bool {
        if let Some(kept) = self.node.poll_store() {
            self.node.handle_stored(self.file.store(&kept).is_ok());
        }
        while let Some((port, message)) = self.node.poll_port_transmit() {
            let link_id = self.link_ids.get(port).copied().flatten();
            if let Some(link_id) = link_id {
                outbox.push_uncounted(link_id.encode_frame(message));
            }
        }
        while let Some(packet) = self.node.poll_transmit() {
            outbox.push_packet(place, packet.frames(format));
        }
        self.node.poll_received_ids()
    }
}
