// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody verify`: recomputes everything that recordings claim from the files alone.

use super::failure::Failure;
use super::progress::Progress;
use crate::base::Exit;
use crate::base::ids::one_line;
use crate::record::verify::{Report, Severity, compare, verify};
use std::path::PathBuf;

/// Check every invariant of recordings: checksums, exactly one outcome per camera and trigger, verdicts.
#[derive(clap::Args)]
#[command(after_help = "\
Prints one line per finding, then a line per node. Exit code 0: every frame is there and good; 3: frames are
missing, and the recording states which and why, or something is unconfirmed; 4: damaged, missing without a record of
it, or contradictory. Unconfirmed: what rests on one source alone, a setting that changed, and exposures that were not
at the time of the others.

The trigger of each frame is determined again from the raw samples: block ids, timestamps by the recorded readings of
the clocks, arrivals, and the HSU's trigger times. Two of them that are independent must agree.

The nodes of a session are compared with each other: in one session's directory, or as a path each.

Examples:
  fourdbody verify /var/lib/fourdbody/sessions/walk-01
  fourdbody verify /mnt/pc-a/walk-01/node-a /mnt/pc-b/walk-01/node-b")]
pub struct Args {
    /// Sessions, recordings of one node, or single segments (of which only the integrity is checked).
    #[arg(required = true)]
    paths: Vec<PathBuf>,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// Verifies each path; returns the worst exit code.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let mut exit = Exit::Done;
    let mut reports = Vec::new();
    for path in &args.paths {
        let progress = Progress::of_bytes("verifying");
        let result = verify(path, &|done, total| progress.at(done, total));
        drop(progress);
        let found = match &result {
            Ok(report) => severity_exit(report.worst),
            // A path that does not exist is a mistake in the command, not damage.
            Err(_) if !path.exists() => Exit::Usage,
            Err(_) => Exit::Corrupt,
        };
        exit = worse(exit, found);
        match result {
            Ok(report) if args.json => {
                let value = serde_json::to_value(&report).map_err(|e| Failure::new(Exit::Failure, e))?;
                reports.push(value);
            }
            Ok(report) => print(&report),
            Err(error) => {
                eprintln!("error: {error}");
                reports.push(serde_json::json!({"path": path, "error": error.to_string()}));
            }
        }
    }
    let (compared, findings) = if args.paths.len() > 1 { compare(&args.paths) } else { Default::default() };
    if findings.iter().any(|finding| finding.severity == Severity::Corrupt) {
        exit = worse(exit, Exit::Corrupt);
    }
    if args.json {
        let value = serde_json::json!({
            "exit": exit as u8, "reports": reports, "compared": compared, "findings": findings,
        });
        println!("{value}");
    } else {
        findings.iter().for_each(|finding| println!("{finding}"));
        compared.iter().for_each(|comparison| println!("{comparison}"));
    }
    Ok(exit)
}

fn print(report: &Report) {
    for finding in &report.findings {
        println!("{finding}");
    }
    if report.findings_omitted > 0 {
        println!("... and {} findings more", report.findings_omitted);
    }
    for recording in &report.recordings {
        println!("node {}: {}", recording.node, recording.verdict);
    }
    for comparison in &report.compared {
        println!("{comparison}");
    }
    let word = match report.worst {
        None | Some(Severity::Note) if report.single_segment => {
            "every checksum is right; more cannot be checked of a single segment"
        }
        None | Some(Severity::Note) if report.imported => {
            "every checksum and every count is right; only the file names show which trigger an image is of"
        }
        None | Some(Severity::Note) => {
            "good: every checksum and every count is right, and two sources agree on each frame's trigger"
        }
        Some(Severity::Unconfirmed) => {
            "unconfirmed: every checksum and every count is right, but not everything is confirmed: see the lines \
             above that begin with this word"
        }
        Some(Severity::Loss) if report.is_unconfirmed() => {
            "data loss; and not everything is confirmed: see the lines above that begin with `unconfirmed`"
        }
        Some(Severity::Loss) => "data loss, all of it accounted for",
        Some(Severity::Corrupt) => {
            "CORRUPT: files are damaged or incomplete, or contradict each other, see above; run `fourdbody recover \
             PATH --out DIR` to save what is whole"
        }
    };
    println!("{}: {word}", one_line(report.path.display()));
}

fn severity_exit(worst: Option<Severity>) -> Exit {
    match worst {
        None | Some(Severity::Note) => Exit::Done,
        Some(Severity::Unconfirmed | Severity::Loss) => Exit::DataLoss,
        Some(Severity::Corrupt) => Exit::Corrupt,
    }
}

/// The exit code of two paths together: corrupt data outranks everything.
fn worse(a: Exit, b: Exit) -> Exit {
    let rank = |exit: Exit| match exit {
        Exit::Done => 0,
        Exit::DataLoss => 1,
        Exit::Usage => 2,
        _ => 3,
    };
    if rank(b) > rank(a) { b } else { a }
}
