// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody prune`: which recordings may be deleted, and deletes them on request.

use super::failure::Failure;
use crate::base::Exit;
use crate::base::ids::one_line;
use crate::config::WorkerConfig;
use crate::worker::retention::{Judgement, delete, judge};
use crate::worker::state::Job;
use std::path::PathBuf;

/// Show which recordings are verified, reconstructed and copied to the archive, and delete them on request.
///
/// Without names all sessions that were reconstructed or set aside are looked at, by the sizes of their copies. With
/// names every byte is compared with the copy, which is then verified where it lies, and with --delete the recordings
/// that pass are deleted. A copy is another file: a link to the recording, or its directory mounted at a second place,
/// is none. Nothing else ever deletes a recording.
#[derive(clap::Args)]
#[command(after_help = "\
Exit code 4: a session that was named must stay.

Examples:
  fourdbody prune --config /etc/fourdbody/worker.toml
  fourdbody prune --config /etc/fourdbody/worker.toml --delete walk-01 walk-02")]
pub struct Args {
    /// The worker file, for instance /etc/fourdbody/worker.toml.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Sessions to check, byte by byte.
    sessions: Vec<String>,
    /// Delete the recordings of the named sessions that may go.
    #[arg(long, requires = "sessions")]
    delete: bool,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let config = WorkerConfig::load(&args.config)?;
    let named = !args.sessions.is_empty();
    let sessions = if named { args.sessions.clone() } else { reconstructed(&config) };
    let (mut exit, mut judged) = (Exit::Done, Vec::new());
    for session in &sessions {
        let judgement = judge(&config, session, named);
        if named && !judgement.stays.is_empty() {
            exit = Exit::Corrupt;
        }
        let mut deleted = false;
        if args.delete && judgement.stays.is_empty() {
            delete(&judgement).map_err(|e| Failure::corrupt(format!("{session}: {e}")))?;
            deleted = true;
        }
        if args.json {
            judged.push(serde_json::json!({ "judgement": judgement, "deleted": deleted }));
        } else {
            print(&judgement, deleted, named);
        }
    }
    if args.json {
        println!("{}", serde_json::json!({ "sessions": judged }));
    }
    Ok(exit)
}

fn print(judgement: &Judgement, deleted: bool, thoroughly: bool) {
    let (name, gb) = (&judgement.session, judgement.bytes as f64 / 1e9);
    match (judgement.stays.is_empty(), deleted) {
        (true, true) => println!("{name}: deleted, {gb:.2} GB"),
        (true, false) if thoroughly => {
            println!("{name}: may go, {gb:.2} GB: verified, reconstructed and copied")
        }
        (true, false) => {
            println!("{name}: may go by the looks of it, {gb:.2} GB; name it to have every byte compared")
        }
        (false, _) => println!("{name}: stays: {}", one_line(judgement.stays.join("; "))),
    }
}

/// Sessions that are reconstructed or were set aside, by name.
fn reconstructed(config: &WorkerConfig) -> Vec<String> {
    let entries = std::fs::read_dir(&config.results).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    let done = |name: &String| Job::load(&config.results, name).is_some_and(|job| job.has_ended());
    let mut names: Vec<String> = names.filter(done).collect();
    names.sort();
    names
}
