// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session's frames to clouds on disk: parallel, resumable, the same bytes whatever the number of threads.
//!
//! ```text
//! OUT/phases/CAMERA_INDEX.phase   one phase map, of which the clouds are made when they are read ([`super::result`])
//! OUT/calibration.json            the calibration that goes with them
//! OUT/summary.json                the outcome of every frame
//! OUT/reconstruct.json            of which session all this is, and how it is made ([`super::key`])
//!
//! with --format ply:
//! OUT/clouds/CAMERA_INDEX.ply     one directional cloud (without points where the frame was refused)
//! OUT/merged/INDEX.ply            all cameras of one trigger, less what another head sees better (`merge`)
//! OUT/sequence.mcap               the merged clouds, for viewers
//! ```
//!
//! Every file states the parameters that it was made with, as a hash over algorithm, calibration and method, its
//! session, trigger and time, and the frames of its trigger, by the checksums of their pixels; a finished one that
//! states the same is not made again. Where a trigger has no point at all there is no merged cloud.

mod finished;
mod written;

use super::files::{cameras_comment, frame_path, remove_leftovers};
use super::from_phase_maps;
use super::key::Key;
use crate::base::Fault;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::Mono8;
use crate::base::time::process_cpu_time;
use crate::data::{Calibration, Cloud, Frame, FrameSource};
use crate::formats::ply;
use crate::merge::{self, Viewpoint};
use crate::reconstruct::frame_set::{self, Stage};
use crate::reconstruct::pipeline::{Pipeline, Workspace};
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use crate::reconstruct::triangulate::triangulator::Triangulator;
use rayon::prelude::*;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

pub use super::files::{cloud_path, merged_path, time_by_index_ns};
pub use super::plan::{Format, Plan};
pub use super::summary::{FrameSummary, Summary, TriggerSummary};
pub use crate::batch::timings::Timings;

struct Job<'a> {
    source: &'a dyn FrameSource,
    plan: &'a Plan,
    calibration: &'a Calibration,
    parameters: String,
    /// The id of the session that the frames are of.
    session: String,
    /// What stored phase maps state of the calibration.
    calibration_statement: (String, [[f64; 3]; 2]),
    /// The cameras of the plan, by head.
    heads: Vec<Vec<Camera>>,
    timings: Mutex<Timings>,
}

struct Camera {
    id: CameraId,
    /// Its number in merged clouds, which is its place in the calibration.
    number: u8,
    /// Where it and its head's projector are, as its clouds state it.
    viewpoint: Viewpoint,
    pipeline: Pipeline,
}

/// The CRC-32 of a frame's pixels; `None` where there is no frame, an error where it is damaged.
type Pixels = Result<Option<u32>, ()>;

/// Writes the merged clouds of a finished run as one MCAP file, in order; none where there is no point. Triggers
/// without a time of their own are placed by index at `rate_hz`.
pub fn write_sequence(plan: &Plan, summary: &Summary, rate_hz: f64) -> Result<(), String> {
    let with_points = summary.triggers.iter().filter(|trigger| trigger.merged_points > Some(0));
    let triggers = with_points.map(|one| (one.trigger, one.time_ns));
    from_phase_maps::write_sequence(&plan.out, triggers, rate_hz)
}

/// The cameras of the plan, those of a head together, each with its tables: these take longer than a frame.
fn cameras_by_head(plan: &Plan, calibration: &Calibration) -> Result<Vec<Vec<Camera>>, String> {
    let chosen = (0_usize..).zip(calibration.cameras()).filter(|(_, (_, c))| plan.cameras.contains(&c.id));
    let chosen: Vec<_> = chosen.collect();
    let workspace = Arc::new(Workspace::default());
    let made = chosen.par_iter().map(|(number, (head, camera))| {
        let number = u8::try_from(*number).map_err(|_| "more than 255 cameras".to_owned())?;
        let pair = CameraProjector::new(head, camera, calibration)?;
        let triangulator = Triangulator::new(pair);
        let pipeline = Pipeline::new(triangulator, plan.method, plan.maps.is_some());
        let pipeline = pipeline.with_uncertainty(plan.uncertainty).with_workspace(Arc::clone(&workspace));
        let pipeline = pipeline.counting(!plan.merges());
        let viewpoint = Viewpoint::new(head.id.as_str(), &camera.device, &head.projector);
        Ok((&head.id, Camera { id: camera.id.clone(), number, viewpoint, pipeline }))
    });
    let mut heads: Vec<Vec<Camera>> = Vec::new();
    let mut last = None;
    for (head, camera) in made.collect::<Result<Vec<_>, String>>()? {
        match heads.last_mut().filter(|_| last == Some(head)) {
            Some(cameras) => cameras.push(camera),
            None => heads.push(vec![camera]),
        }
        last = Some(head);
    }
    Ok(heads)
}

/// One frame set is under way for every so many threads, which share its cameras: each holds some 150 MiB, and with fewer
/// threads each some of them would wait at its ends.
const THREADS_PER_FRAME_SET: usize = 4;

/// The progress of a run that nobody watches, and nobody ends before its time.
pub fn to_the_end(_: usize) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// Runs the plan on the current rayon pool. `progress` gets the number of triggers done, and may end the run: what is done
/// is kept for the next one.
pub fn run(
    source: &dyn FrameSource,
    calibration: &Calibration,
    plan: &Plan,
    progress: impl Fn(usize) -> ControlFlow<()> + Sync,
) -> Result<(Summary, Timings), Fault> {
    let key = Key::of(source.identity()?, calibration, plan)?;
    if !plan.discard {
        key.claim(&plan.out)?;
        key.keep_calibration(&plan.out, calibration)?;
    }
    for folder in plan.formats.iter().flat_map(|format| format.folders()) {
        let path = plan.out.join(folder);
        std::fs::create_dir_all(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    remove_leftovers(&plan.out);
    let heads = cameras_by_head(plan, calibration)?;
    let (parameters, session) = (key.parameters(), key.session.id.clone());
    let calibration_statement = from_phase_maps::statement_of(calibration);
    let timings = Mutex::default();
    let job = Job { source, plan, calibration, parameters, session, calibration_statement, heads, timings };
    let done = AtomicUsize::new(0);
    let triggers: Vec<u64> = plan.shard_triggers().collect();
    let (began, cpu_began) = (Instant::now(), process_cpu_time());
    let next = AtomicUsize::new(0);
    let lane = |_| {
        let mut made = Vec::new();
        while let Some(&trigger) = triggers.get(next.fetch_add(1, Ordering::Relaxed)) {
            // Nobody begins another one after an error.
            let summary = job.trigger(trigger).inspect_err(|_| next.store(triggers.len(), Ordering::Relaxed));
            made.push((trigger, summary?));
            if progress(done.fetch_add(1, Ordering::Relaxed) + 1).is_break() {
                next.store(triggers.len(), Ordering::Relaxed);
                return Err("stopped as requested; the same run goes on from there".to_owned());
            }
        }
        Ok(made)
    };
    let lanes = rayon::current_num_threads().div_ceil(THREADS_PER_FRAME_SET);
    let lanes: Result<Vec<Vec<_>>, String> = (0..lanes).into_par_iter().with_max_len(1).map(lane).collect();
    let mut triggers: Vec<(u64, TriggerSummary)> = lanes?.into_iter().flatten().collect();
    triggers.sort_unstable_by_key(|(trigger, _)| *trigger);
    let wall_ms = began.elapsed().as_secs_f64() * 1e3;
    let cpu_ms = process_cpu_time().saturating_sub(cpu_began).as_secs_f64() * 1e3;
    let time_base = source.time_base();
    let summary = Summary {
        time_base,
        ..Summary::of(triggers.into_iter().map(|x| x.1).collect(), &key, plan, calibration)
    };
    let mut timings = job.timings.into_inner().unwrap_or_else(PoisonError::into_inner);
    (timings.wall_ms, timings.cpu_ms, timings.threads) = (wall_ms, cpu_ms, rayon::current_num_threads());
    Ok((summary, timings))
}

/// The comment that names the frames that a trigger's clouds depend on, by the CRC-32 of their pixels: `gap` where
/// there is none, and `damaged` where that is not known.
fn frames_comment<'a>(frames: impl Iterator<Item = (&'a CameraId, Pixels)>) -> String {
    let stated = frames.map(|(camera, crc)| match crc {
        Ok(Some(crc)) => format!("{camera}={crc:08x}"),
        Ok(None) => format!("{camera}=gap"),
        Err(()) => format!("{camera}=damaged"),
    });
    format!("frames {}", stated.collect::<Vec<_>>().join(" "))
}

/// Removes a file that an earlier run has written and that is not valid any more, if it is there.
fn remove(path: &Path) -> Result<(), String> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(format!("{}: {error}", path.display()))
        }
        _ => Ok(()),
    }
}

impl Job<'_> {
    fn trigger(&self, trigger: u64) -> Result<TriggerSummary, String> {
        if let Some(finished) = self.finished_trigger(trigger) {
            return Ok(finished);
        }
        let (results, frames) = self.clouds(trigger)?;
        let merged_points = self.plan.merges().then(|| self.merge(trigger, &results, &frames)).transpose()?;
        let frames = results.into_iter().map(|(summary, _)| summary).collect();
        Ok(self.summary_of(trigger, merged_points, frames))
    }

    fn summary_of(
        &self,
        trigger: u64,
        merged_points: Option<usize>,
        frames: Vec<FrameSummary>,
    ) -> TriggerSummary {
        TriggerSummary { trigger, time_ns: self.time_ns(trigger), merged_points, frames }
    }

    fn timings(&self) -> MutexGuard<'_, Timings> {
        self.timings.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn time_ns(&self, trigger: u64) -> Option<u64> {
        self.source.trigger_time_ns(TriggerIndex(trigger))
    }

    /// Writes the merged cloud, unless it has no points; their number.
    fn merge(&self, trigger: u64, results: &[(FrameSummary, Cloud)], frames: &str) -> Result<usize, String> {
        let path = merged_path(&self.plan.out, trigger);
        if results.iter().all(|(_, cloud)| cloud.is_empty()) {
            return remove(&path).map(|()| 0);
        }
        let began = Instant::now();
        let views = self.heads.iter().flatten().zip(results).map(|(camera, (_, cloud))| {
            let from = Some(&camera.viewpoint);
            merge::View { camera: camera.number, cloud, from }
        });
        let views: Vec<_> = views.collect();
        let left_out = merge::left_out(&views, merge::Rule::default());
        self.timings().merge_ms += began.elapsed().as_secs_f64() * 1e3;
        merge::save(&path, &views, &left_out, self.merged_comments(trigger, frames))
            .map_err(|e| format!("{}: {e}", path.display()))
    }

    /// Runs a part of the reconstruction of a frame, and adds its time to the timings.
    fn timed<T>(&self, work: impl FnOnce() -> T) -> T {
        let began = Instant::now();
        let result = work();
        self.timings().add_frame_time(began.elapsed());
        result
    }

    /// The directional clouds of all cameras together, since each frame may give fringe orders to the others; and the
    /// comment that names these frames.
    fn clouds(&self, trigger: u64) -> Result<(Vec<(FrameSummary, Cloud)>, String), String> {
        let cameras: Vec<(usize, &Camera)> =
            self.heads.iter().enumerate().flat_map(|(i, head)| head.iter().map(move |x| (i, x))).collect();
        if let Some(finished) = self.finished(trigger) {
            return Ok(finished);
        }
        let prepare = |(_, camera): &(usize, &Camera)| self.timed(|| self.prepare(camera, trigger));
        let prepared: Vec<(Stage, Pixels)> = cameras.par_iter().with_max_len(1).map(prepare).collect();
        let (stages, pixels): (Vec<Stage>, Vec<Pixels>) = prepared.into_iter().unzip();
        let frames = frames_comment(cameras.iter().map(|(_, camera)| &camera.id).zip(pixels));
        let seen: Vec<_> = cameras
            .iter()
            .map(|(head, camera)| frame_set::Camera {
                id: camera.id.as_str(),
                head: *head,
                pipeline: &camera.pipeline,
            })
            .collect();
        let Plan { margin, most_difference, .. } = *self.plan;
        let stages = self.timed(|| frame_set::settle(&seen, stages, margin, most_difference));
        let work = cameras.par_iter().with_max_len(1).zip(stages).map(|((_, camera), stage)| match stage {
            Stage::Unwrapped(prepared) => {
                self.save(camera, trigger, self.timed(|| camera.pipeline.finish(*prepared)), &frames)
            }
            Stage::Made(result) => self.save(camera, trigger, *result, &frames),
            Stage::Missing(outcome, reason) => {
                for &format in self.plan.formats.iter().filter(|_| !self.plan.discard) {
                    remove(&frame_path(&self.plan.out, format, &camera.id, trigger))?;
                }
                Ok((FrameSummary::missing(&camera.id, outcome, reason), Cloud::default()))
            }
        });
        let made: Result<Vec<_>, String> = work.collect();
        Ok((made?, frames))
    }

    /// The comment that names the frames of a trigger as the source has them now.
    fn frames(&self, trigger: u64) -> String {
        let cameras: Vec<&CameraId> = self.cameras().collect();
        let pixels = cameras.par_iter().with_max_len(1).map(|camera| {
            let crc = self.source.pixels_crc(camera, TriggerIndex(trigger));
            crc.map_err(drop)
        });
        let pixels: Vec<Pixels> = pixels.collect();
        frames_comment(cameras.into_iter().zip(pixels))
    }

    fn cameras(&self) -> impl Iterator<Item = &CameraId> {
        self.heads.iter().flatten().map(|camera| &camera.id)
    }

    /// The frame on its way, and the checksum of its pixels.
    fn prepare(&self, camera: &Camera, trigger: u64) -> (Stage, Pixels) {
        let began = Instant::now();
        let frame = self.source.frame(&camera.id, TriggerIndex(trigger));
        let mapping = began.elapsed();
        let frame = match frame {
            Err(reason) => return (Stage::Missing("damaged", reason), Err(())),
            Ok(frame) => frame,
        };
        let image = match &frame {
            Frame::Image(image) => *image,
            Frame::Owned(plane) => Mono8::from(plane),
            Frame::Gap(cause) => return (Stage::Missing("gap", cause.clone()), Ok(None)),
        };
        let stage = match camera.pipeline.prepare(image) {
            Ok(mut prepared) => {
                prepared.add_time("map", mapping);
                Stage::Unwrapped(Box::new(prepared))
            }
            Err(mut made) => {
                made.stages.push(("map", mapping));
                Stage::Made(made)
            }
        };
        (stage, Ok(frame.pixels_crc()))
    }

    /// The outcome of a trigger whose files are all there; only their headers are read.
    fn finished_trigger(&self, trigger: u64) -> Option<TriggerSummary> {
        let (frames, stated) = self.finished_frames(trigger)?;
        if !self.plan.formats.contains(&Format::Ply) {
            return Some(self.summary_of(trigger, None, frames));
        }
        let points = frames.iter().map(|frame| frame.points).sum();
        let path = merged_path(&self.plan.out, trigger);
        if points == 0 {
            return (!path.exists()).then(|| self.summary_of(trigger, Some(0), frames));
        }
        let header = ply::load_whole_header(&path).ok()?;
        let comments = self.merged_comments(trigger, &stated);
        merge::is_finished(&header, &comments, points, true).then_some(())?;
        Some(self.summary_of(trigger, Some(header.points), frames))
    }

    /// The finished clouds of a trigger, and the comment that names its frames. Of phase maps merged clouds are made
    /// when they are exported: there they are empty.
    fn finished(&self, trigger: u64) -> Option<(Vec<(FrameSummary, Cloud)>, String)> {
        let (frames, stated) = self.finished_frames(trigger)?;
        let load = |(camera, summary): (&Camera, FrameSummary)| {
            let cloud = match summary.outcome.as_ref() {
                "cloud" | "refused" if self.plan.merges() => {
                    ply::load(&cloud_path(&self.plan.out, &camera.id, trigger)).ok()?.1
                }
                _ => Cloud::default(),
            };
            Some((summary, cloud))
        };
        let clouds: Option<Vec<_>> = self.heads.iter().flatten().zip(frames).map(load).collect();
        Some((clouds?, stated))
    }
}
