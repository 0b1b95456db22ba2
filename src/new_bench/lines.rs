// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds the line that each camera's trigger comes by: the one at which a pulse gives a frame.

use super::delays::{self, Delays};
use super::found::Found;
use super::pulses::{Seen, TrainError, Waiting, train};
use super::roles::Role;
use crate::base::image::{Mono8, write_png_grey};
use crate::camera::{Camera, CameraError, FrameContract, SetUp, StreamOptions, Wishes};
use crate::config::{AUTO, NodeConfig, PacketDelay};
use crate::hsu::{HeadTiming, Hsu, HsuTiming, Sync};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Number of pulses of one train.
const PULSES: u32 = 3;
/// Number of trains on one line where frames come, but not one at each pulse: a busy host loses some.
const TRAINS: usize = 3;
/// How long a pulse is held, ns.
const PULSE_NS: u64 = 1_000_000;

/// An open camera of the bench. It has a role from the beginning, which pulses and the operator may change.
pub struct BenchCamera {
    pub role: Role,
    pub found: Found,
    pub camera: Box<dyn Camera>,
    /// Its settings by the node file; trigger line and packet delay are added here.
    pub wishes: Wishes,
    /// The largest packet that arrives, bytes.
    pub largest: Option<u32>,
    /// What pulses have shown; `None` until a line gave a frame at each pulse.
    pub wired: Option<Wired>,
    /// Frames at the rig's rate, and the number of triggers that they are of.
    pub frames_at_rate: Option<(usize, u32)>,
    /// Why it cannot be used as it is.
    pub problems: Vec<String>,
    /// Remarks that the operator should read.
    pub notes: Vec<String>,
}

/// What pulses have shown of a camera.
#[derive(Debug, Clone)]
pub struct Wired {
    /// The trigger line; `None` where raw settings name it, or there is one alone.
    pub line: Option<String>,
    pub delays: Delays,
    pub contract: FrameContract,
    /// The last frame's pixels, row by row.
    pub picture: Vec<u8>,
}

impl BenchCamera {
    /// A camera that was opened, and of which pulses have shown nothing yet.
    pub fn new(
        role: Role,
        found: Found,
        camera: Box<dyn Camera>,
        wishes: Wishes,
        largest: Option<u32>,
    ) -> Self {
        let (wired, frames_at_rate, problems, notes) = (None, None, Vec::new(), Vec::new());
        Self { role, found, camera, wishes, largest, wired, frames_at_rate, problems, notes }
    }

    /// Takes its settings from the node file as it is now.
    pub fn configure(&mut self, config: &NodeConfig) {
        if let Some(known) = config.cameras.iter().find(|known| known.id == self.role.id) {
            self.wishes = Wishes::of(config, known);
        }
    }

    /// Writes its last frame beside the node file; `None` where there is none.
    pub fn write_picture(&self, node_file: &Path) -> Result<Option<PathBuf>, String> {
        let Some(Wired { contract, picture, .. }) = &self.wired else { return Ok(None) };
        let (width, height) = contract.size;
        let Some(image) = Mono8::new(width, height, picture) else { return Ok(None) };
        let stem = node_file.file_stem().unwrap_or_default().to_string_lossy();
        let file = node_file.with_file_name(format!("{stem}-{}.png", self.role.id));
        let written = write_png_grey(&file, image);
        written.map_err(|e| format!("its picture {} cannot be written: {e}", file.display()))?;
        Ok(Some(file))
    }
}

/// The HSU, and the node whose cameras it triggers.
pub struct Unit<'a> {
    pub hsu: &'a Hsu,
    pub config: &'a NodeConfig,
}

/// The triggers of a train on the host's clock, ns, and what each camera sent, with the camera's place.
type Train = (Vec<u64>, Vec<(usize, Seen)>);

impl Unit<'_> {
    fn heads(&self) -> usize {
        self.config.rig.heads.len()
    }

    /// Slow pulses, each head's long enough after the one before for every camera to show which it answers.
    fn slow(&self) -> HsuTiming {
        let head = |head| HeadTiming { delay_ns: delays::head_delay_ns(head), exposure_ns: PULSE_NS };
        HsuTiming {
            period_ns: delays::period_ns(self.heads()),
            sync: Sync::Timer,
            host_silence: Duration::from_secs(2),
            heads: (0..self.heads()).map(head).collect(),
        }
    }

    /// A train with cameras that are set up; those without a contract are left out.
    fn train(
        &self,
        timing: &HsuTiming,
        count: u32,
        cameras: &mut [BenchCamera],
        contracts: &[Option<FrameContract>],
    ) -> Result<Train, TrainError> {
        let (mut places, mut waiting) = (Vec::new(), Vec::new());
        for (place, bench) in cameras.iter_mut().enumerate() {
            let Some(contract) = contracts[place] else { continue };
            let NodeConfig { packet_bytes, socket, .. } = *self.config;
            let options = StreamOptions { contract, packet_bytes, socket, period_ns: timing.period_ns };
            match Waiting::new(bench.camera.as_mut(), &options) {
                Ok(camera) => {
                    places.push(place);
                    waiting.push(camera);
                }
                Err(error) => bench.problems.push(error.to_string()),
            }
        }
        let (triggers, seen) = train(self.hsu, &self.config.node, timing, count, waiting)?;
        Ok((triggers, places.into_iter().zip(seen).collect()))
    }

    /// The mean grey value of a picture of each of these cameras at slow pulses; `None` of one that sent no picture.
    /// They must be set up and wired.
    ///
    /// # Errors
    /// As the train's.
    pub fn look(&self, cameras: &mut [BenchCamera], which: &[usize]) -> Result<Vec<Option<f64>>, TrainError> {
        let contract = |place: usize| {
            let wired = cameras[place].wired.as_ref().filter(|_| which.contains(&place))?;
            Some(wired.contract)
        };
        let contracts: Vec<Option<FrameContract>> = (0..cameras.len()).map(contract).collect();
        let (_, seen) = self.train(&self.slow(), PULSES, cameras, &contracts)?;
        let mean = |place: &usize| {
            let picture = &seen.iter().find(|(at, _)| at == place)?.1.picture;
            let sum: f64 = picture.iter().map(|grey| f64::from(*grey)).sum();
            (!picture.is_empty()).then(|| sum / picture.len() as f64)
        };
        Ok(which.iter().map(mean).collect())
    }

    /// Counts the frames of each camera at the rig's own timing; cameras that are not wired are left out.
    ///
    /// # Errors
    /// As the train's.
    pub fn at_the_rigs_rate(
        &self,
        timing: &HsuTiming,
        count: u32,
        cameras: &mut [BenchCamera],
    ) -> Result<(), TrainError> {
        let mut contracts = vec![None; cameras.len()];
        for (bench, contract) in cameras.iter_mut().zip(&mut contracts) {
            match bench.wired.is_some().then(|| bench.camera.set_up(&bench.wishes)) {
                Some(Ok(set_up)) => *contract = Some(set_up.contract),
                Some(Err(error)) => bench.problems.extend(problems_of(error)),
                None => {}
            }
        }
        for (place, seen) in self.train(timing, count, cameras, &contracts)?.1 {
            cameras[place].frames_at_rate = Some((seen.frames.len(), count));
        }
        Ok(())
    }
}

fn problems_of(error: CameraError) -> Vec<String> {
    match error {
        CameraError::SetUp { problems } => problems,
        other => vec![other.to_string()],
    }
}

/// The trigger lines to try on a camera: the one of the node file first, then all that it has. `None` leaves the line
/// to raw settings.
fn candidates(bench: &BenchCamera) -> VecDeque<Option<String>> {
    if bench.wishes.left_to_settings("trigger_line") {
        return [None].into();
    }
    let in_file = bench.wishes.words.trigger_line.clone();
    let mut lines: VecDeque<Option<String>> = in_file.into_iter().map(Some).collect();
    for line in bench.camera.trigger_lines() {
        if !lines.contains(&Some(line.clone())) {
            lines.push_back(Some(line));
        }
    }
    // Without a source there is one wire alone.
    if lines.is_empty() { [Some(AUTO.to_owned())].into() } else { lines }
}

/// Sets a camera up with a trigger line. A packet delay that it does not support is left out, with a remark.
fn set_up(bench: &mut BenchCamera, line: Option<String>) -> Result<SetUp, CameraError> {
    bench.wishes.words.trigger_line = line;
    let first = bench.camera.set_up(&bench.wishes);
    let Err(CameraError::SetUp { problems }) = &first else { return first };
    let of_delay = |problem: &String| problem.contains("packet_delay_us");
    if !problems.iter().any(of_delay)
        || bench.wishes.words.packet_delay == Some(PacketDelay::Microseconds(0.0))
    {
        return first;
    }
    let why = problems.iter().filter(|problem| of_delay(problem)).cloned().collect::<Vec<_>>().join("; ");
    bench.notes.push(format!("it sends its packets without a delay: {why}"));
    bench.wishes.words.packet_delay = None;
    bench.camera.set_up(&bench.wishes)
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
                        let name = line.clone().unwrap_or_else(|| "by `settings`".to_owned());
                        if tried[place].last() != Some(&name) {
                            tried[place].push(name);
                            trains[place] = 1;
                        }
                        bench.problems.clear();
                        lines[place] = line;
                        contracts[place] = Some(set_up.contract);
                        break;
                    }
                    // A line that cannot be an input is no problem; one that all lines share is.
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
        let (triggers, all_seen) = unit.train(&unit.slow(), PULSES, cameras, &contracts)?;
        for (place, seen) in all_seen {
            let bench = &mut cameras[place];
            let Some(contract) = contracts[place] else { continue };
            let line = lines[place].take();
            let delays = delays::read(&triggers, &seen.frames, unit.heads()).filter(|_| seen.early == 0);
            if let Some(delays) = delays {
                bench.wired = Some(Wired { line, delays, contract, picture: seen.picture });
                continue;
            }
            let (Seen { early, broken, .. }, whole) = (&seen, seen.frames.len());
            let with = format!("with {} it sent", line.as_deref().unwrap_or("its settings"));
            if *early > 0 {
                bench.notes.push(format!("{with} {early} frames while nothing was triggered"));
            } else if whole + broken > 0 {
                bench
                    .notes
                    .push(format!("{with} {whole} whole and {broken} broken frames at {PULSES} pulses"));
                if trains[place] < TRAINS {
                    trains[place] += 1;
                    left[place].push_front(line);
                }
            }
        }
    }
    for (bench, tried) in cameras.iter_mut().zip(tried) {
        if bench.wired.is_none() && !tried.is_empty() {
            bench.wishes.words.trigger_line = None;
            bench.problems.push(format!(
                "no line gave a frame at each of {PULSES} pulses (tried {}): check the wire between the HSU and the \
                 camera",
                tried.join(", ")
            ));
        } else if let Some(wired) = &bench.wired {
            bench.wishes.words.trigger_line = wired.line.clone();
        }
    }
    Ok(())
}
