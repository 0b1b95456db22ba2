// SPDX-License-Identifier: MIT OR Apache-2.0
//! The body while cameras run (`docs/design/live.md`): frame sets of all nodes as points, on time that nobody else wants.
//!
//! Every node samples the same triggers, those that are multiples of a stride, as long as somebody looks. The node whose
//! console is looked at asks the others for their rows of a trigger and reconstructs all cameras together.

mod body;
pub mod rows;

pub use body::{Body, CameraShare, POINTS_MAX, Reconstructor};

use crate::acquire::preview::{Sample, Taps};
use crate::base::ids::CameraId;
use crate::base::time::host_time_ns;
use crate::control::client::NodeClient;
use crate::control::status::path;
use crate::data::Calibration;
use crate::host::realtime;
use rows::Rows;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Frame sets a second that are sampled at most.
const MOST_PER_S: f64 = 15.0;
/// Whoever has not asked for so long does not look any more.
const INTEREST: Duration = Duration::from_secs(2);
/// How often threads look for what is new.
const POLL: Duration = Duration::from_millis(4);
/// Without interest.
const REST: Duration = Duration::from_millis(100);
/// Triggers whose rows are kept for other nodes.
const KEPT: usize = 6;
/// A frame set lacks what another node has not told by then.
const PEER_PATIENCE: Duration = Duration::from_millis(400);
/// Frame sets over which their rate is told.
const RATE_OVER: usize = 12;

/// A frame set as points, with what is told of it.
#[derive(Debug, Clone)]
pub struct Shown {
    /// What is told of it.
    pub facts: Facts,
    /// Arrival of its first frame at this node, host clock, ns.
    pub host_time_ns: u64,
    /// Its points, 12 bytes each ([`crate::preview::quick_look::encode`]).
    pub points: Vec<u8>,
}

/// What is told of a frame set.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Facts {
    /// Counts the frame sets of this node.
    pub number: u64,
    /// Its trigger.
    pub trigger: u64,
    /// How long ago its frames came, ms.
    pub age_ms: f64,
    /// Frame sets a second of late.
    pub frame_sets_per_s: f64,
    /// One entry for each camera that has a frame of this trigger.
    pub cameras: Vec<CameraShare>,
}

/// The live body of a node.
#[derive(Clone)]
pub struct LiveBody {
    shared: Arc<Shared>,
}

struct Shared {
    taps: Arc<Taps>,
    /// Triggers that are multiples of it are sampled.
    stride: u64,
    /// Frames so far apart are not of one session, ns.
    apart_ns: u64,
    calibration: Option<PathBuf>,
    peers: Vec<NodeClient>,
    origin: Instant,
    /// When this node's rows were last wanted, and when its body was, ms after `origin`, plus one; 0: never.
    rows_asked: AtomicU64,
    body_asked: AtomicU64,
    /// Rows of this node's cameras, by trigger, oldest first.
    rows: Mutex<VecDeque<(u64, BTreeMap<usize, Arc<Sample>>)>>,
    shown: Mutex<Option<Arc<Shown>>>,
    problem: Mutex<Option<String>>,
    ended: AtomicBool,
}

impl LiveBody {
    /// Starts the threads, one that samples and, with a calibration, one that reconstructs. They end with [`Self::end`].
    pub fn start(
        taps: Arc<Taps>,
        trigger_rate_hz: f64,
        calibration: Option<PathBuf>,
        peers: Vec<NodeClient>,
    ) -> std::io::Result<Self> {
        let has_calibration = calibration.is_some();
        let stride = (trigger_rate_hz / MOST_PER_S).ceil().max(1.0) as u64;
        let shared = Arc::new(Shared {
            taps,
            stride,
            apart_ns: (3e9 * stride as f64 / trigger_rate_hz).max(1e9) as u64,
            calibration,
            peers,
            origin: Instant::now(),
            rows_asked: AtomicU64::new(0),
            body_asked: AtomicU64::new(0),
            rows: Mutex::default(),
            shown: Mutex::default(),
            problem: Mutex::default(),
            ended: AtomicBool::new(false),
        });
        let sampling = Arc::clone(&shared);
        std::thread::Builder::new().name("live-rows".to_owned()).spawn(move || {
            realtime::step_back();
            sampling.sample();
        })?;
        if has_calibration {
            let reconstructing = Arc::clone(&shared);
            std::thread::Builder::new().name("live-body".to_owned()).spawn(move || {
                realtime::step_back();
                reconstructing.reconstruct();
            })?;
        }
        Ok(Self { shared })
    }

    /// Ends the threads; what they are at is not waited for.
    pub fn end(&self) {
        self.shared.ended.store(true, Ordering::Release);
    }

    /// The newest frame set after this number, and the wish for the next ones; `None` where there is none yet. The error says
    /// why there never will be one.
    pub fn after(&self, number: u64) -> Result<Option<Arc<Shown>>, String> {
        if self.shared.calibration.is_none() {
            let message = "no calibration is configured; set quick_look.calibration in the node file";
            return Err(message.to_owned());
        }
        self.shared.note(&self.shared.rows_asked);
        self.shared.note(&self.shared.body_asked);
        if let Some(problem) = lock(&self.shared.problem).clone() {
            return Err(problem);
        }
        Ok(lock(&self.shared.shown).clone().filter(|shown| shown.facts.number > number))
    }

    /// The rows of this node's cameras of a trigger, and the wish for the next ones; `None` while none is there.
    pub fn rows(&self, trigger: u64) -> Option<Vec<u8>> {
        self.shared.note(&self.shared.rows_asked);
        let found = self.shared.of(trigger)?;
        // A camera that has nothing after its trigger's next ones has lost the frame.
        let cameras = self.shared.taps.cameras().count();
        let late = lock(&self.shared.rows).back().is_some_and(|(newest, _)| *newest > trigger);
        (found.len() == cameras || late).then(|| rows::encode(trigger, &found))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Values are replaced whole.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    fn note(&self, asked: &AtomicU64) {
        asked.store(self.origin.elapsed().as_millis() as u64 + 1, Ordering::Release);
    }

    fn is_wanted(&self, asked: &AtomicU64) -> bool {
        let at = asked.load(Ordering::Acquire);
        let now = self.origin.elapsed().as_millis() as u64 + 1;
        at != 0 && now.saturating_sub(at) < INTEREST.as_millis() as u64
    }

    /// The rows that this node has of a trigger.
    fn of(&self, trigger: u64) -> Option<Rows> {
        let rows = lock(&self.rows);
        let (_, cameras) = rows.iter().find(|(known, _)| *known == trigger)?;
        let ids: Vec<&CameraId> = self.taps.cameras().collect();
        Some(cameras.iter().map(|(place, sample)| (ids[*place].clone(), sample.as_ref().clone())).collect())
    }

    fn sample(&self) {
        let cameras = self.taps.cameras().count();
        let mut asked = vec![false; cameras];
        while !self.ended.load(Ordering::Acquire) {
            if !self.is_wanted(&self.rows_asked) {
                asked.fill(false);
                std::thread::sleep(REST);
                continue;
            }
            for camera in 0..cameras {
                if !asked[camera] {
                    self.taps.ask(camera);
                    asked[camera] = true;
                }
                if let Some(sample) = self.taps.take(camera, &mut None) {
                    let trigger = sample.trigger;
                    self.taps.ask_from(camera, self.next_after(trigger));
                    if trigger % self.stride == 0 {
                        self.keep(camera, sample);
                    }
                }
            }
            std::thread::sleep(POLL);
        }
    }

    fn next_after(&self, trigger: u64) -> u64 {
        (trigger / self.stride + 1) * self.stride
    }

    fn keep(&self, camera: usize, sample: Sample) {
        let mut rows = lock(&self.rows);
        let trigger = sample.trigger;
        // After a pause, or with numbers that begin anew, it is the next session.
        let of_another = |(newest, cameras): &(u64, BTreeMap<usize, Arc<Sample>>)| {
            let before_ns = cameras.values().map(|known| known.host_time_ns).max().unwrap_or_default();
            trigger + 3 * self.stride <= *newest || before_ns + self.apart_ns < sample.host_time_ns
        };
        if rows.back().is_some_and(of_another) {
            rows.clear();
        }
        let place = match rows.iter().position(|(known, _)| *known == trigger) {
            Some(place) => place,
            None => {
                let place = rows.partition_point(|(known, _)| *known < trigger);
                rows.insert(place, (trigger, BTreeMap::new()));
                place
            }
        };
        rows[place].1.insert(camera, Arc::new(sample));
        while rows.len() > KEPT {
            rows.pop_front();
        }
    }

    /// The newest trigger of which this node has all cameras, or has given some up.
    fn newest(&self, last: Option<u64>) -> Option<u64> {
        let cameras = self.taps.cameras().count();
        let rows = lock(&self.rows);
        let whole = rows.iter().rev().find(|(_, found)| found.len() == cameras).map(|(trigger, _)| *trigger);
        // Where a camera is away for good, what lies two strides back will not become whole.
        let behind = rows.iter().rev().nth(2).map(|(trigger, _)| *trigger);
        whole.max(behind).filter(|trigger| last != Some(*trigger))
    }

    fn reconstruct(&self) {
        let Some(calibration) = &self.calibration else { return };
        let mut reconstructor = None;
        let threads = std::thread::available_parallelism().map_or(1, |n| (n.get() / 2).max(1));
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|n| format!("live-body-{n}"))
            .start_handler(|_| realtime::step_back())
            .build();
        let pool = match pool {
            Ok(pool) => pool,
            Err(error) => return self.fail(format!("cannot start threads: {error}")),
        };
        let (mut last, mut number) = (None, 0);
        let mut done: VecDeque<Instant> = VecDeque::new();
        while !self.ended.load(Ordering::Acquire) {
            if !self.is_wanted(&self.body_asked) {
                (last, reconstructor) = (None, None);
                std::thread::sleep(REST);
                continue;
            }
            if reconstructor.is_none() {
                let loaded = Calibration::load(calibration).map_err(|e| e.to_string());
                match loaded.and_then(|calibration| pool.install(|| Reconstructor::new(calibration))) {
                    Ok(made) => reconstructor = Some(made),
                    Err(reason) => return self.fail(format!("{}: {reason}", calibration.display())),
                }
            }
            let (Some(made), Some(trigger)) = (&reconstructor, self.newest(last)) else {
                std::thread::sleep(POLL);
                continue;
            };
            last = Some(trigger);
            let Some(mut rows) = self.of(trigger) else { continue };
            let host_time_ns = rows.values().map(|sample| sample.host_time_ns).min().unwrap_or_default();
            rows.extend(self.rows_of_peers(trigger));
            let Body { points, cameras } = pool.install(|| made.body(&rows));
            number += 1;
            done.push_back(Instant::now());
            while done.len() > RATE_OVER {
                done.pop_front();
            }
            let span = done.front().map_or(0.0, |first| first.elapsed().as_secs_f64());
            let frame_sets_per_s = if span > 0.0 { (done.len() - 1) as f64 / span } else { 0.0 };
            let facts = Facts { number, trigger, age_ms: 0.0, frame_sets_per_s, cameras };
            *lock(&self.shown) = Some(Arc::new(Shown { facts, host_time_ns, points }));
        }
    }

    fn fail(&self, reason: String) {
        tracing::warn!("no live body: {reason}");
        *lock(&self.problem) = Some(reason);
    }

    /// What the other nodes have of a trigger, asked for at the same time; nothing of those that do not say it in time.
    fn rows_of_peers(&self, trigger: u64) -> Rows {
        let wanted = path::LIVE_ROWS.replace("{trigger}", &trigger.to_string());
        let ask = |peer: &NodeClient| -> Rows {
            let Ok(Some(answer)) = peer.fetch(&wanted, PEER_PATIENCE) else { return Rows::new() };
            match rows::decode(&answer) {
                Ok((found, rows)) if found == trigger => rows,
                Ok(_) => Rows::new(),
                Err(reason) => {
                    tracing::debug!("rows of {}: {reason}", peer.url());
                    Rows::new()
                }
            }
        };
        std::thread::scope(|scope| {
            let asked: Vec<_> = self.peers.iter().map(|peer| scope.spawn(move || ask(peer))).collect();
            asked.into_iter().filter_map(|answer| answer.join().ok()).flatten().collect()
        })
    }
}

impl Shown {
    /// What is told of it now.
    pub fn facts_now(&self) -> Facts {
        let age_ms = host_time_ns().saturating_sub(self.host_time_ns) as f64 / 1e6;
        Facts { age_ms: (age_ms * 10.0).round() / 10.0, ..self.facts.clone() }
    }
}
