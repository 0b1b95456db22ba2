//! The `fourdbody` command line: parse, run the command, turn its outcome into the exit code.

use clap::{Parser, Subcommand};
use fourdbody::cmds::{self, Exit, Failure};
use std::process::ExitCode;

/// 4D human-body scanner: capture, verify, reconstruct.
///
/// Exit codes: 0 done; 1 any other failure; 2 usage or configuration; 3 done, with data loss that is
/// accounted for; 4 data corrupt or a verification failed; 5 device or link failure.
#[derive(Parser)]
#[command(version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Node(cmds::node::Args),
    CheckConfig(cmds::check_config::Args),
    Cameras(cmds::cameras::Args),
    Capture(cmds::capture::Args),
    Status(cmds::status::Args),
    Doctor(cmds::doctor::Args),
    Board(cmds::board::Args),
    Calibrate(cmds::calibrate::Args),
    Export(cmds::export::Args),
    Import(cmds::import::Args),
    Info(cmds::info::Args),
    Verify(cmds::verify::Args),
    Pattern(cmds::pattern::Args),
    Reconstruct(cmds::reconstruct::Args),
    Recover(cmds::recover::Args),
    Token(cmds::token::Args),
    Validate(cmds::validate::Args),
    View(cmds::view::Args),
}

fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_env("FOURDBODY_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let cli = Cli::parse();
    match run(&cli.command) {
        Ok(exit) => exit.into(),
        Err(Failure { exit, message }) => {
            eprintln!("error: {message}");
            exit.into()
        }
    }
}

fn run(command: &Command) -> Result<Exit, Failure> {
    match command {
        Command::Node(args) => cmds::node::run(args),
        Command::CheckConfig(args) => cmds::check_config::run(args),
        Command::Cameras(args) => cmds::cameras::run(args),
        Command::Capture(args) => cmds::capture::run(args),
        Command::Status(args) => cmds::status::run(args),
        Command::Doctor(args) => cmds::doctor::run(args),
        Command::Export(args) => cmds::export::run(args),
        Command::Board(args) => cmds::board::run(args),
        Command::Calibrate(args) => cmds::calibrate::run(args),
        Command::Import(args) => cmds::import::run(args),
        Command::Info(args) => cmds::info::run(args),
        Command::Verify(args) => cmds::verify::run(args),
        Command::Pattern(args) => cmds::pattern::run(args),
        Command::Reconstruct(args) => cmds::reconstruct::run(args),
        Command::Recover(args) => cmds::recover::run(args),
        Command::Token(args) => cmds::token::run(args),
        Command::Validate(args) => cmds::validate::run(args),
        Command::View(args) => cmds::view::run(args),
    }
}
