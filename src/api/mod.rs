//! The node's HTTP control API: data transfer objects, server, client.
//!
//! Loopback only for now (the configuration refuses anything else). JSON in and out; an error is a
//! [`Fault`](crate::session::state::Fault) with its exit code.

pub mod client;
pub mod dto;
pub mod server;
