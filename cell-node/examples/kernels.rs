//! Prints the operation counts and the errors of the kernels on a UR5, as tables.
//!
//! ```text
//! cargo run -p cell-node --example kernels
//! ```

#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "it prints, and stops where it cannot")]

use cell_node::kernel::oracle::{CountingWord, PaperWord, Projection};
use cell_node::kernel::{Kernel, Operations, Scalar, Word, Wrench};
use cell_node::sine::{cosine, paper_cosine, paper_sine, sine};
use protocol::fixed::{Q1_14, Q3_12};

#[path = "../src/tests/kernel/oracle.rs"]
mod oracle;

use oracle::{Case, Errors};

fn main() {
    println!("Sine over all 65 536 angles (Q1.14; rounding alone: mean 1.52e-5)\n");
    println!("| function | mean error | max error |\n|---|---|---|");
    print_sine_errors("sine, by eighths of a turn", sine, f64::sin);
    print_sine_errors("cosine, by eighths of a turn", cosine, f64::cos);
    print_sine_errors("sine, fifth order (paper)", paper_sine, f64::sin);
    print_sine_errors("cosine, fifth order (paper)", paper_cosine, f64::cos);

    println!("\nOne Jacobian on a UR5\n");
    println!("| kernel | k | mul | add | sin | cos | negations | angle additions | roundings |");
    println!("|---|---|---|---|---|---|---|---|---|");
    (1..=6).rev().for_each(|joint| print_operation_counts::<Wrench<_>>("wrench", joint));
    (1..=6).rev().for_each(|joint| print_operation_counts::<Projection<_>>("projection", joint));
    println!("| paper, Eq. 27 | 6 | 103 | 57 | 6 | 6 | | | |");

    println!("\nTorques of loaded joints on a UR5, Nm\n");
    println!("| kernel and numbers | mean error | max error |\n|---|---|---|");
    let wrench = kernel_errors::<Q1_14, Wrench>();
    print_torque_errors("wrench, words", wrench);
    print_torque_errors("projection, words", kernel_errors::<Q1_14, Projection>());
    print_torque_errors("wrench, words, paper's sine", kernel_errors::<PaperWord, Wrench<_>>());
    print_torque_errors("projection, words, paper's sine", kernel_errors::<PaperWord, Projection<_>>());
    let real = |case: &Case| {
        Wrench::<f64>::new(&case.parameters()).jacobian(&case.words()).map(|row| row * case.force)
    };
    print_torque_errors("either, real numbers, from the same words", Errors::of(real));
    let rounded = Errors::of(|case| real(case).map(|torque| Q3_12::nearest(torque).to_f64()));
    print_torque_errors("the same, rounded to Q3.12", rounded);
    let (poses, Errors { torques, omitted, .. }) = (Case::all().len(), wrench);
    println!("\n{torques} torques in {poses} poses; {omitted} poses left out because a torque exceeds Q3.12");
}

fn kernel_errors<W: Word + Scalar, K: Kernel<W>>() -> Errors {
    Errors::of_words(|parameters, joints| K::new(parameters).jacobian(joints).map(W::to_word))
}

fn print_sine_errors(name: &str, function: impl Fn(Q1_14) -> Q1_14, oracle: impl Fn(f64) -> f64) {
    let errors = (i16::MIN..=i16::MAX).map(|bits| {
        let angle = Q1_14::from_bits(bits);
        (function(angle).to_f64() - oracle(angle.to_radians())).abs()
    });
    let (sum, max) = errors.fold((0.0, 0.0_f64), |(sum, most), error| (sum + error, most.max(error)));
    println!("| {name} | {:.2e} | {max:.2e} |", sum / 65_536.0);
}

fn print_operation_counts<K: Kernel<CountingWord>>(name: &str, joint: u8) {
    let case = Case::all().into_iter().find(|case| case.joint == joint).unwrap();
    let kernel = K::new(&case.parameters());
    let (_, done) = Operations::count_operations(|| kernel.jacobian(&case.words()));
    let work = [done.multiplications, done.additions, done.sines, done.cosines];
    let rest = [done.negations, done.angle_additions, done.roundings];
    println!(
        "| {name} | {joint} | {} |",
        work.iter().chain(&rest).map(u32::to_string).collect::<Vec<_>>().join(" | ")
    );
}

fn print_torque_errors(name: &str, Errors { mean, max, .. }: Errors) {
    println!("| {name} | {mean:.2e} | {max:.2e} |");
}
