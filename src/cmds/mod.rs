// SPDX-License-Identifier: MIT OR Apache-2.0
//! One file per command of the command line: its arguments, and what it prints.
//!
//! Results go to standard output, diagnostics to standard error. Everything a command does lives in the
//! library's other modules; here is only the talking.

mod board;
mod calibrate;
mod calibrate_live;
mod calibration;
mod camera_setup;
mod camera_state;
mod cameras;
mod capture;
mod check_config;
mod cli;
mod cluster;
mod connect;
mod doctor;
mod export;
mod failure;
mod frame_sets;
mod import;
mod info;
mod node;
mod pattern;
mod progress;
mod prune;
mod reconstruct;
mod recover;
mod report;
mod signals;
mod status;
mod token;
mod validate;
mod verify;
mod view;
mod worker;

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
