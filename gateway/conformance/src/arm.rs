//! Test configurations, and the values that the documents require for them: F_z, torque words, and J in floating point.

use model::central::CentralComputation;
use model::decode::Decoded;
use protocol::fixed::{Q, Q1_14, Q3_12, Q5_10, TorqueFormat};
use protocol::id::CellId;
use protocol::message::{Message, SensorPage, SkinSensors};
use protocol::packet::Epoch;
use protocol::parameters::{Abilities, Contact, MAX_JOINTS, MAX_ROWS, Parameters, Pose, Row, RowKind};
use rand::seq::IndexedRandom as _;
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;

/// A pseudo-random generator with a fixed seed.
#[derive(Clone, Debug)]
pub(crate) struct TestRandom(Pcg64Mcg);

impl TestRandom {
    pub(crate) fn new(seed: u64) -> Self {
        Self(Pcg64Mcg::seed_from_u64(seed))
    }

    /// Returns a random word, from the whole range.
    pub(crate) fn random_word(&mut self) -> i16 {
        self.0.random()
    }

    /// Returns a random number below a bound, or 0 if the bound is 0.
    pub(crate) fn random_below(&mut self, bound: u32) -> u32 {
        self.0.random_range(0..bound.max(1))
    }

    /// Returns a random number in [-1, 1).
    fn random_signed_unit(&mut self) -> f64 {
        f64::from(self.random_word()) / 32_768.0
    }

    /// Returns a random element of a slice.
    pub(crate) fn choose<T: Copy + Default>(&mut self, of: &[T]) -> T {
        of.choose(&mut self.0).copied().unwrap_or_default()
    }
}

/// The period in the test configurations. A cell skips joints that are older than a period, and a cell that is a
/// process may have to wait for a processor, so the period is long.
const PERIOD_US: u16 = 60_000;

/// Gain 1, no proximity, no thresholds: the force is the sum of the three contact words.
pub(crate) const UNIT_GAIN_CONTACT: Contact = Contact {
    alpha_c: Q3_12::from_bits(4096),
    alpha_p: Q5_10::ZERO,
    contact_threshold: Q5_10::ZERO,
    proximity_threshold: Q1_14::ZERO,
    force_threshold: Q5_10::ZERO,
};

fn revolute_row(a: i16, d: i16, alpha: i16, theta_offset: i16) -> Row {
    let [a, d, alpha, theta_offset] = [a, d, alpha, theta_offset].map(Q1_14::from_bits);
    Row { kind: RowKind::Revolute, a, d, alpha, theta_offset }
}

/// Returns the cell of the protocol's complete configuration, on joint k of a UR5, with [`UNIT_GAIN_CONTACT`] contact.
pub(crate) fn example_parameters(joint: u8) -> Parameters {
    let mut rows = [Row::default(); MAX_ROWS];
    let ur5 = [
        revolute_row(0, 0x05B5, 0x4000, 0),
        revolute_row(-0x1B32, 0, 0, 0),
        revolute_row(-0x191B, 0, 0, 0),
        revolute_row(0, 0x06FC, 0x4000, 0),
        revolute_row(0, 0x060F, -0x4000, 0),
        revolute_row(0, 0x0544, 0, 0),
    ];
    for (row, ur5) in rows.iter_mut().zip(ur5) {
        *row = ur5;
    }
    Parameters {
        joint,
        joints: 6,
        row: 0,
        table_rows: 0,
        torque_format: TorqueFormat::Q3_12,
        pose: Pose {
            position: [0x0666, 0x0333, 0x03D7].map(Q1_14::from_bits),
            normal: [0, 0x3333, 0x2666].map(Q1_14::from_bits),
        },
        contact: UNIT_GAIN_CONTACT,
        period_us: PERIOD_US,
        rows,
    }
}

/// Returns the configuration of [`example_parameters`] with a period of 16 ms (62.5 joints a second), for checks of
/// times.
pub(crate) fn fast_example_parameters(joint: u8) -> Parameters {
    Parameters { period_us: 16_000, ..example_parameters(joint) }
}

/// Returns a configuration of the maximum size that the cell accepts. Each word has a different value, so that a word
/// lost in flash is noticed.
pub(crate) fn distinct_parameters(abilities: Abilities) -> Parameters {
    let mut all = example_parameters(3);
    all.period_us = 55_500;
    all.contact = Contact {
        alpha_c: Q3_12::from_bits(4_101),
        alpha_p: Q5_10::from_bits(1_031),
        contact_threshold: Q5_10::from_bits(107),
        proximity_threshold: Q1_14::from_bits(827),
        force_threshold: Q5_10::from_bits(113),
    };
    for (row, step) in all.rows.iter_mut().zip(1..=6) {
        row.theta_offset = Q1_14::from_bits(0x0107 * step);
    }
    let (joints, rows) = (abilities.max_joints(), abilities.max_rows());
    let mut large = Parameters { torque_format: TorqueFormat::Q7_8, ..all };
    let (mut moving, mut word) = (0, 0);
    for (place, row) in large.rows.iter_mut().take(rows).enumerate() {
        let rest = rows - place;
        let is_fixed = moving == joints || place % 3 == 1 && rest > joints - moving;
        moving += usize::from(!is_fixed);
        let mut next = || {
            word += 37;
            Q1_14::from_bits(word)
        };
        let (a, d, alpha, theta_offset) = (next(), next(), next(), next());
        let kind = match is_fixed {
            true => RowKind::Fixed,
            false if place % 4 == 2 => RowKind::Prismatic,
            false => RowKind::Revolute,
        };
        *row = Row {
            kind,
            a: Q1_14::from_bits(a.to_bits() / 8),
            d: Q1_14::from_bits(d.to_bits() / 8),
            alpha,
            theta_offset,
        };
    }
    let byte = |number: usize| u8::try_from(number).unwrap_or_default();
    (large.joints, large.table_rows, large.row) = (byte(joints), byte(rows), byte(rows));
    large.joint = large.joints;
    if abilities.first_missing(&large).is_none() { large } else { all }
}

/// Returns the gains and thresholds of the document's example.
pub(crate) fn example_contact() -> Contact {
    let [alpha_c, threshold] = [4096, 0x67];
    Contact {
        alpha_c: Q3_12::from_bits(alpha_c),
        alpha_p: Q5_10::ZERO,
        contact_threshold: Q5_10::from_bits(threshold),
        proximity_threshold: Q1_14::from_bits(0x0334),
        force_threshold: Q5_10::from_bits(threshold),
    }
}

/// The size of a chain: its joints and rows, and whether some joints are prismatic.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ChainShape {
    pub(crate) joints: usize,
    pub(crate) rows: usize,
    pub(crate) prismatic: bool,
}

/// Returns an arm of a given shape and limited reach, with a cell somewhere on it.
pub(crate) fn random_parameters(dice: &mut TestRandom, shape: ChainShape) -> Parameters {
    let mut rows = [Row::default(); MAX_ROWS];
    let fixed = shape.rows.saturating_sub(shape.joints);
    // Lengths and slides add up to less than 2 m.
    let share = 1.9 / f64::from(u32::try_from(2 * shape.rows + 4).unwrap_or(u32::MAX));
    let mut left = (shape.joints, fixed);
    for row in rows.iter_mut().take(shape.rows) {
        let is_fixed = left.0 == 0 || left.1 > 0 && dice.random_below(2) == 0;
        let kind = match is_fixed {
            true => RowKind::Fixed,
            false if shape.prismatic && dice.random_below(3) == 0 => RowKind::Prismatic,
            false => RowKind::Revolute,
        };
        if is_fixed {
            left.1 -= 1
        } else {
            left.0 -= 1
        }
        let twist = [0x4000, -0x4000, 0, dice.random_word(), dice.random_word()];
        *row = Row {
            kind,
            a: Q1_14::nearest(dice.random_signed_unit() * share),
            d: Q1_14::nearest(
                dice.random_signed_unit() * share / if kind == RowKind::Prismatic { 2.0 } else { 1.0 },
            ),
            alpha: Q1_14::from_bits(dice.choose(&twist)),
            theta_offset: Q1_14::from_bits(dice.random_word()),
        };
    }
    let plain = rows.iter().take(shape.rows).all(|row| row.kind == RowKind::Revolute);
    // The cell is on the last row, or on one after the first joint.
    let first = rows.iter().position(Row::has_joint).unwrap_or(0);
    let span = u32::try_from(shape.rows - first).unwrap_or(1);
    let place =
        if dice.random_below(2) == 0 { shape.rows } else { first + 1 + dice.random_below(span) as usize };
    let joint = rows.iter().take(place).filter(|row| row.has_joint()).count();
    let byte = |number: usize| u8::try_from(number).unwrap_or_default();
    let (row, table_rows) = if plain { (0, 0) } else { (byte(place), byte(shape.rows)) };
    let position = [0; 3].map(|_| Q1_14::nearest(dice.random_signed_unit() * share));
    Parameters {
        joint: byte(joint),
        joints: byte(shape.joints),
        row,
        table_rows,
        torque_format: TorqueFormat::Q3_12,
        pose: Pose { position, normal: random_unit_vector(dice) },
        contact: UNIT_GAIN_CONTACT,
        period_us: PERIOD_US,
        rows,
    }
}

/// Returns a random vector of length 1.
fn random_unit_vector(dice: &mut TestRandom) -> [Q1_14; 3] {
    loop {
        let any = [0; 3].map(|_| dice.random_signed_unit());
        let length = any.iter().map(|x| x * x).sum::<f64>().sqrt();
        if (0.1..=1.0).contains(&length) {
            return any.map(|x| Q1_14::nearest(x / length));
        }
    }
}

/// Returns joint positions for a chain; prismatic joints stay near 0.
pub(crate) fn random_positions(dice: &mut TestRandom, parameters: &Parameters) -> [i16; MAX_JOINTS] {
    let moving: Vec<_> =
        parameters.all_rows().iter().filter(|row| row.has_joint()).map(|row| row.kind).collect();
    let share = 16_384 / i16::try_from(parameters.all_rows().len().max(1) * 3).unwrap_or(i16::MAX);
    core::array::from_fn(|index| match moving.get(index) {
        None => 0,
        Some(RowKind::Prismatic) => dice.random_word() % share,
        Some(RowKind::Revolute | RowKind::Fixed) => match dice.random_below(8) {
            0 => dice.choose(&[0, 0x4000, -0x4000, i16::MIN, i16::MAX]),
            _ => dice.random_word(),
        },
    })
}

/// Computes F_z in steps of 2^-16 N, by Algorithm 1 of the document.
pub(crate) fn expected_force(contact: &Contact, skin: &SkinSensors) -> i64 {
    let bits = |word: i16| i64::from(word);
    let f_c: i64 = skin.contact.iter().map(|word| bits(word.to_bits())).sum();
    let f_c = if f_c < bits(contact.contact_threshold.to_bits()) { 0 } else { f_c };
    let p = bits(skin.proximity.to_bits());
    let f_p = if p < bits(contact.proximity_threshold.to_bits()) { 0 } else { p };
    let f_z = ((bits(contact.alpha_c.to_bits()) * f_c) << 2) + bits(contact.alpha_p.to_bits()) * f_p;
    let f_z = if f_z < bits(contact.force_threshold.to_bits()) << 14 { 0 } else { f_z.max(0) };
    (f_z + 128) >> 8
}

/// Computes a torque word from a word of J and a force in steps of 2^-16 N.
pub(crate) fn torque_word(j: i16, force: i64, format: TorqueFormat) -> i16 {
    let bits = 30 - i64::from(format.fraction_bits());
    let held = ((i64::from(j) * force + (1 << (bits - 1))) >> bits).clamp(i16::MIN.into(), i16::MAX.into());
    i16::try_from(held).unwrap_or_default()
}

/// Splits a sum into three contact words.
pub(crate) fn contact_words(sum: i32) -> [Q5_10; 3] {
    let first = (sum / 3).clamp(i16::MIN.into(), i16::MAX.into());
    let second = ((sum - first) / 2).clamp(i16::MIN.into(), i16::MAX.into());
    [first, second, sum - first - second]
        .map(|word| Q5_10::from_bits(i16::try_from(word).unwrap_or_default()))
}

/// Formats words, separated by spaces.
pub(crate) fn format_words(words: &[i16]) -> String {
    words.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
}

/// Formats the values of a sensors page.
pub(crate) fn format_page(page: SensorPage) -> String {
    let message = Message::Sensors { from: CellId::MAX, epoch: Epoch(0), page };
    let text = Decoded::Message(message).to_string();
    text.split_once(": ").map_or_else(String::new, |(_, values)| values.to_owned())
}

/// Formats latched sensor values, or `nothing`.
pub(crate) fn format_skin(skin: Option<SkinSensors>) -> String {
    skin.map_or_else(|| "nothing".to_owned(), |skin| format_page(SensorPage::Skin(skin)))
}

/// Returns a press with this sum of contact words, and no other values.
pub(crate) fn press_with_sum(sum: i32) -> SkinSensors {
    SkinSensors { contact: contact_words(sum), ..SkinSensors::default() }
}

/// Returns the sum of contact words for which, with [`UNIT_GAIN_CONTACT`], a torque word equals the word of J.
pub(crate) fn unit_press_sum(format: TorqueFormat) -> i32 {
    1 << (24 - format.fraction_bits())
}

/// Computes J in m (without a unit for prismatic joints), from the words of the parameters and of the joints.
pub(crate) fn exact_jacobian(
    central: &CentralComputation,
    positions: &[i16; MAX_JOINTS],
) -> [f64; MAX_JOINTS] {
    let words = positions.map(Q1_14::from_bits);
    central.cell_torque(0, &central.link_frames(&words), 1.0)
}

/// Returns the distance of a word of J from the nearest word to the exact value, in steps.
pub(crate) fn rounding_error_steps(j: i16, exact: f64) -> u32 {
    let nearest = Q::<14>::nearest(exact).to_bits();
    i32::from(j).abs_diff(nearest.into())
}

/// Returns the distance from the exact value that J-3 allows, in steps: 8, and one more for each row after the sixth.
pub(crate) fn jacobian_tolerance_steps(parameters: &Parameters) -> u32 {
    8 + u32::try_from(parameters.rows_to_cell().len().saturating_sub(6)).unwrap_or(0)
}
