//! Compares the cell's integers with `protocol/tests/golden/arithmetic.json`, which another program wrote from the
//! document.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use cell_node::contact::{Force, Torque};
use cell_node::sum::{EpochStart, SubtreeSum, SumWords};
use protocol::fixed::{Q, Q1_14, TorqueFormat};
use protocol::packet::{Epoch, WORDS, pad_with_defaults};
use protocol::parameters::{Parameter, Parameters, SumSchedule};
use protocol::time::{Micros, Span};
use serde_json::Value;

const ARITHMETIC: &str = include_str!("../../../../protocol/tests/golden/arithmetic.json");
const PERIOD: u64 = 16_000;

fn rows(section: &str) -> Vec<Value> {
    let all: Value = serde_json::from_str(ARITHMETIC).unwrap();
    let rows = all[section].as_array().unwrap().clone();
    assert!(rows.len() > 2, "{section}");
    rows
}

fn words<const N: usize>(value: &Value) -> [i16; N] {
    let words: Vec<i16> = serde_json::from_value(value.clone()).unwrap();
    words.try_into().unwrap()
}

fn jacobian_and_force(of: &Value) -> ([Q1_14; WORDS], Force) {
    (words(&of["jacobian"]).map(Q1_14::from_bits), Force::from_steps(of["force"].as_i64().unwrap()))
}

// FORCE-1, TORQUE-1
#[test]
fn forces_and_torques_are_those_of_the_other_program() {
    for row in rows("forces") {
        let mut rule = Parameters::default();
        let [a, b, c, d, e] = words(&row["contact"]);
        rule.set(Parameter::Contact, [a, b, c, d, e, 0]).unwrap();
        let [c1, c2, c3, proximity, _, _] = words(&row["sensors"]);
        let force =
            Force::fuse([c1, c2, c3].map(Q::from_bits), Q1_14::from_bits(proximity), &rule.contact).steps();
        assert_eq!(Some(i64::from(force)), row["force"].as_i64(), "{row}");
        let (jacobian, force) = jacobian_and_force(&row);
        let torque = Torque::new(&jacobian, force);
        assert_eq!(torque.torque_words(TorqueFormat::Q3_12)[..6], words::<6>(&row["torque"]), "{row}");
    }
}

// SUM-2, SUM-3, SUM-6
#[test]
fn sums_and_what_rounding_carries_are_those_of_the_other_program() {
    for row in rows("sums") {
        let mut sum = SubtreeSum::default();
        let carry = row["carry"] == 1;
        sum.set_schedule(Some(SumSchedule { slot_us: 1_000, deepest: 1, carry }));
        let mut epoch = Epoch(253);
        for (index, step) in (0..).zip(row["epochs"].as_array().unwrap()) {
            epoch = epoch.next();
            let at = Micros(index * PERIOD);
            let children = step["children"].as_array().unwrap();
            let begin = EpochStart {
                epoch,
                at,
                period: Span(PERIOD),
                depth: Some(0),
                may_send: true,
                children: (1 << children.len()) - 1,
            };
            let own = step["own"].as_object().map(|_| {
                let (jacobian, force) = jacobian_and_force(&step["own"]);
                Torque::new(&jacobian, force).exact_torques()
            });
            sum.begin_epoch(&begin, own.as_ref());
            for (port, child) in children.iter().enumerate() {
                let count = u8::try_from(child["count"].as_u64().unwrap()).unwrap();
                sum.handle_state_message(at, port, epoch);
                sum.receive_sum(
                    at,
                    port,
                    epoch,
                    SumWords {
                        torque: pad_with_defaults(&words::<WORDS>(&child["words"])).map(Q::from_bits),
                        count,
                    },
                );
            }
            let sent = sum.poll_sum(at + Span(PERIOD / 2));
            let sent = sent.map(|(_, SumWords { torque, count }, _)| (torque.map(Q::to_bits), count));
            let expected = step["sends"].as_object().map(|sends| {
                (
                    pad_with_defaults(&words::<WORDS>(&sends["words"])),
                    u8::try_from(sends["count"].as_u64().unwrap()).unwrap(),
                )
            });
            assert_eq!(sent, expected, "{step}");
        }
    }
}
