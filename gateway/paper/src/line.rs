//! Linear regression: the line that fits weighted points best, R², and the confidence interval of the slope.

use analysis::report::figure::Quantity;

/// A point with a weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeightedPoint {
    /// The independent variable.
    pub x: f64,
    /// The dependent variable.
    pub y: f64,
    /// The number of measurements that the point represents; above 0.
    pub weight: f64,
}

impl WeightedPoint {
    /// Returns a point at `x` whose y is the median of the measurements, weighted by their number.
    #[must_use]
    pub fn median(x: f64, measured: &mut [f64]) -> Self {
        Self { x, y: quantile(measured, 0.5), weight: count_to_f64(measured.len()) }
    }
}

/// A line `y = slope x + intercept`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinearFit {
    /// The slope, in units of y per unit of x.
    pub slope: f64,
    /// The intercept, in units of y.
    pub intercept: f64,
    /// R²: the share of y's variance that the line explains, in [0, 1].
    pub quality: f64,
    /// Half the width of the slope's 95 % confidence interval, in the unit of the slope.
    pub slope_half: f64,
}

impl LinearFit {
    /// Returns the line for which the weighted sum of squared distances along y is smallest. Returns `None` if there
    /// are fewer than three points or all have the same x, because the line or its interval is then undefined.
    ///
    /// With weights w, means weighted by w, and n points:
    ///
    /// ```text
    ///   slope = Sxy / Sxx        R² = 1 - Σ w r² / Syy        s² = Σ w r² / (n - 2)
    ///   interval of the slope: slope ± t(0.975, n - 2) · sqrt(s² / Sxx)
    /// ```
    #[must_use]
    pub fn fit(points: &[WeightedPoint]) -> Option<Self> {
        if points.len() < 3 {
            return None;
        }
        let total: f64 = points.iter().map(|point| point.weight).sum();
        let mean = |of: fn(&WeightedPoint) -> f64| {
            points.iter().map(|point| point.weight * of(point)).sum::<f64>() / total
        };
        let (x_mean, y_mean) = (mean(|point| point.x), mean(|point| point.y));
        let (mut sxx, mut sxy, mut syy) = (0.0, 0.0, 0.0);
        for WeightedPoint { x, y, weight } in points {
            let (dx, dy) = (x - x_mean, y - y_mean);
            sxx += weight * dx * dx;
            sxy += weight * dx * dy;
            syy += weight * dy * dy;
        }
        if sxx <= 0.0 {
            return None;
        }
        let slope = sxy / sxx;
        let intercept = y_mean - slope * x_mean;
        let left = |point: &WeightedPoint| point.weight * (point.y - slope * point.x - intercept).powi(2);
        let residual: f64 = points.iter().map(left).sum();
        // If all y are equal, there is no variance that the line could explain, so the quality is 0.
        let quality = if syy > 0.0 { (1.0 - residual / syy).max(0.0) } else { 0.0 };
        let freedom = count_to_f64(points.len() - 2);
        let slope_half = student_t(freedom) * (residual / freedom / sxx).sqrt();
        Some(Self { slope, intercept, quality, slope_half })
    }

    /// Returns the line that fits points of equal weight best.
    #[must_use]
    pub fn fit_unweighted(points: &[(f64, f64)]) -> Option<Self> {
        let points: Vec<_> = points.iter().map(|&(x, y)| WeightedPoint { x, y, weight: 1.0 }).collect();
        Self::fit(&points)
    }

    /// Returns the value of the line at `x`.
    #[must_use]
    pub fn value_at(&self, x: f64) -> f64 {
        self.slope * x + self.intercept
    }

    /// Returns the slope with its 95 % confidence interval as a quantity in `unit`, without conversion.
    #[must_use]
    pub fn slope_in(&self, unit: &str) -> Quantity {
        Quantity::new(self.slope, unit).with_half_interval(self.slope_half)
    }

    /// Returns the upper end of the slope's 95 % confidence interval.
    #[must_use]
    pub fn slope_at_most(&self) -> f64 {
        self.slope + self.slope_half
    }

    /// Returns the x at which a rising line reaches `y`; NaN for a line that does not rise.
    #[must_use]
    pub fn x_at_value(&self, y: f64) -> f64 {
        if self.slope > 0.0 { (y - self.intercept) / self.slope } else { f64::NAN }
    }
}

/// Converts a count to a floating-point number.
#[must_use]
#[expect(clippy::cast_precision_loss, reason = "counts of what is in memory, below 2^53")]
pub fn count_to_f64(count: usize) -> f64 {
    count as f64
}

/// Returns the 97.5 % quantile of Student's t distribution for `freedom` degrees of freedom. It is computed by an
/// expansion about the normal distribution (Abramowitz and Stegun 26.7.5), which is up to 5 % too small below 10
/// degrees of freedom.
fn student_t(freedom: f64) -> f64 {
    const Z_95_PERCENT: f64 = 1.959_963_984_540_054;
    let z = |power: i32| Z_95_PERCENT.powi(power);
    let terms = [
        (z(3) + Z_95_PERCENT) / 4.0,
        (5.0 * z(5) + 16.0 * z(3) + 3.0 * Z_95_PERCENT) / 96.0,
        (3.0 * z(7) + 19.0 * z(5) + 17.0 * z(3) - 15.0 * Z_95_PERCENT) / 384.0,
        (79.0 * z(9) + 776.0 * z(7) + 1482.0 * z(5) - 1920.0 * z(3) - 945.0 * Z_95_PERCENT) / 92_160.0,
    ];
    terms.into_iter().zip(1..).fold(Z_95_PERCENT, |sum, (term, power)| sum + term / freedom.powi(power))
}

/// Returns the quantile of the values: the value below which the share `part`, in [0, 1], of them lies. Returns NaN if
/// there are no values.
#[must_use]
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a place within the values")]
pub fn quantile(values: &mut [f64], part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    let place = (part * count_to_f64(last)).round() as usize;
    values.get(place).copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_found_and_explains_everything() {
        let points: Vec<_> = (0..10).map(|x| (f64::from(x), 3.0 * f64::from(x) - 2.0)).collect();
        let line = LinearFit::fit_unweighted(&points).unwrap();
        assert!((line.slope - 3.0).abs() < 1e-12 && (line.intercept + 2.0).abs() < 1e-12);
        assert!((line.quality - 1.0).abs() < 1e-12 && line.slope_half < 1e-6);
        assert!((line.x_at_value(25.0) - 9.0).abs() < 1e-12 && (line.value_at(9.0) - 25.0).abs() < 1e-12);
    }

    /// A common example in textbooks: x is 1 to 5 and y is 2, 4, 5, 4, 5. Slope 0.6, intercept 2.2, R² 0.6, standard
    /// error of the slope 0.2828, t(0.975, 3) = 3.182.
    #[test]
    fn quality_and_interval_are_those_of_a_textbook() {
        let points = [(1.0, 2.0), (2.0, 4.0), (3.0, 5.0), (4.0, 4.0), (5.0, 5.0)];
        let line = LinearFit::fit_unweighted(&points).unwrap();
        assert!((line.slope - 0.6).abs() < 1e-12 && (line.intercept - 2.2).abs() < 1e-12);
        assert!((line.quality - 0.6).abs() < 1e-12);
        assert!((line.slope_half / 0.282_843 - 3.182).abs() < 0.02 * 3.182, "{}", line.slope_half);
        assert!((line.slope_at_most() - line.slope - line.slope_half).abs() < 1e-12);
    }

    #[test]
    fn students_t_is_that_of_the_tables() {
        for (freedom, target, within) in
            [(3.0, 3.182, 0.02), (10.0, 2.228, 1e-3), (29.0, 2.045, 1e-3), (100.0, 1.984, 1e-3)]
        {
            let t = student_t(freedom);
            assert!((t / target - 1.0).abs() < within, "{freedom}: {t}");
        }
    }

    #[test]
    fn a_weight_of_three_is_three_points() {
        let once = [(0.0, 1.0), (1.0, 2.0), (1.0, 2.0), (1.0, 2.0), (2.0, 5.0)];
        let thrice = [(0.0, 1.0, 1.0), (1.0, 2.0, 3.0), (2.0, 5.0, 1.0)];
        let thrice = thrice.map(|(x, y, weight)| WeightedPoint { x, y, weight });
        let (once, thrice) = (LinearFit::fit_unweighted(&once).unwrap(), LinearFit::fit(&thrice).unwrap());
        assert!((once.slope - thrice.slope).abs() < 1e-12);
        assert!((once.intercept - thrice.intercept).abs() < 1e-12);
        assert!((once.quality - thrice.quality).abs() < 1e-12);
    }

    #[test]
    fn where_there_is_no_line_there_is_none() {
        assert_eq!(LinearFit::fit_unweighted(&[(0.0, 1.0), (1.0, 2.0)]), None);
        assert_eq!(LinearFit::fit_unweighted(&[(1.0, 1.0), (1.0, 2.0), (1.0, 3.0)]), None);
        let level = LinearFit::fit_unweighted(&[(0.0, 1.0), (1.0, 1.0), (2.0, 1.0)]).unwrap();
        assert!(level.x_at_value(5.0).is_nan(), "a line that does not rise has no limit");
    }

    #[test]
    fn quantiles_are_values() {
        let mut values = [3.0, 1.0, 2.0, 5.0, 4.0];
        let at = |part, values: &mut [f64]| quantile(values, part);
        assert!((at(0.5, &mut values) - 3.0).abs() < 1e-12);
        assert!((at(0.0, &mut values) - 1.0).abs() < 1e-12 && (at(1.0, &mut values) - 5.0).abs() < 1e-12);
        assert!(quantile(&mut [], 0.5).is_nan());
    }
}
