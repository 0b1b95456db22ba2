// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody node`: the daemon of one acquisition PC.

use super::connect::backend;
use super::failure::Failure;
use super::signals::{STOP, Signals};
use crate::api::{self, Auth, Listeners, NodeHandle, Services, Shared, State};
use crate::base::Exit;
use crate::config::NodeConfig;
use crate::host::process_limits::ProcessMemory;
use crate::node::hold::check_limits;
use crate::node::node_thread::NodeThread;
use crate::record::{Interrupted, interrupted};
use crate::systemd::Notifier;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

/// Run the daemon of one acquisition PC: cameras, HSU link, recordings, control API.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody node --config config/node-a.toml")]
pub struct Args {
    /// The node file, for instance config/node-a.toml.
    #[arg(long, value_name = "FILE", required_unless_present = "print_openapi")]
    config: Option<PathBuf>,
    /// Print the description of the control API (OpenAPI, JSON) and end.
    #[arg(long)]
    print_openapi: bool,
}

/// How long the API answers after the end for clients that have not fetched the verdict yet: a capture polls ten times
/// a second.
const READ_PATIENCE: Duration = Duration::from_secs(5);

/// Runs the command until SIGTERM or SIGINT. A session in progress is ended and gets its verdict, and the API answers
/// until that was fetched; a second signal ends the process at once.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let Some(config) = args.config.as_deref().filter(|_| !args.print_openapi) else {
        let text = serde_json::to_string_pretty(&api::description());
        println!("{}", text.map_err(Failure::failed)?);
        return Ok(Exit::Done);
    };
    let config = NodeConfig::load(config)?;
    // Before anything is opened: libraries end the process where they get no memory.
    check_limits(&config, &ProcessMemory::at_start(), 0)?;
    let backend = backend()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(|e| Failure::failed(format!("cannot start the API's runtime: {e}")))?;
    let auth = Auth::new(&config.api)?;
    let listeners = runtime.block_on(Listeners::bind(&config.api))?;
    // Before anything is recorded: a recording in progress looks the same.
    let mut unfinished = interrupted(&config.sessions_dir);
    unfinished.retain(|found| found.node == config.node);
    unfinished.iter().for_each(warn_of);
    let mut signals = runtime
        .block_on(async { Signals::watch(&STOP) })
        .map_err(|e| Failure::failed(format!("cannot watch signals: {e}")))?;
    let driver = NodeThread::start(config.clone(), backend).map_err(Failure::failed)?;
    driver.status.write().unwrap_or_else(PoisonError::into_inner).interrupted = unfinished;
    let read = api::OutcomeRead::default();
    let handle = NodeHandle {
        commands: driver.commands.clone(),
        status: Arc::clone(&driver.status),
        read: Arc::clone(&read),
        telemetry: Arc::clone(&driver.telemetry),
    };
    let (listen, socket) =
        (config.api.listen, config.api.socket.as_ref().map(|s| s.path.display().to_string()));
    let notifier = Notifier::start(Arc::clone(&driver.status), Arc::clone(&driver.telemetry))
        .map_err(|e| Failure::failed(format!("cannot start a thread: {e}")))?;
    let services =
        Services::start(&config, driver.commands.clone(), Arc::clone(&driver.status), driver.taps.clone())?;
    let shared = State::new(config, handle, auth, services, &listeners)
        .map_err(|e| Failure::failed(format!("cannot start the audit log's thread: {e}")))?;
    tracing::info!(listen = listen.map(tracing::field::display), socket, "node is up");
    let quick_looks = shared.services.quick_looks.clone();
    let live = shared.services.live.clone();
    let ended = runtime.block_on(serve(listeners, shared, &driver, notifier, &read, &mut signals));
    quick_looks.end();
    live.end();
    match ended {
        Ended::Orderly(served) => {
            driver.shut_down();
            let failed = |e| Failure::failed(format!("the control API failed: {e}"));
            served.map(|()| Exit::Done).map_err(failed)
        }
        // The driver is not waited for: its recording is left as by a crash.
        Ended::Forced => Err(Failure::failed(
            "ended by a second signal; a session in progress is unfinished, see `fourdbody verify`",
        )),
    }
}

/// Nothing is recovered unasked: it takes disk space and time, and the operator may want to look first.
fn warn_of(found: &Interrupted) {
    let (path, reason, frames, command) =
        (found.path.display(), &found.reason, found.frames, found.command());
    tracing::warn!(
        "the recording {path} was interrupted ({reason}); it has {frames} frames; save them with: {command}"
    );
}

/// How serving the API ended.
enum Ended {
    /// After the first signal, or by a failure of the API.
    Orderly(std::io::Result<()>),
    /// By a second signal, which does not wait.
    Forced,
}

async fn serve(
    listeners: Listeners,
    shared: Shared,
    driver: &NodeThread,
    notifier: Option<Notifier>,
    read: &api::OutcomeRead,
    signals: &mut Signals,
) -> Ended {
    let (end, ended) = tokio::sync::oneshot::channel::<()>();
    let until_end = async move { drop(ended.await) };
    let mut server = tokio::spawn(listeners.serve(api::router(shared.clone()), until_end));
    let joined =
        |joined: Result<std::io::Result<()>, _>| joined.unwrap_or_else(|e| Err(std::io::Error::other(e)));
    tokio::select! {
        failed = &mut server => return Ended::Orderly(joined(failed)),
        () = signals.next() => {}
    }
    drop(notifier);
    tracing::info!("stopping; a second signal ends at once");
    shared.audit.event("stop by a signal", shared.status().session.as_ref().filter(|s| s.outcome.is_none()));
    driver.request_stop();
    let orderly = async {
        until_fetched(driver, read).await;
        drop(end);
        joined(server.await)
    };
    tokio::select! {
        served = orderly => Ended::Orderly(served),
        () = signals.next() => Ended::Forced,
    }
}

/// Waits until the driver has ended and the outcome of its last session was fetched, or no client has fetched it within
/// `READ_PATIENCE`.
async fn until_fetched(driver: &NodeThread, read: &api::OutcomeRead) {
    const POLL: Duration = Duration::from_millis(20);
    while !driver.has_ended() {
        tokio::time::sleep(POLL).await;
    }
    let last = {
        let status = driver.status.read().unwrap_or_else(PoisonError::into_inner);
        status.session.as_ref().map(|session| session.session_id)
    };
    let Some(last) = last else { return };
    let begin = Instant::now();
    while read.load(Ordering::Acquire) != last && begin.elapsed() < READ_PATIENCE {
        tokio::time::sleep(POLL).await;
    }
}
