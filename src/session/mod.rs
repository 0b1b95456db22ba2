//! One capture on one node: the pure state machine, and the driver that carries out its actions.

mod attendant;
pub mod capture;
mod current;
pub mod devices;
pub mod driver;
mod events;
mod link;
mod prepare;
pub mod silence;
pub mod state;
