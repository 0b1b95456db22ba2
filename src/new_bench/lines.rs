// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds the line that each camera's trigger comes by: the one at which a pulse gives a frame.

use super::delays::{self, Delays};
use super::found::Found;
use super::pulses::{Reception, Seen, Train, TrainError, Waiting, train};
use crate::base::ids::NodeId;
use crate::camera::{Camera, CameraError, FrameContract, SetUp, Wishes};
use crate::config::{AUTO, PacketDelay};
use crate::hsu::{HeadTiming, Hsu, HsuTiming, Sync};
use std::collections::VecDeque;
use std::time::Duration;

/// Pulses of one train.
const PULSES: u32 = 3;
/// Trains on one line, where frames come that are not one at each pulse: a busy host loses some.
const TRAINS: usize = 3;
/// How long a pulse is held, ns.
const PULSE_NS: u64 = 1_000_000;

/// A camera on the bench.
pub struct BenchCamera {
    /// Who it is.
    pub found: Found,
    /// The camera, under our control.
    pub camera: Box<dyn Camera>,
    /// What the node file says of it; trigger line and packet delay are added here.
    pub wishes: Wishes,
    /// The largest packet that arrives, bytes.
    pub largest: Option<u32>,
    /// What is known of its trigger.
    pub wired: Option<Wired>,
    /// Why it cannot be used as it is.
    pub problems: Vec<String>,
    /// What an operator should know.
    pub told: Vec<String>,
}

/// What a pulse has shown.
#[derive(Debug, Clone)]
pub struct Wired {
    /// The line; `None` where raw settings say it, or there is one alone.
    pub line: Option<String>,
    /// Head and delays.
    pub delays: Delays,
    /// What its frames are.
    pub contract: FrameContract,
    /// The last frame's pixels.
    pub picture: Vec<u8>,
}

/// The HSU, and what a train on it needs.
pub struct Unit<'a> {
    /// The unit.
    pub hsu: &'a Hsu,
    /// This node.
    pub node: &'a NodeId,
    /// How many heads the rig has.
    pub heads: usize,
    /// How streams are made.
    pub reception: Reception,
}

impl Unit<'_> {
    /// Slow pulses, each head's far enough behind the one before to be told from it.
    fn slow(&self) -> HsuTiming {
        let head = |head| HeadTiming { delay_ns: delays::head_delay_ns(head), exposure_ns: PULSE_NS };
        HsuTiming {
            period_ns: delays::period_ns(self.heads),
            sync: Sync::Timer,
            host_silence: Duration::from_secs(2),
            heads: (0..self.heads).map(head).collect(),
        }
    }

    /// A train with cameras that are set up; those without a contract are left out.
    fn train(
        &self,
        timing: &HsuTiming,
        count: u32,
        cameras: &mut [BenchCamera],
        contracts: &[Option<FrameContract>],
    ) -> Result<Vec<(usize, Seen, Vec<u64>)>, TrainError> {
        let (mut places, mut waiting) = (Vec::new(), Vec::new());
        for (place, bench) in cameras.iter_mut().enumerate() {
            let Some(contract) = contracts[place] else { continue };
            match Waiting::new(bench.camera.as_mut(), contract, &self.reception, timing.period_ns) {
                Ok(camera) => {
                    places.push(place);
                    waiting.push(camera);
                }
                Err(error) => bench.problems.push(error.to_string()),
            }
        }
        let Train { triggers, seen } = train(self.hsu, self.node, timing, count, waiting)?;
        Ok(places.into_iter().zip(seen).map(|(place, seen)| (place, seen, triggers.clone())).collect())
    }

    /// The mean grey value of a picture of each of these cameras at slow pulses; `None` of one that sent no picture. They must
    /// be set up and wired.
    ///
    /// # Errors
    /// As the train's.
    pub fn look(&self, cameras: &mut [BenchCamera], which: &[usize]) -> Result<Vec<Option<f64>>, TrainError> {
        let contract = |place: usize| {
            let wired = cameras[place].wired.as_ref().filter(|_| which.contains(&place))?;
            Some(wired.contract)
        };
        let contracts: Vec<Option<FrameContract>> = (0..cameras.len()).map(contract).collect();
        let seen = self.train(&self.slow(), PULSES, cameras, &contracts)?;
        let mean = |place: &usize| {
            let picture = &seen.iter().find(|(at, ..)| at == place)?.1.picture;
            let sum: f64 = picture.iter().map(|grey| f64::from(*grey)).sum();
            (!picture.is_empty()).then(|| sum / picture.len() as f64)
        };
        Ok(which.iter().map(mean).collect())
    }

    /// Frames of each camera at the rig's own timing, out of how many triggers; they must be wired.
    ///
    /// # Errors
    /// As the train's.
    pub fn at_the_rigs_rate(
        &self,
        timing: &HsuTiming,
        count: u32,
        cameras: &mut [BenchCamera],
    ) -> Result<Vec<Option<usize>>, TrainError> {
        let mut contracts = vec![None; cameras.len()];
        for (bench, contract) in cameras.iter_mut().zip(&mut contracts) {
            let wishes = bench.wishes.clone();
            match bench.wired.is_some().then(|| bench.camera.set_up(&wishes)) {
                Some(Ok(set_up)) => *contract = Some(set_up.contract),
                Some(Err(error)) => bench.problems.extend(problems_of(error)),
                None => {}
            }
        }
        let mut frames = vec![None; cameras.len()];
        for (place, seen, _) in self.train(timing, count, cameras, &contracts)? {
            frames[place] = Some(seen.frames.len());
        }
        Ok(frames)
    }
}

fn problems_of(error: CameraError) -> Vec<String> {
    match error {
        CameraError::SetUp { problems } => problems,
        other => vec![other.to_string()],
    }
}

/// The lines to try on a camera: what the node file says first, then all that it has. `None`: nothing is said.
fn candidates(bench: &BenchCamera) -> VecDeque<Option<String>> {
    if bench.wishes.left_to_settings("trigger_line") {
        return [None].into();
    }
    let said = bench.wishes.words.trigger_line.clone();
    let mut lines: VecDeque<Option<String>> = said.into_iter().map(Some).collect();
    for line in bench.camera.trigger_lines() {
        if !lines.contains(&Some(line.clone())) {
            lines.push_back(Some(line));
        }
    }
    // Without a source there is one wire alone.
    if lines.is_empty() { [Some(AUTO.to_owned())].into() } else { lines }
}

/// Sets a camera up with a line. A packet delay that it does not have is left out, and told.
fn set_up(bench: &mut BenchCamera, line: Option<String>) -> Result<SetUp, CameraError> {
    bench.wishes.words.trigger_line = line;
    let wishes = bench.wishes.clone();
    let first = bench.camera.set_up(&wishes);
    let Err(CameraError::SetUp { problems }) = &first else { return first };
    let of_delay = |problem: &String| problem.contains("packet_delay_us");
    if !problems.iter().any(of_delay)
        || bench.wishes.words.packet_delay == Some(PacketDelay::Microseconds(0.0))
    {
        return first;
    }
    let told = problems.iter().filter(|problem| of_delay(problem)).cloned().collect::<Vec<_>>().join("; ");
    bench.wishes.words.packet_delay = None;
    let again = bench.camera.set_up(&bench.wishes.clone());
    bench.told.push(format!("it sends its packets without a delay: {told}"));
    again
}

/// Tries line after line on all cameras at once, until each has sent a frame at every pulse or has no line left.
///
/// # Errors
/// The HSU's. What is wrong with a camera is in its `problems`.
pub fn find(
    unit: &Unit<'_>,
    cameras: &mut [BenchCamera],
    mut tell: impl FnMut(&str),
) -> Result<(), TrainError> {
    let mut left: Vec<VecDeque<Option<String>>> = cameras.iter().map(candidates).collect();
    let mut tried: Vec<Vec<String>> = vec![Vec::new(); cameras.len()];
    let mut trains = vec![1; cameras.len()];
    loop {
        let mut contracts = vec![None; cameras.len()];
        let mut lines = vec![None; cameras.len()];
        for (place, bench) in cameras.iter_mut().enumerate().filter(|(_, bench)| bench.wired.is_none()) {
            while let Some(line) = left[place].pop_front() {
                match set_up(bench, line.clone()) {
                    Ok(set_up) => {
                        let name = line.clone().unwrap_or_else(|| "as `settings` say".to_owned());
                        if tried[place].last() != Some(&name) {
                            tried[place].push(name);
                            trains[place] = 1;
                        }
                        bench.problems.clear();
                        lines[place] = line;
                        contracts[place] = Some(set_up.contract);
                        break;
                    }
                    // A line that is no input is no reason; one that all lines have is told.
                    Err(error) if tried[place].is_empty() => bench.problems = problems_of(error),
                    Err(_) => {}
                }
            }
        }
        if contracts.iter().all(Option::is_none) {
            break;
        }
        let trying: Vec<String> = (0..cameras.len())
            .filter(|place| contracts[*place].is_some())
            .map(|place| {
                format!("{} {}", cameras[place].found.serial, lines[place].as_deref().unwrap_or("-"))
            })
            .collect();
        tell(&format!("{PULSES} pulses of the HSU: {}", trying.join(", ")));
        for (place, seen, triggers) in unit.train(&unit.slow(), PULSES, cameras, &contracts)? {
            let bench = &mut cameras[place];
            let Some(contract) = contracts[place] else { continue };
            match delays::read(&triggers, &seen.frames, unit.heads) {
                Some(delays) if seen.early == 0 => {
                    let line = lines[place].take();
                    bench.wired = Some(Wired { line, delays, contract, picture: seen.picture });
                }
                _ if seen.early > 0 => bench.told.push(format!(
                    "with {} it sent {} frames while nothing was triggered",
                    lines[place].as_deref().unwrap_or("its settings"),
                    seen.early
                )),
                _ if !seen.frames.is_empty() || seen.broken > 0 => {
                    bench.told.push(format!(
                        "with {} it sent {} whole and {} broken frames at {PULSES} pulses",
                        lines[place].as_deref().unwrap_or("its settings"),
                        seen.frames.len(),
                        seen.broken
                    ));
                    if trains[place] < TRAINS {
                        trains[place] += 1;
                        left[place].push_front(lines[place].take());
                    }
                }
                _ => {}
            }
        }
    }
    for (bench, tried) in cameras.iter_mut().zip(tried) {
        if bench.wired.is_none() && !tried.is_empty() {
            bench.wishes.words.trigger_line = None;
            bench.problems.push(format!(
                "no line gave a frame at each of {PULSES} pulses (tried {}): check the wire between the HSU and the camera",
                tried.join(", ")
            ));
        } else if let Some(wired) = &bench.wired {
            bench.wishes.words.trigger_line = wired.line.clone();
        }
    }
    Ok(())
}
