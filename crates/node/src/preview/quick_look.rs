// SPDX-License-Identifier: MIT OR Apache-2.0
//! A few frame sets of a session just recorded, as clouds that a browser can turn: does the body reconstruct?
//!
//! `fourdbody reconstruct` does the work in a process of its own, at idle priority, and is ended at once when the node
//! receives a request for the next session. Each node sees its own cameras; a console puts the clouds of both
//! together.

use crate::base::ids::NodeId;
use crate::batch::result::Clouds;
use crate::config::QuickLookConfig;
use crate::control::status::{NodeStatus, Outcome};
use crate::data::{Cloud, FrameSource};
use crate::record::{SessionReader, node_dir};
use crate::task::{self, Ended};
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// Most points of one node and frame set that a browser receives: every n-th of them.
pub const POINTS_MAX: usize = 80_000;
/// Size of a point in bytes, as [`encode`] writes it.
pub const POINT_BYTES: usize = 12;
/// Number of quick looks that stay in memory.
const KEPT: usize = 4;
const POLL: Duration = Duration::from_millis(50);

/// How far a look is.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum Progress {
    /// It was not requested, or is not kept any more.
    #[default]
    NotAsked,
    /// The reconstruction of the frame sets runs.
    Working {
        /// Frame sets that are ready.
        done: usize,
        /// Number of frame sets of this look.
        of: usize,
    },
    /// All clouds can be fetched.
    Ready,
    /// The next session came first; it can be requested again.
    GaveWay,
    /// No cloud could be made.
    Failed {
        /// Why it could not be made.
        reason: String,
    },
}

/// The quick look at a session.
#[derive(Debug, Clone, Default, Serialize, utoipa::ToSchema)]
pub struct Look {
    /// How far the quick look is.
    #[serde(flatten)]
    pub progress: Progress,
    /// The triggers whose clouds are ready.
    pub triggers: Vec<u64>,
    #[serde(skip)]
    clouds: BTreeMap<u64, Arc<Vec<u8>>>,
}

/// Makes quick looks, one at a time. The API's server starts it; its thread requests a look at every session that was
/// just recorded. The reconstruction runs in a process of its own, which is ended when the node receives a request for
/// the next session.
#[derive(Clone)]
pub struct QuickLooks {
    inner: Arc<Inner>,
}

struct Inner {
    settings: Option<QuickLookConfig>,
    node: NodeId,
    sessions_dir: PathBuf,
    status: Arc<RwLock<NodeStatus>>,
    looks: Mutex<VecDeque<(String, Look)>>,
    busy: AtomicBool,
    ended: AtomicBool,
}

impl QuickLooks {
    /// Starts the thread that looks at every session as soon as it is recorded. Without settings nothing is looked at.
    pub fn start(
        settings: Option<QuickLookConfig>,
        status: Arc<RwLock<NodeStatus>>,
    ) -> std::io::Result<Self> {
        let (node, sessions_dir) = {
            let status = status.read().unwrap_or_else(PoisonError::into_inner);
            (status.node.clone(), status.sessions_dir.clone())
        };
        let inner = Arc::new(Inner {
            settings,
            node,
            sessions_dir,
            status,
            looks: Mutex::default(),
            busy: AtomicBool::new(false),
            ended: AtomicBool::new(false),
        });
        let looks = Self { inner };
        if looks.inner.settings.is_some() {
            let watching = looks.clone();
            std::thread::Builder::new().name("quick-look".to_owned()).spawn(move || watching.watch())?;
        }
        Ok(looks)
    }

    /// Ends the thread and the reconstruction that it has started, and waits for that for a second at most.
    pub fn end(&self) {
        const PATIENCE: Duration = Duration::from_secs(1);
        self.inner.ended.store(true, Ordering::Release);
        let begin = Instant::now();
        while self.inner.busy.load(Ordering::Acquire) && begin.elapsed() < PATIENCE {
            std::thread::sleep(POLL);
        }
    }

    /// A session's look as it is now.
    pub fn of(&self, session: &str) -> Look {
        let looks = self.inner.looks();
        looks.iter().find(|(name, _)| name == session).map(|(_, look)| look.clone()).unwrap_or_default()
    }

    /// A cloud of a look.
    pub fn cloud(&self, session: &str, trigger: u64) -> Option<Arc<Vec<u8>>> {
        self.of(session).clouds.get(&trigger).cloned()
    }

    /// Asks for a session's look; one that is there already is not made again. The reason why not, otherwise.
    pub fn ask(&self, session: &str) -> Result<(), String> {
        let Some(settings) = &self.inner.settings else {
            return Err("no quick look is configured; set quick_look.calibration in the node file".to_owned());
        };
        let recording = node_dir(&self.inner.sessions_dir.join(session), &self.inner.node);
        if crate::base::ids::SessionName::parse(session).is_err() || !recording.is_dir() {
            return Err(format!("no session {session:?} at this node"));
        }
        if matches!(self.of(session).progress, Progress::Ready | Progress::Working { .. }) {
            return Ok(());
        }
        if self.inner.busy.swap(true, Ordering::AcqRel) {
            return Err("another quick look is under way; try again in a few seconds".to_owned());
        }
        self.inner.change(session, |look| *look = Look::default());
        self.inner
            .change(session, |look| look.progress = Progress::Working { done: 0, of: settings.frame_sets });
        let (inner, settings, name) = (Arc::clone(&self.inner), settings.clone(), session.to_owned());
        let work = move || {
            let progress = inner.look(&settings, &name, &recording).err().unwrap_or(Progress::Ready);
            inner.change(&name, |look| look.progress = progress);
            inner.busy.store(false, Ordering::Release);
        };
        std::thread::Builder::new().name("quick-look".to_owned()).spawn(work).map(drop).map_err(|error| {
            self.inner.busy.store(false, Ordering::Release);
            format!("cannot start a thread: {error}")
        })
    }

    fn watch(&self) {
        let mut looked = None;
        while !self.inner.ended.load(Ordering::Acquire) {
            if let Some((id, name)) = self.inner.just_recorded()
                && looked != Some(id)
                && self.ask(&name).is_ok()
            {
                looked = Some(id);
            }
            std::thread::sleep(4 * POLL);
        }
    }
}

impl Inner {
    fn looks(&self) -> MutexGuard<'_, VecDeque<(String, Look)>> {
        self.looks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, session: &str, change: impl FnOnce(&mut Look)) {
        let mut looks = self.looks();
        match looks.iter_mut().find(|(name, _)| name == session) {
            Some((_, look)) => change(look),
            None => {
                let mut look = Look::default();
                change(&mut look);
                looks.push_back((session.to_owned(), look));
                if looks.len() > KEPT {
                    looks.pop_front();
                }
            }
        }
    }

    fn is_idle(&self) -> bool {
        self.status.read().unwrap_or_else(PoisonError::into_inner).is_free()
    }

    /// The last session, if it has ended with a recording.
    fn just_recorded(&self) -> Option<(u64, String)> {
        let status = self.status.read().unwrap_or_else(PoisonError::into_inner);
        let session = status.session.as_ref().filter(|session| !session.dry_run)?;
        let recorded = matches!(session.outcome, Some(Outcome::Recorded(_))) && status.is_free();
        recorded.then(|| (session.session_id, session.name.clone()))
    }

    fn look(&self, settings: &QuickLookConfig, name: &str, recording: &Path) -> Result<(), Progress> {
        let failed = |reason: String| Progress::Failed { reason };
        let session = SessionReader::open_frames(recording).map_err(|e| failed(e.to_string()))?;
        let cameras: Vec<&str> = session.cameras().iter().map(|camera| camera.as_str()).collect();
        let cameras = cameras.join(",");
        let triggers = spread(session.triggers(), settings.frame_sets);
        if triggers.is_empty() {
            return Err(failed("the session has no frames".to_owned()));
        }
        for (done, trigger) in triggers.iter().copied().enumerate() {
            self.change(name, |look| look.progress = Progress::Working { done, of: triggers.len() });
            let out = self.sessions_dir.join(".quick-look").join(format!("{name}-{}-{trigger}", self.node));
            let made = self.reconstruct(settings, recording, &cameras, trigger, &out);
            let cloud = made.and_then(|()| read_cloud(&out, trigger).map_err(failed));
            // What is left of a look that failed is of no use either.
            let _ = std::fs::remove_dir_all(&out);
            let bytes = Arc::new(encode(&cloud?, POINTS_MAX));
            self.change(name, |look| {
                look.triggers.push(trigger);
                look.clouds.insert(trigger, bytes);
            });
        }
        Ok(())
    }

    fn reconstruct(
        &self,
        settings: &QuickLookConfig,
        recording: &Path,
        cameras: &str,
        trigger: u64,
        out: &Path,
    ) -> Result<(), Progress> {
        let failed = |reason: String| Progress::Failed { reason };
        std::fs::create_dir_all(out).map_err(|e| failed(format!("{}: {e}", out.display())))?;
        let log = out.join("log");
        let triggers = format!("{trigger}..{}", trigger + 1);
        let mut args: Vec<OsString> = vec!["reconstruct".into(), recording.into()];
        args.extend([
            "--calibration".into(),
            settings.calibration.clone().into(),
            "--out".into(),
            out.into(),
        ]);
        args.extend(["--triggers", &triggers, "--cameras", cameras, "--jobs", "1"].map(OsString::from));
        let gives_way = |_| (!self.is_idle() || self.ended.load(Ordering::Acquire)).then_some(());
        match task::run(args, &log, gives_way) {
            // 3: a frame of the set is missing; the others are there.
            Ok(Ended::ByItself(Some(0 | 3))) => Ok(()),
            Ok(Ended::Interrupted(())) => Err(Progress::GaveWay),
            Ok(Ended::ByItself(code)) => {
                let code =
                    code.map_or_else(|| "by a signal".to_owned(), |code| format!("with exit code {code}"));
                let text = task::last_output(&log);
                Err(failed(format!("no body could be made: the reconstruction ended {code}: {text}")))
            }
            Err(error) => Err(failed(format!("no body could be made: {error}"))),
        }
    }
}

fn read_cloud(out: &Path, trigger: u64) -> Result<Cloud, String> {
    let clouds = Clouds::open(out)?;
    let place = clouds.merged.get(&trigger).ok_or_else(|| format!("{}: no cloud", out.display()))?;
    clouds.load(place).map(|(_, cloud)| cloud)
}

/// As many triggers as requested, in the middles of equal parts of the session.
fn spread(triggers: std::ops::Range<u64>, count: usize) -> Vec<u64> {
    let (length, count) = (triggers.end.saturating_sub(triggers.start), count as u64);
    let at = |i: u64| triggers.start + (2 * i + 1) * length / (2 * count.max(1));
    let mut found: Vec<u64> = (0..count.min(length)).map(at).collect();
    found.dedup();
    found
}

/// Points for a browser, little-endian, [`POINT_BYTES`] each: x, y, z as i16 in tenths of a millimetre, the normal as
/// three i8 in 127ths, intensity as u8 in 255ths, the camera's number, and the standard uncertainty in hundredths of a
/// millimetre (1 to 255; 0 where it is not known). A cloud of more than `most` points is thinned evenly.
pub fn encode(cloud: &Cloud, most: usize) -> Vec<u8> {
    let step = cloud.len().div_ceil(most.max(1)).max(1);
    let mut bytes = Vec::with_capacity(cloud.len() / step * POINT_BYTES + POINT_BYTES);
    for i in (0..cloud.len()).step_by(step) {
        let place = cloud.position_m[i].map(|x| (x * 1e4).round() as i16);
        place.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
        bytes.extend(cloud.normal[i].map(|x| (x * 127.0).round() as i8 as u8));
        bytes.push((cloud.intensity[i] * 255.0).round() as u8);
        bytes.push(cloud.camera.get(i).copied().unwrap_or(0));
        bytes.push(cloud.sigma_m.get(i).map_or(0, |sigma| (sigma * 1e5).round().clamp(1.0, 255.0) as u8));
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::{POINT_BYTES, POINTS_MAX, encode, spread};
    use crate::data::Cloud;

    #[test]
    fn frame_sets_are_spread_over_the_session() {
        assert_eq!(spread(0..120, 3), [20, 60, 100]);
        assert_eq!(spread(5..6, 3), [5]);
        assert_eq!(spread(4..6, 3), [4, 5]);
        assert!(spread(0..0, 3).is_empty());
    }

    #[test]
    fn a_point_is_twelve_bytes_and_keeps_a_tenth_of_a_millimetre() {
        let cloud = Cloud {
            position_m: vec![[0.123_44, -1.5, 2.0]],
            normal: vec![[0.0, 1.0, -1.0]],
            intensity: vec![0.5],
            pixel: vec![[0, 0]],
            camera: vec![7],
            sigma_m: Vec::new(),
        };
        let bytes = encode(&cloud, POINTS_MAX);
        let number = |i: usize| i16::from_le_bytes([bytes[i], bytes[i + 1]]);
        assert_eq!([number(0), number(2), number(4)], [1234, -15_000, 20_000]);
        assert_eq!(bytes[6..], [0, 127, 129, 128, 7, 0]);
    }

    #[test]
    fn a_large_cloud_is_thinned() {
        let n = 2 * POINTS_MAX + 1;
        let cloud = Cloud {
            position_m: vec![[0.0; 3]; n],
            normal: vec![[0.0; 3]; n],
            intensity: vec![0.0; n],
            ..Cloud::default()
        };
        let points = encode(&cloud, POINTS_MAX).len() / POINT_BYTES;
        assert!(points <= POINTS_MAX && points > POINTS_MAX / 2, "{points}");
    }
}
