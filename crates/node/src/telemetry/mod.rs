// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a running node counts, as metrics and as judgements. Reading costs the pixel path nothing: all of it is atomics
//! that are counted anyway.

pub mod exposition;
pub mod thresholds;

pub use exposition::{Family, Kind, Sample};
pub use thresholds::{Grade, Judgement, Threshold};

use crate::acquire::recorder::Progress;
use crate::base::histogram::Histogram;
use crate::base::ids::CameraId;
use crate::camera::AppliedSetting;
use crate::record::{DiskProgress, GapCause};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Where a node's threads leave what they count.
#[derive(Debug, Default)]
pub struct Telemetry {
    /// Times that the node's thread went round: grows as long as it lives.
    pub node_turns: AtomicU64,
    /// Sessions prepared since the process started.
    pub sessions: AtomicU64,
    current: Mutex<Option<Current>>,
    /// Settings as read back when a session was last prepared.
    applied: Mutex<BTreeMap<CameraId, Vec<AppliedSetting>>>,
}

/// The session in progress, or the last one.
#[derive(Debug, Clone)]
pub struct Current {
    pub progress: Arc<Progress>,
    /// What the writer counts; none in a dry run.
    pub disk: Option<Arc<DiskProgress>>,
    /// Frames that fit into the ring.
    pub ring_capacity: u64,
}

/// What is known of the node besides.
#[derive(Debug, Clone, Default)]
pub struct NodeFacts {
    /// The cameras, each with whether it can be used; in the rig's order.
    pub cameras: Vec<(CameraId, bool)>,
    /// Whether the link to the HSU is up.
    pub hsu: bool,
    /// Free space where sessions are recorded.
    pub free_bytes: u64,
    /// Of that, never to be used.
    pub reserve_bytes: u64,
    /// Bytes of images a second, while a session runs.
    pub bytes_per_second: f64,
}

impl NodeFacts {
    /// How long a session can be, s.
    pub fn disk_seconds_left(&self) -> f64 {
        self.free_bytes.saturating_sub(self.reserve_bytes) as f64 / self.bytes_per_second.max(1.0)
    }
}

impl Telemetry {
    /// Counts a session that begins, and shows its counters from now on.
    pub fn begin(&self, current: Current) {
        self.sessions.fetch_add(1, Ordering::Relaxed);
        *lock(&self.current) = Some(current);
    }

    /// Adds the counters of the session's recording, once it was created.
    pub fn recording(&self, disk: Arc<DiskProgress>) {
        if let Some(current) = lock(&self.current).as_mut() {
            current.disk = Some(disk);
        }
    }

    /// Stores the settings that a camera read back when it was set up.
    pub fn applied(&self, camera: &CameraId, settings: Vec<AppliedSetting>) {
        lock(&self.applied).insert(camera.clone(), settings);
    }

    /// A camera's settings as read back when a session was last prepared.
    pub fn applied_to(&self, camera: &CameraId) -> Option<Vec<AppliedSetting>> {
        lock(&self.applied).get(camera).cloned()
    }

    /// The session in progress, or the last one.
    pub fn current(&self) -> Option<Current> {
        lock(&self.current).clone()
    }

    /// Everything that has a threshold, judged; what belongs to a session only when there was one.
    pub fn judgements(&self, facts: &NodeFacts) -> Vec<Judgement> {
        let missing = facts.cameras.iter().filter(|(_, usable)| !usable).count();
        let mut judged = vec![
            thresholds::CAMERAS_MISSING.judge(missing as f64),
            thresholds::HSU_MISSING.judge(f64::from(u8::from(!facts.hsu))),
            thresholds::DISK_TIME_LEFT.judge(facts.disk_seconds_left().round()),
        ];
        let Some(Current { progress, disk, ring_capacity }) = self.current() else { return judged };
        let sum = |counters: &[AtomicU64]| counters.iter().map(load).sum::<u64>() as f64;
        let (frames, gaps) = (sum(&progress.frames), sum(&progress.gaps));
        let ring = load(&progress.ring_high_water) as f64 / ring_capacity.max(1) as f64;
        judged.push(thresholds::FRAMES_MISSING.judge(100.0 * gaps / (frames + gaps).max(1.0)));
        judged.push(thresholds::RING_HIGH_WATER.judge(100.0 * ring));
        judged.push(thresholds::MATCH_P99.judge(progress.latencies.matched.quantile_ms(0.99)));
        judged.push(thresholds::WRITE_P99.judge(progress.latencies.written.quantile_ms(0.99)));
        judged.extend(disk.map(|disk| thresholds::DURABLE_P99.judge(disk.durable.quantile_ms(0.99))));
        judged
    }

    /// All metrics of the node, and of the session in progress or the last one.
    pub fn metrics(&self, facts: &NodeFacts) -> Vec<Family> {
        let flag = |usable: bool| f64::from(u8::from(usable));
        let cameras =
            facts.cameras.iter().map(|(id, usable)| Sample::new(&[("camera", id.as_str())], flag(*usable)));
        let usable = "1 when a camera answers.";
        let mut families =
            vec![Family::new("fourdbody_camera_usable", usable, Kind::Gauge, cameras.collect())];
        let (free, left) = (facts.free_bytes as f64, facts.disk_seconds_left());
        let (turns, sessions) = (load(&self.node_turns) as f64, load(&self.sessions) as f64);
        let single = [
            ("fourdbody_hsu_usable", "1 when the HSU answers.", Kind::Gauge, flag(facts.hsu)),
            ("fourdbody_disk_free_bytes", "Free space where sessions are recorded.", Kind::Gauge, free),
            ("fourdbody_disk_left_seconds", "How long a session can be.", Kind::Gauge, left),
            ("fourdbody_node_turns_total", "Turns of the node's thread.", Kind::Counter, turns),
            ("fourdbody_sessions_total", "Sessions and previews prepared.", Kind::Counter, sessions),
        ];
        families.extend(single.map(Family::single));
        if let Some(current) = self.current() {
            let ids: Vec<&str> = facts.cameras.iter().map(|(id, _)| id.as_str()).collect();
            families.extend(session_metrics(&current, &ids));
        }
        families
    }
}

/// Of the session in progress, or the last one: they begin anew with each.
fn session_metrics(current: &Current, cameras: &[&str]) -> Vec<Family> {
    let Current { progress, disk, ring_capacity } = current;
    let of_cameras = |name, help, counters: &[AtomicU64]| {
        let samples = cameras
            .iter()
            .zip(counters)
            .map(|(id, count)| Sample::new(&[("camera", id)], load(count) as f64));
        Family::new(name, help, Kind::Counter, samples.collect())
    };
    let gaps = cameras.iter().zip(&progress.causes).flat_map(|(camera, causes)| {
        let counted = GapCause::ALL.iter().zip(causes);
        counted.map(|(cause, count)| {
            Sample::new(&[("camera", camera), ("cause", &cause.to_string())], load(count) as f64)
        })
    });
    let latencies = &progress.latencies;
    let durable = disk.as_ref().map(|disk| ("write_to_durable", &disk.durable));
    let stages: [(&str, &Histogram); 4] = [
        ("last_packet_to_match", &latencies.matched),
        ("match_to_ring", &latencies.assembled),
        ("ring_to_write", &latencies.written),
        ("last_packet_to_write", &latencies.total),
    ];
    let stages = stages
        .into_iter()
        .chain(durable)
        .map(|(stage, histogram)| Sample::of(&[("stage", stage)], histogram));
    let by_stage = "How long frames took, by stage.";
    let mut families = vec![
        of_cameras("fourdbody_packets_total", "Packets seen.", &progress.activity),
        of_cameras("fourdbody_frames_received_total", "Frames taken off the stream.", &progress.received),
        of_cameras("fourdbody_frames_written_total", "Frames that the writer took.", &progress.frames),
        Family::new("fourdbody_gaps_total", "Gap records, by cause.", Kind::Counter, gaps.collect()),
        Family::new("fourdbody_latency_seconds", by_stage, Kind::Histogram, stages.collect()),
    ];
    let written = disk.as_ref().map_or(0, |disk| load(&disk.bytes));
    let (dropped, high) = (load(&progress.dropped), load(&progress.ring_high_water));
    let (recorder, writer) = (load(&progress.recorder_turns), load(&progress.writer_turns));
    let (waiting, most) = (load(&progress.high_water), "Most frames in and before the ring.");
    let accounting = "Turns of the thread that keeps the accounting.";
    let single = [
        ("fourdbody_triggers_total", "Triggers reported.", Kind::Counter, load(&progress.triggers)),
        ("fourdbody_frames_dropped_total", "Frames dropped before a full ring.", Kind::Counter, dropped),
        ("fourdbody_ring_high_water_frames", "Most frames in the ring.", Kind::Gauge, high),
        ("fourdbody_ring_capacity_frames", "Frames that fit into the ring.", Kind::Gauge, *ring_capacity),
        ("fourdbody_waiting_high_water_frames", most, Kind::Gauge, waiting),
        ("fourdbody_written_bytes_total", "Bytes of frames handed to the disk.", Kind::Counter, written),
        ("fourdbody_recorder_turns_total", accounting, Kind::Counter, recorder),
        ("fourdbody_writer_turns_total", "Turns of the writer's thread.", Kind::Counter, writer),
    ];
    families.extend(single.map(|(name, help, kind, value)| Family::single((name, help, kind, value as f64))));
    families
}

fn load(counter: &AtomicU64) -> u64 {
    counter.load(Ordering::Relaxed)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Values are assigned whole: what a panic left is usable.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
