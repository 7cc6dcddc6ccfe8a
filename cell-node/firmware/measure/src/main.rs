//! Measurement of the cell's arithmetic on emulated microcontrollers and on the host. `tests/firmware/count` runs it.
//!
//! The first task prints, for each case, the words of J and of the torques from both kernels; the words must be the
//! same on all machines. The second task does the same for random cells. The third runs each kernel once per case, while the
//! emulator counts the instructions of the functions `measure_...`.
#![cfg_attr(target_os = "none", no_std, no_main)]

mod cases;
mod counted;
mod machine;
mod random;

use cases::CASES;
use cell_node::contact::{MAX_JACOBIAN_STEPS, TorqueRounding};
use cell_node::kernel::oracle::Projection;
use cell_node::kernel::{Kernel, Wrench};
use cell_node::node::Node;
use counted::Frames;
use machine::Machine;
use protocol::can::Format;
use protocol::fixed::{Q1_14, TorqueFormat};
use protocol::message::Joints;
use protocol::parameters::MAX_JOINTS;

/// Number of cases that are counted for each joint of a chain.
const COUNTED: usize = 10;

/// Runs the task requested on the command line.
fn run(machine: &mut Machine) {
    match machine.task() {
        b'c' => count(machine),
        b's' => stack(machine),
        b'r' => random::run(machine),
        _ => words(machine),
    }
}

/// Prints a line for each case: the words of J and of the torques, first from the wrench kernel, then from the
/// projection kernel.
fn words(machine: &mut Machine) {
    for case in CASES {
        wrench_words(machine, case);
        projection_words(machine, case);
        machine.line();
    }
}

#[inline(never)]
fn wrench_words(machine: &mut Machine, case: &cases::Case) {
    let mut jacobian = [Q1_14::ZERO; MAX_JOINTS];
    let kernel = Wrench::new(&case.parameters());
    counted::wrench(&kernel, &case.joints(), &mut jacobian);
    torque_words(machine, case, &jacobian, kernel.rounding());
}

#[inline(never)]
fn projection_words(machine: &mut Machine, case: &cases::Case) {
    let mut jacobian = [Q1_14::ZERO; MAX_JOINTS];
    counted::projection(&Projection::new(&case.parameters()), &case.joints(), &mut jacobian);
    torque_words(machine, case, &jacobian, &TorqueRounding::new(TorqueFormat::Q3_12, MAX_JACOBIAN_STEPS));
}

/// Appends the words of J, and of the torques that follow from J.
fn torque_words(
    machine: &mut Machine,
    case: &cases::Case,
    jacobian: &[Q1_14; MAX_JOINTS],
    rounding: &TorqueRounding,
) {
    let mut torque = [0; MAX_JOINTS];
    let count = usize::from(case.chain().joints());
    counted::torque_words(jacobian, case.joint, case.force, &mut torque, rounding);
    machine.words(jacobian.iter().take(count).map(|word| word.to_bits()));
    machine.words(torque.iter().take(count).copied());
}

/// Runs the kernels for each counted case, and prints the chain and the joint of the case in a line.
fn count(machine: &mut Machine) {
    let mut done = [[0; MAX_JOINTS + 1]; 8];
    for case in CASES.iter().filter(|case| case.is_counted()) {
        let place =
            done.get_mut(usize::from(case.chain)).and_then(|chain| chain.get_mut(usize::from(case.joint)));
        match place {
            Some(done) if *done < COUNTED => *done += 1,
            _ => continue,
        }
        kernels(case);
        reply(case, Format::Fd, false);
        reply(case, Format::Classic, false);
        machine.text(case.chain().name);
        machine.words([i16::from(case.joint)].into_iter());
        machine.line();
    }
}

/// Prints the number of bytes of stack that one reply uses, and the size of a node, which can be kept in a static.
fn stack(machine: &mut Machine) {
    let case = CASES.iter().rfind(|case| case.is_counted());
    machine.number(case.map_or(0, |case| reply(case, Format::Fd, true)));
    machine.number(u32::try_from(size_of::<Node>()).unwrap_or(u32::MAX));
    machine.line();
}

/// Runs both kernels and the rounding to torque words for one case.
#[inline(never)]
fn kernels(case: &cases::Case) {
    let (parameters, joints) = (case.parameters(), case.joints());
    let mut jacobian = [Q1_14::ZERO; MAX_JOINTS];
    let mut torque = [0; MAX_JOINTS];
    counted::projection(&Projection::new(&parameters), &joints, &mut jacobian);
    let kernel = Wrench::new(&parameters);
    counted::wrench(&kernel, &joints, &mut jacobian);
    counted::torque_words(&jacobian, parameters.joint, case.force, &mut torque, kernel.rounding());
}

/// Runs one reply of a cell on this chain. Returns the number of bytes of stack used, if `measures_stack` is
/// true.
#[inline(never)]
fn reply(case: &cases::Case, format: Format, measures_stack: bool) -> u32 {
    let mut node = counted::node(format);
    counted::configure(&mut node, &case.parameters());
    let joints = Joints { positions: case.joints(), in_use: case.chain().joints() };
    let (mut frames, mut answer) = (Frames::NONE, Frames::NONE);
    if counted::press(&mut node, joints, format, &mut frames).is_none() {
        return 0;
    }
    let reply = match format {
        Format::Fd => counted::reply,
        Format::Classic => counted::reply_classic,
    };
    if !measures_stack {
        reply(&mut node, &frames, &mut answer);
        return 0;
    }
    // The node is in this function's frame, above the painted stack.
    let top = machine::painted_stack();
    reply(&mut node, &frames, &mut answer);
    machine::used_stack(top)
}

#[cfg(not(target_os = "none"))]
fn main() {
    run(&mut Machine::default());
}

#[cfg(target_os = "none")]
#[cortex_m_rt::entry]
fn main() -> ! {
    run(&mut Machine::default());
    machine::end()
}
