// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions cut into shards: whatever happens to the processes, what is collected has the bytes of one run with one
//! thread. A mannequin at half size, seen by the two cameras of one head; one frame is missing.

use crate::lab::FOURDBODY;
use crate::simd_paths::render;
use crate::slurm::PrivateSlurm;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Everything of a result that must be the same, by path.
type Files = BTreeMap<PathBuf, Vec<u8>>;

/// Names the program that is built without Aravis.
const COMPUTE_NODE: &str = "FOURDBODY_COMPUTE_NODE";

/// Frame sets of a session.
pub const TRIGGERS: u64 = 7;

/// Photographs and calibration, and what one run with one thread makes of them.
pub struct Fixture {
    dir: tempfile::TempDir,
    triggers: u64,
    expected: Files,
}

/// A cloud's file, whosever it is: without the comments that name its session and its time.
fn whosever(bytes: &[u8]) -> Vec<u8> {
    let is_own =
        |line: &&[u8]| !line.starts_with(b"comment session ") && !line.starts_with(b"comment time_ns ");
    let kept: Vec<&[u8]> = bytes.split_inclusive(|byte| *byte == b'\n').filter(is_own).collect();
    kept.concat()
}

impl Fixture {
    pub fn new() -> Self {
        Self::of(TRIGGERS)
    }

    /// With so many frame sets.
    fn of(triggers: u64) -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let images = render(dir.path(), 1);
        for camera in images.read_dir().expect("a directory") {
            let folder = camera.expect("an entry").path();
            for trigger in 2..triggers {
                let name = |trigger: u64| folder.join(format!("{trigger:06}.png"));
                std::fs::copy(name(trigger % 2), name(trigger)).expect("writable");
            }
        }
        std::fs::remove_file(images.join("h0_low/000004.png")).expect("there is such a frame");
        let fixture = Self { dir, triggers, expected: Files::new() };
        let done = fixture.run("one", &["--jobs", "1"]);
        assert_eq!(done.status.code(), Some(3), "{}", text(&done));
        let expected = fixture.files("one");
        assert_eq!(expected.len() as u64, (2 * triggers - 1) + triggers + 4, "{:?}", expected.keys());
        assert!(expected.values().map(Vec::len).sum::<usize>() > 5_000_000, "there is something to compare");
        Self { expected, ..fixture }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// The command that reconstructs into `name`.
    fn command(&self, name: &str, options: &[&str]) -> Command {
        let mut command = Command::new(FOURDBODY);
        command.arg("reconstruct").arg(self.path("images")).arg("--out").arg(self.path(name));
        command
            .arg("--calibration")
            .arg(self.path("calibration.json"))
            .args(["--format", "ply"])
            .args(options);
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn run(&self, name: &str, options: &[&str]) -> Output {
        self.command(name, options).output().expect("starts")
    }

    fn start(&self, name: &str, options: &[&str]) -> Child {
        self.command(name, options).spawn().expect("starts")
    }

    /// The files of a result, without what is only of its shards, and without the temporary files that killed processes leave.
    fn files(&self, name: &str) -> Files {
        let out = self.path(name);
        let mut files = Files::new();
        for folder in ["clouds", "merged", "."] {
            for entry in out.join(folder).read_dir().expect("a directory") {
                let path = entry.expect("an entry").path();
                let own = path.file_name().expect("a name").to_string_lossy().into_owned();
                if path.is_file() && !own.starts_with("summary-") && !own.ends_with(".partial") {
                    files.insert(Path::new(folder).join(own), std::fs::read(path).expect("readable"));
                }
            }
        }
        files
    }

    /// Whether a result is that of one run.
    pub fn assert_same(&self, name: &str) {
        let found = self.files(name);
        assert!(self.expected.keys().eq(found.keys()), "{name}: {:?}", found.keys());
        for (file, bytes) in &self.expected {
            assert!(found[file] == *bytes, "{name}: {} differs", file.display());
        }
    }

    /// Whether the clouds in a directory are those of one run, over photographs or over a session of them.
    pub fn assert_clouds(&self, out: &Path) {
        let mut count = 0;
        for (file, bytes) in self.expected.iter().filter(|(file, _)| !file.starts_with(".")) {
            let found = std::fs::read(out.join(file)).unwrap_or_default();
            let (found, bytes) = (whosever(&found), whosever(bytes));
            assert!(found == bytes, "{} differs: {} and {} bytes", file.display(), found.len(), bytes.len());
            count += 1;
        }
        assert_eq!(count, 3 * self.triggers - 1);
    }

    /// Waits until a result has so many clouds.
    fn wait_for_clouds(&self, name: &str, count: usize) {
        let until = Instant::now() + Duration::from_secs(120);
        let clouds = || {
            let entries = self.path(name).join("clouds").read_dir().into_iter().flatten().flatten();
            entries.filter(|entry| entry.path().extension().is_some_and(|x| x == "ply")).count()
        };
        while clouds() < count {
            assert!(Instant::now() < until, "{} clouds, waited for {count}", clouds());
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// What the tasks of a Slurm run: the program without Aravis, where `make test` has built it and names it here.
pub fn program_of_a_compute_node() -> PathBuf {
    std::env::var_os(COMPUTE_NODE).map_or_else(|| FOURDBODY.into(), PathBuf::from)
}

pub fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// Sends a signal to a process of this test and waits for its end.
fn stop(mut child: Child, signal: libc::c_int) {
    let pid = libc::pid_t::try_from(child.id()).expect("a process id");
    // SAFETY: the process is our child and has not been waited for, so that the id is still its own.
    assert_eq!(unsafe { libc::kill(pid, signal) }, 0);
    assert!(!child.wait().expect("our child").success());
}

#[test]
fn shards_that_were_killed_or_ran_twice_are_collected_to_the_bytes_of_one_run() {
    let fixture = Fixture::new();
    let shard = |i: u64| format!("{i}/3");
    // Killed, and ended in the manner of a scheduler whose time limit is near; then run again.
    for (clouds, signal) in [(1, libc::SIGKILL), (3, libc::SIGTERM)] {
        let child = fixture.start("shards", &["--shard", &shard(0), "--jobs", "1"]);
        fixture.wait_for_clouds("shards", clouds);
        stop(child, signal);
        let refused = fixture.run("shards", &["--collect", "3"]);
        assert_eq!(refused.status.code(), Some(1), "{}", text(&refused));
        assert!(text(&refused).contains("--shard 0/3"), "{}", text(&refused));
    }
    // What a write that was cut off by a power failure leaves.
    let cut = fixture.path("shards").join("clouds/h0_up_000000.ply");
    let bytes = std::fs::read(&cut).expect("was the first");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).expect("writable");
    assert_eq!(fixture.run("shards", &["--shard", &shard(0)]).status.code(), Some(0));
    // The same shard twice at once, as when a node is given up that still works.
    let twice = [1, 1, 2].map(|i| fixture.start("shards", &["--shard", &shard(i), "--jobs", "1"]));
    let codes = twice.map(|child| child.wait_with_output().expect("our child").status.code());
    assert_eq!(codes, [Some(3), Some(3), Some(0)]);
    assert!(!fixture.path("shards/summary.json").exists());
    for _ in 0..2 {
        let collected = fixture.run("shards", &["--collect", "3", "--jobs", "2"]);
        assert_eq!(collected.status.code(), Some(3), "{}", text(&collected));
        fixture.assert_same("shards");
    }
}

#[test]
fn what_is_missing_or_of_another_kind_is_named_and_nothing_is_collected() {
    let fixture = Fixture::new();
    let refused = |options: &[&str], code: i32, words: &[&str]| {
        let output = fixture.run("cut", options);
        assert_eq!(output.status.code(), Some(code), "{}", text(&output));
        for word in words {
            assert!(text(&output).contains(word), "expected {word:?} in:\n{}", text(&output));
        }
        assert!(!fixture.path("cut/summary.json").exists() && !fixture.path("cut/sequence.mcap").exists());
    };
    assert_eq!(fixture.run("cut", &["--shard", "1/2"]).status.code(), Some(0));
    refused(
        &["--collect", "2"],
        1,
        &["1 of 2 shards", "--shard 0/2: ", "summary-0-of-2.json", "run to its end"],
    );
    // Of the photographs of other triggers, of other cameras, with another method.
    assert_eq!(fixture.run("cut", &["--shard", "0/2", "--triggers", "0..4"]).status.code(), Some(0));
    refused(&["--collect", "2"], 2, &["--shard 0/2: ", "lacks triggers 4, 6;"]);
    refused(
        &["--collect", "2", "--cameras", "h0_up"],
        2,
        &["h0_up,h0_low", "expected h0_up\n", "--shard 1/2"],
    );
    refused(&["--collect", "2", "--uncertainty"], 2, &["2 of 2 shards", "parameters"]);
    assert_eq!(fixture.run("cut", &["--shard", "0/2"]).status.code(), Some(3));
    // Files that went missing, were cut, or made by another run since.
    let cloud = fixture.path("cut/clouds/h0_up_000003.ply");
    let bytes = std::fs::read(&cloud).expect("was written");
    std::fs::write(&cloud, &bytes[..bytes.len() - 1]).expect("writable");
    std::fs::remove_file(fixture.path("cut/merged/000001.ply")).expect("was written");
    refused(&["--collect", "2"], 1, &["1 of 2 shards", "--shard 1/2: no whole files of triggers 1, 3"]);
    std::fs::write(fixture.path("cut/summary-0-of-2.json"), "{}").expect("writable");
    refused(&["--collect", "2"], 2, &["2 of 2 shards", "damaged"]);
    for shard in ["0/2", "1/2"] {
        assert!(matches!(fixture.run("cut", &["--shard", shard]).status.code(), Some(0 | 3)));
    }
    assert_eq!(fixture.run("cut", &["--collect", "2"]).status.code(), Some(3));
    fixture.assert_same("cut");
}

impl Fixture {
    /// `cluster submit` of all frame sets into `name`.
    fn submit(&self, slurm: &PrivateSlurm, name: &str, options: &[&str]) -> Output {
        let mut command = slurm.command(FOURDBODY);
        command.args(["cluster", "submit"]).arg(self.path("images")).arg("--out").arg(self.path(name));
        command.arg("--calibration").arg(self.path("calibration.json")).args(options);
        if !options.contains(&"--program") {
            command.arg("--program").arg(program_of_a_compute_node());
        }
        command.args(["--format", "ply", "--cpus", "1", "--json"]).output().expect("starts")
    }

    /// The job that Slurm received under this name.
    fn submitted(&self, slurm: &PrivateSlurm, name: &str, options: &[&str]) -> Value {
        let output = self.submit(slurm, name, options);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output));
        serde_json::from_slice(&output.stdout).expect("JSON")
    }

    /// Waits until all of it is in one of these states; returns the exit code of `cluster status` and what it says.
    fn wait_for(&self, slurm: &PrivateSlurm, name: &str, states: &[&str]) -> (i32, Value) {
        let until = Instant::now() + Duration::from_secs(300);
        loop {
            let mut command = slurm.command(FOURDBODY);
            let output =
                command.args(["cluster", "status", "--json"]).arg(self.path(name)).output().expect("starts");
            let code = output.status.code().expect("not killed");
            let status: Value =
                serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", text(&output)));
            if states.iter().any(|state| status["state"] == **state) {
                return (code, status);
            }
            assert!(
                code == 0 && ["waiting", "running"].contains(&status["state"].as_str().unwrap_or_default()),
                "{status}"
            );
            assert!(Instant::now() < until, "{status}\n{}", self.logs(name));
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    fn logs(&self, name: &str) -> String {
        let folder = self.path(name).join("cluster/log");
        let read = |entry: std::fs::DirEntry| std::fs::read_to_string(entry.path()).unwrap_or_default();
        folder.read_dir().into_iter().flatten().flatten().map(read).collect::<Vec<_>>().join("--\n")
    }

    /// Waits for the process of a shard, and returns its id.
    fn process_of(&self, name: &str, shard: &str) -> libc::pid_t {
        let (out, until) = (self.path(name), Instant::now() + Duration::from_secs(120));
        loop {
            for entry in std::fs::read_dir("/proc").expect("a directory").flatten() {
                let line = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
                let mut words = line.split(|byte| *byte == 0);
                // Not the shell that the script starts in.
                let ours = words.next().is_some_and(|program| program.ends_with(b"fourdbody"));
                let has = |word: &[u8]| line.split(|byte| *byte == 0).any(|found| found == word);
                if ours && has(shard.as_bytes()) && has(out.as_os_str().as_encoded_bytes()) {
                    return entry.file_name().to_string_lossy().parse().expect("a process id");
                }
            }
            assert!(Instant::now() < until, "no process of shard {shard}: {}", self.logs(name));
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// Times that Slurm started a shard anew.
fn restarts(status: &Value, shard: usize) -> u64 {
    status["shards"][shard]["task"]["restarts"].as_u64().unwrap_or(0)
}

#[test]
fn four_slurm_tasks_one_killed_and_one_out_of_time_make_the_bytes_of_one_run() {
    let Some(slurm) = PrivateSlurm::start() else { return };
    // So many frame sets that a task can be met at work.
    let fixture = Fixture::of(14);
    let job = fixture.submitted(&slurm, "slurm", &["--tasks", "4"]);
    assert_eq!((&job["shards"], &job["array"]), (&4.into(), &Value::from([0, 1, 2, 3])), "{job}");
    assert!(job["sizing"]["cpu_s_per_frame_set"].as_f64().is_some_and(|s| s > 0.0), "{job}");
    // The node takes the first one down; to the last one Slurm says that its time is nearly over. (Slurm's number of the last
    // task is that of the array, so that what is meant for it may hit all.)
    let first = fixture.process_of("slurm", "0/4");
    // SAFETY: a signal to a process whose command line was just seen to be that of this test's job.
    assert_eq!(unsafe { libc::kill(first, libc::SIGKILL) }, 0);
    let refused = fixture.submit(&slurm, "slurm", &["--tasks", "4"]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    assert!(text(&refused).contains("submitted already"), "{}", text(&refused));
    fixture.process_of("slurm", "3/4");
    let last = format!("{}_3", job["array_job"]);
    let told = slurm.run("scancel", &["--signal=USR1", "--batch", &last]);
    assert!(told.status.success(), "{}", text(&told));

    let (code, status) = fixture.wait_for(&slurm, "slurm", &["done", "failed"]);
    assert_eq!(
        (code, &status["state"]),
        (3, &"done".into()),
        "a frame is missing: {status}\n{}",
        fixture.logs("slurm")
    );
    assert_eq!([0, 1, 2, 3].map(|shard| restarts(&status, shard)), [1, 0, 0, 1], "{status}");
    assert_eq!((&status["frame_sets"], &status["frame_sets_done"]), (&14.into(), &14.into()));
    fixture.assert_same("slurm");

    // What is lost later is taken up by the same command; what is there is left alone.
    std::fs::remove_file(fixture.path("slurm/summary-2-of-4.json")).expect("was written");
    std::fs::remove_file(fixture.path("slurm/merged/000002.ply")).expect("was written");
    let job = fixture.submitted(&slurm, "slurm", &["--tasks", "4"]);
    assert_eq!(job["array"], Value::from([2]), "{job}");
    let (code, status) = fixture.wait_for(&slurm, "slurm", &["done", "failed"]);
    assert_eq!((code, &status["state"]), (3, &"done".into()), "{status}\n{}", fixture.logs("slurm"));
    fixture.assert_same("slurm");

    a_task_that_cannot_succeed_ends_it(&fixture, &slurm);
    crate::object_store::by_tasks_of(&slurm);
}

fn a_task_that_cannot_succeed_ends_it(fixture: &Fixture, slurm: &PrivateSlurm) {
    let refused = fixture.submit(slurm, "failed", &["--tasks", "2", "--partition", "none-of-that-name"]);
    assert_eq!(refused.status.code(), Some(1), "{}", text(&refused));
    assert!(text(&refused).contains("sbatch"), "{}", text(&refused));
    let program = ["--tasks", "2", "--program", "/the/node/has no such program"];
    fixture.submitted(slurm, "failed", &program);
    let (code, status) = fixture.wait_for(slurm, "failed", &["failed"]);
    assert_eq!((code, &status["frame_sets_done"]), (1, &0.into()), "{status}");
    assert!(fixture.logs("failed").contains("No such file"), "{}", fixture.logs("failed"));
}

#[test]
fn without_slurm_the_scripts_can_be_read_and_nothing_is_submitted() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let images = render(dir.path(), 1);
    let timings = dir.path().join("timings.json");
    let measured =
        r#"{"frames": 4, "threads": 1, "cpu_ms": 400.0, "peak_memory_bytes": 104857600, "wall_ms": 1.0}"#;
    std::fs::write(&timings, measured).expect("writable");
    let submit = |options: &[&str]| {
        let mut command = Command::new(FOURDBODY);
        command.args(["cluster", "submit"]).arg(&images).arg("--out").arg(dir.path().join("it's out"));
        command.arg("--calibration").arg(dir.path().join("calibration.json")).arg("--timings").arg(&timings);
        command.args(options).env("PATH", "/nothing/here").output().expect("starts")
    };
    let refused = submit(&["--tasks", "2"]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    assert!(text(&refused).contains("sbatch is not installed"), "{}", text(&refused));
    let shown =
        submit(&["--tasks", "2", "--dry-run", "--account", "gait", "--sbatch=--qos=high", "--at-once", "1"]);
    assert_eq!(shown.status.code(), Some(0), "{}", text(&shown));
    // 2 x 4 threads x 100 MiB + 256 MiB.
    for expected in [
        "#SBATCH --array=0-1%1\n",
        "#SBATCH --cpus-per-task=4\n",
        "#SBATCH --mem=1056M\n",
        "#SBATCH --time=11\n",
        "#SBATCH --account=gait\n#SBATCH --qos=high\n",
        "it'\\''s out/cluster/calibration.json'",
        "--shard \"$SLURM_ARRAY_TASK_ID/2\" --jobs 4 &\n",
        "--collect 2 --jobs 4 &\n",
        "0.200 s of a processor a frame set",
    ] {
        assert!(text(&shown).contains(expected), "expected {expected:?} in:\n{}", text(&shown));
    }
    assert!(!dir.path().join("it's out").exists(), "a dry run writes nothing");
    let refused = submit(&["--tasks", "3", "--dry-run"]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    assert!(text(&refused).contains("only 2 frame sets"), "{}", text(&refused));
}

#[test]
fn the_program_of_a_compute_node_needs_no_camera_library() {
    let library = b"libaravis-0.8.so";
    let needs_it = |program: &Path| {
        let bytes = std::fs::read(program).unwrap_or_else(|e| panic!("{}: {e}", program.display()));
        bytes.windows(library.len()).any(|part| part == library)
    };
    // What is looked for is found where it must be.
    assert_eq!(needs_it(Path::new(FOURDBODY)), cfg!(feature = "aravis"));
    if std::env::var_os(COMPUTE_NODE).is_none() {
        println!("skipped: {COMPUTE_NODE} names no program built without Aravis; `make test` builds one");
        return;
    }
    assert!(!needs_it(&program_of_a_compute_node()));
}
