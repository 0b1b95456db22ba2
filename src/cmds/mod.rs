// SPDX-License-Identifier: MIT OR Apache-2.0
//! One file per command of the command line: its arguments, and what it prints.
//!
//! Results go to standard output, diagnostics to standard error. Everything a command does lives in the
//! library's other modules; here is only the talking.

pub mod board;
pub mod calibrate;
mod calibrate_live;
pub mod calibration;
mod camera_setup;
mod camera_state;
pub mod cameras;
pub mod capture;
pub mod check_config;
mod cli;
pub mod cluster;
pub mod connect;
pub mod doctor;
pub mod export;
mod failure;
pub mod frame_sets;
pub mod import;
pub mod info;
pub mod node;
pub mod pattern;
mod progress;
pub mod prune;
pub mod reconstruct;
pub mod recover;
pub mod report;
mod signals;
pub mod status;
pub mod token;
pub mod validate;
pub mod verify;
pub mod view;
pub mod worker;

pub use cli::{Cli, Command};
pub use failure::Failure;

use std::ops::RangeInclusive;

/// A parser of numbers within a range, for clap; `expected` describes them where an argument is refused.
fn number_in(
    range: RangeInclusive<f64>,
    expected: &'static str,
) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync + 'static {
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("expected {expected}, found {text:?}"))
    }
}
