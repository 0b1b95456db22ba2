// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim`: the simulator's command line.

use clap::{Parser, Subcommand};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use fourdbody_simulator::cmds;
use std::io::IsTerminal;
use std::process::ExitCode;

/// Simulated light, cameras and HSU for fourdbody: real protocols, simulated photons.
///
/// Exit codes: 0 done; 1 any other failure; 2 usage or configuration; 4 a check failed.
#[derive(Parser)]
#[command(version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Lab(cmds::lab::Args),
    Run(cmds::run::Args),
    Render(cmds::render::Args),
    ExportPng(cmds::export_png::Args),
    ConvertRig(cmds::convert_rig::Args),
    Cameras(cmds::cameras::Args),
    Summarize(cmds::summarize::Args),
    BenchIngest(cmds::bench_ingest::Args),
    CheckAccounting(cmds::check_accounting::Args),
    CompareRig(cmds::compare_rig::Args),
    Gather(cmds::gather::Args),
}

fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_env("FOURDBODY_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let colours = std::io::stderr().is_terminal();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(colours).init();
    match run(&Cli::parse().command) {
        Ok(exit) => exit.into(),
        Err(Failure { exit, message }) => {
            eprintln!("error: {message}");
            exit.into()
        }
    }
}

fn run(command: &Command) -> Result<Exit, Failure> {
    match command {
        Command::Lab(args) => cmds::lab::run(args),
        Command::Run(args) => cmds::run::run(args),
        Command::Render(args) => cmds::render::run(args),
        Command::ExportPng(args) => cmds::export_png::run(args),
        Command::ConvertRig(args) => cmds::convert_rig::run(args),
        Command::Cameras(args) => cmds::cameras::run(args),
        Command::Summarize(args) => cmds::summarize::run(args),
        Command::BenchIngest(args) => cmds::bench_ingest::run(args),
        Command::CheckAccounting(args) => cmds::check_accounting::run(args),
        Command::CompareRig(args) => cmds::compare_rig::run(args),
        Command::Gather(args) => cmds::gather::run(args),
    }
}
