//! Stores the time of the last frame of each bus. Times are compared within a bus, because frames of different buses
//! may be recorded out of order.

/// Times of the last frames of the first `BUSES` buses.
#[derive(Debug, Default)]
pub(super) struct LastFrameTimes<const BUSES: usize>(Vec<(String, u64)>);

impl<const BUSES: usize> LastFrameTimes<BUSES> {
    /// Stores `nanos` as the time of the newest frame of `bus`. Returns the time of the frame before it on that bus, if
    /// known.
    pub(super) fn replace(&mut self, bus: &str, nanos: u64) -> Option<u64> {
        let Some((_, last)) = self.0.iter_mut().find(|(name, _)| name == bus) else {
            if self.0.len() < BUSES {
                self.0.push((bus.to_owned(), nanos));
            }
            return None;
        };
        Some(core::mem::replace(last, nanos))
    }
}
