//! `fourdbody capture`: one session on all nodes, from preparation to the verdict.

use super::{Exit, Failure};
use crate::session::capture::{CaptureOptions, capture};
use std::path::PathBuf;

/// Capture one session on all nodes; live progress; the verdict at the end.
///
/// No trigger is emitted unless every camera of every node is armed and verified. Ctrl-C ends the train after
/// the current trigger and keeps what was recorded. Exit code 3 when frames are missing (each has a gap record).
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody capture --nodes http://127.0.0.1:7401,http://127.0.0.1:7402 --duration 10 --name walk-01"
)]
pub struct Args {
    /// The nodes' URLs, separated by commas.
    #[arg(long, value_name = "URL,URL", value_delimiter = ',', required = true)]
    nodes: Vec<String>,
    /// Seconds to capture; the number of triggers follows from the rig's rate.
    #[arg(long, value_name = "S", conflicts_with = "triggers", required_unless_present = "triggers")]
    duration: Option<f64>,
    /// Triggers to capture; 0 runs until Ctrl-C.
    #[arg(long, value_name = "N")]
    triggers: Option<u64>,
    /// Session name, also its directory; by default made from the time.
    #[arg(long)]
    name: Option<String>,
    /// Pseudonymous id of the subject.
    #[arg(long)]
    subject: Option<String>,
    /// Free text kept with the session.
    #[arg(long)]
    note: Option<String>,
    /// Print one JSON object at the end instead of text.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    if args.duration.is_some_and(|s| !(s > 0.0 && s < 1e6)) {
        return Err(Failure::new(Exit::Usage, "--duration: expected seconds above 0"));
    }
    let options = CaptureOptions {
        nodes: args.nodes.clone(),
        duration_s: args.duration,
        triggers: args.triggers,
        name: args.name.clone(),
        subject: args.subject.clone(),
        note: args.note.clone(),
    };
    let show_progress = !args.json && std::io::IsTerminal::is_terminal(&std::io::stderr());
    let captured = capture(&options, |line| {
        if show_progress {
            eprint!("\r{line}\x1b[K");
        }
    });
    if show_progress {
        eprintln!();
    }
    let captured =
        captured.map_err(|fault| Failure { exit: Exit::from_code(fault.exit), message: fault.message })?;
    if args.json {
        println!("{}", captured.to_json());
    } else {
        captured.lines().iter().for_each(|line| println!("{line}"));
        print_directories(&captured.directories());
    }
    Ok(captured.exit())
}

fn print_directories(directories: &[PathBuf]) {
    directories.iter().for_each(|directory| println!("recording: {}", directory.display()));
}
