//! One cell of a [`Wiring`](super::Wiring), and its parameters.

use std::collections::{HashMap, VecDeque};

use cell_node::contact::{Force, Torque};
use cell_node::kernel::{Kernel, Wrench};
use cell_node::sum::SumWords;
use protocol::can::Frame;
use protocol::fixed::{Q1_14, Q3_12, Q7_8};
use protocol::id::CellId;
use protocol::message::{PortsPage, TreePage};
use protocol::parameters::{Contact, MAX_JOINTS, Parameters, Pose, Row};
use protocol::port::{PORTS, PortMessage};
use protocol::time::Micros;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use super::{PortEnd, positions};
use crate::life::PowerState;
use protocol::packet::pad_with_defaults;

/// An input of a cell.
#[derive(Clone, Copy, Debug)]
pub(super) enum Inlet {
    Frame(Frame),
    Port(usize, PortMessage),
}

/// A cell of a wiring.
#[derive(Debug)]
pub struct WiredCell {
    /// The cell's node id, once it has one; it survives restarts, as in flash.
    pub node_id: Option<CellId>,
    /// The far end of the wire at each port.
    pub wires: [Option<PortEnd>; PORTS + 1],
    /// True for each port whose incoming direction is down.
    pub deaf: [bool; PORTS + 1],
    /// The last network page by which the cell reported its place in the tree.
    pub tree: Option<TreePage>,
    /// The last network page by which the cell reported its ports.
    pub ports: Option<PortsPage>,
    /// The cell's own torque, as it enters sums.
    pub(super) own: [i32; MAX_JOINTS],
    pub(super) serial: u32,
    pub(super) parameters: Parameters,
    pub(super) force: Force,
    pub(super) life: PowerState<(Micros, Inlet)>,
    pub(super) wake: Option<Micros>,
    /// Deferred frames, which do not wake the cell, with their times on the bus.
    pub(super) deferred: VecDeque<(Micros, Frame)>,
    pub(super) newest: Micros,
    /// The sums that the cell sent in each of the last epochs: their words, and the cells in them.
    pub(super) said: HashMap<u8, Vec<(SumWords, u128)>>,
}

impl WiredCell {
    pub(super) fn new(index: usize, dice: &mut Pcg64Mcg) -> Self {
        let mut normal = [0.0_f64; 3].map(|_| dice.random_range(-1.0..1.0_f64));
        let length = normal.iter().map(|n| n * n).sum::<f64>().sqrt().max(1e-3);
        normal.iter_mut().for_each(|n| *n /= length);
        if (normal.iter().map(|n| n * n).sum::<f64>() - 1.0).abs() > 1e-3 {
            normal = [0.0, 0.0, 1.0];
        }
        let row = |a, alpha, d| Row {
            a: Q1_14::nearest(a),
            d: Q1_14::nearest(d),
            alpha: Q1_14::nearest(alpha),
            ..Row::default()
        };
        let rows = [
            row(0.0, 1.0, 0.09),
            row(-0.425, 0.0, 0.0),
            row(-0.392, 0.0, 0.0),
            row(0.0, 1.0, 0.11),
            row(0.0, -1.0, 0.095),
            row(0.0, 0.0, 0.08),
        ];
        let parameters = Parameters {
            joint: 6,
            joints: 6,
            pose: Pose {
                position: [0.0; 3].map(|_: f64| Q1_14::nearest(dice.random_range(-0.2..0.2))),
                normal: normal.map(Q1_14::nearest),
            },
            contact: Contact { alpha_c: Q3_12::nearest(1.0), ..Contact::default() },
            period_us: 16_000,
            rows: pad_with_defaults(&rows),
            ..Parameters::default()
        };
        let force = Force::from_steps(i64::from(dice.random_range(1_000_i32..4_000)) << 6);
        let jacobian = Wrench::new(&parameters).jacobian(&pad_with_defaults(&positions()));
        let own = Torque::new(&jacobian, force).exact_torques().map(|exact| {
            let word: Q7_8 = exact.round();
            i32::from(word.to_bits())
        });
        Self {
            node_id: None,
            wires: [None; PORTS + 1],
            deaf: [false; PORTS + 1],
            tree: None,
            ports: None,
            own,
            serial: 1_000 + u32::try_from(index).expect("few cells"),
            parameters,
            force,
            life: PowerState::Off,
            wake: None,
            deferred: VecDeque::new(),
            newest: Micros(0),
            said: HashMap::new(),
        }
    }
}
