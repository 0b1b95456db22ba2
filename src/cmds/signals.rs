// SPDX-License-Identifier: MIT OR Apache-2.0
//! Signals that end a command in an orderly way instead of ending its process.

use std::io;
use std::task::Poll;
use tokio::signal::unix::{Signal, SignalKind, signal};

/// SIGTERM and SIGINT: what systemd, `kill` and Ctrl-C send.
pub(super) const STOP: [SignalKind; 2] = [SignalKind::terminate(), SignalKind::interrupt()];

/// Signals of some kinds, from the moment this value is made on. None of them ends the process by itself any more.
pub(super) struct Signals(Vec<Signal>);

impl Signals {
    /// Registers the signals. Needs a runtime.
    pub(super) fn watch(kinds: &[SignalKind]) -> io::Result<Self> {
        kinds.iter().map(|kind| signal(*kind)).collect::<io::Result<_>>().map(Self)
    }

    /// Waits for the next signal.
    pub(super) async fn next(&mut self) {
        std::future::poll_fn(|context| {
            let any = self.0.iter_mut().any(|signal| signal.poll_recv(context).is_ready());
            if any { Poll::Ready(()) } else { Poll::Pending }
        })
        .await;
    }
}

/// Calls `handle` at every signal of these kinds, on a thread of its own.
pub(super) fn on_signals(kinds: &[SignalKind], mut handle: impl FnMut() + Send + 'static) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // Registered before the thread runs: from here on no signal ends the process.
    let mut signals = runtime.block_on(async { Signals::watch(kinds) })?;
    let watch = move || {
        runtime.block_on(async {
            loop {
                signals.next().await;
                handle();
            }
        });
    };
    std::thread::Builder::new().name("signals".to_owned()).spawn(watch).map(drop)
}
