//! Piecewise linear curves over time.

use protocol::time::Span;

/// Interpolates a curve at a time in µs: linear between its points, which are sorted by time, and constant outside
/// them. Returns `None` without any points.
pub(super) fn interpolate<T: Copy>(points: &[(T, f64)], at: u64, micros: impl Fn(T) -> u64) -> Option<f64> {
    let after = points.partition_point(|(point, _)| micros(*point) <= at);
    let before = after.checked_sub(1).and_then(|index| points.get(index));
    match (before, points.get(after)) {
        (Some(&(from, low)), Some(&(to, high))) => {
            let passed = |until: u64| seconds(Span(until.saturating_sub(micros(from))));
            Some(low + (high - low) * (passed(at) / passed(micros(to))))
        }
        (Some((_, one)), None) | (None, Some((_, one))) => Some(*one),
        (None, None) => None,
    }
}

/// Converts a time span to s.
#[expect(clippy::cast_precision_loss, reason = "2^53 us are 285 years")]
pub(super) fn seconds(span: Span) -> f64 {
    span.0 as f64 * 1e-6
}
