//! Queries the cells of a bus, and collects what they report.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use model::decode::Decoded;
use model::listing::CellListing;
use protocol::bus::{Bus, BusError, BusOptions, Filter, GATEWAY_RECEIVE_BUFFER_BYTES, KindChoice};
use protocol::can::Format;
use protocol::id::{Command, Id, Kind};
use protocol::message::Message;
use protocol::time::Micros;

use crate::bus::listen::{self, Listener, send_message, tolerate_transient_error};

/// Time to wait for a heartbeat (sent four times a second), which shows the cells' frame format.
const FORMAT_TIMEOUT: Duration = Duration::from_millis(300);
/// Interval between queries to all cells.
const QUERY_INTERVAL: Duration = Duration::from_secs(2);
/// Maximum time that one poll of the bus waits for a frame.
const POLL_TIMEOUT: Duration = Duration::from_millis(50);

/// Reports received from the cells of a bus, and the time of the last query.
#[derive(Debug)]
pub struct CellWatch {
    listener: Listener,
    began: Instant,
    listing: CellListing,
    non_packets: u64,
    /// Format of packets, if known before the first frame.
    format: Option<Format>,
    requested: Option<Instant>,
}

impl CellWatch {
    /// Opens a bus, which may be a classic interface, to receive from cells and gateways. Queries are sent in `format`
    /// or, if it is `None`, in the format of the received frames.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus cannot be opened.
    pub fn open(name: &str, kind: KindChoice, format: Option<Format>) -> Result<Self, BusError> {
        let kinds = Kind::ALL.into_iter().filter(|kind| kind.is_from_cells());
        let mut filters: Vec<_> = kinds.map(Filter::for_kind).collect();
        filters.push(Filter::exact(Id::command(Command::Joints)));
        let receive_buffer = GATEWAY_RECEIVE_BUFFER_BYTES as usize;
        let options = BusOptions { filters, receive_buffer, ..BusOptions::default() };
        let listener = Listener::new(listen::open_bus(name, kind, None, options)?, None);
        let listing = CellListing::new();
        Ok(Self { listener, began: Instant::now(), listing, non_packets: 0, format, requested: None })
    }

    /// The open bus.
    #[must_use]
    pub const fn bus(&self) -> &Bus {
        self.listener.bus()
    }

    /// The reports received so far.
    #[must_use]
    pub const fn listing(&self) -> &CellListing {
        &self.listing
    }

    /// Number of received frames that are not packets of the protocol.
    #[must_use]
    pub const fn non_packet_count(&self) -> u64 {
        self.non_packets
    }

    /// Time since the bus was opened.
    #[must_use]
    pub fn elapsed(&self) -> Duration {
        self.began.elapsed()
    }

    /// The present time on the listing's clock.
    #[must_use]
    pub fn now(&self) -> Micros {
        Micros::from_elapsed(self.began.elapsed())
    }

    /// Queries the cells as soon as the format of their frames is known. If `again` is set, repeats the query at
    /// intervals.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus is gone or closed.
    pub fn query_cells(&mut self, again: bool) -> Result<(), BusError> {
        let due = self.requested.is_none_or(|requested| again && requested.elapsed() >= QUERY_INTERVAL);
        let waited = (self.elapsed() >= FORMAT_TIMEOUT).then_some(Format::Fd);
        let Some(format) = self.format.or_else(|| self.listing.format()).or(waited).filter(|_| due) else {
            return Ok(());
        };
        self.requested = Some(Instant::now());
        let requested =
            [Message::Report, Message::Sync].iter().try_for_each(|it| send_message(self.bus(), it, format));
        match requested {
            // Cells that cannot be queried can still be received.
            Err(BusError::FdFrame { .. }) => Ok(()),
            requested => tolerate_transient_error(requested, Duration::ZERO).map(|_| ()),
        }
    }

    /// Receives frames for the time of one poll. While the bus is down, waits instead, unless `stopped` is set.
    ///
    /// # Errors
    /// Returns [`BusError`] if the bus is gone or closed.
    pub fn receive(&mut self, stopped: &AtomicBool) -> Result<(), BusError> {
        let heard = self.listener.receive(POLL_TIMEOUT);
        if stopped.load(Ordering::Relaxed) {
            heard?;
        } else {
            tolerate_transient_error(heard, POLL_TIMEOUT)?;
        }
        let now = self.now();
        for (received, decoded) in self.listener.decoded_frames() {
            if let Decoded::Message(message) = decoded {
                self.listing.receive(now, received.frame.format(), &message);
            } else {
                self.non_packets += 1;
            }
        }
        Ok(())
    }
}
