//! The thread that hears a bus.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use protocol::bus::{Bus, Inbox};
use protocol::can::Format;
use protocol::time::Micros;

use super::hall::Hall;
use crate::run::realtime;
use crate::run::roots::Roots;
use model::decode::{Decoded, Decoder};

/// How often it is looked whether to go on.
const LOOK: Duration = Duration::from_millis(50);
/// The pause while an interface is down.
const DOWN: Duration = Duration::from_millis(20);

/// Hears a bus until it is over, and is the gateway's side of its roots' wires; returns how many frames came faster
/// than they were heard.
pub(super) fn hear(
    lane: usize,
    bus: &Bus,
    format: Format,
    mut roots: Option<Roots>,
    hall: &Arc<Hall>,
) -> u64 {
    realtime::prepare_receiver();
    let mut inbox = Inbox::new();
    let mut decoder = Decoder::new(Some(format));
    // Its cells may be there already, and organise themselves as they come.
    roots.iter_mut().for_each(Roots::explore);
    while !hall.deaf.load(Ordering::Relaxed) {
        if let Some(roots) = &mut roots {
            roots.speak(bus);
        }
        let patience = roots.as_ref().map_or(LOOK, |roots| LOOK.min(roots.patience()));
        match bus.wait(Some(patience)).and_then(|ready| if ready { bus.receive(&mut inbox) } else { Ok(0) }) {
            Ok(0) => continue,
            Ok(_) => {}
            Err(error) if error.may_pass() => {
                hall.judge().is_down(lane);
                hall.has_heard();
                std::thread::sleep(DOWN);
                continue;
            }
            // Whoever sends next hears it too, and says so.
            Err(_) => {
                hall.judge().is_down(lane);
                hall.has_heard();
                break;
            }
        }
        let mut judge = hall.judge();
        for received in inbox.frames().filter(|received| !received.own) {
            if roots.as_mut().is_some_and(|roots| roots.take(&received.frame)) {
                continue;
            }
            let at = Micros(received.at_nanos / 1_000);
            if let Decoded::Message(message) = decoder.decode(at, bus.name(), &received.frame) {
                judge.hear(lane, &message);
            }
        }
        drop(judge);
        hall.has_heard();
    }
    inbox.dropped().into()
}
