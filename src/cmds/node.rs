//! `fourdbody node`: the daemon of one acquisition PC.

use super::{Exit, Failure};
use crate::api::server;
use crate::config::NodeConfig;
use crate::record::{Interrupted, interrupted};
use crate::session::driver::Driver;
use std::path::PathBuf;
use std::sync::PoisonError;

/// Run the daemon of one acquisition PC: cameras, HSU link, recordings, control API.
#[derive(clap::Args)]
#[command(after_help = "Example:\n  fourdbody node --config config/node-a.toml")]
pub struct Args {
    /// The node file.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
}

/// Runs the command until SIGTERM or SIGINT.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    let config = NodeConfig::load(&args.config)?;
    let backend = backend()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(|e| Failure::new(Exit::Failure, format!("cannot start the API's runtime: {e}")))?;
    let listen = config.listen;
    let listener = runtime.block_on(tokio::net::TcpListener::bind(listen)).map_err(|e| {
        let message = format!("cannot listen on {listen} (api.listen): {e}; is another node running?");
        Failure::new(Exit::Usage, message)
    })?;
    let mut unfinished = interrupted(&config.sessions_dir);
    unfinished.retain(|found| found.node == config.node);
    let driver = Driver::start(config, backend).map_err(|e| Failure::new(Exit::Failure, e))?;
    let (commands, status) = (driver.commands(), driver.status());
    unfinished.iter().for_each(warn_of);
    status.write().unwrap_or_else(PoisonError::into_inner).interrupted = unfinished;
    tracing::info!(%listen, "node is up");
    let served = runtime.block_on(async {
        let signals =
            stop_signal().map_err(|e| Failure::new(Exit::Failure, format!("cannot watch signals: {e}")))?;
        server::serve(listener, commands, status, signals)
            .await
            .map_err(|e| Failure::new(Exit::Failure, format!("the control API failed: {e}")))
    });
    // A session in progress is finished first: its recording gets its verdict.
    driver.shut_down();
    served.map(|()| Exit::Done)
}

/// Nothing is recovered unasked: it takes disk space and time, and the operator may want to look first.
fn warn_of(found: &Interrupted) {
    let (path, reason, frames, command) =
        (found.path.display(), &found.reason, found.frames, found.command());
    tracing::warn!(
        "the recording {path} was interrupted ({reason}); it has {frames} frames; save them with: {command}"
    );
}

/// Resolves at the first SIGTERM or SIGINT.
fn stop_signal() -> std::io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);
    Ok(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        tracing::info!("stopping");
    })
}

#[cfg(feature = "aravis")]
fn backend() -> Result<Box<dyn crate::camera::CameraBackend>, Failure> {
    Ok(Box::new(crate::camera::AravisCameras))
}

#[cfg(not(feature = "aravis"))]
fn backend() -> Result<Box<dyn crate::camera::CameraBackend>, Failure> {
    let message = "this binary was built without the feature `aravis` and cannot drive cameras; build it with default features";
    Err(Failure::new(Exit::Usage, message))
}
