//! The node's HTTP control API: data transfer objects, server, client, tokens.
//!
//! Over a Unix socket for local users, over TCP with TLS and tokens where configured (`docs/design/api.md`). JSON in
//! and out; an error is a [`Fault`](crate::session::state::Fault) with its exit code.

pub mod client;
pub mod dto;
pub mod proof;
pub mod server;
pub mod tokens;
