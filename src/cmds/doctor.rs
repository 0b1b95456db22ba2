// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody doctor`: is this host fit for its cameras' rate?

use super::connect::backend;
use super::failure::Failure;
use super::progress::Progress;
use crate::base::Exit;
use crate::config::NodeConfig;
use crate::doctor::{Finding, Grade, examine, exit_of};
use std::cell::RefCell;
use std::path::PathBuf;
use std::time::Duration;

/// Examine this host: sockets, limits, network, disk, cameras, HSU; a verdict a line.
///
/// Limits and capabilities are those of the user who runs this: run it as the node's user. Exit codes: 0 fit
/// (perhaps with warnings), 1 the host is unfit, 2 configuration, 5 a device failed.
#[derive(clap::Args)]
#[command(after_help = "\
Example, with the user and the rights of the service:
  sudo prlimit --rtprio=70 --memlock=unlimited setpriv --reuid=fourdbody --regid=fourdbody --init-groups \\
    --inh-caps=+net_raw --ambient-caps=+net_raw fourdbody doctor --config /etc/fourdbody/node.toml --disk-seconds 10")]
pub struct Args {
    /// The node file; without it only the host is examined, for four cameras of 1920 x 1200 at 120 Hz.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
    /// How long to record noise into the sessions directory; 0: not at all. The file is deleted.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u64).range(0..=600))]
    disk_seconds: u64,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let config = args.config.as_deref().map(NodeConfig::load).transpose()?;
    let mut findings: Vec<Finding> = Vec::new();
    let disk_time = Duration::from_secs(args.disk_seconds);
    // Shown by the disk test, and cleared before the next verdict is printed.
    let progress: RefCell<Option<Progress>> = RefCell::default();
    let at = |done: Duration, all: Duration| {
        let mut progress = progress.borrow_mut();
        let progress = progress.get_or_insert_with(|| Progress::of("testing the disk", "ms"));
        progress.at(done.as_millis() as u64, all.as_millis() as u64);
    };
    examine(config.as_ref(), backend().ok(), disk_time, &at, |finding| {
        drop(progress.take());
        // Each verdict at once: an absent camera takes seconds.
        if !args.json {
            println!("{finding}");
        }
        findings.push(finding);
    });
    let exit = exit_of(&findings);
    let count = |grade| findings.iter().filter(|finding| finding.grade == grade).count();
    let (ok, warnings, failed) = (count(Grade::Ok), count(Grade::Warning), count(Grade::Failed));
    let fit = exit == Exit::Done;
    if args.json {
        let node = config.as_ref().map(|config| &config.node);
        println!("{}", serde_json::json!({ "fit": fit, "node": node, "findings": findings }));
    } else {
        println!("{}: {ok} ok, {warnings} warnings, {failed} failed", if fit { "fit" } else { "not fit" });
    }
    Ok(exit)
}
