//! The control loop: each tick computes the messages to send and a record from the state of the buses.
//!
//! | module | what |
//! |---|---|
//! | [`cycle`] | the tick itself, and its input and output |
//! | [`controller`], [`motion`] | controllers that turn torques into joint velocities, and the controller of each motion |
//! | [`external`] | a controller in another program, behind a Unix datagram socket |
//! | [`robot`] | the simulated arm |

pub mod controller;
pub mod cycle;
pub mod external;
pub mod motion;
pub mod robot;

#[cfg(test)]
mod tests;
