// SPDX-License-Identifier: MIT OR Apache-2.0
//! Progress of work that takes over two seconds: a line that is kept up to date on a terminal, a line every half minute
//! elsewhere. With the rate, and the time that is left.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Work that takes less time shows no progress.
const PATIENCE: Duration = Duration::from_secs(2);
/// Time between two lines on a terminal, where each replaces the one before.
const REFRESH: Duration = Duration::from_millis(200);
/// Time between two lines in a file, which keeps them all.
const LOGGED: Duration = Duration::from_secs(30);

/// Shows how far something is, on standard error.
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

    /// Counts bytes, and prints them as MiB.
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
        let (patience, refresh) = if state.terminal { (PATIENCE, REFRESH) } else { (LOGGED, LOGGED) };
        let elapsed = state.started.elapsed();
        if state.shown.map_or(elapsed < patience, |at| at.elapsed() < refresh) {
            return;
        }
        state.shown = Some(Instant::now());
        let line = self.line(done, total, elapsed);
        if state.terminal {
            eprint!("\r{line}\x1b[K");
        } else {
            eprintln!("{line}");
        }
    }

    /// How far it is, how fast it goes, and what is left.
    fn line(&self, done: u64, total: u64, elapsed: Duration) -> String {
        let (unit, size) = self.unit;
        let percent = done.saturating_mul(100) / total.max(1);
        let rate = done as f64 / size as f64 / elapsed.as_secs_f64().max(1e-3);
        let left = match done {
            0 => String::new(),
            _ => {
                let seconds = elapsed.as_secs_f64() * total.saturating_sub(done) as f64 / done as f64;
                format!(", {} left", duration(seconds))
            }
        };
        format!("{}: {} of {} {unit} ({percent} %), {rate:.1}/s{left}", self.what, done / size, total / size)
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if self.state.get_mut().is_ok_and(|state| state.terminal && state.shown.is_some()) {
            eprint!("\r\x1b[K");
        }
    }
}

/// Hours, minutes and seconds, as far as there are any.
fn duration(seconds: f64) -> String {
    match seconds.round() as u64 {
        s @ 0..60 => format!("{s} s"),
        s @ 60..3600 => format!("{} min {} s", s / 60, s % 60),
        s => format!("{} h {} min", s / 3600, s / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::{Progress, duration};
    use std::time::Duration;

    #[test]
    fn a_line_has_the_rate_and_what_is_left() {
        let progress = Progress::of("reconstruct", "triggers");
        let line = progress.line(30, 120, Duration::from_secs(60));
        assert_eq!(line, "reconstruct: 30 of 120 triggers (25 %), 0.5/s, 3 min 0 s left");
        let bytes = Progress::of_bytes("verify").line(0, 1 << 21, Duration::ZERO);
        assert_eq!(bytes, "verify: 0 of 2 MiB (0 %), 0.0/s");
        assert_eq!([59.6, 3600.0 * 1.5].map(duration), ["1 min 0 s", "1 h 30 min"]);
    }
}
