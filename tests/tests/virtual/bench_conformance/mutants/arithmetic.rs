//! Cells with wrong F_z, J and torque words.

use protocol::message::State;
use protocol::parameters::Parameters;

use super::FaultCase;
use crate::bench_conformance::wrong::{beat, force, retorqued, right_force, rounded, with, with_word};

const UP: fn(i64) -> i64 = |f_z| (f_z + 128) >> 8;
const AT: fn(i64, i64) -> bool = |value, threshold| value >= threshold;
const ALL: fn(i64) -> i64 = |sum| sum;

/// Faults of the arithmetic.
pub(crate) const ARITHMETIC: &[FaultCase] = &[
    ("F_z is cut off, not rounded", "FORCE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                memory.torque_of(of, |of, skin| force(of, skin, AT, ALL, |f_z| f_z >> 8), rounded)
            })
        };
    }),
    ("what equals a threshold does not count", "FORCE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                memory.torque_of(of, |of, skin| force(of, skin, |value, at| value > at, ALL, UP), rounded)
            })
        };
    }),
    ("the sum of the contact words is held in a word", "FORCE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let held = |sum: i64| sum.clamp(i16::MIN.into(), i16::MAX.into());
                memory.torque_of(of, |of, skin| force(of, skin, AT, held, UP), rounded)
            })
        };
    }),
    ("thresholds are forgotten after some time", "FORCE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let f_z = |of: &Parameters, skin: &_| {
                    force(of, skin, |value, at| at == 0 && value >= 0 || value >= 2 * at, ALL, UP)
                };
                memory.torque_of(of, f_z, rounded)
            })
        };
    }),
    ("ties go down", "TORQUE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let down = |exact: i64, bits: u32| rounded(exact - 1, bits);
                memory.torque_of(of, right_force, down)
            })
        };
    }),
    ("ties go away from zero", "TORQUE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let away = |exact: i64, bits: u32| rounded(exact.abs(), bits) * exact.signum();
                memory.torque_of(of, right_force, away)
            })
        };
    }),
    ("torques wrap", "TORQUE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                memory.torque_of(of, right_force, |exact, bits| (exact + (1 << (bits - 1))) >> bits)
            })
        };
    }),
    ("torques are held one step too early", "TORQUE-1", |it| {
        it.say =
            |_, message| with_word(message, |words| words.iter_mut().for_each(|it| *it = (*it).max(-32_767)));
    }),
    ("another torque format is sent in Q3.12", "TORQUE-1", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let bits = 30 - of.torque_format.fraction_bits();
                memory.torque_of(of, right_force, move |exact, _| {
                    rounded(exact, if bits == 20 { 18 } else { bits })
                })
            })
        };
    }),
    ("J is off by 20 steps", "J-3", |it| {
        it.say = |_, message| with_word(message, |words| words[0] = words[0].saturating_add(20));
    }),
    ("the sign of alpha is lost", "J-3", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let mut of = *of;
                for row in &mut of.rows {
                    row.alpha = protocol::fixed::Q1_14::from_bits(row.alpha.to_bits().saturating_abs());
                }
                memory.torque_of(&of, right_force, rounded)
            })
        };
    }),
    ("the first configuration's J is kept", "CONF-7", |it| {
        it.say = |memory, message| {
            retorqued(memory, message, |memory, of| {
                let first = memory.commits[0];
                let of = if first.joints == of.joints { first } else { *of };
                memory.torque_of(&of, right_force, rounded)
            })
        };
    }),
    ("J wraps", "J-2", |it| {
        it.say = |_, message| {
            with_word(message, |words| {
                if words[0] == i16::MIN || words[0] == i16::MAX {
                    words[0] = words[0].wrapping_mul(2);
                }
            })
        };
    }),
    ("a word beyond joint k is not 0", "J-1", |it| {
        it.say = |memory, message| {
            let joint = usize::from(memory.in_use().joint);
            with_word(message, |words| words[joint.min(13)] = 1)
        };
    }),
    ("SATURATED is never set", "TORQUE-2", |it| {
        it.say = |_, message| vec![(0, with(message, State::SATURATED, false))];
    }),
    ("SATURATED stays", "STATE-2", |it| {
        it.say = |memory, mut message| {
            if let Some(beat) = beat(&mut message) {
                if beat.state.has(State::SATURATED) {
                    memory.count = 2;
                }
                let set = memory.count > 0;
                memory.count = memory.count.saturating_sub(1);
                let again = with(message, State::SATURATED, set);
                // The next heartbeat has it too: a second one is sent at once.
                return if set { vec![(0, again), (50, again)] } else { vec![(0, again)] };
            }
            vec![(0, message)]
        };
    }),
];
