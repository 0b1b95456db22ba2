// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody info`: describes recordings without checking them.

use super::failure::Failure;
use crate::base::Exit;
use crate::base::ids::one_line;
use crate::record::describe::{self, Sheet, Table};
use crate::record::{RecordingReader, Unreadable, open_each};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Most lines about what is missing that are printed; JSON has all.
const MAX_LINES: usize = 20;

/// Describe a session, a recording or a segment: who, when, which cameras, how many triggers, what is missing.
#[derive(clap::Args)]
#[command(after_help = "\
Works on interrupted and damaged recordings too, and lists what is missing. Checksums are not computed: see
`fourdbody verify`. Clocks are fitted again from the recorded exchanges: offset is the device's clock minus the
host's, skew how much faster it runs, residual the median distance of the last exchanges from the fit, and
open what round trips leave uncertain.

Exit code 0: described; 2: there is no recording; 4: a recording, or all of it, cannot be read.

Examples:
  fourdbody info /var/lib/fourdbody/sessions/walk-01
  fourdbody info --json /var/lib/fourdbody/sessions/walk-01/node-a")]
pub struct Args {
    /// A session, a recording of one node, or a single segment.
    path: PathBuf,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// Describes the recordings at the path; returns the exit code.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let (recordings, unreadable) = open_each(&args.path)?;
    if args.json {
        println!("{}", session_json(args, &recordings, &unreadable));
    } else {
        print_session(&recordings);
        recordings.iter().for_each(print_recording);
        for one in &unreadable {
            println!("{}\n  NOT READABLE  {}", one_line(one.path.display()), one_line(&one.reason));
        }
    }
    Ok(if unreadable.is_empty() { Exit::Done } else { Exit::Corrupt })
}

fn session_json(args: &Args, recordings: &[RecordingReader], unreadable: &[Unreadable]) -> serde_json::Value {
    let first = recordings.iter().filter_map(|r| r.segments.first()).map(|s| s.first_trigger).min();
    let end = recordings.iter().map(RecordingReader::triggers_end).max().unwrap_or(0);
    serde_json::json!({
        "path": args.path, "first_trigger": first.unwrap_or(0).min(end), "end_trigger": end,
        "recordings": recordings.iter().map(recording_json).collect::<Vec<_>>(),
        "unreadable": unreadable,
    })
}

fn recording_json(recording: &RecordingReader) -> serde_json::Value {
    let events = describe::events(recording);
    let counts: BTreeMap<&str, u64> = events.iter().map(|kind| (kind.kind.as_str(), kind.count)).collect();
    serde_json::json!({
        "path": recording.path,
        "header": recording.header,
        "segments": recording.segments.len(),
        "segment_files": describe::segments(recording),
        "bytes": recording.bytes(),
        "triggers": recording.triggers_end(),
        "duration_s": describe::duration_s(recording),
        "measured_rate_hz": describe::measured_rate_hz(recording),
        "cameras": describe::cameras(recording),
        "trigger_table_rows": recording.triggers.len(),
        "time_code": describe::time_code(recording),
        "clock_samples": recording.clock_samples.len(),
        "clocks": describe::clocks(recording),
        "actions": describe::actions(recording),
        "ptp": describe::ptp(recording),
        "event_counts": counts,
        "event_kinds": events,
        "events": recording.events,
        "verdict": recording.verdict,
        "write_statistics": recording.statistics,
        "missing": describe::missing(recording),
    })
}

/// Prints a line about several nodes together.
fn print_session(recordings: &[RecordingReader]) {
    let [first, _, ..] = recordings else { return };
    let nodes: Vec<&str> = recordings.iter().map(|recording| recording.header.node.as_str()).collect();
    let cameras: usize = recordings.iter().map(|recording| recording.header.cameras.len()).sum();
    let one = recordings.iter().all(|recording| recording.header.session_id == first.header.session_id);
    let session = &first.header.session;
    if one {
        println!("session {session} of nodes {}: {cameras} cameras", nodes.join(" and "));
    } else {
        println!("NOT ONE SESSION: the recordings of nodes {} have different ids", nodes.join(" and "));
    }
}

fn print_recording(recording: &RecordingReader) {
    let sheet = Sheet::of(recording);
    println!("{}", one_line(recording.path.display()));
    for (name, value) in &sheet.facts {
        println!("  {name:<11} {value}");
    }
    for line in sheet.missing.iter().take(MAX_LINES) {
        println!("  MISSING     {}", one_line(line));
    }
    if sheet.missing.len() > MAX_LINES {
        println!("  MISSING     ... and {} lines more", sheet.missing.len() - MAX_LINES);
    }
    if !sheet.missing.is_empty() {
        println!(
            "  to do       run `fourdbody verify` to find what is damaged, `fourdbody recover` to save the rest"
        );
    }
    sheet.tables.iter().for_each(print_table);
}

fn print_table(table: &Table) {
    let head: Vec<String> = table.head.iter().map(ToString::to_string).collect();
    let lines = || std::iter::once(&head).chain(&table.rows);
    let width = |column: usize| lines().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..head.len()).map(width).collect();
    println!("  {}", table.title);
    for line in lines() {
        let cells = line.iter().zip(&widths).map(|(cell, width)| format!("{cell:<width$}"));
        println!("    {}", cells.collect::<Vec<_>>().join("  ").trim_end());
    }
}
