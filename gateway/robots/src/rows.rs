//! Denavit-Hartenberg rows, and their computation from the axes of the joints.

use core::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Matrix4, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use protocol::parameters::RowKind;
use protocol::skin::{ChainBase, ChainRow, DenavitHartenberg, JointKind};

/// Upper bound of `a` and `d` of a row, in m, exclusive. The lower bound is its negative, inclusive.
pub const MAX_LENGTH_M: f64 = 2.0;

/// Maximum difference between the kinematics of rows and URDF, in m or rad.
pub const MAX_RESIDUAL: f64 = 1e-9;

/// Tolerance of angles in rad. Axes are parallel if the sine of the angle between them is smaller. Angles this close to
/// a multiple of a quarter turn are rounded to it; pi / 2 written with 12 digits is off by 5e-12.
const ANGLE_TOLERANCE: f64 = 1e-11;

/// Lengths below this value, in m, are rounded to zero.
const LENGTH_TOLERANCE_M: f64 = 1e-12;

/// Distance in m below which two origins count as the same, and difference in m below which two paths count as equally
/// long.
const SAME_POINT_DISTANCE_M: f64 = 1e-9;

/// Minimum sine of the angle between two axes. Below it, the common normal of the axes cannot be computed precisely.
const MIN_NORMAL_SINE: f64 = 1e-3;

/// Maximum distance in m of frame 0 from the origin of the first joint, and of the last frame from the origin of the
/// last joint, both along the joint's axis.
const MAX_AXIS_SHIFT_M: f64 = 1.0;

/// Lengths in m that a fixed row must save. A row has a cost because it adds a rounding error to a cell's computation.
/// The second value is for chains whose rows are too long with the first.
pub(crate) const FIXED_ROW_COSTS_M: [f64; 2] = [0.2, 0.0];

/// Cost in m of a length that exceeds the range of a row.
const OUT_OF_RANGE_COST_M: f64 = 1e3;

/// One row in standard Denavit-Hartenberg form, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`. It leads from frame l - 1, whose z
/// axis is the axis of the row's joint, to frame l.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DhRow {
    /// Kind of the row: the kind of its joint, or fixed.
    pub kind: RowKind,
    /// The length along the new x axis in m.
    pub a: f64,
    /// The twist about the new x axis in rad.
    pub alpha: f64,
    /// The offset along the axis in m. For a prismatic joint, the joint position is added to it.
    pub d: f64,
    /// The angle about the axis in rad. For a revolute joint, the joint position is added to it.
    pub theta_offset: f64,
}

impl From<&ChainRow> for DhRow {
    fn from(row: &ChainRow) -> Self {
        let DenavitHartenberg { a, alpha, d, theta_offset } = row.table;
        Self { kind: row.kind, a, alpha, d, theta_offset }
    }
}

impl DhRow {
    /// Returns the transform from frame l - 1 to frame l, with the joint at this position in rad or m. In a fixed row
    /// the position has no effect.
    #[must_use]
    pub fn transform(&self, position: f64) -> Isometry3<f64> {
        let (theta, d) = match self.kind {
            RowKind::Revolute => (self.theta_offset + position, self.d),
            RowKind::Prismatic => (self.theta_offset, self.d + position),
            RowKind::Fixed => (self.theta_offset, self.d),
        };
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), theta);
        let twist = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), self.alpha);
        let (sine, cosine) = theta.sin_cos();
        Isometry3::from_parts(Translation3::new(self.a * cosine, self.a * sine, d), turn * twist)
    }

    /// Converts the row to a row of a skin's chain, with the limits of its joint in rad or m.
    #[must_use]
    pub const fn with_limits(&self, limits: [f64; 2]) -> ChainRow {
        let Self { kind, a, alpha, d, theta_offset } = *self;
        ChainRow { kind, table: DenavitHartenberg { a, alpha, d, theta_offset }, limits }
    }

    /// Returns |a| + |d| of the row in m. A value that is out of range counts as 1000 m.
    fn length(&self) -> f64 {
        let length = |value: f64| if value.abs() < MAX_LENGTH_M { value.abs() } else { OUT_OF_RANGE_COST_M };
        length(self.a) + length(self.d)
    }

    /// Returns the row with lengths that are nearly zero set to zero, and angles that are nearly multiples of a quarter
    /// turn rounded.
    fn rounded(self) -> Self {
        let length = |value: f64| if value.abs() < LENGTH_TOLERANCE_M { 0.0 } else { value };
        // Adding zero removes the sign of a negative zero.
        let angle = |value| round_to_quarter_turn(value) + 0.0;
        Self {
            a: length(self.a),
            alpha: angle(self.alpha),
            d: length(self.d),
            theta_offset: angle(self.theta_offset),
            ..self
        }
    }
}

/// Returns the frames 0 to `rows.len()`, with the joints at `positions` in rad or m. `base` is frame 0. Joints without
/// a value in `positions` are at zero.
#[must_use]
pub fn frames(base: &Isometry3<f64>, rows: &[DhRow], positions: &[f64]) -> Vec<Isometry3<f64>> {
    let mut positions = positions.iter();
    let mut frame = *base;
    let mut all = vec![frame];
    for row in rows {
        let position = if row.kind == RowKind::Fixed { None } else { positions.next() };
        frame *= row.transform(position.copied().unwrap_or_default());
        all.push(frame);
    }
    all
}

/// The axis of a joint, with all joints at position zero, in the coordinates of the root.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axis {
    /// Origin of the joint.
    pub(crate) point: Point3<f64>,
    /// Direction of the axis, a unit vector.
    pub(crate) direction: Vector3<f64>,
    /// Kind of the joint.
    pub(crate) kind: JointKind,
}

/// A path: a sequence of rows from frame 0 to the axis of a joint.
#[derive(Clone, Debug)]
struct RowPath {
    rows: Vec<DhRow>,
    /// The last frame of the path, in the coordinates of the root.
    frame: Isometry3<f64>,
    /// Sum of the lengths of the rows and the costs of fixed rows, in m.
    cost: f64,
}

impl RowPath {
    /// Returns the path extended by these rows.
    fn extended_by_rows(&self, rows: &[DhRow], row_cost: f64) -> Self {
        let frame = rows.iter().fold(self.frame, |frame, row| frame * row.transform(0.0));
        let cost = |row: &DhRow| row.length() + if row.kind == RowKind::Fixed { row_cost } else { 0.0 };
        let cost = self.cost + rows.iter().map(cost).sum::<f64>();
        Self { rows: [self.rows.as_slice(), rows].concat(), frame, cost }
    }
}

impl Axis {
    /// Returns the point of this axis that is nearest to the other axis; `None` if it cannot be computed precisely.
    fn nearest_point_to(&self, other: &Self) -> Option<Point3<f64>> {
        let across = self.direction.cross(&other.direction);
        let between = other.point - self.point;
        let along = between.cross(&other.direction).dot(&across) / across.norm_squared();
        (across.norm() >= MIN_NORMAL_SINE).then(|| self.point + self.direction * along)
    }
}

/// Computes frame 0 and the rows of a chain: one row for each axis, and fixed rows where necessary. Paths may lead
/// along the common normals of the axes or through the origins of the joints. The shortest path is chosen, so that rows
/// do not fold back. The origin of the last row is the point of the last axis that is nearest to `tip`. `row_cost` is
/// the length in m that a fixed row must save.
pub(crate) fn rows_for_axes(axes: &[Axis], tip: &Point3<f64>, row_cost: f64) -> (Isometry3<f64>, Vec<DhRow>) {
    let Some(first) = axes.first() else { return (Isometry3::identity(), Vec::new()) };
    let base = base_frame(first);
    let mut ways = vec![RowPath { rows: Vec::new(), frame: base, cost: 0.0 }];
    for (index, axis) in axes.iter().enumerate() {
        let kind = axis.kind.row_kind();
        let next = axes.get(index + 1);
        let mut longer: Vec<RowPath> = Vec::new();
        for way in &ways {
            let local = |point: &Point3<f64>| way.frame.inverse_transform_point(point).coords;
            let Some(next) = next else {
                let d = local(tip).z.clamp(-MAX_AXIS_SHIFT_M, MAX_AXIS_SHIFT_M);
                longer.push(way.extended_by_rows(
                    &[DhRow { kind, a: 0.0, alpha: 0.0, d, theta_offset: 0.0 }.rounded()],
                    row_cost,
                ));
                continue;
            };
            let direction = way.frame.inverse_transform_vector(&next.direction);
            let mut places = vec![local(&next.point)];
            places.extend(
                axes.get(index + 2).and_then(|beyond| next.nearest_point_to(beyond)).map(|foot| local(&foot)),
            );
            for rows in candidate_rows(kind, &places, &direction) {
                let way = way.extended_by_rows(&rows, row_cost);
                // Paths that end in the same frame have the same continuations.
                let same = |other: &&mut RowPath| {
                    let apart = other.frame.translation.vector - way.frame.translation.vector;
                    apart.norm() < SAME_POINT_DISTANCE_M
                };
                match longer.iter_mut().find(same) {
                    Some(other) if way.cost < other.cost - SAME_POINT_DISTANCE_M => *other = way,
                    Some(_) => {}
                    None => longer.push(way),
                }
            }
        }
        ways = longer;
    }
    // Of equally long paths the first is chosen: it leads by way of common normals and joints.
    let shortest = ways
        .into_iter()
        .reduce(|best, way| if way.cost < best.cost - SAME_POINT_DISTANCE_M { way } else { best });
    (base, shortest.map(|way| way.rows).unwrap_or_default())
}

/// Returns frame 0. Its z axis is the axis of the first joint, and its x axis is as close to the root's as possible.
/// Its origin is the point of the axis that is nearest to the root, if that point is near the joint. For most robots,
/// frame 0 is therefore the root frame itself.
fn base_frame(first: &Axis) -> Isometry3<f64> {
    let z = first.direction;
    let mut x = Vector3::x() - z * z.x;
    if x.norm() < 0.1 {
        x = Vector3::y() - z * z.y;
    }
    let x = x.normalize();
    let y = z.cross(&x);
    let turn = Rotation3::from_basis_unchecked(&[x, y, z]);
    let along = -z.dot(&first.point.coords);
    let origin = if along.abs() <= MAX_AXIS_SHIFT_M / 2.0 { first.point + z * along } else { first.point };
    Isometry3::from_parts(origin.into(), UnitQuaternion::from_rotation_matrix(&turn))
}

/// Returns the possible sequences of rows from a frame whose z axis is a joint axis to the next axis, which has the
/// direction `direction` and passes through the points `places`. Each sequence is one row, or one row and fixed rows.
fn candidate_rows(kind: RowKind, places: &[Vector3<f64>], direction: &Vector3<f64>) -> Vec<Vec<DhRow>> {
    let Some(point) = places.first() else { return Vec::new() };
    // The point of the axis that is nearest to the frame's origin.
    let nearest = point - direction * direction.dot(point);
    let places = places.iter().copied().chain([nearest]);
    let sine = direction.x.hypot(direction.y);
    if sine < ANGLE_TOLERANCE {
        return places.map(|place| vec![row_to_parallel_axis(kind, &place, direction)]).collect();
    }
    let normal = (sine >= MIN_NORMAL_SINE).then(|| vec![row_along_common_normal(kind, point, direction)]);
    normal
        .into_iter()
        .chain(places.map(|place| rows_via_helper_axis(kind, &place, direction).to_vec()))
        .collect()
}

/// Returns the row to an axis that is parallel or opposite to the z axis. Any d is possible; the one that leads to the
/// next joint's origin is used.
fn row_to_parallel_axis(kind: RowKind, point: &Vector3<f64>, direction: &Vector3<f64>) -> DhRow {
    let meets = point.xy().norm() < LENGTH_TOLERANCE_M;
    let theta_offset = if meets { 0.0 } else { fold_to_quarter_turn(point.y.atan2(point.x)) };
    let alpha = if direction.z > 0.0 { 0.0 } else { PI };
    DhRow { kind, a: x_after_rotation(point, theta_offset), alpha, d: point.z, theta_offset }.rounded()
}

/// Returns the row that leads along the common normal to an axis through `point`.
fn row_along_common_normal(kind: RowKind, point: &Vector3<f64>, direction: &Vector3<f64>) -> DhRow {
    let along = -point.xy().dot(&direction.xy()) / direction.xy().norm_squared();
    let theta_offset = fold_to_quarter_turn(direction.x.atan2(-direction.y));
    // The component of the direction that is perpendicular to the new x axis.
    let (sine, cosine) = theta_offset.sin_cos();
    let alpha = (sine * direction.x - cosine * direction.y).atan2(direction.z);
    let d = point.z + along * direction.z;
    DhRow { kind, a: x_after_rotation(point, theta_offset), alpha, d, theta_offset }.rounded()
}

/// Returns the x coordinate of a point after a rotation of the axes by `theta` about z. It is used as the length of the
/// common normal, because the angle may have been rounded to a quarter turn: the row must lead to the point with the
/// rounded angle.
fn x_after_rotation(point: &Vector3<f64>, theta: f64) -> f64 {
    let (sine, cosine) = theta.sin_cos();
    point.x * cosine + point.y * sine
}

/// Returns the two rows to the next axis that lead along a helper axis. The helper axis passes through the point `at`
/// of the next axis and is perpendicular to both axes. The result is precise even if the angle between the axes is
/// small.
fn rows_via_helper_axis(kind: RowKind, at: &Vector3<f64>, direction: &Vector3<f64>) -> [DhRow; 2] {
    let normal = Vector3::new(-direction.y, direction.x, 0.0).normalize();
    let row = row_along_common_normal(kind, at, &normal);
    let frame = row.transform(0.0);
    let at = frame.inverse_transform_point(&Point3::from(*at)).coords;
    let back = row_along_common_normal(RowKind::Fixed, &at, &frame.inverse_transform_vector(direction));
    [row, back]
}

/// Returns an angle within [-pi/2, pi/2] in rad that describes the same or the opposite direction.
fn fold_to_quarter_turn(angle: f64) -> f64 {
    let angle = round_to_quarter_turn(angle);
    if angle.abs() <= FRAC_PI_2 { angle } else { angle - PI.copysign(angle) }
}

/// Rounds an angle in rad to a multiple of a quarter turn if it is nearly one.
fn round_to_quarter_turn(angle: f64) -> f64 {
    let whole = (angle / FRAC_PI_2).round() * FRAC_PI_2;
    if (angle - whole).abs() < ANGLE_TOLERANCE { whole } else { angle }
}

/// Returns the base of a skin's chain as an isometry.
#[must_use]
pub fn chain_base_pose(base: &ChainBase) -> Isometry3<f64> {
    let turn = Matrix4::from(base.transform_matrix()).fixed_view::<3, 3>(0, 0).into_owned();
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    Isometry3::from_parts(base.position.into(), turn)
}
