//! Random robots, cells, joint positions and forces, the same on all machines: the words of J and of the torques must be
//! too. Where the kernel is in assembly, it must also agree with the code in Rust, and be used for just the chains that
//! it is for.

use cell_node::contact::MAX_JACOBIAN_STEPS;
use cell_node::kernel::{Kernel, Wrench};
use protocol::fixed::{Q1_14, Q3_12, TorqueFormat};
use protocol::parameters::{Contact, MAX_JOINTS, Parameters, Pose, RowKind};

use crate::counted;
use crate::machine::Machine;

/// Number of random cells.
const CELLS: u32 = 10_000;
/// Number of cells whose words are one line of output.
const CELLS_PER_LINE: u32 = 20;
/// Longest chain in rows.
const MAX_RANDOM_ROWS: u32 = 14;

/// A linear congruential generator.
struct Generator(u32);

impl Generator {
    fn word(&mut self) -> i16 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let [.., high, highest] = self.0.to_le_bytes();
        i16::from_le_bytes([high, highest])
    }

    /// Returns a number below `end`.
    fn below(&mut self, end: u32) -> u32 {
        u32::from(self.word().cast_unsigned()) * end >> 16
    }

    /// Returns a length in steps of 2^-14 m that is often zero, and else at most a quarter of a metre.
    fn length(&mut self) -> Q1_14 {
        let is_zero = self.below(2) == 0;
        Q1_14::from_bits(if is_zero { 0 } else { self.word() >> 3 })
    }

    fn parameters(&mut self) -> Parameters {
        let mut parameters = Parameters {
            pose: Pose {
                position: [self.length(), self.length(), self.length()],
                normal: [self.word() / 2, self.word() / 2, self.word() / 2].map(Q1_14::from_bits),
            },
            contact: Contact { alpha_c: Q3_12::from_bits(1 << 12), ..Contact::default() },
            torque_format: match self.below(3) {
                0 => TorqueFormat::Q3_12,
                1 => TorqueFormat::Q5_10,
                _ => TorqueFormat::Q7_8,
            },
            period_us: 16_000,
            ..Parameters::default()
        };
        let rows = 1 + self.below(MAX_RANDOM_ROWS);
        let carrier = 1 + self.below(rows);
        // Robots of revolute joints only, and with whole quarter turns only, are frequent.
        let (only_revolute, only_quarters) = (self.below(4) > 0, self.below(4) > 0);
        for (number, row) in (1..=rows).zip(parameters.rows.iter_mut()) {
            let is_odd = !only_quarters && self.below(6) == 0;
            let alpha = if is_odd { self.word() } else { low_word(self.below(4) << 14) };
            row.kind = match self.below(8) {
                0 if !only_revolute => RowKind::Prismatic,
                1 if !only_revolute => RowKind::Fixed,
                _ => RowKind::Revolute,
            };
            (row.a, row.d, row.alpha) = (self.length(), self.length(), Q1_14::from_bits(alpha));
            row.theta_offset = Q1_14::from_bits(if self.below(3) == 0 { self.word() } else { 0 });
            parameters.joints += u8::from(row.has_joint());
            parameters.joint += u8::from(row.has_joint() && number <= carrier);
        }
        parameters.table_rows = rows.to_le_bytes()[0];
        parameters.row = carrier.to_le_bytes()[0];
        parameters
    }
}

/// Returns the low 16 bits of a number.
const fn low_word(number: u32) -> i16 {
    let [low, high, ..] = number.to_le_bytes();
    i16::from_le_bytes([low, high])
}

/// Returns true for a chain that assembly is for: of revolute joints, with twists of whole quarter turns between them.
fn is_for_assembly(parameters: &Parameters, kernel: &Wrench) -> bool {
    let mut chain = parameters.rows_to_cell();
    // Fixed rows next to the cell are folded into its constants, as the twist of its own row is.
    while let [rest @ .., last] = chain
        && last.kind == RowKind::Fixed
    {
        chain = rest;
    }
    let [below @ .., own] = chain else { return false };
    let is_plain = |row: &protocol::parameters::Row| {
        row.kind == RowKind::Revolute && row.alpha.to_bits().trailing_zeros() >= 14
    };
    own.kind == RowKind::Revolute
        && below.iter().all(is_plain)
        && kernel.jacobian_bound() < MAX_JACOBIAN_STEPS
}

/// Prints a line with a hash of the words for every few cells. The last line counts the cells whose J was computed in
/// assembly, those for which it was other than that of the Rust code, and those that took the wrong one of the two.
pub(crate) fn run(machine: &mut Machine) {
    let mut generator = Generator(1);
    let (mut in_assembly, mut other_words, mut wrong_way) = (0, 0, 0);
    let mut hash = 0x811C_9DC5_u32;
    for number in 1..=CELLS {
        let (mut kernel, parameters, joints, force) = cell(&mut generator);
        let mut jacobian = [Q1_14::ZERO; MAX_JOINTS];
        counted::wrench(&kernel, &joints, &mut jacobian);
        let mut torque = [0; MAX_JOINTS];
        counted::torque_words(&jacobian, parameters.joint, force, &mut torque, kernel.rounding());
        for word in jacobian.iter().map(|word| word.to_bits()).chain(torque) {
            hash = (hash ^ u32::from(word.cast_unsigned())).wrapping_mul(0x0100_0193);
        }
        if kernel.is_in_assembly() {
            in_assembly += 1;
            kernel.use_rust_code();
            let mut expected = [Q1_14::ZERO; MAX_JOINTS];
            kernel.write_jacobian(&joints, &mut expected);
            other_words += u32::from(jacobian != expected);
            wrong_way += u32::from(!is_for_assembly(&parameters, &kernel));
        } else {
            wrong_way += u32::from(is_for_assembly(&parameters, &kernel));
        }
        if number % CELLS_PER_LINE == 0 {
            machine.number(hash);
            machine.line();
        }
    }
    machine.text("assembly");
    [in_assembly, other_words, wrong_way].into_iter().for_each(|count| machine.number(count));
    machine.line();
}

/// Returns the next cell, the joint positions of its robot, and the force on it in steps of 2^-16 N.
#[inline(never)]
fn cell(generator: &mut Generator) -> (Wrench, Parameters, [Q1_14; MAX_JOINTS], i32) {
    let parameters = generator.parameters();
    let joints = core::array::from_fn(|_| Q1_14::from_bits(generator.word()));
    let force = i32::from(generator.word()) << 4;
    (Wrench::new(&parameters), parameters, joints, force)
}
