//! Runs a link: one thread forwards frames between a bus and a Zenoh session. The rules are in the pure module `hosts`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use protocol::bus::{Bus, BusError, BusKind, BusOptions, Inbox};
use protocol::id::CellId;
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use vcan_setup::hosts::incoming::{HostsToBusQueue, MAX_SOURCES, SourceAccount};
use vcan_setup::hosts::message::StampedFrame;
use vcan_setup::hosts::outgoing::{BusAccount, BusToHostsQueue};
use vcan_setup::hosts::report::{HostReport, LinkReport, listen};
use vcan_setup::hosts::returned::ReturnedFrameDetector;
use zenoh::bytes::ZBytes;
use zenoh::key_expr::KeyExpr;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};

use crate::event::LinkEvent;
use crate::log;
use crate::session::{FRAMES, HEARD, LinkError, LinkSettings, config, host_of, key, life};
use crate::watchers::Watchers;

/// The requested receive buffer of the bus socket, in bytes.
const RECEIVE_BUFFER: usize = 8 << 20;
/// The interval between two attempts to send to a bus whose queue is full.
const SEND_RETRY_INTERVAL: Duration = Duration::from_millis(1);
/// The interval between two attempts to open an unavailable bus.
const REOPEN_INTERVAL: Duration = Duration::from_millis(100);
/// The minimum interval between two messages about losses on standard error.
const LOSS_REPORT_INTERVAL: Duration = Duration::from_secs(1);
/// The interval between two reports to other hosts and to programs on this machine.
const REPORT_INTERVAL: Duration = Duration::from_millis(200);
/// The maximum number of batches read from the bus before the link sends and handles events again.
const MAX_BATCHES: usize = 4;

/// The state that the link's thread shares with the threads of Zenoh.
struct Shared {
    incoming: Mutex<HostsToBusQueue>,
    /// By host: the counts that this host has published of the frames received from here.
    ours: Mutex<BTreeMap<String, SourceAccount>>,
    wake: OwnedFd,
}

impl Shared {
    fn incoming(&self) -> MutexGuard<'_, HostsToBusQueue> {
        self.incoming.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn ours(&self) -> MutexGuard<'_, BTreeMap<String, SourceAccount>> {
        self.ours.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wake(&self) {
        // Writing fails only if the counter is at its maximum, and then the thread is woken anyway.
        let _ = rustix::io::write(&self.wake, &1_u64.to_ne_bytes());
    }
}

/// A link between a local bus and the buses of the same name on other hosts.
pub(crate) struct HostLink {
    settings: LinkSettings,
    kind: BusKind,
    session: Session,
    publisher: Publisher<'static>,
    /// The publisher of the counts of frames received from the other hosts.
    accounts: Publisher<'static>,
    shared: Arc<Shared>,
    events: Receiver<LinkEvent>,
    /// Subscriptions and liveliness tokens. Dropping them ends them.
    declared: Vec<Box<dyn Send>>,
    bus: Option<Bus>,
    outgoing: BusToHostsQueue,
    returned: ReturnedFrameDetector,
    began: Instant,
    missed_before: u64,
    there: BTreeSet<String>,
    /// The programs on this machine that receive reports. Its socket also prevents a second link of the same bus.
    watchers: Watchers,
    tell_at: Instant,
}

impl fmt::Debug for HostLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("HostLink").field("settings", &self.settings).finish_non_exhaustive()
    }
}

impl HostLink {
    /// Opens the bus and a Zenoh session. The other hosts need not be reachable yet.
    ///
    /// # Errors
    /// Returns [`LinkError`] if the bus cannot be opened, if the configuration is wrong, or if another process links
    /// the bus.
    pub(crate) fn open(settings: LinkSettings) -> Result<Self, LinkError> {
        let own = key(FRAMES, &settings.bus, &settings.host)?;
        let config = config(&settings)?;
        let kind = settings.choice.resolve(&settings.bus);
        let listener = listen(&settings.bus, kind, settings.directory.as_deref()).map_err(|error| {
            if error.kind() == io::ErrorKind::AddrInUse {
                LinkError::Twice(settings.bus.clone())
            } else {
                LinkError::Wait(error)
            }
        })?;
        let bus = open(&settings)?;
        let (tell, events) = channel();
        log::listen(tell.clone());
        let session = zenoh::open(config).wait().map_err(|error| settings.blame(&error.to_string()))?;
        let publisher = session
            .declare_publisher(own)
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::RealTime)
            .allowed_destination(Locality::Remote)
            .wait()
            .map_err(LinkError::zenoh)?;
        let accounts = session
            .declare_publisher(key(HEARD, &settings.bus, &settings.host)?)
            .allowed_destination(Locality::Remote)
            .wait()
            .map_err(LinkError::zenoh)?;
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK);
        let wake = wake.map_err(|errno| LinkError::Wait(errno.into()))?;
        let shared = Arc::new(Shared { incoming: Mutex::default(), ours: Mutex::default(), wake });
        let mut link = Self {
            settings,
            kind,
            session,
            publisher,
            accounts,
            shared,
            events,
            declared: Vec::new(),
            bus: Some(bus),
            outgoing: BusToHostsQueue::new(life()),
            returned: ReturnedFrameDetector::default(),
            began: Instant::now(),
            missed_before: 0,
            there: BTreeSet::new(),
            watchers: Watchers::new(listener),
            tell_at: Instant::now(),
        };
        link.declare(&tell)?;
        Ok(link)
    }

    /// Subscribes to what the other hosts publish: their frames, their counts of this host's frames, and their
    /// presence.
    fn declare(&mut self, tell: &Sender<LinkEvent>) -> Result<(), LinkError> {
        let LinkSettings { bus, host, .. } = self.settings.clone();
        let shared = Arc::clone(&self.shared);
        self.subscribe(FRAMES, tell.clone(), move |from, bytes| {
            shared.incoming().receive_message(from, bytes).map_err(|error| error.to_string())
        })?;
        let (shared, this) = (Arc::clone(&self.shared), host.clone());
        self.subscribe(HEARD, tell.clone(), move |from, bytes| {
            let heard: BTreeMap<String, SourceAccount> = serde_json::from_slice(bytes)
                .map_err(|error| format!("its counts of received frames cannot be decoded: {error}"))?;
            let mut ours = shared.ours();
            if let Some(heard) =
                heard.get(&this).filter(|_| ours.len() < MAX_SOURCES || ours.contains_key(from))
            {
                ours.insert(from.to_owned(), *heard);
            }
            Ok(())
        })?;
        let (shared, tell, this) = (Arc::clone(&self.shared), tell.clone(), host.clone());
        let seen = move |sample: Sample| {
            let from = host_of(sample.key_expr().as_str()).to_owned();
            if from != this {
                let is_there = sample.kind() == SampleKind::Put;
                let _ = tell.send(if is_there { LinkEvent::Joined(from) } else { LinkEvent::Gone(from) });
                shared.wake();
            }
        };
        let liveliness = self.session.liveliness();
        let watch = liveliness.declare_subscriber(key(FRAMES, &bus, "*")?).history(true).callback(seen);
        self.declared.push(Box::new(watch.wait().map_err(LinkError::zenoh)?));
        let token = liveliness.declare_token(key(FRAMES, &bus, &host)?).wait().map_err(LinkError::zenoh)?;
        self.declared.push(Box::new(token));
        Ok(())
    }

    /// Subscribes to a key. Passes received data to `take`, and reports the errors that it returns.
    fn subscribe(
        &mut self,
        what: &str,
        tell: Sender<LinkEvent>,
        take: impl Fn(&str, &[u8]) -> Result<(), String> + Send + Sync + 'static,
    ) -> Result<(), LinkError> {
        let LinkSettings { bus, host, .. } = self.settings.clone();
        let shared = Arc::clone(&self.shared);
        let taken = move |sample: Sample| {
            let from = host_of(sample.key_expr().as_str());
            if from == host {
                return;
            }
            if let Err(why) = take(from, &sample.payload().to_bytes()) {
                let _ = tell.send(LinkEvent::Garbage(from.to_owned(), why));
            }
            shared.wake();
        };
        let all: KeyExpr<'static> = key(what, &bus, "*")?;
        let subscriber =
            self.session.declare_subscriber(all).allowed_origin(Locality::Remote).callback(taken);
        self.declared.push(Box::new(subscriber.wait().map_err(LinkError::zenoh)?));
        Ok(())
    }

    /// Returns the kind of the local bus.
    #[must_use]
    pub(crate) const fn kind(&self) -> BusKind {
        self.kind
    }

    /// Forwards frames until `stop` is readable or hung up. Returns the final counts of all frames.
    ///
    /// # Errors
    /// Returns [`LinkError::Wait`] if the system cannot wait.
    pub(crate) fn run(
        mut self,
        stop: impl AsFd,
        mut report: impl FnMut(LinkEvent),
    ) -> Result<LinkReport, LinkError> {
        let (mut inbox, mut bytes) = (Inbox::new(), Vec::new());
        let (mut said, mut say_at, mut open_at) = ((0, 0), Instant::now(), Instant::now());
        let mut warned = BTreeSet::new();
        loop {
            if !self.wait(&stop).map_err(LinkError::Wait)? {
                break;
            }
            if self.bus.is_none() && open_at <= Instant::now() {
                open_at = Instant::now() + REOPEN_INTERVAL;
                self.bus = open(&self.settings).ok();
                if self.bus.is_some() {
                    report(LinkEvent::BusBack);
                }
            }
            let lost = self.read(&mut inbox).and_then(|()| self.write());
            if let Err(error) = lost {
                self.bus = None;
                self.missed_before += u64::from(inbox.dropped_count());
                inbox = Inbox::new();
                report(LinkEvent::BusAway(error.to_string()));
            }
            self.publish(&mut bytes);
            self.note_events(&mut report);
            if self.returned.returned_frame_count() > 0 && warned.insert(None) {
                report(LinkEvent::Circle);
            }
            let shared: Vec<_> = self.shared.incoming().shared_host_names().map(str::to_owned).collect();
            for host in shared {
                if warned.insert(Some(host.clone())) {
                    report(LinkEvent::SameName(host));
                }
            }
            let losses = self.losses();
            if losses != said && say_at <= Instant::now() {
                report(LinkEvent::Lost {
                    from_here: losses.0 - said.0,
                    from_others: losses.1.saturating_sub(said.1),
                });
                (said, say_at) = (losses, Instant::now() + LOSS_REPORT_INTERVAL);
            }
            self.watchers.accept();
            if self.tell_at <= Instant::now() {
                self.send_reports();
            }
        }
        let report = self.report();
        self.declared.clear();
        let _ = self.session.close().wait();
        Ok(report)
    }

    /// Updates which hosts are present, and reports the events that have occurred.
    fn note_events(&mut self, report: &mut impl FnMut(LinkEvent)) {
        for event in self.events.try_iter() {
            if let LinkEvent::Joined(host) = &event
                && self.there.len() < MAX_SOURCES
            {
                self.there.insert(host.clone());
            } else if let LinkEvent::Gone(host) = &event {
                self.there.remove(host);
            }
            // The report to programs on this machine is due at once, because a host has come or gone.
            self.tell_at = self.began;
            report(event);
        }
    }

    /// Publishes the counts of the other hosts' frames, and sends the report to the programs on this machine.
    fn send_reports(&mut self) {
        self.tell_at = Instant::now() + REPORT_INTERVAL;
        let report = self.report();
        let heard: BTreeMap<_, _> = report.hosts.iter().map(|(host, it)| (host, it.heard)).collect();
        if let Ok(bytes) = serde_json::to_vec(&heard)
            && !heard.is_empty()
        {
            // The counts are published five times a second, so a lost message does no harm.
            let _ = self.accounts.put(bytes).wait();
        }
        self.watchers.send(&report);
    }

    /// Reads frames from the bus and queues them for the other hosts.
    fn read(&mut self, inbox: &mut Inbox) -> Result<(), BusError> {
        let Some(bus) = &self.bus else { return Ok(()) };
        let now = nanos(self.began.elapsed());
        for _ in 0..MAX_BATCHES {
            let count = bus.receive(inbox)?;
            for received in inbox.frames() {
                if self.returned.is_returned(now, &received.frame) {
                    continue;
                }
                let at_nanos = if received.at_nanos == 0 { wall() } else { received.at_nanos };
                self.outgoing.push(StampedFrame { at_nanos, frame: received.frame });
            }
            self.outgoing.set_missed_count(self.missed_before + u64::from(inbox.dropped_count()));
            if count == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Sends the frames of other hosts that are queued to the bus.
    fn write(&mut self) -> Result<(), BusError> {
        let Some(bus) = &self.bus else { return Ok(()) };
        let now = nanos(self.began.elapsed());
        let mut incoming = self.shared.incoming();
        while !incoming.waiting_frames().is_empty() {
            let returned = &mut self.returned;
            let copies = incoming
                .waiting_frames()
                .iter()
                .take_while(|frame| returned.is_circled_copy(now, frame))
                .count();
            incoming.remove_copies(copies);
            let frames = incoming
                .waiting_frames()
                .iter()
                .take_while(|frame| !returned.is_circled_copy(now, frame))
                .count();
            let sent = bus.send(incoming.waiting_frames().get(..frames).unwrap_or_default());
            let count = sent.as_ref().map_or_else(|error| error.sent, |()| frames);
            for frame in incoming.waiting_frames().iter().take(count) {
                self.returned.record_sent(now, frame);
            }
            incoming.remove_sent(count);
            match sent {
                Ok(()) => {}
                Err(error) => {
                    if matches!(error.cause, BusError::Full { .. }) {
                        return Ok(());
                    }
                    let count = incoming.waiting_frames().len();
                    incoming.remove_refused(count);
                    return Err(error.cause);
                }
            }
        }
        Ok(())
    }

    /// Passes queued frames to Zenoh, which never blocks. Zenoh drops frames that find no room; the other hosts count
    /// these as lost.
    fn publish(&mut self, bytes: &mut Vec<u8>) {
        loop {
            let count = self.outgoing.encode_message(bytes);
            if count == 0 {
                return;
            }
            match self.publisher.put(ZBytes::from(bytes.as_slice())).wait() {
                Ok(()) => self.outgoing.remove_sent(count),
                Err(_) => self.outgoing.remove_refused(count),
            }
        }
    }

    /// Waits for frames, for Zenoh, or for the next report. Returns false if the link should stop.
    fn wait(&self, stop: &impl AsFd) -> io::Result<bool> {
        let mut polled =
            vec![PollFd::new(stop, PollFlags::IN), PollFd::new(&self.shared.wake, PollFlags::IN)];
        let listener = self.watchers.listener();
        polled.extend(listener.map(|listener| PollFd::from_borrowed_fd(listener, PollFlags::IN)));
        polled.extend(self.bus.as_ref().map(|bus| PollFd::from_borrowed_fd(bus.as_fd(), PollFlags::IN)));
        let is_full = !self.shared.incoming().waiting_frames().is_empty();
        let until_told = self.tell_at.saturating_duration_since(Instant::now());
        let timeout = match &self.bus {
            None => REOPEN_INTERVAL.min(until_told),
            Some(_) if is_full => SEND_RETRY_INTERVAL.min(until_told),
            Some(_) => until_told,
        };
        match poll(&mut polled, Timespec::try_from(timeout).ok().as_ref()) {
            Ok(_) | Err(Errno::INTR) => {}
            // The kernel lacks memory for a moment. All sources are then treated as ready.
            Err(Errno::NOMEM | Errno::AGAIN) => std::thread::sleep(SEND_RETRY_INTERVAL),
            Err(errno) => return Err(errno.into()),
        }
        let came = |at: usize| polled.get(at).is_some_and(|polled| !polled.revents().is_empty());
        if came(1) {
            // The value of the counter does not matter, because all sources are treated as ready.
            let _ = rustix::io::read(&self.shared.wake, &mut [0; 8]);
        }
        Ok(!came(0))
    }

    /// Returns the number of lost frames from the local bus, and of those from other hosts.
    fn losses(&self) -> (u64, u64) {
        let BusAccount { dropped, missed, .. } = self.outgoing.account();
        let incoming = self.shared.incoming();
        let of_others =
            incoming.accounts().map(|(_, heard, _)| heard.missing_frame_count()).fold(0, u64::saturating_add);
        (dropped + missed, of_others)
    }

    fn report(&self) -> LinkReport {
        let incoming = self.shared.incoming();
        let ours = self.shared.ours();
        let mut hosts: BTreeMap<String, HostReport> = incoming
            .accounts()
            .map(|(host, heard, nodes)| {
                let nodes = nodes.iter().map(CellId::get).collect();
                (host.to_owned(), HostReport { heard, nodes, ..HostReport::default() })
            })
            .collect();
        for (host, heard) in ours.iter() {
            hosts.entry(host.clone()).or_default().ours = Some(*heard);
        }
        for host in &self.there {
            hosts.entry(host.clone()).or_default().is_there = true;
        }
        LinkReport {
            host: self.settings.host.clone(),
            sent: self.outgoing.account(),
            hosts,
            returned: self.returned.returned_frame_count(),
            unknown_hosts: incoming.unknown_hosts(),
        }
    }
}

fn open(settings: &LinkSettings) -> Result<Bus, BusError> {
    let options = BusOptions {
        receive_buffer: RECEIVE_BUFFER,
        send_timeout: Duration::ZERO,
        directory: settings.directory.clone(),
        ..BusOptions::default()
    };
    Bus::open(&settings.bus, settings.choice, &options)?.without_time()
}

fn wall() -> u64 {
    nanos(SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default())
}

fn nanos(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}
