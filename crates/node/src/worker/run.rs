// SPDX-License-Identifier: MIT OR Apache-2.0
//! The worker: one session after the other, verified and reconstructed in processes that can be ended at any moment.

use super::give_way::GiveWay;
use super::queue::{self, Found};
use super::state::{Activity, Job, OWN_DIR, Stage, WorkerState};
use crate::base::time::host_time_ns;
use crate::base::{Exit, Fault, regular, write_whole};
use crate::batch::collect_shards;
use crate::batch::key::{ALGORITHM, CALIBRATION_FILE, KEY_FILE, Key, calibration_sha256};
use crate::calibrate::drift::history;
use crate::config::{Output, WorkerConfig};
use crate::data::Calibration;
use crate::record::{free_bytes, node_dir};
use crate::task::{self, Ended};
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Time between two looks for sessions when there is nothing to do.
const LOOK: Duration = Duration::from_secs(2);
/// Time between two writes of the worker's state while a process runs.
const STATE_PERIOD: Duration = Duration::from_secs(1);
/// Time before the second attempt at a session; doubled before each further one.
const RETRY: Duration = Duration::from_secs(10);
/// With less free space than this a failure is attributed to the disk: four frame sets as PLY files.
const SHORT_BYTES: u64 = 256 << 20;

/// The worker of one results' directory. `fourdbody worker` makes it, and it holds the directory's lock until it is
/// dropped. It works on one session at a time, in processes that it can end at any moment, and never while a node is
/// in a session; a session that fails too often is set aside with the reason.
pub struct Worker {
    config: WorkerConfig,
    give_way: GiveWay,
    stop: Arc<AtomicBool>,
    state: WorkerState,
    /// Sessions that will be tried again some seconds later.
    retries: u64,
    /// Held as long as it lives.
    _lock: File,
}

/// Why the worker ends a process that did nothing wrong.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Interruption {
    /// The worker itself has to end.
    Stop,
    /// A capture needs the machine.
    Capture(String),
    /// Something is missing that is not the session's fault.
    Obstacle(String),
}

/// What came of a session in one go.
enum Outcome {
    Ended,
    Interrupted(Interruption),
    /// It failed, and may work another time.
    Failed(String),
    /// It failed, and will fail again.
    SetAside(String),
}

impl Worker {
    /// Takes the results' directory; refuses when another worker has it. `stop` ends the worker.
    pub fn new(config: WorkerConfig, stop: Arc<AtomicBool>) -> Result<Self, Fault> {
        let own = config.results.join(OWN_DIR);
        let failed = |e: std::io::Error| Fault::new(Exit::Failure, format!("{}: {e}", own.display()));
        std::fs::create_dir_all(&own).map_err(failed)?;
        let lock = regular::lock_file(&own.join("lock")).map_err(failed)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let message = format!(
                    "another worker is running on {}; end it, or use another results directory",
                    config.results.display()
                );
                return Err(Fault::new(Exit::Usage, message));
            }
            Err(TryLockError::Error(error)) => return Err(failed(error)),
        }
        let give_way = GiveWay::start(&config.nodes)?;
        Ok(Self { config, give_way, stop, state: WorkerState::default(), retries: 0, _lock: lock })
    }

    /// Works until it is stopped; with `once` until there is nothing to do. Whether every session found is done.
    pub fn run(&mut self, once: bool) -> Result<bool, Fault> {
        let mut shown = None;
        while !self.stop.load(Ordering::Acquire) {
            let found = self.look();
            let obstacle = self.obstacle();
            let interruption = self.interruption();
            match (interruption.or(obstacle), found) {
                (Some(Interruption::Obstacle(reason)), _) if once => {
                    self.state.not_yet.push(("all".to_owned(), reason));
                    break;
                }
                (Some(interruption), _) => self.rest(&interruption),
                (None, Some(found)) => match self.work(&found) {
                    Some(obstacle) if once => {
                        self.state.not_yet.push((found.name, obstacle));
                        break;
                    }
                    // It will not be out of the way at once.
                    Some(_) => {}
                    None => continue,
                },
                (None, None) if once && self.retries == 0 => break,
                (None, None) => self.publish(Activity::Idle, None),
            }
            if shown.as_ref() != Some(&self.state.line()) {
                shown = Some(self.state.line());
                tracing::info!("{}", self.state.line());
            }
            self.sleep(LOOK);
        }
        self.state.job = None;
        self.publish(Activity::Ended, None);
        Ok(self.state.queued.is_empty() && self.state.not_yet.is_empty() && self.state.set_aside.is_empty())
    }

    /// Looks at all sessions; the one that comes next.
    fn look(&mut self) -> Option<Found> {
        let inventory = queue::look(&self.config, &asked_first(&self.config.results));
        self.state.queued = inventory.ready.iter().map(|found| found.name.clone()).collect();
        (self.state.not_yet, self.state.set_aside) = (inventory.not_yet, inventory.set_aside);
        (self.state.done, self.retries) = (inventory.done, inventory.retries);
        inventory.ready.into_iter().next()
    }

    fn interruption(&self) -> Option<Interruption> {
        if self.stop.load(Ordering::Acquire) {
            return Some(Interruption::Stop);
        }
        self.give_way.to().map(Interruption::Capture)
    }

    /// What keeps any session from being worked on, and is not a session's fault.
    fn obstacle(&self) -> Option<Interruption> {
        let results = &self.config.results;
        let reason = match free_bytes(results) {
            Err(error) => format!("{}: {error}", results.display()),
            Ok(free) if free < self.config.reserve_bytes => format!(
                "{} has {} MiB free, work.reserve_mib is {}; make room",
                results.display(),
                free >> 20,
                self.config.reserve_bytes >> 20
            ),
            Ok(_) => return None,
        };
        Some(Interruption::Obstacle(reason))
    }

    fn rest(&mut self, interruption: &Interruption) {
        match interruption {
            Interruption::Stop => {}
            Interruption::Capture(node) => self.publish(Activity::GivesWay, Some(node.clone())),
            Interruption::Obstacle(reason) => self.publish(Activity::Waiting, Some(reason.clone())),
        }
    }

    fn publish(&mut self, activity: Activity, reason: Option<String>) {
        self.state.activity = activity;
        self.state.reason = reason;
        self.state.written_ns = host_time_ns();
        // What cannot be written now is written a second later; the state is for people.
        if let Err(error) = self.state.store(&self.config.results) {
            tracing::warn!("the worker's state cannot be written: {error}");
        }
    }

    fn sleep(&self, time: Duration) {
        let begin = Instant::now();
        while begin.elapsed() < time && !self.stop.load(Ordering::Acquire) {
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Why a failure is not the session's fault: its recordings have gone, or there is no room for a few frame sets.
    fn blame(&self, found: &Found) -> Option<String> {
        let room = free_bytes(&self.config.results).unwrap_or(0);
        if room < SHORT_BYTES {
            let results = self.config.results.display();
            return Some(format!("{results} has {} MiB free; make room", room >> 20));
        }
        queue::parts(&self.config, &found.name).err()
    }

    /// One session, until it is done or something comes between. What kept it from being done that is not its own
    /// fault.
    fn work(&mut self, found: &Found) -> Option<String> {
        let results = self.config.results.clone();
        let mut job = Job::load(&results, &found.name).unwrap_or_default();
        let mut obstacle = None;
        let outcome = match self.begin(&mut job, found) {
            Ok(()) => self.carry_on(&mut job, found),
            Err(reason) => Outcome::Failed(reason),
        };
        match outcome {
            Outcome::Ended => tracing::info!(session = job.session, frame_sets = job.of, "reconstructed"),
            Outcome::Interrupted(interruption) => {
                tracing::info!(session = job.session, ?interruption, "interrupted");
                self.state.job = Some(job.clone());
                self.rest(&interruption);
                self.keep(&job);
                return match interruption {
                    Interruption::Obstacle(reason) => Some(reason),
                    _ => None,
                };
            }
            // What cannot be read because it has gone looks like what is wrong.
            Outcome::SetAside(reason) if self.blame(found).is_none() => {
                tracing::warn!(session = job.session, "set aside: {reason}");
                job.stage = Stage::SetAside;
                job.reason = Some(reason);
            }
            Outcome::Failed(reason) | Outcome::SetAside(reason) => {
                obstacle = self.blame(found);
                job.attempts += u32::from(obstacle.is_none());
                let wait = RETRY * 2_u32.saturating_pow(job.attempts.saturating_sub(1).min(16));
                job.not_before_ns = host_time_ns() + u64::try_from(wait.as_nanos()).unwrap_or(0);
                if job.attempts >= self.config.attempts {
                    job.stage = Stage::SetAside;
                }
                tracing::warn!(session = job.session, attempts = job.attempts, "failed: {reason}");
                job.reason = Some(reason);
            }
        }
        if job.has_ended() {
            job.ended_ns = host_time_ns();
        }
        self.state.job = None;
        self.keep(&job);
        obstacle
    }

    fn keep(&self, job: &Job) {
        // Of a job that cannot be written nothing is lost: finished outputs are found again.
        if let Err(error) = job.store(&self.config.results) {
            tracing::warn!(session = job.session, "its state cannot be written: {error}");
            self.sleep(STATE_PERIOD);
        }
    }

    /// Links to the recordings, and the calibration that the session keeps.
    fn begin(&self, job: &mut Job, found: &Found) -> Result<(), String> {
        let dir = self.config.results.join(&found.name);
        let session = dir.join("session");
        let failed = |path: &Path, e: std::io::Error| format!("{}: {e}", path.display());
        std::fs::create_dir_all(&session).map_err(|e| failed(&session, e))?;
        for (node, part) in self.config.nodes.iter().zip(&found.parts) {
            let link = node_dir(&session, &node.name);
            let part = std::path::absolute(part).map_err(|e| failed(part, e))?;
            if std::fs::read_link(&link).ok().as_ref() != Some(&part) {
                // A link of an earlier attempt, when the share was mounted elsewhere.
                let _ = std::fs::remove_file(&link);
                std::os::unix::fs::symlink(&part, &link).map_err(|e| failed(&link, e))?;
            }
        }
        if job.session_id.is_empty() {
            *job = Job { began_ns: host_time_ns(), ..Job::default() };
        }
        (job.session, job.of) = (found.name.clone(), found.triggers);
        Ok(())
    }

    fn carry_on(&mut self, job: &mut Job, found: &Found) -> Outcome {
        if !job.session_id.is_empty() && job.session_id != found.session_id {
            return Outcome::SetAside(format!(
                "its results are of another session of this name ({}); move them away",
                job.session_id
            ));
        }
        job.session_id = found.session_id.clone();
        let began = Instant::now();
        if matches!(job.stage, Stage::Waiting | Stage::Verifying) {
            job.stage = Stage::Verifying;
            if let Some(outcome) = self.verify(job) {
                job.busy_s += began.elapsed().as_secs_f64();
                return outcome;
            }
            job.stage = Stage::Reconstructing;
            self.keep(job);
        }
        let outcome = self.reconstruct(job);
        job.busy_s += began.elapsed().as_secs_f64();
        outcome
    }

    /// `None` when nothing is wrong with the recordings.
    fn verify(&mut self, job: &mut Job) -> Option<Outcome> {
        let session = self.config.results.join(&job.session).join("session");
        match self.task(job, vec!["verify".into(), session.into()]) {
            Ok(Ended::ByItself(Some(0 | 3))) => None,
            Ok(Ended::ByItself(Some(4))) => {
                Some(Outcome::SetAside(format!("verify found it corrupt: {}", self.last_output(job))))
            }
            other => Some(self.outcome(job, other)),
        }
    }

    fn reconstruct(&mut self, job: &mut Job) -> Outcome {
        let dir = self.config.results.join(&job.session);
        let calibration = dir.join(CALIBRATION_FILE);
        if !calibration.exists()
            && let Err(reason) = keep_calibration(&self.config.calibration, &calibration)
        {
            return Outcome::Interrupted(Interruption::Obstacle(reason));
        }
        if let Err(reason) = earlier_apart(&dir, &calibration, self.config.output) {
            return Outcome::Failed(reason);
        }
        let cameras = match self.cameras(&calibration, &dir.join("session")) {
            Ok(cameras) => cameras,
            Err(reason) => return Outcome::SetAside(reason),
        };
        if let Some(interruption) = self.check(job, &calibration) {
            return Outcome::Interrupted(interruption);
        }
        let args: Vec<OsString> = vec![
            "reconstruct".into(),
            dir.join("session").into(),
            "--calibration".into(),
            calibration.into(),
            "--out".into(),
            dir.clone().into(),
            "--format".into(),
            self.config.output.as_str().into(),
            "--cameras".into(),
            cameras.into(),
            "--jobs".into(),
            self.config.threads().to_string().into(),
            "--timings".into(),
            dir.join("timings.json").into(),
        ];
        match self.task(job, args) {
            Ok(Ended::ByItself(Some(0 | 3))) => match summarize(job, &dir) {
                Ok(()) => Outcome::Ended,
                Err(reason) => Outcome::Failed(reason),
            },
            Ok(Ended::ByItself(Some(code @ (2 | 4)))) => Outcome::SetAside(format!(
                "reconstruct ended with exit code {code}: {}",
                self.last_output(job)
            )),
            other => self.outcome(job, other),
        }
    }

    /// Checks whether the devices still stand where the session's calibration has them, for the history: once, before
    /// the long work, which does not depend on it.
    fn check(&mut self, job: &mut Job, calibration: &Path) -> Option<Interruption> {
        let own = self.config.results.join(OWN_DIR);
        let known = Calibration::load(calibration).map_err(|e| e.to_string());
        let sha256 = known.and_then(|known| calibration_sha256(&known)).ok()?;
        let said =
            |one: &history::Checked| one.session_id == job.session_id && one.calibration_sha256 == sha256;
        if history::load(&own).iter().any(said) {
            return None;
        }
        let args: Vec<OsString> = vec![
            "calibration".into(),
            "check".into(),
            self.config.results.join(&job.session).join("session").into(),
            "--calibration".into(),
            calibration.into(),
            "--history".into(),
            own.into(),
            "--jobs".into(),
            self.config.threads().to_string().into(),
        ];
        match self.task(job, args) {
            Ok(Ended::Interrupted(interruption)) => Some(interruption),
            Ok(Ended::ByItself(Some(0 | 4))) => None,
            other => {
                tracing::warn!(session = job.session, ?other, "not checked: {}", self.last_output(job));
                None
            }
        }
    }

    /// The cameras of the session, in the calibration's order: of one node's recordings it has others. All of the
    /// session's must be in it.
    fn cameras(&self, calibration: &Path, session: &Path) -> Result<String, String> {
        use crate::data::FrameSource;
        let known = Calibration::load(calibration).map_err(|e| e.to_string())?;
        let recorded = crate::record::SessionReader::open_frames(session).map_err(|e| e.to_string())?;
        if let Some(one) = recorded.unreadable().first() {
            return Err(format!("{one}; worker --retry after `fourdbody recover`, or when its disk is back"));
        }
        let both = known.cameras().map(|(_, camera)| camera.id.as_str());
        let both: Vec<&str> =
            both.filter(|id| recorded.cameras().iter().any(|c| c.as_str() == *id)).collect();
        let lacking = recorded.cameras().iter().filter(|id| !both.contains(&id.as_str()));
        let lacking: Vec<&str> = lacking.map(|id| id.as_str()).collect();
        if !lacking.is_empty() {
            return Err(format!(
                "the calibration lacks the session's cameras {}; worker --retry after correcting it",
                lacking.join(", ")
            ));
        }
        Ok(both.join(","))
    }

    fn outcome(&self, job: &Job, ended: std::io::Result<Ended<Interruption>>) -> Outcome {
        match ended {
            Ok(Ended::Interrupted(interruption)) => Outcome::Interrupted(interruption),
            Ok(Ended::ByItself(Some(code))) => {
                Outcome::Failed(format!("exit code {code}: {}", self.last_output(job)))
            }
            Ok(Ended::ByItself(None)) => Outcome::Failed(format!("killed: {}", self.last_output(job))),
            Err(error) => Outcome::Failed(format!("cannot run a process: {error}")),
        }
    }

    fn log(&self, job: &Job) -> PathBuf {
        self.config.results.join(&job.session).join("log")
    }

    fn last_output(&self, job: &Job) -> String {
        task::last_output(&self.log(job))
    }

    /// Runs a process for this job, while telling how far it is.
    fn task(&mut self, job: &mut Job, args: Vec<OsString>) -> std::io::Result<Ended<Interruption>> {
        let log = self.log(job);
        let dir = self.config.results.join(&job.session);
        let output = self.config.output;
        let mut shown: Option<Duration> = None;
        task::run(args, &log, |elapsed| {
            if let Some(interruption) = self.interruption() {
                return Some(interruption);
            }
            if shown.is_none_or(|shown| elapsed - shown >= STATE_PERIOD) {
                shown = Some(elapsed);
                if let Some(obstacle) = self.obstacle() {
                    return Some(obstacle);
                }
                job.done = frame_sets(&dir, output).min(job.of);
                self.state.job = Some(job.clone());
                self.publish(Activity::Working, None);
            }
            None
        })
    }
}

/// Copies the calibration, after having read it, so that a session begins with one that can be used.
fn keep_calibration(from: &Path, to: &Path) -> Result<(), String> {
    Calibration::load(from).map_err(|e| format!("the calibration: {e}"))?;
    let text =
        regular::read(from, regular::STATEMENT_BYTES).map_err(|e| format!("{}: {e}", from.display()))?;
    write_whole(to, |file| file.write_all(&text)).map_err(|e| format!("{}: {e}", to.display()))
}

/// What was made of the session with another calibration, algorithm or output is put aside, so that results are of one
/// kind; nothing is deleted.
fn earlier_apart(dir: &Path, calibration: &Path, output: Output) -> Result<(), String> {
    let Some(key) = Key::load(dir)? else { return Ok(()) };
    let wanted = Calibration::load(calibration).map_err(|e| e.to_string())?;
    let is_theirs = key.calibration_sha256 == calibration_sha256(&wanted)?;
    if is_theirs && (key.algorithm, key.format.as_str()) == (ALGORITHM, output.as_str()) {
        return Ok(());
    }
    let failed = |path: &Path, e: std::io::Error| format!("{}: {e}", path.display());
    let apart = (1..).map(|n: u32| dir.join(format!("earlier-{n}"))).find(|path| !path.exists());
    let apart = apart.ok_or("no name is left for earlier results")?;
    std::fs::create_dir(&apart).map_err(|e| failed(&apart, e))?;
    tracing::warn!("results of another calibration, algorithm or output are put aside: {}", apart.display());
    // They are read with what lies beside them, which must be theirs.
    if is_theirs {
        keep_calibration(calibration, &apart.join(CALIBRATION_FILE))?;
    }
    // The key comes last: while it is there, the rest is found again.
    for name in ["clouds", "merged", "phases", "sequence.mcap", "summary.json", KEY_FILE] {
        let from = dir.join(name);
        match std::fs::rename(&from, apart.join(name)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(failed(&from, error)),
            _ => {}
        }
    }
    Ok(())
}

/// Frame sets of which something is ready, for people: `retention` looks more closely.
fn frame_sets(dir: &Path, output: Output) -> u64 {
    let (folder, end) = match output {
        Output::Ply => ("merged", ".ply"),
        Output::Phase => ("phases", ".phase"),
    };
    let entries = std::fs::read_dir(dir.join(folder)).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    // `INDEX` or `CAMERA_INDEX`: no camera has every frame.
    let index = |name: &str| name.strip_suffix(end)?.rsplit('_').next()?.parse().ok();
    names.filter_map(|name| index(&name)).collect::<BTreeSet<u64>>().len() as u64
}

/// Takes the figures of a finished session from its summary.
fn summarize(job: &mut Job, dir: &Path) -> Result<(), String> {
    let summary = collect_shards::load_summary(dir)?;
    if summary.session.id != job.session_id {
        return Err(format!(
            "its results are of the session {}, expected {}",
            summary.session, job.session_id
        ));
    }
    let timings = regular::read(&dir.join("timings.json"), regular::SUMMARY_BYTES).unwrap_or_default();
    let timings: serde_json::Value = serde_json::from_slice(&timings).unwrap_or_default();
    job.peak_memory_bytes = timings["peak_memory_bytes"].as_u64().unwrap_or(0);
    job.frames_without_cloud = (summary.refused + summary.gaps + summary.damaged) as u64;
    job.points = summary.points() as u64;
    job.parameters = summary.parameters;
    (job.stage, job.done, job.reason) = (Stage::Done, job.of, None);
    Ok(())
}

/// The sessions that a person has put before the others.
fn asked_first(results: &Path) -> Vec<String> {
    let text = regular::read_text(&results.join(OWN_DIR).join("first"), regular::TEXT_BYTES);
    let text = text.unwrap_or_default();
    text.lines().map(str::to_owned).collect()
}

/// Puts a session before all others, for a worker that is running or will be.
pub fn ask_first(results: &Path, session: &str) -> std::io::Result<()> {
    let own = results.join(OWN_DIR);
    std::fs::create_dir_all(&own)?;
    let others = asked_first(results);
    let lines =
        std::iter::once(session).chain(others.iter().map(String::as_str).filter(|other| *other != session));
    let text: String = lines.map(|line| format!("{line}\n")).collect();
    write_whole(&own.join("first"), |file| file.write_all(text.as_bytes()))
}

/// Lets a session that was set aside, or waits for its next attempt, be tried again at once.
pub fn retry(results: &Path, session: &str) -> Result<(), Fault> {
    let Some(mut job) = Job::load(results, session) else {
        let message = format!("no work on a session {session:?} in {}", results.display());
        return Err(Fault::new(Exit::Usage, message));
    };
    if job.stage == Stage::Done {
        return Err(Fault::new(
            Exit::Usage,
            format!("session {session} is done; delete its results to repeat it"),
        ));
    }
    (job.stage, job.attempts, job.not_before_ns, job.reason) = (Stage::Waiting, 0, 0, None);
    // The one it was begun with may be why.
    let _ = std::fs::remove_file(results.join(session).join("calibration.json"));
    job.store(results).map_err(|e| Fault::new(Exit::Failure, format!("{}: {e}", results.display())))
}
