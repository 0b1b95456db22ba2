// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody capture`: sessions on all nodes, from preparation to the verdict.

use super::connect::Connect;
use super::failure::Failure;
use super::signals::on_signals;
use crate::base::ids::one_line;
use crate::base::{Exit, Fault};
use crate::capture::participant::Participant;
use crate::capture::report::Captured;
use crate::capture::request::{CaptureRequest, Control, Stage};
use crate::capture::series::{self, Series};
use crate::control::request::StartOn;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use tokio::signal::unix::SignalKind;

/// Capture sessions on all nodes; live progress; the verdict at the end.
///
/// No trigger is emitted unless every camera of every node is armed and verified. Ctrl-C ends the train after
/// the current trigger and keeps what was recorded. Exit code 3 when frames are missing (each has a gap record).
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody capture --nodes http://127.0.0.1:7401,http://127.0.0.1:7402 --duration 10 --name walk-01")]
pub struct Args {
    #[command(flatten)]
    connect: Connect,
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
    /// Captures in a row; their names end in -01, -02, ...
    #[arg(long, value_name = "N", default_value_t = 1)]
    takes: u32,
    /// Seconds from the end of a take to the preparation of the next.
    #[arg(long, value_name = "S", default_value_t = 0)]
    pause: u32,
    /// Seconds from the moment at which every node is ready to the first trigger.
    #[arg(long, value_name = "S", default_value_t = 0)]
    countdown: u32,
    /// Begin at an edge of one of the HSU's inputs, 0 to 7: a hand switch, or another device's start. Waits 120 s for
    /// it.
    #[arg(long, value_name = "INPUT[:rising|:falling]")]
    start_on: Option<StartOn>,
    /// Keep this many seconds before Record, which is Enter here: the train starts, frames are held in memory (1.1 GB a
    /// second and node at full rate), nothing is written before. --duration and --triggers count from Record.
    #[arg(long, value_name = "S", conflicts_with_all = ["start_on", "dry_run"])]
    pre_trigger: Option<f64>,
    /// Record this many seconds more after Ctrl-C; a second Ctrl-C ends at once.
    #[arg(long, value_name = "S")]
    post_trigger: Option<f64>,
    /// Do all but write: triggers, frames and verdict are real, nothing is recorded.
    #[arg(long)]
    dry_run: bool,
    /// Capture a part of the rig: without this all nodes of the rig must be in --nodes.
    #[arg(long)]
    partial: bool,
    /// Print one JSON object at the end instead of text.
    #[arg(long)]
    json: bool,
}

impl Args {
    fn series(&self) -> Series {
        let wish = CaptureRequest {
            preview: false,
            duration_s: self.duration,
            triggers: self.triggers,
            name: self.name.clone(),
            subject: self.subject.clone(),
            note: self.note.clone(),
            start_on: self.start_on,
            pre_trigger_s: self.pre_trigger,
            post_trigger_s: self.post_trigger,
            dry_run: self.dry_run,
            partial: self.partial,
            countdown_s: self.countdown,
            on_behalf_of: None,
        };
        Series { wish, takes: self.takes, pause_s: self.pause, number: false }
    }
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let nodes = args.connect.clients()?;
    let nodes: Vec<Box<dyn Participant>> =
        nodes.into_iter().map(|node| Box::new(node) as Box<dyn Participant>).collect();
    let control = Arc::new(Control::default());
    stop_on_ctrl_c(&control)?;
    if args.pre_trigger.is_some_and(|seconds| seconds > 0.0) {
        eprintln!("Enter records: it keeps the last seconds, and what comes");
        record_on_enter(&control);
    }
    let show_progress = !args.json && std::io::IsTerminal::is_terminal(&std::io::stderr());
    let mut known = BTreeSet::new();
    let show = |take: u32, stage: &Stage| {
        if let Stage::Recording { notices, .. } | Stage::Holding { notices, .. } = stage {
            // Once each, and at once: the subject is still there.
            for notice in notices.iter().filter(|notice| !known.contains(&(take, notice.to_string()))) {
                eprintln!("{}{notice}", if show_progress { "\r\x1b[K" } else { "" });
            }
            known.extend(notices.iter().map(|notice| (take, notice.clone())));
        }
        if show_progress && args.takes > 1 {
            eprint!("\rtake {take} of {}: {}\x1b[K", args.takes, one_line(stage));
        } else if show_progress {
            eprint!("\r{}\x1b[K", one_line(stage));
        }
    };
    let tell = |captured: &Captured| {
        if show_progress {
            eprintln!();
        }
        if !args.json {
            captured.lines().iter().for_each(|line| println!("{line}"));
            print_directories(&captured.directories());
        }
    };
    let (takes, fault) = match series::run(&nodes, &args.series(), &control, show, tell) {
        Ok(ended) => {
            ended.stopped.iter().for_each(|reason| eprintln!("{reason}"));
            (ended.takes, None)
        }
        Err((takes, fault)) => (takes, Some(fault)),
    };
    if show_progress && fault.is_some() {
        eprintln!();
    }
    if args.json {
        print_json(&takes, args.takes);
    }
    if let Some(fault) = fault {
        return Err(fault);
    }
    let worst = takes.iter().map(Captured::exit).find(|exit| *exit != Exit::Done);
    Ok(worst.unwrap_or(Exit::Done))
}

/// One take is an object, several are a list in one.
fn print_json(takes: &[Captured], requested: u32) {
    match takes {
        [] if requested == 1 => {}
        [take] if requested == 1 => println!("{}", take.to_json()),
        takes => {
            let takes: Vec<_> = takes.iter().map(Captured::to_json).collect();
            println!("{}", serde_json::json!({ "takes_asked": requested, "takes": takes }));
        }
    }
}

fn print_directories(directories: &[PathBuf]) {
    directories.iter().for_each(|directory| println!("recording: {}", directory.display()));
}

/// Each line of standard input is Record. Where it ends there will be none.
fn record_on_enter(control: &Arc<Control>) {
    let control = Arc::clone(control);
    std::thread::spawn(move || {
        let mut recorded = false;
        for line in std::io::stdin().lines() {
            if line.is_err() {
                break;
            }
            match control.record() {
                true => recorded = true,
                false if recorded => {}
                false => eprintln!("nothing is held yet: press Enter again when it is"),
            }
        }
        if !recorded {
            eprintln!("standard input ended before Record was pressed: the capture is stopped");
            control.stop();
        }
    });
}

/// From here on Ctrl-C ends the capture, not the process; a second one ends the process where the capture does not
/// react.
pub(super) fn stop_on_ctrl_c(control: &Arc<Control>) -> Result<(), Fault> {
    let control = Arc::clone(control);
    on_signals(&[SignalKind::interrupt()], move || {
        if control.ends() {
            std::process::exit(i32::from(Exit::Failure as u8));
        }
        control.stop();
    })
    .map_err(|e| Fault::failed(format!("cannot watch for Ctrl-C: {e}")))
}
