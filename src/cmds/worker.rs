// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody worker`: reconstructs by itself what the nodes have recorded.

use super::failure::{Failure, print};
use super::signals::{STOP, on_signals};
use crate::base::Exit;
use crate::base::ids::one_line;
use crate::config::WorkerConfig;
use crate::worker::run::{Worker, ask_first, retry};
use crate::worker::state::WorkerState;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Reconstruct by itself what the nodes have recorded, when nothing else is to be done.
///
/// Sessions are verified first, and worked on at idle priority; a capture comes before everything. Results are in a
/// directory each below `results` of the worker file. SIGTERM and SIGINT end the worker; what is finished stays and is
/// not made again.
#[derive(clap::Args)]
#[command(after_help = "\
Exit code 3 (with --once): sessions are left that are not ready, or were set aside.

Examples:
  fourdbody worker --config /etc/fourdbody/worker.toml
  fourdbody worker --config worker.toml --state
  fourdbody worker --config worker.toml --first walk-07
  fourdbody worker --config worker.toml --retry walk-03")]
pub struct Args {
    /// The worker file, for instance /etc/fourdbody/worker.toml.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// End when there is nothing to do.
    #[arg(long, conflicts_with_all = ["state", "first", "retry"])]
    once: bool,
    /// Only print what the worker of these results does.
    #[arg(long, conflicts_with_all = ["first", "retry"])]
    state: bool,
    /// Only ask for a session before all others.
    #[arg(long, value_name = "SESSION", conflicts_with = "retry")]
    first: Option<String>,
    /// Only let a session that was set aside be tried again, with the calibration that is configured now.
    #[arg(long, value_name = "SESSION")]
    retry: Option<String>,
    /// With --state: print JSON instead of text.
    #[arg(long, requires = "state")]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let config = WorkerConfig::load(&args.config)?;
    if args.state {
        return state(&config, args.json);
    }
    if let Some(session) = &args.first {
        let path = config.results.display().to_string();
        ask_first(&config.results, session).map_err(|e| Failure::failed(format!("{path}: {e}")))?;
        return Ok(Exit::Done);
    }
    if let Some(session) = &args.retry {
        retry(&config.results, session)?;
        return Ok(Exit::Done);
    }
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    on_signals(&STOP, move || stopped.store(true, Ordering::Release))
        .map_err(|e| Failure::failed(format!("signals cannot be watched: {e}")))?;
    let complete = Worker::new(config, stop)?.run(args.once)?;
    Ok(if complete || !args.once { Exit::Done } else { Exit::DataLoss })
}

fn state(config: &WorkerConfig, json: bool) -> Result<Exit, Failure> {
    let state = WorkerState::load(&config.results).ok_or_else(|| {
        let message = format!("no worker has been at work on {}; start one", config.results.display());
        Failure::usage(message)
    })?;
    let lines = |title: &str, named: &[(String, String)]| {
        named
            .iter()
            .for_each(|(name, reason)| println!("  {title:<10} {}", one_line(format!("{name}: {reason}"))));
    };
    print(json, &serde_json::json!(state), || {
        println!("{}", one_line(state.line()));
        state.queued.iter().for_each(|name| println!("  queued     {}", one_line(name)));
        lines("not yet", &state.not_yet);
        lines("set aside", &state.set_aside);
    });
    Ok(Exit::Done)
}
