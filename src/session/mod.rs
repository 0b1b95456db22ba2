//! One capture on one node: the pure state machine, and the driver that carries out its actions.

pub mod capture;
mod current;
pub mod devices;
pub mod driver;
pub mod state;
