// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long threads had work and no processor: what Linux counts for each in `/proc/thread-self/schedstat`.

use std::fmt;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

/// Shortest time over which a thread's counts are compared.
const WINDOW: Duration = Duration::from_millis(200);
/// Time without a processor, each time a thread wants to run, that is more than a busy host causes.
const STILL: Duration = Duration::from_millis(50);

/// What the kernel counts of a thread, in all or in a window.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Counts {
    ran: Duration,
    waited: Duration,
    /// Times that it got a processor.
    runs: u32,
}

impl Counts {
    fn read(schedstat: &File) -> Option<Self> {
        let mut text = [0; 96];
        let length = schedstat.read_at(&mut text, 0).ok()?;
        let mut fields = std::str::from_utf8(text.get(..length)?).ok()?.split_whitespace();
        let mut next = || fields.next()?.parse::<u64>().ok();
        let (ran, waited, runs) = (next()?, next()?, next()?);
        let (ran, waited) = (Duration::from_nanos(ran), Duration::from_nanos(waited));
        Some(Self { ran, waited, runs: runs as u32 })
    }

    fn since(self, before: Self) -> Self {
        Self {
            ran: self.ran.saturating_sub(before.ran),
            waited: self.waited.saturating_sub(before.waited),
            runs: self.runs.wrapping_sub(before.runs),
        }
    }

    /// It waited for half of the window, and long each time: one that often waits a little gets its work done.
    fn stood_still(&self, window: Duration) -> bool {
        self.waited * 2 >= window && self.waited >= STILL * self.runs.clamp(1, 1000)
    }

    /// It had work all the time, and waited for a third of it. A thread that waits for a disk has none.
    fn held_back(&self, window: Duration) -> bool {
        self.waited * 3 >= window && (self.ran + self.waited) * 5 >= window * 4
    }
}

/// A thread that is watched.
struct Watched {
    thread: ThreadId,
    role: String,
    schedstat: File,
    counts: Counts,
    read: Instant,
    /// Counts of the last window, and its length.
    last: (Counts, Duration),
}

/// A thread that waited for a processor for most of a window.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Starved {
    pub role: String,
    /// Time that it waited for a processor, of the window.
    pub waited: Duration,
    pub window: Duration,
}

impl fmt::Display for Starved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { role, waited, window } = self;
        let (waited, window) = (waited.as_millis(), window.as_millis());
        write!(f, "the host gave a {role} thread no processor for {waited} of {window} ms")
    }
}

fn watched() -> MutexGuard<'static, Vec<Watched>> {
    static WATCHED: Mutex<Vec<Watched>> = Mutex::new(Vec::new());
    WATCHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Ends the watch of the thread that owns it, with the thread: the file of its counts is closed then.
struct UntilTheEnd(ThreadId);

impl Drop for UntilTheEnd {
    fn drop(&mut self) {
        watched().retain(|watched| watched.thread != self.0);
    }
}

thread_local! {
    static UNTIL_THE_END: UntilTheEnd = UntilTheEnd(std::thread::current().id());
}

/// Watches the calling thread until it ends. Where the kernel does not count, nothing is known.
pub fn watch(role: &str) {
    let Ok(schedstat) = File::open("/proc/thread-self/schedstat") else { return };
    let Some(counts) = Counts::read(&schedstat) else { return };
    let (role, read, last) = (role.to_owned(), Instant::now(), (Counts::default(), WINDOW));
    let thread = UNTIL_THE_END.with(|this| this.0);
    watched().push(Watched { thread, role, schedstat, counts, read, last });
}

/// The watched thread that stood still for want of a processor, if any did; of several the one that waited longest.
/// Looks at most every 200 ms, and costs a system call a thread then.
pub fn starved() -> Option<Starved> {
    let mut worst: Option<Starved> = None;
    for thread in watched().iter_mut() {
        let window = thread.read.elapsed();
        if window < WINDOW {
            continue;
        }
        let Some(counts) = Counts::read(&thread.schedstat) else { continue };
        let grown = counts.since(thread.counts);
        (thread.counts, thread.read, thread.last) = (counts, Instant::now(), (grown, window));
        if grown.stood_still(window) && worst.as_ref().is_none_or(|worst| worst.waited < grown.waited) {
            worst = Some(Starved { role: thread.role.clone(), waited: grown.waited, window });
        }
    }
    worst
}

/// A thread with one of these roles that had more work than it got processor time for at the last look.
pub fn held_back(roles: &[&str]) -> Option<Starved> {
    let watched = watched();
    let of_roles = watched.iter().filter(|thread| roles.contains(&thread.role.as_str()));
    let held = of_roles.filter(|thread| thread.last.0.held_back(thread.last.1));
    let worst = held.max_by_key(|thread| thread.last.0.waited)?;
    let ((counts, window), role) = (worst.last, worst.role.clone());
    Some(Starved { role, waited: counts.waited, window })
}

#[cfg(test)]
mod tests {
    use super::{Counts, watch, watched};
    use std::time::Duration;

    fn counts(ran_ms: u64, waited_ms: u64, runs: u32) -> Counts {
        let (ran, waited) = (Duration::from_millis(ran_ms), Duration::from_millis(waited_ms));
        Counts { ran, waited, runs }
    }

    #[test]
    fn one_long_wait_is_a_standstill_and_many_short_ones_are_not() {
        let window = Duration::from_millis(200);
        assert!(counts(2, 190, 1).stood_still(window) && counts(0, 200, 0).stood_still(window));
        assert!(counts(20, 160, 3).stood_still(window), "a share of the processor that is used up");
        assert!(!counts(10, 150, 24).stood_still(window), "every wait is shorter than a period");
        assert!(!counts(100, 60, 1).stood_still(window));
    }

    #[test]
    fn a_thread_that_waits_for_its_disk_is_not_held_back_by_the_host() {
        let window = Duration::from_millis(200);
        assert!(counts(90, 100, 40).held_back(window));
        assert!(!counts(10, 80, 40).held_back(window), "it had nothing to do for half of the time");
        assert!(!counts(180, 20, 40).held_back(window), "it had all that there is");
    }

    #[test]
    fn a_thread_is_watched_until_it_ends() {
        let known = || watched().iter().any(|thread| thread.role == "a test");
        std::thread::spawn(move || {
            watch("a test");
            assert!(known());
        })
        .join()
        .expect("it ends");
        assert!(!known(), "nobody has to look for its file to be closed");
    }
}
