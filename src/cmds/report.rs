// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody report`: a session on one page.

use super::failure::Failure;
use crate::base::Exit;
use crate::preview::Exposure;
use crate::report::{Report, gather, render};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Write a page about a session: verdict, gaps over time, light per camera, latencies, points, a turning cloud.
///
/// The page is one HTML file that needs no network. Checksums are not computed: see `fourdbody verify`.
#[derive(clap::Args)]
#[command(
    after_help = "Exit code 0: the page tells all of it; 2: there is no recording; 4: a recording, or all of it, cannot be read, and the page says so.\n\nExample:\n  fourdbody report sessions/walk-01 --clouds clouds/walk-01 --out walk-01.html"
)]
pub struct Args {
    /// A session, a recording of one node, or a single segment.
    session: PathBuf,
    /// What `fourdbody reconstruct` made of it: adds points per frame and a cloud.
    #[arg(long, value_name = "DIR")]
    clouds: Option<PathBuf>,
    /// The page.
    #[arg(long, value_name = "HTML")]
    out: PathBuf,
    /// Print what was written as JSON: {"page": PATH, "bytes": N, "exposure": {CAMERA: {"ev": N, "saturated": N}},
    /// "unreadable": [...]}.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let report = gather(&args.session, args.clouds.as_deref())?;
    let page = render(&report);
    std::fs::write(&args.out, &page)
        .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", args.out.display())))?;
    if args.json {
        let unreadable: Vec<String> = report.unreadable.iter().map(ToString::to_string).collect();
        let exposure: BTreeMap<String, Option<Exposure>> = exposures(&report).collect();
        let told = serde_json::json!({ "page": args.out, "bytes": page.len(), "exposure": exposure, "unreadable": unreadable });
        println!("{told}");
    } else {
        for (camera, exposure) in exposures(&report) {
            let right = exposure.map_or("no fringes to tell by".to_owned(), |exposure| exposure.to_string());
            println!("{camera}: right exposure: {right}");
        }
        println!("{}: {} KiB, opens in any browser", args.out.display(), page.len() / 1024);
    }
    report.unreadable.iter().for_each(|one| eprintln!("NOT READABLE  {one}"));
    Ok(if report.unreadable.is_empty() { Exit::Done } else { Exit::Corrupt })
}

/// By camera, what exposure would be right.
fn exposures(report: &Report) -> impl Iterator<Item = (String, Option<Exposure>)> {
    let cameras = report.nodes.iter().flat_map(|node| &node.cameras);
    cameras.map(|camera| (camera.described.header.id.to_string(), camera.exposure))
}
