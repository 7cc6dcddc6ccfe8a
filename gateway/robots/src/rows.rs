//! Denavit-Hartenberg rows, and the computation of rows from one joint axis to the next.

use core::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Matrix4, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use protocol::parameters::RowKind;
use protocol::skin::{ChainBase, ChainRow, DenavitHartenberg, JointKind};

/// The bound of `a` and `d` of a row, in m: at least its negative, and less than it.
pub const MAX_LENGTH_M: f64 = 2.0;

/// The maximum difference between rows and URDF, in m or rad.
pub const MAX_RESIDUAL: f64 = 1e-9;

/// The tolerance of angles: axes whose angle has a smaller sine are parallel, and angles this close to a multiple of a
/// quarter turn are rounded to it. Pi / 2 written with 12 digits leaves 5e-12.
const ANGLE_TOLERANCE: f64 = 1e-11;

/// Smaller lengths are rounded to zero, in m.
const LENGTH_TOLERANCE_M: f64 = 1e-12;

/// Origins closer than this are the same, and paths whose lengths differ by less are equally long, in m.
const SAME_PLACE_M: f64 = 1e-9;

/// If the sine of the angle between two axes is smaller, their common normal loses digits.
const WELL_KNOWN_SINE: f64 = 1e-3;

/// The maximum distance of frame 0 from the first joint's origin, and of the last frame from its own, along their axes,
/// in m.
const LONG_M: f64 = 1.0;

/// The length that a fixed row must save, in m, because each row adds a rounding error to a cell's computation. The
/// second value is for chains that are too long with the first.
pub(crate) const ROW_COSTS_M: [f64; 2] = [0.2, 0.0];

/// The cost of a length that exceeds the range of a row, in m.
const IMPOSSIBLE_M: f64 = 1e3;

/// One row in standard Denavit-Hartenberg form, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`. It leads from frame l - 1, whose z
/// axis is that of the row's joint, to frame l.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DhRow {
    /// The kind of motion.
    pub kind: RowKind,
    /// The length along the new x axis in m.
    pub a: f64,
    /// The twist about the new x axis in rad.
    pub alpha: f64,
    /// The offset along the axis in m; the position of a prismatic joint is added.
    pub d: f64,
    /// The angle about the axis in rad; the position of a revolute joint is added.
    pub theta_offset: f64,
}

impl From<&ChainRow> for DhRow {
    fn from(row: &ChainRow) -> Self {
        let DenavitHartenberg { a, alpha, d, theta_offset } = row.table;
        Self { kind: row.kind, a, alpha, d, theta_offset }
    }
}

impl DhRow {
    /// Returns the transform from frame l - 1 to frame l, with the joint at this position in rad or m. A fixed row
    /// ignores the position.
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

    /// Converts the row to one of a skin's chain, whose joint stays within these limits.
    #[must_use]
    pub const fn with_limits(&self, limits: [f64; 2]) -> ChainRow {
        let Self { kind, a, alpha, d, theta_offset } = *self;
        ChainRow { kind, table: DenavitHartenberg { a, alpha, d, theta_offset }, limits }
    }

    /// Returns the length of the row in m, with a high cost if it is out of range.
    fn length(&self) -> f64 {
        let length = |value: f64| if value.abs() < MAX_LENGTH_M { value.abs() } else { IMPOSSIBLE_M };
        length(self.a) + length(self.d)
    }

    /// Rounds values that are nearly zero, and angles that are nearly a multiple of a quarter turn.
    fn tidy(self) -> Self {
        let length = |value: f64| if value.abs() < LENGTH_TOLERANCE_M { 0.0 } else { value };
        // Adding zero removes the sign of a negative zero.
        let angle = |value| quarter(value) + 0.0;
        Self {
            a: length(self.a),
            alpha: angle(self.alpha),
            d: length(self.d),
            theta_offset: angle(self.theta_offset),
            ..self
        }
    }
}

/// Returns the frames 0 to `rows.len()` in the coordinates in which `base` is frame 0, with the joints at `positions`
/// in rad or m. Joints without a position are at zero.
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

/// The axis of a joint at position zero, in the root's coordinates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axis {
    /// The origin of the joint.
    pub(crate) point: Point3<f64>,
    /// The direction, of length 1.
    pub(crate) direction: Vector3<f64>,
    /// The kind of motion.
    pub(crate) kind: JointKind,
}

/// A sequence of rows from frame 0 to an axis.
#[derive(Clone, Debug)]
struct RowPath {
    rows: Vec<DhRow>,
    /// The last frame, in the root's coordinates.
    frame: Isometry3<f64>,
    /// The length of the rows plus the cost of fixed rows, in m.
    cost: f64,
}

impl RowPath {
    /// Returns the path extended by these rows.
    fn and(&self, rows: &[DhRow], row_cost: f64) -> Self {
        let frame = rows.iter().fold(self.frame, |frame, row| frame * row.transform(0.0));
        let cost = |row: &DhRow| row.length() + if row.kind == RowKind::Fixed { row_cost } else { 0.0 };
        let cost = self.cost + rows.iter().map(cost).sum::<f64>();
        Self { rows: [self.rows.as_slice(), rows].concat(), frame, cost }
    }
}

impl Axis {
    /// Returns the point of this axis that is nearest to another axis; `None` if it cannot be computed precisely.
    fn foot(&self, other: &Self) -> Option<Point3<f64>> {
        let across = self.direction.cross(&other.direction);
        let between = other.point - self.point;
        let along = between.cross(&other.direction).dot(&across) / across.norm_squared();
        (across.norm() >= WELL_KNOWN_SINE).then(|| self.point + self.direction * along)
    }
}

/// Computes frame 0 and the rows of a chain: one row for each axis, and fixed rows where necessary. Among the paths
/// that lead from frame to frame along common normals or by way of joints, the shortest is chosen, so that rows do not
/// fold back. The origin of the last row is the point of the last axis that is nearest to `tip`. `row_cost` is the
/// length in m that a fixed row must save.
pub(crate) fn chain(axes: &[Axis], tip: &Point3<f64>, row_cost: f64) -> (Isometry3<f64>, Vec<DhRow>) {
    let Some(first) = axes.first() else { return (Isometry3::identity(), Vec::new()) };
    let base = base(first);
    let mut ways = vec![RowPath { rows: Vec::new(), frame: base, cost: 0.0 }];
    for (index, axis) in axes.iter().enumerate() {
        let kind = axis.kind.row();
        let next = axes.get(index + 1);
        let mut longer: Vec<RowPath> = Vec::new();
        for way in &ways {
            let local = |point: &Point3<f64>| way.frame.inverse_transform_point(point).coords;
            let Some(next) = next else {
                let d = local(tip).z.clamp(-LONG_M, LONG_M);
                longer.push(
                    way.and(&[DhRow { kind, a: 0.0, alpha: 0.0, d, theta_offset: 0.0 }.tidy()], row_cost),
                );
                continue;
            };
            let direction = way.frame.inverse_transform_vector(&next.direction);
            let mut places = vec![local(&next.point)];
            places.extend(axes.get(index + 2).and_then(|beyond| next.foot(beyond)).map(|foot| local(&foot)));
            for rows in between(kind, &places, &direction) {
                let way = way.and(&rows, row_cost);
                // Paths that end in the same frame have the same continuations.
                let same = |other: &&mut RowPath| {
                    let apart = other.frame.translation.vector - way.frame.translation.vector;
                    apart.norm() < SAME_PLACE_M
                };
                match longer.iter_mut().find(same) {
                    Some(other) if way.cost < other.cost - SAME_PLACE_M => *other = way,
                    Some(_) => {}
                    None => longer.push(way),
                }
            }
        }
        ways = longer;
    }
    // Of equally long paths the first is chosen: it leads by way of common normals and joints.
    let shortest =
        ways.into_iter().reduce(|best, way| if way.cost < best.cost - SAME_PLACE_M { way } else { best });
    (base, shortest.map(|way| way.rows).unwrap_or_default())
}

/// Returns frame 0. Its z axis is the first joint's axis, and its x axis is as near to the root's as possible. Its
/// origin is the point of the axis that is nearest to the root if that is near the joint. Frame 0 of most robots is
/// therefore the root itself.
fn base(first: &Axis) -> Isometry3<f64> {
    let z = first.direction;
    let mut x = Vector3::x() - z * z.x;
    if x.norm() < 0.1 {
        x = Vector3::y() - z * z.y;
    }
    let x = x.normalize();
    let y = z.cross(&x);
    let turn = Rotation3::from_basis_unchecked(&[x, y, z]);
    let along = -z.dot(&first.point.coords);
    let origin = if along.abs() <= LONG_M / 2.0 { first.point + z * along } else { first.point };
    Isometry3::from_parts(origin.into(), UnitQuaternion::from_rotation_matrix(&turn))
}

/// Returns the possible rows from a frame whose z axis moves to one whose z axis is the line through the `places` along
/// `direction`.
fn between(kind: RowKind, places: &[Vector3<f64>], direction: &Vector3<f64>) -> Vec<Vec<DhRow>> {
    let Some(point) = places.first() else { return Vec::new() };
    // The point of the axis that is nearest to the frame's origin.
    let nearest = point - direction * direction.dot(point);
    let places = places.iter().copied().chain([nearest]);
    let sine = direction.x.hypot(direction.y);
    if sine < ANGLE_TOLERANCE {
        return places.map(|place| vec![parallel(kind, &place, direction)]).collect();
    }
    let normal = (sine >= WELL_KNOWN_SINE).then(|| vec![common_normal(kind, point, direction)]);
    normal.into_iter().chain(places.map(|place| helper(kind, &place, direction).to_vec())).collect()
}

/// Returns the row to an axis parallel or opposite to z: d is free, and leads to the next joint's origin.
fn parallel(kind: RowKind, point: &Vector3<f64>, direction: &Vector3<f64>) -> DhRow {
    let meets = point.xy().norm() < LENGTH_TOLERANCE_M;
    let theta_offset = if meets { 0.0 } else { upright(point.y.atan2(point.x)) };
    let alpha = if direction.z > 0.0 { 0.0 } else { PI };
    DhRow { kind, a: along_x(point, theta_offset), alpha, d: point.z, theta_offset }.tidy()
}

/// Returns the row along the common normal.
fn common_normal(kind: RowKind, point: &Vector3<f64>, direction: &Vector3<f64>) -> DhRow {
    let along = -point.xy().dot(&direction.xy()) / direction.xy().norm_squared();
    let theta_offset = upright(direction.x.atan2(-direction.y));
    // The component of the direction that is perpendicular to the new x axis.
    let (sine, cosine) = theta_offset.sin_cos();
    let alpha = (sine * direction.x - cosine * direction.y).atan2(direction.z);
    let d = point.z + along * direction.z;
    DhRow { kind, a: along_x(point, theta_offset), alpha, d, theta_offset }.tidy()
}

/// Returns the coordinate of a point along the x axis after a rotation by this angle about z. It replaces the length of
/// the common normal: the angle may have been rounded to a quarter turn, and the row must lead to the point with the
/// rounded angle.
fn along_x(point: &Vector3<f64>, theta: f64) -> f64 {
    let (sine, cosine) = theta.sin_cos();
    point.x * cosine + point.y * sine
}

/// Returns the rows by way of a helper axis, which passes through the point `at` of the next axis and is perpendicular
/// to both axes. No digits are lost, however small the angle between them is.
fn helper(kind: RowKind, at: &Vector3<f64>, direction: &Vector3<f64>) -> [DhRow; 2] {
    let normal = Vector3::new(-direction.y, direction.x, 0.0).normalize();
    let row = common_normal(kind, at, &normal);
    let frame = row.transform(0.0);
    let at = frame.inverse_transform_point(&Point3::from(*at)).coords;
    let back = common_normal(RowKind::Fixed, &at, &frame.inverse_transform_vector(direction));
    [row, back]
}

/// Returns an angle within [-pi/2, pi/2] with the same or the opposite direction.
fn upright(angle: f64) -> f64 {
    let angle = quarter(angle);
    if angle.abs() <= FRAC_PI_2 { angle } else { angle - PI.copysign(angle) }
}

/// Rounds an angle that is nearly a multiple of a quarter turn.
fn quarter(angle: f64) -> f64 {
    let whole = (angle / FRAC_PI_2).round() * FRAC_PI_2;
    if (angle - whole).abs() < ANGLE_TOLERANCE { whole } else { angle }
}

/// Returns the base of a skin's chain as a pose.
#[must_use]
pub fn pose_of(base: &ChainBase) -> Isometry3<f64> {
    let turn = Matrix4::from(base.matrix()).fixed_view::<3, 3>(0, 0).into_owned();
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    Isometry3::from_parts(base.position.into(), turn)
}
