// SPDX-License-Identifier: MIT OR Apache-2.0
//! The command line as a whole: the program, its manual pages and its completions are made of it.

use super::failure::Failure;
use super::{
    board, calibrate, calibration, cameras, capture, check_config, cluster, doctor, export, frame_sets,
    import, info, node, pattern, prune, reconstruct, recover, report, status, token, validate, verify, view,
    worker,
};
use crate::base::Exit;
use clap::{Parser, Subcommand};

/// 4D human-body scanner: capture, verify, reconstruct.
///
/// Exit codes: 0 done; 1 any other failure; 2 usage or configuration; 3 done, with data loss that is
/// accounted for; 4 data corrupt or a verification failed; 5 device or link failure.
#[derive(Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

/// The commands, a variant for each.
#[derive(Subcommand)]
#[expect(missing_docs, reason = "each is documented by its arguments")]
pub enum Command {
    Node(node::Args),
    CheckConfig(check_config::Args),
    Cameras(cameras::Args),
    Capture(capture::Args),
    Status(status::Args),
    Doctor(doctor::Args),
    Board(board::Args),
    Calibrate(calibrate::Args),
    Calibration(calibration::Args),
    Export(export::Args),
    #[command(hide = true)]
    FrameSets(frame_sets::Args),
    Import(import::Args),
    Info(info::Args),
    Verify(verify::Args),
    Pattern(pattern::Args),
    Prune(prune::Args),
    Reconstruct(reconstruct::Args),
    Cluster(cluster::Args),
    Recover(recover::Args),
    Report(report::Args),
    Token(token::Args),
    Validate(validate::Args),
    View(view::Args),
    Worker(worker::Args),
}

impl Cli {
    pub fn run(&self) -> Result<Exit, Failure> {
        match &self.command {
            Command::Node(args) => node::run(args),
            Command::CheckConfig(args) => check_config::run(args),
            Command::Cameras(args) => cameras::run(args),
            Command::Capture(args) => capture::run(args),
            Command::Status(args) => status::run(args),
            Command::Doctor(args) => doctor::run(args),
            Command::Export(args) => export::run(args),
            Command::FrameSets(args) => frame_sets::run(args),
            Command::Board(args) => board::run(args),
            Command::Calibrate(args) => calibrate::run(args),
            Command::Calibration(args) => calibration::run(args),
            Command::Import(args) => import::run(args),
            Command::Info(args) => info::run(args),
            Command::Verify(args) => verify::run(args),
            Command::Pattern(args) => pattern::run(args),
            Command::Prune(args) => prune::run(args),
            Command::Reconstruct(args) => reconstruct::run(args),
            Command::Cluster(args) => cluster::run(args),
            Command::Recover(args) => recover::run(args),
            Command::Report(args) => report::run(args),
            Command::Token(args) => token::run(args),
            Command::Validate(args) => validate::run(args),
            Command::View(args) => view::run(args),
            Command::Worker(args) => worker::run(args),
        }
    }
}
