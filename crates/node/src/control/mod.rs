// SPDX-License-Identifier: MIT OR Apache-2.0
//! What both sides of the HTTP API speak: requests, commands, status, tokens and their proofs, and the client.

/// The client of other nodes' APIs.
pub mod client;
/// What the API asks of the node's thread.
pub mod command;
pub(crate) mod interest;
/// Links that log a browser in once.
pub mod links;
/// How a token is shown where others could take it.
pub mod proof;
/// What an operator asks for.
pub mod request;
/// The state of a node, as it reports it.
pub mod status;
/// Tokens: secrets, their hashes and roles.
pub mod tokens;
