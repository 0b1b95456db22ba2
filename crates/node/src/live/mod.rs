// SPDX-License-Identifier: MIT OR Apache-2.0
//! The body while cameras run (`docs/design/live.md`): frame sets of all nodes as points, at low priority.
//!
//! Every node samples the same triggers, those that are multiples of a stride, as long as a console requests them. The
//! node that serves the console fetches the other nodes' rows of a trigger and reconstructs all cameras together.

mod body;
mod kept;
mod rows;

pub use body::CameraShare;

use crate::acquire::preview::ROW_STEP;
use crate::acquire::preview::Taps;
use crate::base::ids::CameraId;
use crate::base::time::host_time_ns;
use crate::control::client::NodeClient;
use crate::control::interest::Interest;
use crate::control::status::path;
use crate::data::Calibration;
use crate::host::realtime;
use crate::reconstruct::Reconstructor;
use body::Body;
use kept::{Kept, Places};
use rows::Rows;
use serde::Serialize;
use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Time between two looks for new samples and frame sets.
const POLL: Duration = Duration::from_millis(4);
/// Time between two looks while no client requests the body.
const REST: Duration = Duration::from_millis(100);
/// A frame set is made without the rows that another node has not sent by then.
const PEER_PATIENCE: Duration = Duration::from_millis(400);
/// Number of frame sets over which their rate is measured.
const RATE_OVER: usize = 12;

/// A frame set as points, with its facts.
#[derive(Debug, Clone)]
pub struct Shown {
    /// Its description for the console.
    pub facts: Facts,
    /// Arrival of its first frame at this node, host clock, ns.
    pub host_time_ns: u64,
    /// Its points, 12 bytes each ([`crate::preview::quick_look::encode`]).
    pub points: Vec<u8>,
}

/// The description of a frame set.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Facts {
    /// Counts the frame sets of this node.
    pub number: u64,
    /// The index of its trigger.
    pub trigger: u64,
    /// How long ago its frames came, ms.
    pub age_ms: f64,
    /// Frame sets a second of late.
    pub frame_sets_per_s: f64,
    /// One entry for each camera that has a frame of this trigger.
    pub cameras: Vec<CameraShare>,
}

/// Another node, and what is taken from it.
#[derive(Debug, Clone)]
pub struct Peer {
    pub client: NodeClient,
    /// Its cameras in the rig: it has no rows of any other.
    pub cameras: Vec<CameraId>,
}

/// The live body of a node. The API's server starts it with two threads of low priority: one samples the frames, the
/// other reconstructs them where a calibration is configured. Both work only while a client requests the body, and end
/// with the server.
#[derive(Clone)]
pub struct LiveBody {
    shared: Arc<Shared>,
}

struct Shared {
    taps: Arc<Taps>,
    calibration: Option<PathBuf>,
    peers: Vec<Peer>,
    origin: Instant,
    rows_requested: Interest,
    body_requested: Interest,
    kept: Mutex<Kept>,
    shown: Mutex<Option<Arc<Shown>>>,
    problem: Mutex<Option<String>>,
    ended: AtomicBool,
}

impl LiveBody {
    /// Starts the threads, one that samples and, with a calibration, one that reconstructs. They end with
    /// [`Self::end`].
    pub fn start(
        taps: Arc<Taps>,
        trigger_rate_hz: f64,
        calibration: Option<PathBuf>,
        peers: Vec<Peer>,
    ) -> std::io::Result<Self> {
        let kept = Kept::new(taps.cameras().count(), trigger_rate_hz);
        let shared = Arc::new(Shared {
            taps,
            calibration,
            peers,
            origin: Instant::now(),
            rows_requested: Interest::default(),
            body_requested: Interest::default(),
            kept: Mutex::new(kept),
            shown: Mutex::default(),
            problem: Mutex::default(),
            ended: AtomicBool::new(false),
        });
        let start = |name: &str, work: fn(&Shared)| {
            let shared = Arc::clone(&shared);
            std::thread::Builder::new().name(name.to_owned()).spawn(move || {
                realtime::step_back();
                work(&shared);
            })
        };
        start("live-rows", Shared::sample)?;
        if shared.calibration.is_some() {
            start("live-body", Shared::reconstruct)?;
        }
        Ok(Self { shared })
    }

    /// Ends the threads; what they are at is not waited for.
    pub fn end(&self) {
        self.shared.ended.store(true, Ordering::Release);
    }

    /// The newest frame set if it is not the one of this number; `None` where there is none yet. The call keeps frame
    /// sets coming. Numbers begin anew with the node. The error is why there never will be one.
    pub fn after(&self, number: u64) -> Result<Option<Arc<Shown>>, String> {
        if self.shared.calibration.is_none() {
            let message = "no calibration is configured; set quick_look.calibration in the node file";
            return Err(message.to_owned());
        }
        self.shared.rows_requested.note();
        self.shared.body_requested.note();
        if let Some(problem) = lock(&self.shared.problem).clone() {
            return Err(problem);
        }
        Ok(lock(&self.shared.shown).clone().filter(|shown| shown.facts.number != number))
    }

    /// The rows of this node's cameras of a trigger, and the wish for the next ones; `None` while none is there.
    pub fn rows(&self, trigger: u64) -> Option<Vec<u8>> {
        self.shared.rows_requested.note();
        let places = lock(&self.shared.kept).settled(trigger, self.shared.now_ns())?;
        let ids: Vec<&CameraId> = self.shared.taps.cameras().collect();
        Some(rows::encode(trigger, places.iter().map(|(place, sample)| (ids[*place], sample.as_ref()))))
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Values are replaced whole.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    fn now_ns(&self) -> u64 {
        self.origin.elapsed().as_nanos() as u64
    }

    /// Rows by the names of their cameras.
    fn named(&self, places: &Places) -> Rows {
        let ids: Vec<&CameraId> = self.taps.cameras().collect();
        places.iter().map(|(place, sample)| (ids[*place].clone(), sample.as_ref().clone())).collect()
    }

    fn sample(&self) {
        let cameras = self.taps.cameras().count();
        while !self.ended.load(Ordering::Acquire) {
            if !self.rows_requested.is_fresh() {
                lock(&self.kept).forget_wishes();
                std::thread::sleep(REST);
                continue;
            }
            for camera in 0..cameras {
                let mut kept = lock(&self.kept);
                let mut spare = kept.spare();
                if let Some(sample) = self.taps.take(camera, &mut spare) {
                    kept.keep(camera, sample, self.now_ns());
                }
                kept.give_back(spare);
                if let Some(trigger) = kept.wish(camera, self.now_ns()) {
                    self.taps.ask_from(camera, trigger);
                }
            }
            std::thread::sleep(POLL);
        }
    }

    fn reconstruct(&self) {
        let Some(calibration) = &self.calibration else { return };
        let mut reconstructor = None;
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
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
            if !self.body_requested.is_fresh() {
                (last, reconstructor) = (None, None);
                std::thread::sleep(REST);
                continue;
            }
            if reconstructor.is_none() {
                let loaded = Calibration::load(calibration).map_err(|e| e.to_string());
                match loaded.and_then(|calibration| {
                    pool.install(|| Reconstructor::of_every_nth_row(calibration, ROW_STEP))
                }) {
                    Ok(made) => reconstructor = Some(made),
                    Err(reason) => return self.fail(format!("{}: {reason}", calibration.display())),
                }
            }
            let (Some(made), Some(trigger)) = (&reconstructor, lock(&self.kept).newest(last)) else {
                std::thread::sleep(POLL);
                continue;
            };
            last = Some(trigger);
            let Some(places) = lock(&self.kept).of(trigger, self.now_ns()) else { continue };
            let mut rows = self.named(&places);
            drop(places);
            let host_time_ns = rows.values().map(|sample| sample.host_time_ns).min().unwrap_or_default();
            rows.extend(self.rows_of_peers(trigger));
            let Body { points, cameras } = pool.install(|| body::body(made, &rows));
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

    /// The rows of a trigger at the other nodes, requested from all at the same time; none of a node that does not
    /// answer in time.
    fn rows_of_peers(&self, trigger: u64) -> Rows {
        let wanted = path::LIVE_ROWS.replace("{trigger}", &trigger.to_string());
        let ask = |peer: &Peer| -> Rows {
            let Ok(Some(answer)) = peer.client.fetch(&wanted, PEER_PATIENCE) else { return Rows::new() };
            rows::of_node(&answer, trigger, &peer.cameras).unwrap_or_else(|reason| {
                tracing::debug!("rows of {}: {reason}", peer.client.url());
                Rows::new()
            })
        };
        std::thread::scope(|scope| {
            let asked: Vec<_> = self.peers.iter().map(|peer| scope.spawn(move || ask(peer))).collect();
            asked.into_iter().filter_map(|answer| answer.join().ok()).flatten().collect()
        })
    }
}

impl Shown {
    /// Its description now, with its age.
    pub fn facts_now(&self) -> Facts {
        let age_ms = host_time_ns().saturating_sub(self.host_time_ns) as f64 / 1e6;
        Facts { age_ms: (age_ms * 10.0).round() / 10.0, ..self.facts.clone() }
    }
}
