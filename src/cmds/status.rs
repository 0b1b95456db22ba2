// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody status`: the health of the nodes.

use super::connect::Connect;
use super::failure::Failure;
use crate::base::Exit;
use crate::base::ids::one_line;
use crate::control::status::{NodeStatus, Outcome};
use crate::telemetry::Grade;

/// Show the health of the nodes: cameras, HSU link, disk, session.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody status --nodes http://127.0.0.1:7401,http://127.0.0.1:7402")]
pub struct Args {
    #[command(flatten)]
    connect: Connect,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Runs the command. Exit code 5 when a node does not answer or misses a device; what is judged bad besides is shown,
/// and changes no exit code.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let mut exit = Exit::Done;
    let mut answers = Vec::new();
    let clients = args.connect.clients()?;
    for (url, client) in args.connect.nodes.iter().zip(clients) {
        match client.status() {
            Ok(status) => {
                if !status.problems().is_empty() {
                    exit = Exit::Device;
                }
                answers.push(serde_json::json!({ "url": url, "status": status }));
                if !args.json {
                    print(&status);
                }
            }
            Err(fault) => {
                exit = Exit::Device;
                answers.push(serde_json::json!({ "url": url, "error": fault.message }));
                if !args.json {
                    eprintln!("error: {}", fault.message);
                }
            }
        }
    }
    if args.json {
        println!("{}", serde_json::json!({ "nodes": answers }));
    }
    Ok(exit)
}

fn print(status: &NodeStatus) {
    let good = status.cameras.iter().filter(|c| c.problem.is_none()).count();
    println!(
        "node {} ({}, rig {}): {}, {good} of {} cameras, HSU {}, {:.1} GB free in {}",
        status.node,
        one_line(&status.version),
        one_line(&status.rig),
        if status.is_in_preview() { "Preview".to_owned() } else { format!("{:?}", status.phase) },
        status.cameras.len(),
        one_line(status.hsu.identity.as_deref().unwrap_or("not connected")),
        status.free_bytes as f64 / 1e9,
        one_line(status.sessions_dir.display())
    );
    for problem in status.problems() {
        println!("  problem: {}", one_line(problem));
    }
    for warning in &status.warnings {
        println!("  warning: {}", one_line(warning));
    }
    for found in &status.interrupted {
        let last = found.last_trigger.map_or("none".to_owned(), |last| last.to_string());
        println!(
            "  interrupted: session {} ({}): {} frames, last trigger {last}; save them with: {}",
            one_line(&found.session),
            one_line(&found.reason),
            found.frames,
            one_line(found.command())
        );
    }
    if let Some(session) = &status.session {
        let frames: u64 = session.cameras.iter().map(|c| c.frames).sum();
        let gaps: u64 = session.cameras.iter().map(|c| c.gaps).sum();
        println!(
            "  session {}: {} triggers, {frames} frames, {gaps} gaps",
            one_line(&session.name),
            session.triggers
        );
        session.notices.iter().for_each(|notice| println!("    {}", one_line(notice)));
        let remarks = session.outcome.as_ref().map(Outcome::remarks).unwrap_or_default();
        remarks.iter().for_each(|remark| println!("    {}", one_line(remark)));
    }
    if let Some(worker) = &status.worker {
        println!("  worker: {}", one_line(&worker.line));
        worker
            .set_aside
            .iter()
            .for_each(|(name, reason)| println!("    set aside {}", one_line(format!("{name}: {reason}"))));
    }
    for judged in &status.judgements {
        let word = match judged.grade {
            Grade::Good => "good",
            Grade::Fair => "fair",
            Grade::Bad => "BAD",
        };
        let (value, unit) = (judged.value, &judged.unit);
        let (good, bad) = (judged.good, judged.bad);
        println!(
            "  {word:<4} {:<16} {value:.1} {unit} (good {good}, bad {bad}): {}",
            judged.name, judged.meaning
        );
    }
}
