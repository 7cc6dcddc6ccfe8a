//! The test vectors as words: robots, cells, joint positions and forces.

use protocol::fixed::{Q1_14, Q3_12};
use protocol::parameters::{Contact, MAX_JOINTS, Parameters, Pose, Row, RowKind};

/// The Denavit-Hartenberg table of a robot.
pub(crate) struct Chain {
    pub(crate) name: &'static str,
    /// Rows as words: a, d, alpha, theta offset, kind.
    pub(crate) rows: &'static [[i16; 5]],
}

/// A test case: a cell, the joint positions of its robot, and a force on the cell.
pub(crate) struct Case {
    pub(crate) chain: u8,
    pub(crate) joint: u8,
    row: u8,
    pose: [i16; 6],
    joints: [i16; MAX_JOINTS],
    /// Force on the cell in steps of 2^-16 N.
    pub(crate) force: i32,
}

include!(concat!(env!("OUT_DIR"), "/cases.rs"));

/// A chain without rows.
static EMPTY: Chain = Chain { name: "", rows: &[] };

impl Chain {
    /// Returns the number of joints of the chain.
    pub(crate) fn joints(&self) -> u8 {
        self.rows.iter().map(|row| u8::from(row[4] != 2)).sum()
    }
}

impl Case {
    pub(crate) fn chain(&self) -> &'static Chain {
        CHAINS.get(usize::from(self.chain)).unwrap_or(&EMPTY)
    }

    /// Returns true if the instructions of this case are counted: those on the UR5 and on the long chains.
    pub(crate) fn is_counted(&self) -> bool {
        self.chain().name == "ur5" || self.chain().name.starts_with("chain-")
    }

    pub(crate) fn joints(&self) -> [Q1_14; MAX_JOINTS] {
        self.joints.map(Q1_14::from_bits)
    }

    pub(crate) fn parameters(&self) -> Parameters {
        let chain = self.chain();
        let [x, y, z, nx, ny, nz] = self.pose.map(Q1_14::from_bits);
        let is_plain = chain.rows.iter().all(|row| row[4] == 0);
        let mut parameters = Parameters {
            joint: self.joint,
            joints: chain.joints(),
            row: if is_plain { 0 } else { self.row },
            table_rows: if is_plain { 0 } else { u8::try_from(chain.rows.len()).unwrap_or_default() },
            pose: Pose { position: [x, y, z], normal: [nx, ny, nz] },
            contact: Contact { alpha_c: Q3_12::from_bits(1 << 12), ..Contact::default() },
            period_us: 16_000,
            ..Parameters::default()
        };
        for (row, [a, d, alpha, theta_offset, kind]) in parameters.rows.iter_mut().zip(chain.rows) {
            let [a, d, alpha, theta_offset] = [*a, *d, *alpha, *theta_offset].map(Q1_14::from_bits);
            let kind = match kind {
                0 => RowKind::Revolute,
                1 => RowKind::Prismatic,
                _ => RowKind::Fixed,
            };
            *row = Row { a, d, alpha, theta_offset, kind };
        }
        parameters
    }
}
