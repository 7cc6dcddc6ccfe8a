//! Denavit-Hartenberg rows, and how the axis of one joint leads to that of the next.

use core::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Matrix4, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use protocol::parameters::RowKind;
use protocol::skin::{Base, ChainRow, DenavitHartenberg, JointKind};

/// `a` and `d` of a row are at least minus this and below it, in m.
pub const MAX_LENGTH_M: f64 = 2.0;

/// How much the rows may differ from the URDF, in m or rad.
pub const MAX_RESIDUAL: f64 = 1e-9;

/// Two axes whose angle has a smaller sine are parallel, and an angle that is nearer to a whole quarter turn is one: pi / 2
/// written with 12 digits leaves 5e-12.
const ANGLE_TOLERANCE: f64 = 1e-11;

/// Lengths below are zero, in m.
const LENGTH_TOLERANCE_M: f64 = 1e-12;

/// Origins that are nearer to each other are one, and a way that is shorter by less is as long, in m.
const SAME_PLACE_M: f64 = 1e-9;

/// Below this sine of the angle between two axes their common normal has lost digits.
const WELL_KNOWN_SINE: f64 = 1e-3;

/// How far frame 0 may be from the first joint's origin, and the last frame from its own, along their axes, in m.
const LONG_M: f64 = 1.0;

/// The length in m that a fixed row has to save: each adds a rounding to what a cell computes. The second is for chains that are too
/// long with the first.
pub(crate) const ROW_COSTS_M: [f64; 2] = [0.2, 0.0];

/// The cost in m of a length that no row can have.
const IMPOSSIBLE_M: f64 = 1e3;

/// One row of the table in standard Denavit-Hartenberg form, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`. It leads from frame l - 1, whose z
/// axis is that of the row's joint, to frame l.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// How it moves.
    pub kind: RowKind,
    /// Length along the new x axis in m.
    pub a: f64,
    /// Twist about the new x axis in rad.
    pub alpha: f64,
    /// Offset along the axis in m; a prismatic joint's position is added.
    pub d: f64,
    /// Angle about the axis in rad; a revolute joint's position is added.
    pub theta_offset: f64,
}

impl From<&ChainRow> for Row {
    fn from(row: &ChainRow) -> Self {
        let DenavitHartenberg { a, alpha, d, theta_offset } = row.table;
        Self { kind: row.kind, a, alpha, d, theta_offset }
    }
}

impl Row {
    /// From frame l - 1 to frame l, with the joint at this position in rad or m; a fixed row ignores it.
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

    /// The same as a row of a skin's chain, whose joint stays within these limits.
    #[must_use]
    pub const fn with_limits(&self, limits: [f64; 2]) -> ChainRow {
        let Self { kind, a, alpha, d, theta_offset } = *self;
        ChainRow { kind, table: DenavitHartenberg { a, alpha, d, theta_offset }, limits }
    }

    /// The way along it in m, if a row can be as long.
    fn length(&self) -> f64 {
        let length = |value: f64| if value.abs() < MAX_LENGTH_M { value.abs() } else { IMPOSSIBLE_M };
        length(self.a) + length(self.d)
    }

    /// With what is nearly zero or nearly a quarter turn made so.
    fn tidy(self) -> Self {
        let length = |value: f64| if value.abs() < LENGTH_TOLERANCE_M { 0.0 } else { value };
        // Adding zero takes the sign from a negative zero.
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

/// The frames 0 to rows.len() in the coordinates in which `base` is frame 0, with the joints at `positions` in rad or m; joints
/// without a position are at zero.
#[must_use]
pub fn frames(base: &Isometry3<f64>, rows: &[Row], positions: &[f64]) -> Vec<Isometry3<f64>> {
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

/// A joint's axis at position zero, in the root's coordinates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axis {
    /// The joint's origin.
    pub(crate) point: Point3<f64>,
    /// Its direction, of length 1.
    pub(crate) direction: Vector3<f64>,
    /// How the joint moves.
    pub(crate) kind: JointKind,
}

/// Rows from frame 0 to an axis.
#[derive(Clone, Debug)]
struct Way {
    rows: Vec<Row>,
    /// Where they lead, in the root's coordinates.
    frame: Isometry3<f64>,
    /// Their length, and what their fixed rows cost, in m.
    cost: f64,
}

impl Way {
    /// With these rows at its end.
    fn and(&self, rows: &[Row], row_cost: f64) -> Self {
        let frame = rows.iter().fold(self.frame, |frame, row| frame * row.transform(0.0));
        let cost = |row: &Row| row.length() + if row.kind == RowKind::Fixed { row_cost } else { 0.0 };
        let cost = self.cost + rows.iter().map(cost).sum::<f64>();
        Self { rows: [self.rows.as_slice(), rows].concat(), frame, cost }
    }
}

impl Axis {
    /// Its point that is nearest to another axis; none where that is not well known.
    fn foot(&self, other: &Self) -> Option<Point3<f64>> {
        let across = self.direction.cross(&other.direction);
        let between = other.point - self.point;
        let along = between.cross(&other.direction).dot(&across) / across.norm_squared();
        (across.norm() >= WELL_KNOWN_SINE).then(|| self.point + self.direction * along)
    }
}

/// Frame 0 and rows of a chain: one row for each axis, and fixed rows where they are needed. Of all ways that lead from frame to frame
/// along common normals, or by way of joints, it is the shortest, so that rows do not fold back. The last row's origin is where the
/// last axis is nearest to `tip`. `row_cost` is the length in m that a fixed row has to save.
pub(crate) fn chain(axes: &[Axis], tip: &Point3<f64>, row_cost: f64) -> (Isometry3<f64>, Vec<Row>) {
    let Some(first) = axes.first() else { return (Isometry3::identity(), Vec::new()) };
    let base = base(first);
    let mut ways = vec![Way { rows: Vec::new(), frame: base, cost: 0.0 }];
    for (index, axis) in axes.iter().enumerate() {
        let kind = axis.kind.row();
        let next = axes.get(index + 1);
        let mut longer: Vec<Way> = Vec::new();
        for way in &ways {
            let local = |point: &Point3<f64>| way.frame.inverse_transform_point(point).coords;
            let Some(next) = next else {
                let d = local(tip).z.clamp(-LONG_M, LONG_M);
                longer.push(
                    way.and(&[Row { kind, a: 0.0, alpha: 0.0, d, theta_offset: 0.0 }.tidy()], row_cost),
                );
                continue;
            };
            let direction = way.frame.inverse_transform_vector(&next.direction);
            let mut places = vec![local(&next.point)];
            places.extend(axes.get(index + 2).and_then(|beyond| next.foot(beyond)).map(|foot| local(&foot)));
            for rows in between(kind, &places, &direction) {
                let way = way.and(&rows, row_cost);
                // Ways to one frame differ in nothing that comes.
                let same = |other: &&mut Way| {
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
    // Of equal ones the first: the one that leads by way of common normals, and joints.
    let shortest =
        ways.into_iter().reduce(|best, way| if way.cost < best.cost - SAME_PLACE_M { way } else { best });
    (base, shortest.map(|way| way.rows).unwrap_or_default())
}

/// Frame 0: z is the first axis, x is as near to the root's as that allows, and the origin is where the axis is nearest to the root's
/// if that is near the joint: so most robots' frame 0 is the root itself.
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

/// The rows that may lead from a frame whose z axis moves to one whose z axis is the line through the `places` along `direction`.
fn between(kind: RowKind, places: &[Vector3<f64>], direction: &Vector3<f64>) -> Vec<Vec<Row>> {
    let Some(point) = places.first() else { return Vec::new() };
    // Where the axis is nearest to the frame's origin.
    let nearest = point - direction * direction.dot(point);
    let places = places.iter().copied().chain([nearest]);
    let sine = direction.x.hypot(direction.y);
    if sine < ANGLE_TOLERANCE {
        return places.map(|place| vec![parallel(kind, &place, direction)]).collect();
    }
    let normal = (sine >= WELL_KNOWN_SINE).then(|| vec![common_normal(kind, point, direction)]);
    normal.into_iter().chain(places.map(|place| helper(kind, &place, direction).to_vec())).collect()
}

/// To an axis that is parallel to z, or opposite: d is free, and leads to the next joint's origin.
fn parallel(kind: RowKind, point: &Vector3<f64>, direction: &Vector3<f64>) -> Row {
    let meets = point.xy().norm() < LENGTH_TOLERANCE_M;
    let theta_offset = if meets { 0.0 } else { upright(point.y.atan2(point.x)) };
    let alpha = if direction.z > 0.0 { 0.0 } else { PI };
    Row { kind, a: along_x(point, theta_offset), alpha, d: point.z, theta_offset }.tidy()
}

/// Along the common normal.
fn common_normal(kind: RowKind, point: &Vector3<f64>, direction: &Vector3<f64>) -> Row {
    let along = -point.xy().dot(&direction.xy()) / direction.xy().norm_squared();
    let theta_offset = upright(direction.x.atan2(-direction.y));
    // Of the direction, what is at a right angle to the new x.
    let (sine, cosine) = theta_offset.sin_cos();
    let alpha = (sine * direction.x - cosine * direction.y).atan2(direction.z);
    let d = point.z + along * direction.z;
    Row { kind, a: along_x(point, theta_offset), alpha, d, theta_offset }.tidy()
}

/// How far a point is along the x axis that was turned by this angle about z. Not the length of the common normal: the angle may have been
/// rounded to a quarter turn, and the row shall lead to the point with the angle that it has.
fn along_x(point: &Vector3<f64>, theta: f64) -> f64 {
    let (sine, cosine) = theta.sin_cos();
    point.x * cosine + point.y * sine
}

/// By way of a helper axis: it passes through the point `at` of the next axis and is perpendicular to both axes, so that nothing is
/// lost however small the angle between them is.
fn helper(kind: RowKind, at: &Vector3<f64>, direction: &Vector3<f64>) -> [Row; 2] {
    let normal = Vector3::new(-direction.y, direction.x, 0.0).normalize();
    let row = common_normal(kind, at, &normal);
    let frame = row.transform(0.0);
    let at = frame.inverse_transform_point(&Point3::from(*at)).coords;
    let back = common_normal(RowKind::Fixed, &at, &frame.inverse_transform_vector(direction));
    [row, back]
}

/// An angle within [-pi/2, pi/2] that is the same direction or the opposite one.
fn upright(angle: f64) -> f64 {
    let angle = quarter(angle);
    if angle.abs() <= FRAC_PI_2 { angle } else { angle - PI.copysign(angle) }
}

/// An angle, made a whole number of quarter turns if it nearly is.
fn quarter(angle: f64) -> f64 {
    let whole = (angle / FRAC_PI_2).round() * FRAC_PI_2;
    if (angle - whole).abs() < ANGLE_TOLERANCE { whole } else { angle }
}

/// Where a skin's chain begins, as a pose.
#[must_use]
pub fn pose_of(base: &Base) -> Isometry3<f64> {
    let turn = Matrix4::from(base.matrix()).fixed_view::<3, 3>(0, 0).into_owned();
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    Isometry3::from_parts(base.position.into(), turn)
}
