//! Histograms of times and their quantiles.

use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};

/// Creates an empty, auto-resizing histogram with three significant digits.
#[must_use]
#[expect(clippy::missing_panics_doc, reason = "three digits are a valid precision")]
pub fn histogram() -> Histogram<u64> {
    Histogram::new(3).expect("three digits are a valid precision")
}

/// A histogram of times in ns that also keeps the exact maximum.
#[derive(Clone, Debug)]
pub struct TimeHistogram {
    histogram: Histogram<u64>,
    longest: u64,
}

impl Default for TimeHistogram {
    fn default() -> Self {
        Self { histogram: histogram(), longest: 0 }
    }
}

impl TimeHistogram {
    /// Adds a time in ns.
    pub fn record(&mut self, nanos: u64) {
        // Recording cannot fail: the histogram resizes itself.
        let _ = self.histogram.record(nanos);
        self.longest = self.longest.max(nanos);
    }

    /// Returns the histogram of all times.
    #[must_use]
    pub const fn histogram(&self) -> &Histogram<u64> {
        &self.histogram
    }

    /// Returns the quantiles in µs. The maximum is exact, and no quantile exceeds it.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
    pub fn quantiles(&self) -> Quantiles {
        let at = |share| self.histogram.value_at_quantile(share).min(self.longest) as f64 / 1e3;
        Quantiles {
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            max: self.longest as f64 / 1e3,
            count: self.histogram.len(),
        }
    }
}

/// Median, 90th and 99th percentile and maximum in µs, and the number of values.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Serialize)]
pub struct Quantiles {
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
    /// Number of values.
    pub count: u64,
}

impl Quantiles {
    /// Computes the quantiles of a histogram in µs; the histogram counts in units of `unit_us` µs.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "times far below 2^53 ns")]
    pub fn from_histogram(histogram: &Histogram<u64>, unit_us: f64) -> Self {
        let at = |quantile| histogram.value_at_quantile(quantile) as f64 * unit_us;
        Self {
            p50: at(0.5),
            p90: at(0.9),
            p99: at(0.99),
            max: histogram.max() as f64 * unit_us,
            count: histogram.len(),
        }
    }
}
