// SPDX-License-Identifier: MIT OR Apache-2.0
//! The options of a new bench, and the person who stands at it.

use super::node_file::Given;
use super::roles::Claim;
use crate::network::Subnet;
use std::path::PathBuf;

/// The options with which [`set_up`](super::set_up) begins.
#[derive(Debug, Clone)]
pub struct Options {
    /// The node file; it need not exist.
    pub path: PathBuf,
    /// Values for the file before its cameras.
    pub given: Given,
    /// Which camera is which, by the operator.
    pub claims: Vec<Claim>,
    /// Whether cameras of a head that nothing else distinguishes are named in the order of their serial numbers.
    pub in_order: bool,
    /// Only cameras with addresses in this network, and those in `claims`.
    pub network: Option<Subnet>,
}

/// The person at the bench.
pub trait Operator {
    /// Reports a step, or what was found.
    fn tell(&mut self, line: &str);
    /// Whether the person agrees to what the question proposes.
    fn agrees(&mut self, question: &str) -> bool;
    /// Waits until the person has done this; `false` where no person is there.
    fn does(&mut self, what: &str) -> bool;
    /// Whether a person is there to answer.
    fn is_there(&self) -> bool;
}
