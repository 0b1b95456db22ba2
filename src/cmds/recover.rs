// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody recover`: makes a complete recording of what a crash or a damaged disk has left.

use super::failure::{Failure, print};
use super::progress::Progress;
use crate::base::Exit;
use crate::record::recover::{RecoverError, RecoveredRecording, Recovery, recover};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Lines that are printed of damage and of added gap records; JSON has all.
const MAX_LINES: usize = 20;

/// Salvage an interrupted or damaged recording into a new, complete one.
#[derive(clap::Args)]
#[command(after_help = "\
The source is never changed. Frames whose checksum is wrong are not passed on: a gap record `damaged` takes their
place. What the interruption cost becomes `aborted`. Check the result with `fourdbody verify DIR`.

Exit code 0: it was finished, and nothing of it is damaged or missing; 3: saved, and what is not is accounted for, or
it was interrupted, and what came after is not known; 4: nothing usable.

Example:
  fourdbody recover /var/lib/fourdbody/sessions/walk-01 --out /var/lib/fourdbody/sessions/walk-01-recovered")]
pub struct Args {
    /// A session, a recording of one node, or a single segment.
    path: PathBuf,
    /// Where the result goes: a directory that does not exist.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let progress = Progress::of_bytes("recovering");
    let result = recover(&args.path, &args.out, &|done, total| progress.at(done, total));
    drop(progress);
    let recovery = result.map_err(|error| Failure::new(exit_of(&error, &args.path), error))?;
    let exit = if recovery.lossless() { Exit::Done } else { Exit::DataLoss };
    let value = json!({ "exit": exit as u8, "recovery": recovery });
    print(args.json, &value, || print_recovery(&recovery));
    Ok(exit)
}

fn exit_of(error: &RecoverError, path: &Path) -> Exit {
    match error {
        // A path that does not exist is a mistake of usage, not of the data.
        RecoverError::NotFound(_) if !path.exists() => Exit::Usage,
        RecoverError::Exists { .. } => Exit::Usage,
        RecoverError::NotFound(_) | RecoverError::Unusable { .. } => Exit::Corrupt,
        RecoverError::Output { .. } => Exit::Failure,
    }
}

fn print_recovery(recovery: &Recovery) {
    for recording in &recovery.recordings {
        print_recording(recording);
    }
    for reason in &recovery.unusable {
        println!("lost: {reason}");
    }
    let interrupted = recovery.recordings.iter().all(|recording| recording.lossless_until_interrupted());
    let word = match recovery.lossless() {
        true => "everything that was there is saved",
        false if recovery.unusable.is_empty() && interrupted => {
            "everything that was written is saved; it was interrupted, and what came after is not known"
        }
        false => "saved, with loss",
    };
    println!("{}: {word}; check it with `fourdbody verify`", recovery.out.display());
}

fn print_recording(recording: &RecoveredRecording) {
    let node = &recording.node;
    let lines = recording.damage.iter().map(|damage| format!("damage: node {node} {damage}"));
    let added = recording.added.iter().map(|run| {
        let (camera, cause) = (&run.camera, run.cause);
        if run.first == run.last {
            format!("added: node {node} camera {camera} trigger {}: gap: {cause}", run.first)
        } else {
            format!("added: node {node} camera {camera} triggers {} to {}: gap: {cause}", run.first, run.last)
        }
    });
    let lines: Vec<String> = lines.chain(added).collect();
    lines.iter().take(MAX_LINES).for_each(|line| println!("{line}"));
    if lines.len() > MAX_LINES {
        println!("... and {} more", lines.len() - MAX_LINES);
    }
    if recording.records_lost > 0 {
        println!("node {node}: {} small records lost with their chunks", recording.records_lost);
    }
    println!("node {node}: {}", recording.verdict);
}
