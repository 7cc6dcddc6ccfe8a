//! Rounding of numbers before they are printed.

/// Rounds to a number of digits after the decimal point.
pub(crate) fn rounded(value: f64, digits: i32) -> f64 {
    let scale = 10.0_f64.powi(digits);
    (value * scale).round() / scale + 0.0
}
