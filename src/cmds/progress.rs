//! A line of progress on a terminal, for work that takes over two seconds.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(2);
const REFRESH: Duration = Duration::from_millis(200);

/// Shows how far something is, on standard error, and only if that is a terminal.
pub struct Progress {
    what: &'static str,
    /// Words for the unit, and how many counts make one of it.
    unit: (&'static str, u64),
    state: Mutex<State>,
}

struct State {
    started: Instant,
    shown: Option<Instant>,
    terminal: bool,
}

impl Progress {
    /// Counts pieces, which are called `unit`.
    pub fn of(what: &'static str, unit: &'static str) -> Self {
        Self::new(what, (unit, 1))
    }

    /// Counts bytes.
    pub fn of_bytes(what: &'static str) -> Self {
        Self::new(what, ("MiB", 1 << 20))
    }

    fn new(what: &'static str, unit: (&'static str, u64)) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let state = State { started: Instant::now(), shown: None, terminal };
        Self { what, unit, state: Mutex::new(state) }
    }

    /// `done` out of `total`; may be called from any thread, as often as convenient.
    pub fn at(&self, done: u64, total: u64) {
        // Whoever does not get the lock skips a line.
        let Ok(mut state) = self.state.try_lock() else { return };
        let due = state.shown.map_or(state.started.elapsed() >= PATIENCE, |at| at.elapsed() >= REFRESH);
        if !state.terminal || !due {
            return;
        }
        state.shown = Some(Instant::now());
        let (unit, size) = self.unit;
        let percent = done.saturating_mul(100) / total.max(1);
        eprint!("\r{}: {} of {} {unit} ({percent} %)  ", self.what, done / size, total / size);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if self.state.get_mut().is_ok_and(|state| state.shown.is_some()) {
            eprint!("\r\x1b[K");
        }
    }
}
