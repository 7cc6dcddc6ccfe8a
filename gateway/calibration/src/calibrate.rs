//! The calibration of a whole skin: estimates each cell from its own readings, improves positions by the distances of
//! neighbours, and marks doubtful cells.

use nalgebra::Vector3;
use protocol::parameters::MAX_JOINTS;
use protocol::skin::{Cell, Skin};

use crate::each::parallel_map;
use crate::estimate::{AgeCovariance, Estimate, PoseGuess, estimate_cell};
use crate::help::{MotionAdvice, suggest_motion};
use crate::lag::StretchLags;
use crate::neighbors::{LocatedCell, improve_positions};
use crate::observe::{Observations, Reading};
use crate::refusal::{GapSummary, Refusal};
use crate::result::{Calibration, CellResult, Diagnosis, Pose, SensorResult, Summary};
use crate::rounded::rounded;
use crate::table::MotionTable;
use crate::zero::zero_offsets;
use model::accelerometer::sensor::{DataSheet, cell_rotation};

pub use crate::settings::Settings;

/// The fraction of the expected readings below which a cell is reported as silent.
const MIN_READING_SHARE: f64 = 0.5;
/// The minimum number of readings for an estimate.
const MIN_READINGS: usize = 200;
/// The factor by which the residuals of a loose or damaged cell exceed those of most cells and those of the data sheet.
const LOOSE_CELL_RESIDUAL_FACTOR: f64 = 1.5;
/// The factor by which the residuals of most cells may exceed the data sheet; above it, the recording is refused.
const MAX_SCATTER_FACTOR: f64 = 1.3;
/// The relative difference above which the recorded broadcast rate does not match that of the skin.
const BROADCAST_RATE_TOLERANCE: f64 = 0.02;
/// The maximum difference between the lags of two stretches on a bus, as a fraction of the recording's duration.
const MAX_LAG_DIFFERENCE_SHARE: f64 = 0.005;
/// The number of rounds of estimates, each of which improves the shifts of stretches.
const SHIFT_ESTIMATE_ROUNDS: usize = 5;
/// The logarithm of the likelihood ratio above which the best joint is certain, against the next best one.
const MIN_LOG_LIKELIHOOD_RATIO: f64 = 10.0;
/// The factor by which a cell must be nearer to the described place of another cell than to its own, to be marked.
const SWAPPED_CELL_DISTANCE_FACTOR: f64 = 2.0;

/// Estimates the pose and the sensor errors of every cell of a skin from a recording.
///
/// # Errors
/// Returns [`Refusal`] if the recording does not match the skin or its sensors, or is too disturbed; nothing is
/// estimated then.
pub fn calibrate(skin: &Skin, seen: &Observations, settings: &Settings) -> Result<Calibration, Refusal> {
    let (seen_by, disturbance) = estimate_cells(skin, seen, settings)?;
    let CellEstimates { tables, lags, estimates } = seen_by;
    let mut cells: Vec<_> = skin
        .cells
        .iter()
        .zip(&estimates)
        .zip(&seen.cells)
        .map(|((cell, estimate), readings)| {
            let table = tables.get(cell.bus).and_then(Option::as_ref);
            let usable =
                table.map_or(0, |table| readings.iter().filter(|it| table.is_motion_known(it)).count());
            let share = as_f64(usable) / as_f64(table.map_or(0, MotionTable::known_motion_count)).max(1.0);
            cell_result(skin, cell, estimate.as_ref(), readings, share)
        })
        .collect();
    mark_scattering_cells(&mut cells, &estimates);
    let wires = improve_by_neighbors(skin, &mut cells, settings);
    find_swapped_cells(skin, &mut cells);
    add_motion_advice(skin, &estimates, &mut cells, settings);
    for (result, cell) in cells.iter_mut().zip(&skin.cells) {
        result.store_pose(skin, cell, tables.get(cell.bus).and_then(Option::as_ref).map(|table| &table.arm));
    }
    let summary = Summary::from_cells(&cells, wires, disturbance);
    let zero_offsets =
        settings.zero_offsets.then(|| zero_offsets(skin, seen, settings, (&tables, &lags), &estimates));
    Ok(Calibration { summary, cells, zero_offsets })
}

/// The estimates of all cells, each from its own readings only.
struct CellEstimates {
    /// The motions of the links, by bus; `None` for a bus without a chain.
    tables: Vec<Option<MotionTable>>,
    lags: Vec<StretchLags>,
    /// The estimate of each cell.
    estimates: Vec<Option<Estimate>>,
}

/// Estimates each cell from its own readings, and the shifts of stretches between gaps from the cells of a bus.
fn estimate_cells(
    skin: &Skin,
    seen: &Observations,
    settings: &Settings,
) -> Result<(CellEstimates, GapSummary), Refusal> {
    check_joints_and_rate(skin, seen)?;
    let mut lags: Vec<_> = seen.buses.iter().map(StretchLags::zero_lags).collect();
    let period = settings.sheet.period_s();
    for round in 0..=SHIFT_ESTIMATE_ROUNDS {
        let now = estimate_each_cell(skin, seen, settings, lags);
        let disturbance = check_recording_gaps(skin, seen, &now.tables)?;
        let more: Vec<_> = now
            .tables
            .iter()
            .zip(&now.lags)
            .enumerate()
            .map(|(bus, (table, lags))| {
                let cells = skin.cells.iter().zip(&now.estimates).zip(&seen.cells);
                let cells = cells.filter(|((cell, _), _)| cell.bus == bus);
                let cells =
                    cells.filter_map(|((_, estimate), readings)| Some((estimate.as_ref()?, &readings[..])));
                lags.refined_by_residuals(table.as_ref()?, cells, period)
            })
            .collect();
        let Some((bus, most)) = more
            .iter()
            .enumerate()
            .find_map(|(bus, more)| Some((bus, more.as_ref()?.stretch_with_largest_lag())))
        else {
            check_scatter(&now.estimates, &settings.sheet, disturbance)?;
            check_lag_differences(skin, seen, &now.lags, disturbance)?;
            return Ok((now, disturbance));
        };
        if round == SHIFT_ESTIMATE_ROUNDS {
            return Err(shift_refusal(skin, seen, (bus, most), disturbance));
        }
        lags = now.lags.into_iter().zip(more).map(|(before, more)| more.unwrap_or(before)).collect();
    }
    unreachable!("the last round returns")
}

fn shift_refusal(
    skin: &Skin,
    seen: &Observations,
    (bus, (place, lag)): (usize, (usize, f64)),
    disturbance: GapSummary,
) -> Refusal {
    let gap = seen.buses.get(bus).and_then(|bus| bus.gaps.iter().rev().find(|gap| gap.place <= place));
    let (from, from_s) = gap.map_or((0, 0.0), |gap| (gap.place, gap.at_s));
    let at_s = from_s + as_f64(place - from) / skin.timing.broadcast_hz();
    let (at_s, ms) = (rounded(at_s, 3), rounded(lag * 1e3, 1));
    Refusal::Shifted { bus: bus_name(skin, bus), at_s, ms, disturbance }
}

/// Checks that the lags of a bus' stretches differ by at most [`MAX_LAG_DIFFERENCE_SHARE`] of the duration, because
/// many large shifts cannot be estimated accurately.
fn check_lag_differences(
    skin: &Skin,
    seen: &Observations,
    lags: &[StretchLags],
    disturbance: GapSummary,
) -> Result<(), Refusal> {
    for (bus, (lags, observed)) in lags.iter().zip(&seen.buses).enumerate() {
        let length_s = as_f64(observed.joints.len()) / skin.timing.broadcast_hz();
        if lags.lag_range_s() > MAX_LAG_DIFFERENCE_SHARE * length_s {
            return Err(shift_refusal(skin, seen, (bus, lags.stretch_with_largest_lag()), disturbance));
        }
    }
    Ok(())
}

fn bus_name(skin: &Skin, bus: usize) -> String {
    skin.buses.get(bus).map_or_else(String::new, |bus| bus.name.clone())
}

/// Checks that the number of joints in a recording and their broadcast rate match the skin.
fn check_joints_and_rate(skin: &Skin, seen: &Observations) -> Result<(), Refusal> {
    for (bus, observed) in
        seen.buses.iter().enumerate().filter(|(bus, _)| skin.cells_on_bus(*bus).next().is_some())
    {
        if let Some(got) = observed.other_joints {
            let joints = skin.chain(bus).joints.len();
            return Err(Refusal::Joints { bus: bus_name(skin, bus), got, joints });
        }
        let hz = skin.timing.broadcast_hz();
        if let Some(got) = observed
            .period_s()
            .map(f64::recip)
            .filter(|got| (got / hz - 1.0).abs() > BROADCAST_RATE_TOLERANCE)
        {
            return Err(Refusal::Rate { bus: bus_name(skin, bus), got: rounded(got, 2), hz: rounded(hz, 2) });
        }
    }
    Ok(())
}

/// Returns the gaps of a recording, or an error if the motion is known for too few of its broadcasts.
fn check_recording_gaps(
    skin: &Skin,
    seen: &Observations,
    tables: &[Option<MotionTable>],
) -> Result<GapSummary, Refusal> {
    let mut all = GapSummary::default();
    for (bus, (observed, table)) in seen.buses.iter().zip(tables).enumerate() {
        let Some(table) = table else { continue };
        let disturbance = GapSummary::from_bus(observed, table.known_motion_count());
        if table.known_motion_count() < MIN_READINGS {
            return Err(Refusal::Disturbed { bus: bus_name(skin, bus), disturbance });
        }
        all = all.merged_with(disturbance);
    }
    Ok(all)
}

/// Checks that readings do not scatter much more than the data sheet allows.
fn check_scatter(
    estimates: &[Option<Estimate>],
    sheet: &DataSheet,
    disturbance: GapSummary,
) -> Result<(), Refusal> {
    let middle = |pick: fn(&Estimate) -> f64| {
        let mut all: Vec<_> = estimates.iter().flatten().map(pick).collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).copied().unwrap_or_default()
    };
    let times = middle(|estimate| estimate.noise_times).max(middle(|estimate| estimate.rough_times));
    if times <= MAX_SCATTER_FACTOR {
        return Ok(());
    }
    Err(Refusal::Scatter {
        times: rounded(times, 1),
        noise_mg: rounded(middle(|estimate| estimate.noise_g) * 1e3, 1),
        sheet_mg: rounded(sheet.reading_deviation() * 1e3, 1),
        disturbance,
    })
}

fn estimate_each_cell(
    skin: &Skin,
    seen: &Observations,
    settings: &Settings,
    lags: Vec<StretchLags>,
) -> CellEstimates {
    let buses: Vec<_> = (0..skin.buses.len()).collect();
    let tables: Vec<_> = parallel_map(buses.len(), settings.threads, |bus| {
        let is_used = skin.cells_on_bus(bus).next().is_some();
        let (sheet, gravity) = (&settings.sheet, settings.gravity);
        lags.get(bus)
            .filter(|_| is_used)
            .map(|lags| MotionTable::new(skin, bus, seen, sheet, gravity, &[0.0; MAX_JOINTS], lags))
    });
    let ages = AgeCovariance::for_sheet(&settings.sheet, 1.0 / skin.timing.broadcast_hz());
    let estimates = parallel_map(skin.cells.len(), settings.threads, |index| {
        let cell = skin.cells.get(index)?;
        let table = tables.get(cell.bus)?.as_ref()?;
        let readings = seen.cells.get(index)?;
        if readings.len() < MIN_READINGS || is_stuck(readings) {
            return None;
        }
        let own = table
            .arm
            .transform_between(cell.row, skin.chain(cell.bus).row_of(cell.joint).unwrap_or_default());
        let guess = PoseGuess {
            joint: cell.joint,
            rotation: own.rotation * cell_rotation(cell.orientation, cell.normal),
            position: own.transform_point(&cell.position.into()).coords,
        };
        estimate_cell(table, readings, &guess, &settings.sheet, &ages)
    });
    CellEstimates { tables, lags, estimates }
}

/// Returns true if all readings are equal.
fn is_stuck(readings: &[Reading]) -> bool {
    let mut readings = readings.iter().map(|reading| reading.g.map(f64::to_bits));
    let first = readings.next();
    readings.all(|reading| Some(reading) == first)
}

/// Returns the result for one cell, from its own readings only.
fn cell_result(
    skin: &Skin,
    cell: &Cell,
    estimate: Option<&Estimate>,
    readings: &[Reading],
    share: f64,
) -> CellResult {
    let mut result = CellResult::without_estimate(skin, cell, readings.len());
    if readings.is_empty() {
        result.troubles.push(Diagnosis::Dead);
    } else if is_stuck(readings) {
        result.troubles.push(Diagnosis::Stuck);
    } else if share < MIN_READING_SHARE || readings.len() < MIN_READINGS {
        result.troubles.push(Diagnosis::Silent { share: rounded(share, 3) });
    }
    let Some(estimate) = estimate else {
        if result.troubles.is_empty() {
            result.troubles.push(Diagnosis::Silent { share: rounded(share, 3) });
        }
        return result;
    };
    let mirror = estimate.model.matrix;
    result.sensor = SensorResult {
        bias_g: Some(estimate.model.bias.into()),
        gain: Some(mirror.diagonal().into()),
        noise_g: Some(estimate.noise_g),
        rough_g: Some(estimate.rough_g),
    };
    if estimate.joint == 0 {
        result.troubles.push(Diagnosis::Still);
        return result;
    }
    if estimate.margin < MIN_LOG_LIKELIHOOD_RATIO {
        result.troubles.push(Diagnosis::Joint { joint: estimate.joint });
    }
    result.pose = Some(Pose {
        joint: estimate.joint,
        position: estimate.model.position,
        rotation: estimate.model.rotation,
        position_covariance: estimate.position_covariance(),
        turn_covariance: estimate.rotation_covariance(),
    });
    result
}

/// Marks cells whose readings scatter much more than those of most cells and than the data sheet allows.
fn mark_scattering_cells(cells: &mut [CellResult], estimates: &[Option<Estimate>]) {
    let times = |(cell, estimate): (&CellResult, &Option<Estimate>)| {
        cell.pose.as_ref().and(estimate.as_ref()).map(|estimate| estimate.rough_times)
    };
    let mut all: Vec<_> = cells.iter().zip(estimates).filter_map(times).collect();
    all.sort_by(f64::total_cmp);
    let Some(&most) = all.get(all.len() / 2) else { return };
    for (cell, estimate) in cells.iter_mut().zip(estimates) {
        let Some(times) = times((cell, estimate)).map(|times| times / most.max(1.0)) else { continue };
        if times > LOOSE_CELL_RESIDUAL_FACTOR {
            cell.troubles.push(Diagnosis::Loose { times: rounded(times, 1) });
        }
    }
}

/// Improves the positions of the cells by the lengths of wires, link by link, and returns the number of wires used.
fn improve_by_neighbors(skin: &Skin, cells: &mut [CellResult], settings: &Settings) -> usize {
    let Some(spacing) = settings.spacing else { return 0 };
    let mut used = 0;
    for bus in 0..skin.buses.len() {
        for joint in 1..=u8::try_from(skin.chain(bus).joints.len()).unwrap_or_default() {
            let on_link = |(_, (cell, result)): &(usize, (&Cell, &CellResult))| {
                let determined =
                    result.pose.as_ref().is_some_and(|pose| pose.joint == joint && pose.is_determined());
                cell.bus == bus && determined && result.troubles.is_empty()
            };
            let members: Vec<_> =
                skin.cells.iter().zip(&*cells).enumerate().filter(on_link).map(|(index, _)| index).collect();
            let mut known: Vec<_> = members
                .iter()
                .filter_map(|&index| cells.get(index)?.pose.as_ref())
                .map(|pose| LocatedCell {
                    position: pose.position,
                    normal: pose.rotation * Vector3::z(),
                    covariance: pose.position_covariance,
                })
                .collect();
            let place = |node| {
                members.iter().position(|&index| skin.cells.get(index).is_some_and(|cell| cell.node == node))
            };
            let mut wires = Vec::new();
            for (one, cell) in members.iter().filter_map(|&index| skin.cells.get(index)).enumerate() {
                let others = cell.neighbors.iter().flatten().filter_map(|node| place(*node));
                wires.extend(others.filter(|other| one < *other).map(|other| (one, other)));
            }
            used += improve_positions(&mut known, &wires, &spacing);
            for (index, known) in members.into_iter().zip(known) {
                if let Some(pose) = cells.get_mut(index).and_then(|cell| cell.pose.as_mut()) {
                    (pose.position, pose.position_covariance) = (known.position, known.covariance);
                }
            }
        }
    }
    used
}

/// Marks cells that were found at the described place of another cell.
fn find_swapped_cells(skin: &Skin, cells: &mut [CellResult]) {
    let found: Vec<_> =
        skin.cells.iter().zip(&*cells).map(|(cell, result)| other_cell_at(skin, cell, result)).collect();
    for (index, (result, place)) in cells.iter_mut().zip(&found).enumerate() {
        let Some(other) = place else { continue };
        let Some(there) = skin.cells.get(*other) else { continue };
        let both = found.get(*other).copied().flatten() == Some(index);
        let node = there.node.get();
        result.troubles.push(if both { Diagnosis::Swapped { node } } else { Diagnosis::Elsewhere { node } });
    }
}

/// Returns the other cell of the same bus at whose described place a cell was found.
fn other_cell_at(skin: &Skin, cell: &Cell, result: &CellResult) -> Option<usize> {
    let pose = result.pose.as_ref().filter(|pose| pose.is_determined())?;
    // Half a turn counts as much as a metre: an offset by a cell's width equals 5 degrees.
    let far = |described: &Cell| {
        if described.joint != pose.joint {
            return f64::INFINITY;
        }
        let normal = pose.rotation * Vector3::z();
        let way = (Vector3::from(described.position) - pose.position).norm();
        way + normal.angle(&Vector3::from(described.normal)) / core::f64::consts::PI
    };
    let own = far(cell);
    let others = skin.cells.iter().enumerate();
    let others = others.filter(|(_, other)| other.bus == cell.bus && other.node != cell.node);
    let mut distances: Vec<_> = others.map(|(index, other)| (far(other), index)).collect();
    distances.sort_by(|one, other| one.0.total_cmp(&other.0));
    let (nearest, index) = *distances.first()?;
    let next = distances.get(1).map_or(f64::INFINITY, |(next, _)| *next);
    let certain = 2.0 * pose.position_radius_95_m() + 0.002;
    (nearest * SWAPPED_CELL_DISTANCE_FACTOR < own
        && nearest * SWAPPED_CELL_DISTANCE_FACTOR < next + 2e-3
        && own > certain)
        .then_some(index)
}

/// Adds to each cell without a determined pose the motion that would help to determine it.
fn add_motion_advice(
    skin: &Skin,
    estimates: &[Option<Estimate>],
    cells: &mut [CellResult],
    settings: &Settings,
) {
    let mut known: Vec<((usize, u8), MotionAdvice)> = Vec::new();
    for ((cell, estimate), result) in skin.cells.iter().zip(estimates).zip(cells) {
        let (Some(estimate), Some(pose)) = (estimate, &result.pose) else { continue };
        if pose.is_determined() {
            continue;
        }
        let key = (cell.bus, pose.joint);
        let help = known.iter().find(|(of, _)| *of == key).map(|(_, help)| help.clone());
        let help = help.unwrap_or_else(|| {
            let help = suggest_motion(skin, cell.bus, estimate, settings);
            known.push((key, help.clone()));
            help
        });
        let [position_mm, orientation_deg] =
            [pose.position_radius_95_m() * 1e3, pose.rotation_angle_95_rad().to_degrees()];
        result.troubles.push(Diagnosis::NotObservable {
            position_mm: rounded(position_mm, 1),
            orientation_deg: rounded(orientation_deg, 1),
            help,
        });
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts of readings")]
const fn as_f64(of: usize) -> f64 {
    of as f64
}
