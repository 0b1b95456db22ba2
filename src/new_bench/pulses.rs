// SPDX-License-Identifier: MIT OR Apache-2.0
//! A short train of the HSU, and the frames that cameras send at its triggers.

use super::delays::FrameTimes;
use crate::base::ids::{NodeId, SessionName};
use crate::base::time::{HostClock, host_time_ns, monotonic_ns};
use crate::camera::{
    Camera, CameraClockSample, CameraError, FrameStream, Received, StreamOptions, Transfer, quiet_stream,
};
use crate::host::frame_memory::Pool;
use crate::hsu::{ArmRequest, Hsu, HsuError, HsuEvent, HsuTiming, session_id};
use std::time::{Duration, Instant};

/// Number of readings of each clock, of which the one with the shortest round trip is used.
const READINGS: usize = 8;
/// Time before the train in which frames show that a camera is not triggered by the HSU.
const SILENCE: Duration = Duration::from_millis(250);
/// How long frames are awaited after the last trigger.
const TAIL: Duration = Duration::from_millis(400);
/// How long the report of the end is awaited after a train has ended.
const END_PATIENCE: Duration = Duration::from_secs(3);
/// Number of frame buffers of each stream.
const BLOCKS: usize = 16;

/// A camera with an open stream that waits for pulses.
pub struct Waiting<'a> {
    camera: &'a mut dyn Camera,
    stream: Box<dyn FrameStream>,
    size: (usize, usize),
    /// A reading of its clock, where it has one.
    clock: Option<CameraClockSample>,
    seen: Seen,
}

/// What a camera sent during a train.
#[derive(Debug, Default)]
pub struct Seen {
    /// Complete frames, in their order.
    pub frames: Vec<FrameTimes>,
    /// Frames that were not complete.
    pub broken: usize,
    /// Frames that came while nothing was triggered.
    pub early: usize,
    /// The last complete frame's pixels, row by row.
    pub picture: Vec<u8>,
}

impl<'a> Waiting<'a> {
    /// Makes a stream for a camera that is set up, and reads its clock.
    ///
    /// # Errors
    /// As the camera's.
    pub fn new(camera: &'a mut dyn Camera, options: &StreamOptions) -> Result<Self, CameraError> {
        let (pool, contract) = (Pool::new(false, 0), options.contract);
        let blocks = || pool.take(contract.pixels(), contract.received_bytes(), BLOCKS);
        let (stream, _) = quiet_stream(camera, blocks, options)?;
        let mut clock: Option<CameraClockSample> = None;
        for _ in 0..READINGS {
            let Some(reading) = camera.sample_clock()? else { break };
            let way = |of: &CameraClockSample| of.host_after_ns.saturating_sub(of.host_before_ns);
            clock = clock.filter(|best| way(best) <= way(&reading)).or(Some(reading));
        }
        Ok(Self { camera, stream, size: contract.size, clock, seen: Seen::default() })
    }

    fn take(&mut self, host: &HostClock, begun: bool) {
        while let Some(received) = self.stream.next(Duration::from_millis(1)) {
            if !begun {
                self.seen.early += 1;
            } else if received.transfer == Transfer::Complete {
                self.note(&received, host);
            } else {
                self.seen.broken += 1;
            }
        }
    }

    fn note(&mut self, received: &Received, host: &HostClock) {
        let stamped_ns = self.clock.filter(|_| received.camera_ns > 0).map(|reading| {
            let middle = reading.host_before_ns.midpoint(reading.host_after_ns);
            let since = i128::from(received.camera_ns) - i128::from(reading.camera_ns);
            u64::try_from(i128::from(host.from_monotonic(middle)) + since).unwrap_or(0)
        });
        let arrived_ns = host.from_recent_realtime(received.host_ns);
        self.seen.frames.push(FrameTimes { arrived_ns, stamped_ns });
        self.seen.picture = received.block.pixels()[..self.size.0 * self.size.1].to_vec();
    }
}

/// The HSU's clock minus the host's, ns.
fn hsu_minus_host_ns(hsu: &Hsu, host: &HostClock) -> Result<i128, HsuError> {
    let mut best: Option<(Duration, i128)> = None;
    for _ in 0..READINGS {
        let reading = hsu.query_clock()?;
        let way = reading.received.saturating_duration_since(reading.sent);
        let middle = monotonic_ns(reading.sent).midpoint(monotonic_ns(reading.received));
        let offset = i128::from(reading.time_ns) - i128::from(host.from_monotonic(middle));
        best = best.filter(|(known, _)| *known <= way).or(Some((way, offset)));
    }
    Ok(best.map_or(0, |(_, offset)| offset))
}

/// Why there was no train.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The unit failed, or its link did.
    #[error("{0}")]
    Hsu(#[from] HsuError),
    /// The unit reported the beginning of the train, and not its end.
    #[error("the HSU began {wanted} triggers and reported {found} of them; check the serial cable")]
    NoEnd { wanted: u32, found: usize },
}

/// Has the unit emit `count` triggers with this timing, and receives the frames of the cameras. Returns the triggers on
/// the host's clock, ns, ascending, and what each camera sent, in their order. Cameras are stopped, whatever happens.
///
/// # Errors
/// [`TrainError`]; a camera that cannot be started is one that sends nothing.
pub fn train(
    hsu: &Hsu,
    node: &NodeId,
    timing: &HsuTiming,
    count: u32,
    mut cameras: Vec<Waiting<'_>>,
) -> Result<(Vec<u64>, Vec<Seen>), TrainError> {
    let host = HostClock::start();
    let result = fire(hsu, node, timing, count, &mut cameras, &host);
    for waiting in &mut cameras {
        if let Err(error) = waiting.camera.stop() {
            tracing::warn!("a camera's acquisition cannot be stopped: {error}");
        }
    }
    let triggers = result?;
    Ok((triggers, cameras.into_iter().map(|waiting| waiting.seen).collect()))
}

fn fire(
    hsu: &Hsu,
    node: &NodeId,
    timing: &HsuTiming,
    count: u32,
    cameras: &mut [Waiting<'_>],
    host: &HostClock,
) -> Result<Vec<u64>, TrainError> {
    hsu.configure(timing)?;
    let session = session_id(&SessionName(format!("setup-{}", host_time_ns())));
    let request =
        ArmRequest { session, triggers: Some(u64::from(count)), warm_up: 0, nodes: vec![node.clone()] };
    hsu.arm(&request)?;
    hsu.wait_armed(session, Duration::from_secs(2))?;
    let offset = hsu_minus_host_ns(hsu, host)?;
    for waiting in cameras.iter_mut() {
        if let Err(error) = waiting.camera.start() {
            tracing::warn!("a camera's acquisition cannot be started: {error}");
        }
    }
    let silent_until = Instant::now() + SILENCE;
    while Instant::now() < silent_until {
        cameras.iter_mut().for_each(|waiting| waiting.take(host, false));
        std::thread::sleep(Duration::from_millis(5));
    }
    hsu.start(session)?;
    let (mut triggers, mut ended) = (Vec::new(), None);
    let whole = Duration::from_nanos(timing.period_ns * u64::from(count + 2));
    let deadline = Instant::now() + whole + END_PATIENCE;
    loop {
        cameras.iter_mut().for_each(|waiting| waiting.take(host, true));
        for event in hsu.events().try_iter() {
            match event {
                HsuEvent::Trigger { session: of, trigger } if of == session => {
                    triggers.push(u64::try_from(i128::from(trigger.time_ns) - offset).unwrap_or(0));
                }
                HsuEvent::Done { session: of, .. } if of == session => {
                    ended = Some(Instant::now() + Duration::from_nanos(timing.period_ns) + TAIL);
                }
                _ => {}
            }
        }
        match ended {
            Some(tail) if Instant::now() >= tail => break,
            None if Instant::now() >= deadline => break,
            _ => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    if ended.is_none() || triggers.len() != count as usize {
        return Err(TrainError::NoEnd { wanted: count, found: triggers.len() });
    }
    Ok(triggers)
}
