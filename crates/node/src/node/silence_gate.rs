// SPDX-License-Identifier: MIT OR Apache-2.0
//! The silence before a session: no camera may send while there is no trigger, its frames could be taken for those of
//! the first ones.
//!
//! Some cameras send one frame that they have left over when their acquisition starts. Where silence follows it,
//! longer than the usual one, it is known for what it is, and left out by name.

use super::node_thread::Node;
use crate::acquire::recorder::RecorderCommand;
use crate::base::{Exit, Fault};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Least duration of the silence before arming, in trigger periods.
const PERIODS: u32 = 10;
/// Longest silence that slow triggers or a stray frame can require.
const AT_MOST: Duration = Duration::from_secs(2);
/// After a frame without a trigger the silence must be longer by this factor.
const AFTER_A_FRAME: u32 = 4;
/// Time between two looks at the packet counters.
const LOOK: Duration = Duration::from_millis(10);

/// What the counters show so far.
#[derive(Debug, PartialEq, Eq)]
enum Heard {
    Wait,
    Silence,
    /// These cameras sent frames in spite of it.
    Loud(Vec<usize>),
}

/// Judges the packet counters of the cameras from the start of their streams. Pure.
#[derive(Debug)]
struct Gate {
    silence: Duration,
    /// Packets of each camera so far.
    heard: Vec<u64>,
    /// Time of the last change of a counter, since the start.
    since: Duration,
}

impl Gate {
    fn new(silence: Duration, cameras: usize) -> Self {
        Self { silence, heard: vec![0; cameras], since: Duration::ZERO }
    }

    /// At `now` since the start, with each camera's packets and frames since then.
    fn look(&mut self, now: Duration, counts: &[(u64, u64)]) -> Heard {
        let with = |is_one: &dyn Fn(&(u64, u64)) -> bool| -> Vec<usize> {
            (0..counts.len()).filter(|camera| is_one(&counts[*camera])).collect()
        };
        // More than what one frame can have left over.
        let repeated = with(&|(_, frames)| *frames > 1);
        if !repeated.is_empty() {
            return Heard::Loud(repeated);
        }
        let heard: Vec<u64> = counts.iter().map(|(packets, _)| *packets).collect();
        if heard != self.heard {
            (self.heard, self.since) = (heard, now);
        }
        let loud = with(&|(packets, _)| *packets > 0);
        let after = (self.silence * AFTER_A_FRAME).min(AT_MOST.max(self.silence));
        let needed = if loud.is_empty() { self.silence } else { after };
        if now.saturating_sub(self.since) >= needed {
            Heard::Silence
        } else if now > self.silence + 2 * after {
            Heard::Loud(loud)
        } else {
            Heard::Wait
        }
    }
}

impl Node {
    /// Waits for silence; frames that were sent before it belong to no trigger.
    pub(crate) fn silence_gate(&mut self) -> Result<(), Fault> {
        let gate = self.config.silence_gate;
        let Some(session) = self.session.as_ref().filter(|_| !gate.is_zero()) else { return Ok(()) };
        let period = Duration::from_secs_f64(1.0 / self.config.rig.trigger_rate_hz);
        let silence = gate.max(period * PERIODS).min(AT_MOST.max(gate));
        let (began, mut gate) = (Instant::now(), Gate::new(silence, session.cameras.len()));
        let load =
            |counters: &[AtomicU64], i: usize| counters.get(i).map_or(0, |n| n.load(Ordering::Relaxed));
        loop {
            std::thread::sleep(LOOK.min(silence));
            let counts = |i| (load(&session.progress.activity, i), load(&session.progress.received, i));
            let counts: Vec<(u64, u64)> = (0..session.cameras.len()).map(counts).collect();
            match gate.look(began.elapsed(), &counts) {
                Heard::Wait => {}
                Heard::Silence => break,
                Heard::Loud(cameras) => {
                    let names: Vec<&str> = cameras.iter().map(|i| session.cameras[*i].id.as_str()).collect();
                    return Err(loud(&names));
                }
            }
        }
        session.send(RecorderCommand::Silent { until_ns: session.clock.now() });
        Ok(())
    }
}

fn loud(names: &[&str]) -> Fault {
    Fault::new(
        Exit::Device,
        format!(
            "{} sent frames although nothing was triggered; expected silence before the start, but for one stray \
             frame of a camera: check TriggerMode and TriggerSource in the node file, and that nothing else drives the trigger \
             line; a camera that must send by itself needs silence_gate_ms = 0",
            names.join(", ")
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::{Gate, Heard};
    use std::time::Duration;

    const SILENCE: u64 = 250;

    /// Looks every 10 ms at two cameras, of which the second has sent this much by then; the result, and its time, ms.
    fn judged(heard: impl Fn(u64) -> (u64, u64)) -> (Heard, u64) {
        let mut gate = Gate::new(Duration::from_millis(SILENCE), 2);
        let look = |ms| match gate.look(Duration::from_millis(ms), &[(0, 0), heard(ms)]) {
            Heard::Wait => None,
            said => Some((said, ms)),
        };
        (1..).map(|turn| turn * 10).find_map(look).expect("it ends")
    }

    #[test]
    fn one_frame_with_silence_behind_it_is_a_stray_and_more_is_a_camera_that_sends() {
        assert_eq!(judged(|_| (0, 0)), (Heard::Silence, SILENCE));
        // Before the first look, and late; a frame whose end is taken for lost only much later.
        assert_eq!(judged(|_| (9, 1)), (Heard::Silence, 10 + 4 * SILENCE));
        assert_eq!(judged(|ms| if ms < 200 { (0, 0) } else { (9, 1) }), (Heard::Silence, 200 + 4 * SILENCE));
        assert_eq!(judged(|ms| (9, u64::from(ms > 100))), (Heard::Silence, 10 + 4 * SILENCE));
        // Two at once, one that repeats, a slow one, and packets of no frame.
        assert_eq!(judged(|_| (18, 2)).0, Heard::Loud(vec![1]));
        assert_eq!(judged(|ms| (ms / 100, ms / 100)).0, Heard::Loud(vec![1]));
        assert_eq!(judged(|ms| (ms / 900 + 1, ms / 900 + 1)).0, Heard::Loud(vec![1]));
        assert_eq!(judged(|ms| (ms, 0)), (Heard::Loud(vec![1]), 9 * SILENCE + 10));
    }
}
