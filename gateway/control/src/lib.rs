//! One tick of the control loop: what the buses know goes in, what has to be sent and recorded comes out.
//!
//! | module | what |
//! |---|---|
//! | [`cycle`] | the tick itself, and its input and output |
//! | [`controller`], [`motion`] | torques into joint velocities, and the controller of each motion |
//! | [`external`] | a controller in another program, behind a Unix datagram socket |
//! | [`robot`] | the simulated arm |

pub mod controller;
pub mod cycle;
pub mod external;
pub mod motion;
pub mod robot;

#[cfg(test)]
mod tests;
