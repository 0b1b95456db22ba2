//! `fourdbody status`: the health of the nodes.

use super::{Exit, Failure};
use crate::api::client::NodeClient;
use crate::api::dto::NodeStatus;

/// Show the health of the nodes: cameras, HSU link, disk, session.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody status --nodes http://127.0.0.1:7401,http://127.0.0.1:7402")]
pub struct Args {
    /// The nodes' URLs, separated by commas.
    #[arg(long, value_name = "URL,URL", value_delimiter = ',', required = true)]
    nodes: Vec<String>,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// Runs the command. Exit code 5 when a node does not answer or misses a device.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let mut exit = Exit::Done;
    let mut answers = Vec::new();
    for url in &args.nodes {
        match NodeClient::new(url).status() {
            Ok(status) => {
                if !problems(&status).is_empty() {
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

/// What keeps a node from capturing, each with the device's name.
fn problems(status: &NodeStatus) -> Vec<String> {
    let cameras = status.cameras.iter();
    let cameras = cameras.filter_map(|c| c.problem.as_ref().map(|p| format!("camera {}: {p}", c.id)));
    let hsu = status.hsu.problem.iter().map(|p| format!("HSU at {}: {p}", status.hsu.device.display()));
    cameras.chain(hsu).collect()
}

fn print(status: &NodeStatus) {
    let good = status.cameras.iter().filter(|c| c.problem.is_none()).count();
    println!(
        "node {} ({}, rig {}): {:?}, {good} of {} cameras, HSU {}, {:.1} GB free in {}",
        status.node,
        status.version,
        status.rig,
        status.phase,
        status.cameras.len(),
        status.hsu.identity.as_deref().unwrap_or("not connected"),
        status.free_bytes as f64 / 1e9,
        status.sessions_dir.display()
    );
    for problem in problems(status) {
        println!("  problem: {problem}");
    }
    for warning in &status.warnings {
        println!("  warning: {warning}");
    }
    for found in &status.interrupted {
        let last = found.last_trigger.map_or("none".to_owned(), |last| last.to_string());
        println!(
            "  interrupted: session {} ({}): {} frames, last trigger {last}; save them with: {}",
            found.session,
            found.reason,
            found.frames,
            found.command()
        );
    }
    if let Some(session) = &status.session {
        let frames: u64 = session.cameras.iter().map(|c| c.frames).sum();
        let gaps: u64 = session.cameras.iter().map(|c| c.gaps).sum();
        println!("  session {}: {} triggers, {frames} frames, {gaps} gaps", session.name, session.triggers);
    }
}
