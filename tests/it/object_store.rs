// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions and results in an S3-compatible object store: a real server (`s3s-fs`, which `make test` installs into target/tools),
//! whose objects are files, so that the tests see what is in it.

use crate::cluster::{Fixture, TRIGGERS, program_of_a_compute_node, text};
use crate::lab::{FOURDBODY, assert_contains, fourdbody, text_of};
use crate::slurm::PrivateSlurm;
use serde_json::Value;
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(240);
const KEYS: [&str; 2] = ["a-laboratory", "its-secret"];

/// A server with the bucket `lab`, of which one session is in `sessions/walk`.
struct Store {
    fixture: Fixture,
    port: u16,
    server: Option<Child>,
}

impl Store {
    /// `None` where the server is not installed.
    fn new() -> Option<Self> {
        if !program().exists() {
            println!("skipped: no {}; `make test` installs it", program().display());
            return None;
        }
        let fixture = Fixture::new();
        let sessions = fixture.path("store/lab/sessions");
        std::fs::create_dir_all(&sessions).expect("writable");
        crate::worker::import(&fixture, &sessions.join("walk"));
        let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port");
        let port = free.local_addr().expect("bound").port();
        drop(free);
        let mut store = Self { fixture, port, server: None };
        store.start();
        Some(store)
    }

    /// A dry run of `cluster submit` says what of the results in the store is done, and makes no directory of its own.
    fn assert_dry_run_writes_nothing(&self) {
        let (out, calibration) = (self.fixture.path("planned"), self.fixture.path("calibration.json"));
        let mut command = Command::new(FOURDBODY);
        command.args(["cluster", "submit", "s3://lab/sessions/walk", "--store", "s3://lab/results/walk"]);
        command.arg("--out").arg(&out).arg("--calibration").arg(&calibration);
        self.tell(&mut command);
        let done = command.args(["--format", "ply", "--tasks", "3", "--dry-run"]).output().expect("starts");
        assert_eq!(done.status.code(), Some(0), "{}", text(&done));
        assert!(!out.exists(), "a dry run wrote {}", out.display());
    }

    fn start(&mut self) {
        let mut command = Command::new(program());
        command.args(["--host", "127.0.0.1", "--port", &self.port.to_string()]);
        command.args(["--access-key", KEYS[0], "--secret-key", KEYS[1]]).arg(self.fixture.path("store"));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        self.server = Some(command.spawn().expect("starts"));
        let until = Instant::now() + PATIENCE;
        while TcpStream::connect((Ipv4Addr::LOCALHOST, self.port)).is_err() {
            assert!(Instant::now() < until, "the server does not listen");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn stop(&mut self) {
        if let Some(mut server) = self.server.take() {
            let _ = server.kill();
            let _ = server.wait();
        }
    }

    /// An object of the results.
    fn object(&self, name: &str) -> PathBuf {
        self.fixture.path("store/lab/results/walk").join(name)
    }

    fn command(&self, scratch: &str, options: &[&str]) -> Command {
        let scratch = self.fixture.path(scratch);
        std::fs::create_dir_all(&scratch).expect("writable");
        let mut command = Command::new(FOURDBODY);
        command.args(["reconstruct", "s3://lab/sessions/walk", "--out", "s3://lab/results/walk"]);
        command.arg("--calibration").arg(self.fixture.path("calibration.json"));
        command.arg("--scratch").arg(scratch).args(["--jobs", "1", "--format", "ply"]).args(options);
        self.tell(&mut command);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    /// Where the store is, and the keys.
    fn tell(&self, command: &mut Command) {
        command.env("AWS_ACCESS_KEY_ID", KEYS[0]).env("AWS_SECRET_ACCESS_KEY", KEYS[1]);
        command.env("AWS_REGION", "us-east-1").env("AWS_ALLOW_HTTP", "true");
        command.env("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{}", self.port));
    }

    fn run(&self, scratch: &str, options: &[&str]) -> Output {
        self.command(scratch, options).output().expect("starts")
    }

    /// Starts a run and waits until the store has its first cloud.
    fn run_until_something_is_there(&self, scratch: &str, options: &[&str]) -> Child {
        let mut child = self.command(scratch, options).spawn().expect("starts");
        let until = Instant::now() + PATIENCE;
        let clouds = || self.object("clouds").read_dir().is_ok_and(|mut entries| entries.next().is_some());
        while !clouds() {
            assert!(Instant::now() < until, "no cloud comes");
            let ended = child.try_wait().expect("our child");
            assert!(ended.is_none(), "it has ended, {ended:?}, and there is no cloud");
            std::thread::sleep(Duration::from_millis(5));
        }
        child
    }
}

impl Drop for Store {
    fn drop(&mut self) {
        self.stop();
    }
}

fn program() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("target/tools/bin/s3s-fs")
}

#[test]
fn shards_of_a_session_in_a_store_are_collected_there_to_the_bytes_of_one_run() {
    let Some(store) = Store::new() else { return };
    // Killed, and taken up by another machine, which has only what is in the store.
    let mut killed = store.run_until_something_is_there("first", &["--shard", "0/3"]);
    killed.kill().expect("our child");
    killed.wait().expect("our child");
    for (shard, scratch) in [("0/3", "second"), ("1/3", "first"), ("2/3", "second")] {
        let done = store.run(scratch, &["--shard", shard]);
        assert!(matches!(done.status.code(), Some(0 | 3)), "{shard}: {}", text(&done));
    }
    let early = store.run("third", &["--collect", "4"]);
    assert_eq!(early.status.code(), Some(1), "{}", text(&early));
    let collected = store.run("third", &["--collect", "3"]);
    assert_eq!(collected.status.code(), Some(3), "a frame is missing: {}", text(&collected));
    store.fixture.assert_clouds(&store.object(""));
    // The session has times, the photographs have none: behind its time each message is the same.
    let clouds = |path: &Path| -> Vec<Vec<u8>> {
        let bytes = std::fs::read(path).expect("a sequence");
        let messages =
            mcap::MessageStream::new(&bytes).expect("intact").map(|message| message.expect("intact"));
        messages.map(|message| message.data[2 + usize::from(message.data[1])..].to_vec()).collect()
    };
    let (found, expected) = (store.object("sequence.mcap"), store.fixture.path("one/sequence.mcap"));
    assert!(clouds(&found) == clouds(&expected));
    let summary = std::fs::read(store.object("summary.json")).expect("was stored");
    let summary: Value = serde_json::from_slice(&summary).expect("JSON");
    assert_eq!(summary["triggers"].as_array().map(Vec::len), Some(TRIGGERS as usize));
    assert_eq!(summary["gaps"], 1);
    // What was staged is gone, but for the run that was killed.
    let left = |scratch: &str| store.fixture.path(scratch).read_dir().expect("a directory").count();
    assert_eq!(
        [left("first"), left("second"), left("third")],
        [1, 0, 1],
        "the refused collection is the third's"
    );
    store.assert_dry_run_writes_nothing();
}

#[test]
fn a_store_that_goes_away_ends_the_work_cleanly_and_the_same_run_takes_it_up() {
    let Some(mut store) = Store::new() else { return };
    let running = store.run_until_something_is_there("scratch", &[]);
    store.stop();
    let ended = running.wait_with_output().expect("our child");
    assert_eq!(ended.status.code(), Some(1), "{}", text(&ended));
    assert_contains(&text(&ended), &["s3://lab/results/walk", "run the same again"]);
    let away = store.run("elsewhere", &[]);
    assert_eq!(away.status.code(), Some(1), "{}", text(&away));
    assert_contains(&text(&away), &["s3://lab/sessions/walk", "AWS_ENDPOINT_URL"]);
    store.start();
    let done = store.run("scratch", &[]);
    assert_eq!(done.status.code(), Some(3), "a frame is missing: {}", text(&done));
    store.fixture.assert_clouds(&store.object(""));
    let wrong =
        store.command("scratch", &[]).env("AWS_SECRET_ACCESS_KEY", "guessed").output().expect("starts");
    assert_eq!(wrong.status.code(), Some(1), "{}", text(&wrong));
}

/// Two tasks whose frames come from a store, and whose clouds go there; scripts and logs are in a directory.
pub fn by_tasks_of(slurm: &PrivateSlurm) {
    let Some(store) = Store::new() else { return };
    let out = store.fixture.path("out");
    let cluster = |arguments: &[&str]| {
        let mut command = slurm.command(FOURDBODY);
        store.tell(&mut command);
        let output = command.arg("cluster").args(arguments).arg("--json").output().expect("starts");
        let found: Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{}", text(&output)));
        (output.status.code(), found)
    };
    let [out, calibration, scratch, program] = [
        out,
        store.fixture.path("calibration.json"),
        store.fixture.path("scratch"),
        program_of_a_compute_node(),
    ]
    .map(|p| p.display().to_string());
    std::fs::create_dir(&scratch).expect("writable");
    let (code, job) = cluster(&[
        "submit",
        "s3://lab/sessions/walk",
        "--store",
        "s3://lab/results/walk",
        "--out",
        &out,
        "--calibration",
        &calibration,
        "--scratch",
        &scratch,
        "--program",
        &program,
        "--format",
        "ply",
        "--tasks",
        "2",
        "--cpus",
        "1",
    ]);
    assert_eq!((code, &job["array"]), (Some(0), &Value::from([0, 1])), "{job}");
    let until = Instant::now() + PATIENCE;
    loop {
        let (code, status) = cluster(&["status", &out]);
        if status["state"] == "done" {
            assert_eq!((code, &status["frame_sets_done"]), (Some(3), &TRIGGERS.into()), "{status}");
            break;
        }
        assert!(status["state"] != "failed" && Instant::now() < until, "{status}");
        std::thread::sleep(Duration::from_millis(300));
    }
    store.fixture.assert_clouds(&store.object(""));
    assert!(!Path::new(&out).join("merged").exists(), "the clouds are in the store");
}

#[test]
fn locations_that_make_no_sense_are_refused() {
    for session in ["s3://", "s3://NotABucket/x", "s3://lab/../x"] {
        let refused =
            fourdbody(&["reconstruct", session, "--calibration", "none.json", "--out", "/nonexistent/out"]);
        assert_eq!(refused.status.code(), Some(2), "{}", text_of(&refused));
        assert_contains(&text_of(&refused), &["s3://BUCKET/PREFIX"]);
    }
}
