//! One capture on one node: the pure state machine, and the driver that carries out its actions. And one capture on all
//! nodes: what coordinates them, from the command line or from a node.

mod attendant;
pub mod capture;
pub mod captured;
pub mod coordinator;
mod countdown;
mod current;
pub mod devices;
pub mod driver;
mod events;
mod link;
pub mod participant;
pub mod peer_watch;
mod prepare;
pub mod series;
pub mod silence;
pub mod state;
