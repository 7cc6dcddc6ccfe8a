//! Figures of the paper: *Efficient Distributed Torque Computation for Large Scale Robot Skin*.

/// Mean error of a single cell's torques, Q3.12, in Nm (Fig. 6).
pub const SINGLE_CELL_ERROR_NM: f64 = 0.0054;
/// Mean error of summed torques, Q7.8, in Nm (Fig. 6).
pub const SUMMED_ERROR_NM: f64 = 0.0356;
/// Duration of all work in a cycle except the central computation, in s (Fig. 8).
pub const NON_CENTRAL_WORK_S: f64 = 0.2e-3;
/// Time of a cycle at 500 Hz, in s.
pub const CYCLE_TIME_S: f64 = 2e-3;
/// Time of the central computation per cell, in s (Eq. 29).
pub const CENTRAL_TIME_PER_CELL_S: f64 = 0.827e-6;
/// Time of the central computation without cells, in s (Eq. 29).
pub const CENTRAL_FIXED_TIME_S: f64 = 0.010_73e-3;
/// Goodness of fit (R squared) of Eq. 29.
pub const CELLS_FIT_R_SQUARED: f64 = 0.9995;
/// Time of the central computation per active cell, in s (Eq. 30).
pub const CENTRAL_TIME_PER_ACTIVE_CELL_S: f64 = 0.798e-6;
/// Time of the central computation of 253 inactive cells, in s (Eq. 30).
pub const CENTRAL_TIME_NONE_ACTIVE_S: f64 = 0.2e-3;
/// Goodness of fit (R squared) of Eq. 30.
pub const ACTIVE_CELLS_FIT_R_SQUARED: f64 = 0.939;
/// Maximum number of cells at 500 Hz, none of them active.
pub const MAX_CELLS_NONE_ACTIVE: f64 = 2160.0;
/// Maximum number of cells at 500 Hz, 100 of them active (Eq. 31).
pub const MAX_CELLS_WITH_ACTIVE: f64 = 2067.0;
/// Number of active cells for which [`MAX_CELLS_WITH_ACTIVE`] holds.
pub const ACTIVE_CELLS_AT_LIMIT: f64 = 100.0;
/// Mean error of the fifth-order approximation of the sine.
pub const SINE_MEAN_ERROR: f64 = 6.7e-4;
/// Numbers of multiplications, additions, sines and cosines in one cell's Jacobian on the last link of six (Eq. 27).
pub const JACOBIAN_OPERATIONS: [u32; 4] = [103, 57, 6, 6];

/// Returns the maximum number of cells whose central computation fits in a cycle beside the rest of the work, as the
/// paper derives its limits: `(cycle - rest - fixed - active · per active) / per cell`, all in s. Returns NaN if cells
/// cost nothing.
#[must_use]
pub fn max_cells(per_cell: f64, fixed: f64, per_active: f64, active: f64) -> f64 {
    let room = CYCLE_TIME_S - NON_CENTRAL_WORK_S - fixed - active * per_active;
    if per_cell > 0.0 { (room / per_cell).floor() } else { f64::NAN }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first limit is rounded in the paper: its own law gives 2163.
    #[test]
    fn the_papers_laws_lead_to_its_limits() {
        let none =
            max_cells(CENTRAL_TIME_PER_CELL_S, CENTRAL_FIXED_TIME_S, CENTRAL_TIME_PER_ACTIVE_CELL_S, 0.0);
        assert!((none - 2163.0).abs() < 0.5 && (none - MAX_CELLS_NONE_ACTIVE).abs() < 5.0);
        assert!(
            (max_cells(
                CENTRAL_TIME_PER_CELL_S,
                CENTRAL_FIXED_TIME_S,
                CENTRAL_TIME_PER_ACTIVE_CELL_S,
                ACTIVE_CELLS_AT_LIMIT
            ) - MAX_CELLS_WITH_ACTIVE)
                .abs()
                < 0.5
        );
        assert!(max_cells(0.0, CENTRAL_FIXED_TIME_S, CENTRAL_TIME_PER_ACTIVE_CELL_S, 0.0).is_nan());
    }
}
