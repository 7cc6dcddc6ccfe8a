//! Measures several quantities in turn, on a machine that also does other work.
//!
//! Each round measures every quantity once, in a new random order. A short disturbance then affects one quantity in one
//! round, and a long one affects all quantities alike. The median of the measurements of a quantity is used.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64Mcg;

use super::line::quantile;

/// Measures each of `things` quantities once in each of `rounds` rounds. `once` measures the quantity with the given
/// index. Returns the sorted measurements of each quantity.
pub fn measure_interleaved(
    things: usize,
    rounds: usize,
    seed: u64,
    mut once: impl FnMut(usize) -> f64,
) -> Vec<Vec<f64>> {
    let mut dice = Pcg64Mcg::seed_from_u64(seed);
    let mut order: Vec<usize> = (0..things).collect();
    let mut measured = vec![Vec::with_capacity(rounds); things];
    for _ in 0..rounds {
        order.shuffle(&mut dice);
        for &thing in &order {
            let value = once(thing);
            if let Some(values) = measured.get_mut(thing) {
                values.push(value);
            }
        }
    }
    for values in &mut measured {
        values.sort_by(f64::total_cmp);
    }
    measured
}

/// Returns the median of the measurements of each quantity.
#[must_use]
pub fn medians(measured: &[Vec<f64>]) -> Vec<f64> {
    measured.iter().map(|values| quantile(&mut values.clone(), 0.5)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_thing_is_measured_in_every_round_and_a_stall_bends_nothing() {
        let mut calls = Vec::new();
        let measured = measure_interleaved(5, 9, 1, |thing| {
            calls.push(thing);
            let stalls = [0, 7, 22].contains(&calls.len());
            f64::from(u8::try_from(thing).unwrap()) + if stalls { 1e6 } else { 0.0 }
        });
        assert_eq!(medians(&measured), [0.0, 1.0, 2.0, 3.0, 4.0]);
        let mut orders: Vec<_> = calls.chunks(5).map(<[usize]>::to_vec).collect();
        assert_eq!(orders.len(), 9);
        orders.dedup();
        assert!(orders.len() > 5, "rounds go in other orders");
        for order in &mut orders {
            order.sort_unstable();
            assert_eq!(*order, [0, 1, 2, 3, 4]);
        }
    }
}
