// SPDX-License-Identifier: MIT OR Apache-2.0
//! The worker (docs/design/worker.md) as a process, on recordings of a mannequin at half size, seen by one head.

use crate::cluster::{Fixture, TRIGGERS};
use crate::crash::{Random, number};
use crate::lab::{FOURDBODY, assert_contains, fourdbody, text_of};
use fourdbody::calibrate::drift::history::{self, Verdict};
use fourdbody::worker::state::{Activity, Job, Stage, WorkerState};
use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(240);

/// Records the photographs of the fixture as a session.
pub fn import(fixture: &Fixture, out: &Path) {
    let [rig, images, out] =
        [rig(fixture), fixture.path("images"), out.to_owned()].map(|path| path.display().to_string());
    let imported = fourdbody(&["import", "--rig", &rig, "--images", &images, "--out", &out]);
    assert_eq!(imported.status.code(), Some(3), "one frame is missing: {}", text_of(&imported));
}

/// The shipped rig at half size with its first head alone.
fn rig(fixture: &Fixture) -> PathBuf {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let text = std::fs::read_to_string(path).expect("config/rig.toml is in the repository");
    let mut rig: toml::Table = text.parse().expect("valid");
    rig["head"].as_array_mut().expect("heads").truncate(1);
    // What the half-size light was rendered with.
    rig["pattern"]["marker_index"] = 40.into();
    let text = rig.to_string().replace("1920", "960").replace("1200", "600");
    let path = fixture.path("rig.toml");
    std::fs::write(&path, text).expect("writable");
    path
}

/// A directory with sessions, a worker file and results.
struct Place {
    fixture: Fixture,
}

impl Place {
    /// A worker's folders with one session, "walk".
    fn new() -> Self {
        Self::with(TRIGGERS)
    }

    /// With one session of so many frame sets, of which the first are those of the fixture.
    fn with(triggers: u64) -> Self {
        let place = Self { fixture: Fixture::new() };
        for camera in ["h0_up", "h0_low"] {
            let image = |trigger: u64| place.path("images").join(camera).join(format!("{trigger:06}.png"));
            for trigger in TRIGGERS..triggers {
                std::fs::copy(image(trigger % 2), image(trigger)).expect("writable");
            }
        }
        place.import("walk");
        place.configure("", "threads = 1\nreserve_mib = 1");
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.fixture.path(name)
    }

    fn results(&self) -> PathBuf {
        self.path("results")
    }

    fn import(&self, name: &str) {
        std::fs::create_dir_all(self.path("sessions")).expect("writable");
        import(&self.fixture, &self.path("sessions").join(name));
    }

    fn configure(&self, node: &str, work: &str) {
        self.configure_to_write("ply", node, work);
    }

    fn configure_to_write(&self, write: &str, node: &str, work: &str) {
        let text = format!(
            "format = 1\nresults = \"results\"\ncalibration = \"calibration.json\"\narchive = \"archive\"\n\
             [[node]]\nname = \"a\"\nsessions_dir = \"sessions\"\n{node}\n[work]\nwrite = \"{write}\"\n{work}\n"
        );
        std::fs::write(self.path("worker.toml"), text).expect("writable");
    }

    fn config(&self) -> String {
        self.path("worker.toml").display().to_string()
    }

    fn start(&self) -> Running {
        let log =
            std::fs::File::options().create(true).append(true).open(self.path("worker.log")).expect("a log");
        let mut command = Command::new(FOURDBODY);
        command
            .args(["worker", "--config", &self.config()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log);
        Running(command.spawn().expect("starts"))
    }

    fn prune(&self, options: &[&str]) -> (Option<i32>, String) {
        let config = self.config();
        let args: Vec<&str> =
            ["prune", "--config", &config].into_iter().chain(options.iter().copied()).collect();
        let output = fourdbody(&args);
        (output.status.code(), text_of(&output))
    }

    fn once(&self) -> (Option<i32>, String) {
        let done = fourdbody(&["worker", "--config", &self.config(), "--once"]);
        (done.status.code(), text_of(&done))
    }

    fn state(&self) -> WorkerState {
        WorkerState::load(&self.results()).unwrap_or_default()
    }

    fn wait(&self, what: &str, holds: impl Fn(&WorkerState) -> bool) -> WorkerState {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let state = self.state();
            if holds(&state) {
                return state;
            }
            let log = || std::fs::read_to_string(self.path("worker.log")).unwrap_or_default();
            assert!(Instant::now() < deadline, "never {what}: {state:#?}\n{}", log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The clouds of every frame set that is finished, with their inodes: a file that is written anew has another.
    fn inodes(&self) -> BTreeMap<PathBuf, u64> {
        let files = |folder: &str| {
            let entries = std::fs::read_dir(self.results().join("walk").join(folder)).into_iter().flatten();
            let clouds =
                entries.flatten().filter(|entry| entry.path().extension().is_some_and(|e| e == "ply"));
            clouds.map(|entry| (entry.path(), entry.metadata().expect("metadata").ino())).collect::<Vec<_>>()
        };
        let merged: BTreeMap<PathBuf, u64> = files("merged").into_iter().collect();
        let is_finished = |(path, _): &(PathBuf, u64)| {
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            let index = name.rsplit_once('_').map_or(name.as_str(), |(_, index)| index);
            merged.keys().any(|path| path.ends_with(index))
        };
        let clouds: Vec<(PathBuf, u64)> = files("clouds").into_iter().filter(is_finished).collect();
        merged.iter().map(|(path, inode)| (path.clone(), *inode)).chain(clouds).collect()
    }

    /// The results of the session have the bytes of one run with one thread.
    fn assert_same(&self) {
        self.fixture.assert_clouds(&self.results().join("walk"));
    }
}

/// A worker's process; killed when dropped.
struct Running(Child);

impl Running {
    fn kill(&mut self) {
        self.0.kill().expect("a child");
        self.0.wait().expect("a child");
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Processes of this program that mention the path.
fn processes(path: &Path) -> Vec<String> {
    let wanted = path.display().to_string();
    let entries = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    let commands = entries.filter_map(|entry| std::fs::read(entry.path().join("cmdline")).ok());
    let commands = commands.map(|bytes| String::from_utf8_lossy(&bytes).replace('\0', " "));
    commands
        .filter(|command| command.contains("fourdbody reconstruct") && command.contains(&wanted))
        .collect()
}

#[test]
fn a_worker_that_is_killed_ten_times_gives_the_bytes_of_one_run() {
    let place = Place::new();
    let mut random = Random(number("FOURDBODY_SEED", 3));
    let mut kept: BTreeMap<PathBuf, u64> = BTreeMap::new();
    for kill in 0..10 {
        let mut worker = place.start();
        std::thread::sleep(Duration::from_millis(200 + random.below(1500)));
        let deadline = Instant::now() + PATIENCE;
        // It works at idle priority: on a busy machine nothing may have been finished by then.
        while kill == 9 && place.inodes().is_empty() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(10));
        }
        worker.kill();
        while !processes(&place.results()).is_empty() {
            assert!(Instant::now() < deadline, "left behind: {:?}", processes(&place.results()));
            std::thread::sleep(Duration::from_millis(10));
        }
        let now = place.inodes();
        kept.iter().for_each(|(path, inode)| {
            assert_eq!(now.get(path), Some(inode), "kill {kill}: {} was made again", path.display());
        });
        kept = now;
    }
    assert!(!kept.is_empty(), "no cloud was finished before the last kill");
    let (code, text) = place.once();
    assert_eq!(code, Some(0), "{text}");
    place.assert_same();
    let now = place.inodes();
    assert!(kept.iter().all(|(path, inode)| now.get(path) == Some(inode)), "{kept:?}\n{now:?}");
    let job = Job::load(&place.results(), "walk").expect("there");
    assert_eq!((job.stage, job.done, job.of), (Stage::Done, TRIGGERS, TRIGGERS));
    assert_eq!((job.attempts, job.frames_without_cloud), (0, 1));
    assert!(job.points > 10_000, "{job:?}");
    // The calibration was looked at, to the end and once: one head alone does not tell whether it stands.
    let own = place.results().join(".worker");
    let said = history::load(&own);
    assert_eq!(said.len(), 1, "{said:?}");
    assert_eq!((&said[0].session, &said[0].session_id), (&"walk".to_owned(), &job.session_id));
    assert_eq!(said[0].verdict, Verdict::NotKnown, "{said:?}");
    assert!(
        said[0].recorded_ns > 0
            && own.join(history::PLOT).is_file()
            && !own.join("calibration-check").exists()
    );
}

#[cfg(feature = "aravis")]
#[test]
fn a_capture_comes_first_and_the_worker_resumes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let laboratory = crate::lab::laboratory(dir.path(), 20.0);
    // Work for much longer than a capture takes to begin.
    let place = Place::with(60);
    let node = &laboratory.nodes[0].path;
    let text = std::fs::read_to_string(node).expect("readable");
    let shown = format!("{text}\n[worker]\nresults = \"{}\"\n", place.results().display());
    std::fs::write(node, shown).expect("writable");
    let nodes = crate::lab::start_nodes(&laboratory);
    place.configure(&format!("url = \"{}\"", nodes[0].client.url()), "threads = 1\nreserve_mib = 1");
    let mut worker = place.start();
    place.wait("at work", |state| {
        state.activity == Activity::Working
            && state.job.as_ref().is_some_and(|job| job.stage == Stage::Reconstructing && job.done > 0)
    });
    let capture = Command::new(FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--triggers", "40", "--name", "first"])
        .output();
    place.wait("gave way, or done", |state| state.activity != Activity::Working);
    let capture = capture.expect("it ends");
    assert_eq!(capture.status.code(), Some(0), "no frame is lost: {}", text_of(&capture));
    let log = std::fs::read_to_string(place.path("worker.log")).expect("a log");
    assert_contains(&log, &["interrupted", "node a: "]);
    place.wait("done", |state| state.done == 1 && state.activity == Activity::Idle);
    place.assert_same();
    let deadline = Instant::now() + PATIENCE;
    let told = || nodes[0].client.status().expect("it answers").worker;
    while told().is_none_or(|worker| {
        !worker.running || !worker.line.contains("nothing to do; 0 queued, 0 not yet ready, 1 done")
    }) {
        assert!(Instant::now() < deadline, "the node never says what the worker did: {:?}", told());
        std::thread::sleep(Duration::from_millis(50));
    }
    Command::new("kill").args(["-TERM", &worker.0.id().to_string()]).status().expect("kill is there");
    assert!(worker.0.wait().expect("a child").success());
    assert_eq!(place.state().activity, Activity::Ended);
}

#[test]
fn what_cannot_be_reconstructed_is_set_aside_with_its_reason_and_nothing_else_waits_for_it() {
    let place = Place::new();
    for name in ["damaged", "unclosed"] {
        place.import(name);
    }
    let segment = |name: &str| place.path("sessions").join(name).join("node-a/segment-000.mcap");
    let mut bytes = std::fs::read(segment("damaged")).expect("readable");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(segment("damaged"), &bytes).expect("writable");
    let whole = std::fs::read(segment("unclosed")).expect("readable");
    std::fs::write(segment("unclosed"), &whole[..whole.len() / 2]).expect("writable");

    let (code, text) = place.once();
    assert_eq!(code, Some(3), "{text}");
    let state = place.state();
    assert_eq!(state.done, 1, "{state:#?}");
    let reason = |list: &[(String, String)], name: &str| {
        list.iter().find(|(session, _)| session == name).map(|(_, reason)| reason.clone()).unwrap_or_default()
    };
    assert_contains(&reason(&state.set_aside, "damaged"), &["verify found it corrupt"]);
    assert_contains(&reason(&state.not_yet, "unclosed"), &["node a", "not closed"]);

    // Repaired, it is done when somebody asks for it, and not before.
    bytes[middle] ^= 0x10;
    std::fs::write(segment("damaged"), &bytes).expect("writable");
    std::fs::write(segment("unclosed"), &whole).expect("writable");
    assert_eq!(place.once().0, Some(3));
    let retried = fourdbody(&["worker", "--config", &place.config(), "--retry", "damaged"]);
    assert!(retried.status.success(), "{}", text_of(&retried));
    assert_eq!(place.once().0, Some(0), "{:#?}", place.state());
    assert_eq!(place.state().done, 3);
}

#[test]
fn a_calibration_that_is_not_there_yet_is_waited_for_without_hurry() {
    let place = Place::new();
    let (there, away) = (place.path("calibration.json"), place.path("away.json"));
    std::fs::rename(&there, &away).expect("moved");
    let mut worker = place.start();
    place.wait("waiting", |state| state.reason.as_ref().is_some_and(|reason| reason.contains("calibration")));
    let looks = || {
        let log = std::fs::read_to_string(place.path("worker.log")).unwrap_or_default();
        log.matches("interrupted").count()
    };
    let before = looks();
    std::thread::sleep(Duration::from_secs(3));
    assert!(looks() <= before + 4, "{before} looks, {} three seconds later", looks());
    std::fs::rename(&away, &there).expect("moved");
    place.wait("done", |state| state.done == 1);
    place.assert_same();
    worker.kill();
}

#[test]
fn a_disk_that_is_full_or_a_share_that_is_away_is_waited_for() {
    let place = Place::new();
    place.configure("", "threads = 1\nreserve_mib = 1000000000");
    let (code, text) = place.once();
    assert_eq!(code, Some(3), "{text}");
    assert!(!place.results().join("walk/clouds").exists());
    place.configure("", "threads = 1\nreserve_mib = 1");
    let (there, away) = (place.path("sessions/walk/node-a"), place.path("away"));
    std::fs::rename(&there, &away).expect("moved");
    assert_eq!(place.once().0, Some(0), "no session is known");
    std::fs::rename(&away, &there).expect("moved");
    assert_eq!(place.once().0, Some(0));
    let job = Job::load(&place.results(), "walk").expect("there");
    assert_eq!((job.stage, job.attempts), (Stage::Done, 0));
}

/// A small file system; it is taken away when dropped.
struct Tmpfs(PathBuf);

impl Tmpfs {
    /// `None` where this process may not mount anything.
    fn mount(path: PathBuf, mib: u64) -> Option<Self> {
        std::fs::create_dir_all(&path).expect("writable");
        let size = format!("size={mib}m");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(&path).status();
        mounted.is_ok_and(|status| status.success()).then_some(Self(path))
    }

    fn resize(&self, mib: u64) {
        let size = format!("remount,size={mib}m");
        let done = Command::new("mount").args(["-o", &size]).arg(&self.0).status();
        assert!(done.is_ok_and(|status| status.success()));
    }
}

impl Drop for Tmpfs {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(&self.0).status();
    }
}

#[test]
fn a_disk_that_fills_up_stops_the_work_and_more_room_resumes_it() {
    let place = Place::new();
    let Some(disk) = Tmpfs::mount(place.results(), 24) else {
        println!("skipped: file systems are mounted by root only");
        return;
    };
    // Once by the reserve, once by the disk itself.
    for reserve_mib in [8, 0] {
        place.configure("", &format!("threads = 1\nreserve_mib = {reserve_mib}\nattempts = 1"));
        let (code, text) = place.once();
        assert_eq!(code, Some(3), "{text}");
        let job = Job::load(&place.results(), "walk").expect("there");
        assert_ne!(job.stage, Stage::Done);
        assert_eq!(job.attempts, 0, "the disk is to blame, not the session: {job:?}");
    }
    let before = place.inodes();
    assert!(!before.is_empty(), "something was finished before");
    disk.resize(400);
    let (code, text) = place.once();
    assert_eq!(code, Some(0), "{text}");
    place.assert_same();
    let after = place.inodes();
    assert!(before.iter().all(|(path, inode)| after.get(path) == Some(inode)), "{before:?}\n{after:?}");
}

#[test]
fn only_one_worker_has_the_results() {
    let place = Place::new();
    let mut worker = place.start();
    place.wait("at work", |state| state.activity == Activity::Working);
    let (code, text) = place.once();
    worker.kill();
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["another worker is running"]);
}

#[test]
fn only_what_is_reconstructed_and_copied_byte_for_byte_is_ever_deleted() {
    let place = Place::new();
    let prune = |options: &[&str]| place.prune(options);
    let recording = place.path("sessions/walk/node-a");
    let (code, text) = prune(&["--delete", "walk"]);
    assert_eq!(code, Some(4), "{text}");
    assert_contains(&text, &["not reconstructed yet"]);
    assert_eq!(place.once().0, Some(0));

    let (code, text) = prune(&["--delete", "walk"]);
    assert_eq!(code, Some(4), "{text}");
    let copy = place.path("archive/walk/node-a");
    std::fs::create_dir_all(&copy).expect("writable");
    let mut bytes = std::fs::read(recording.join("segment-000.mcap")).expect("readable");
    bytes[5000] ^= 1;
    std::fs::write(copy.join("segment-000.mcap"), &bytes).expect("writable");
    assert_contains(&prune(&[]).1, &["by the looks of it"]);
    let (code, text) = prune(&["--delete", "walk"]);
    assert_eq!(code, Some(4), "{text}");
    assert_contains(&text, &["differs from the recording"]);
    assert!(recording.exists());

    // The recording itself under another name is no second copy.
    let second = copy.join("segment-000.mcap");
    let linked: [&dyn Fn() -> std::io::Result<()>; 3] = [
        &|| std::os::unix::fs::symlink(recording.join("segment-000.mcap"), &second),
        &|| std::fs::hard_link(recording.join("segment-000.mcap"), &second),
        &|| std::fs::remove_dir(&copy).and_then(|()| std::os::unix::fs::symlink(&recording, &copy)),
    ];
    for link in linked {
        std::fs::remove_file(&second).expect("there");
        link().expect("linked");
        let (code, text) = prune(&["--delete", "walk"]);
        assert_eq!(code, Some(4), "{text}");
        assert_contains(&text, &["is no second copy", "copy the bytes to another place"]);
        assert!(recording.join("segment-000.mcap").exists());
    }
    std::fs::remove_file(&copy).expect("a link");
    std::fs::remove_dir_all(place.path("archive")).expect("there");
    std::os::unix::fs::symlink("sessions", place.path("archive")).expect("linked");
    let (code, text) = prune(&["--delete", "walk"]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["archive: ", "expected another place"]);
    assert!(recording.join("segment-000.mcap").exists());
    std::fs::remove_file(place.path("archive")).expect("a link");
    std::fs::create_dir_all(&copy).expect("writable");

    bytes[5000] ^= 1;
    std::fs::write(copy.join("segment-000.mcap"), &bytes).expect("writable");
    assert_contains(&prune(&["walk"]).1, &["may go", "verified, reconstructed and copied"]);
    assert!(recording.exists(), "nothing is deleted unless asked for");
    assert_contains(&prune(&["--delete", "walk"]).1, &["deleted"]);
    assert!(!recording.exists() && place.results().join("walk/merged/000000.ply").exists());
    assert_eq!(std::fs::read_dir(place.path("sessions")).expect("a directory").count(), 0, "no leftovers");
    place.assert_same();

    // Another session of that name is not taken for the one that is done.
    place.import("walk");
    let (code, text) = place.once();
    assert_eq!(code, Some(3), "{text}");
    let state = place.state();
    assert_eq!((state.done, state.not_yet.len()), (0, 1), "{state:#?}");
    assert_contains(&state.not_yet[0].1, &["older session of this name"]);
}

#[test]
fn phase_maps_are_results_and_a_session_keeps_its_recordings_when_one_of_them_is_gone() {
    let place = Place::new();
    place.configure_to_write("phase", "", "threads = 1\nreserve_mib = 1");
    assert_eq!(place.once().0, Some(0));
    let job = Job::load(&place.results(), "walk").expect("there");
    assert_eq!((job.stage, job.done, job.of), (Stage::Done, TRIGGERS, TRIGGERS));
    let (recording, copy) = (place.path("sessions/walk/node-a"), place.path("archive/walk/node-a"));
    std::fs::create_dir_all(&copy).expect("writable");
    std::fs::copy(recording.join("segment-000.mcap"), copy.join("segment-000.mcap")).expect("writable");

    let map = place.results().join("walk/phases/h0_up_000002.phase");
    let whole = std::fs::read(&map).expect("readable");
    std::fs::write(&map, &whole[..whole.len() - 1]).expect("writable");
    let (code, text) = place.prune(&["--delete", "walk"]);
    assert_eq!(code, Some(4), "{text}");
    assert_contains(&text, &["no whole results of trigger 2"]);
    std::fs::remove_file(&map).expect("there");
    assert_contains(&place.prune(&[]).1, &["no whole results of trigger 2"]);
    assert!(recording.exists());

    // Of the trigger whose frame is missing there is only the other camera's.
    std::fs::write(&map, &whole).expect("writable");
    assert_contains(&place.prune(&["--delete", "walk"]).1, &["deleted"]);
    assert!(!recording.exists() && map.exists());
}

#[test]
fn a_session_of_which_nothing_was_reconstructed_is_set_aside_and_its_recording_stays() {
    let place = Place::new();
    // Black frames; and photographs of which the calibration is another's.
    let images = place.path("black");
    let pixels = vec![0; 960 * 600];
    for camera in ["h0_up", "h0_low"] {
        std::fs::create_dir_all(images.join(camera)).expect("writable");
        let image = fourdbody::base::image::Mono8::new(960, 600, &pixels).expect("fits");
        fourdbody::base::image::write_png_grey(&images.join(camera).join("0.png"), image).expect("writable");
    }
    let [rig, from, out] =
        [rig(&place.fixture), images, place.path("sessions/black")].map(|p| p.display().to_string());
    let imported = fourdbody(&["import", "--rig", &rig, "--images", &from, "--out", &out]);
    assert_eq!(imported.status.code(), Some(0), "{}", text_of(&imported));
    let calibration = place.path("calibration.json");
    let right = std::fs::read(&calibration).expect("readable");
    let mut wrong = fourdbody::data::Calibration::load(&calibration).expect("valid");
    let cameras = &mut wrong.heads[0].cameras;
    let devices: Vec<_> = cameras.iter().map(|camera| camera.device.clone()).collect();
    cameras.iter_mut().zip(devices.into_iter().rev()).for_each(|(camera, device)| camera.device = device);
    wrong.save(&calibration).expect("writable");

    assert_eq!(place.once().0, Some(3));
    let state = place.state();
    assert_eq!((state.done, state.set_aside.len()), (0, 2), "{state:#?}");
    for (session, reason) in &state.set_aside {
        assert_contains(reason, &["exit code 4", "no frame was reconstructed"]);
        let copy = place.path("archive").join(session).join("node-a");
        let recording = place.path("sessions").join(session).join("node-a");
        std::fs::create_dir_all(&copy).expect("writable");
        std::fs::copy(recording.join("segment-000.mcap"), copy.join("segment-000.mcap")).expect("writable");
        for options in [&["--delete", session.as_str()][..], &[]] {
            let (code, text) = place.prune(options);
            assert_eq!(code, Some(if options.is_empty() { 0 } else { 4 }), "{text}");
            assert_contains(
                &text,
                &[&format!("{session}: stays: it was set aside"), "no frame was reconstructed"],
            );
        }
        assert!(recording.exists());
    }
    // With the right calibration the one with light is done; what was made with the wrong one is kept apart.
    std::fs::write(&calibration, right).expect("writable");
    let retried = fourdbody(&["worker", "--config", &place.config(), "--retry", "walk"]);
    assert!(retried.status.success(), "{}", text_of(&retried));
    assert_eq!(place.once().0, Some(3));
    assert_eq!(Job::load(&place.results(), "walk").expect("there").stage, Stage::Done);
    place.assert_same();
    assert!(place.results().join("walk/earlier-1/summary.json").exists());
    assert_contains(&place.prune(&["--delete", "walk"]).1, &["deleted"]);

    // Results that were taken from another session are no reason to delete this one's recordings.
    place.import("other");
    assert_eq!(place.once().0, Some(3));
    let copy = place.path("archive/other/node-a");
    std::fs::create_dir_all(&copy).expect("writable");
    std::fs::copy(place.path("sessions/other/node-a/segment-000.mcap"), copy.join("segment-000.mcap"))
        .expect("writable");
    let summary = place.results().join("other/summary.json");
    std::fs::copy(place.results().join("walk/summary.json"), summary).expect("writable");
    let (code, text) = place.prune(&["--delete", "other"]);
    assert_eq!(code, Some(4), "{text}");
    assert_contains(&text, &["results of another session", "walk"]);
}
