// SPDX-License-Identifier: MIT OR Apache-2.0
//! One file per command of the command line: its arguments, and what it prints.
//!
//! Results go to standard output, diagnostics to standard error. The work of a command is done by the other modules of
//! the library; here are only its arguments and its output.

mod board;
mod calibrate;
mod calibrate_live;
mod calibration;
mod calibration_import;
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
