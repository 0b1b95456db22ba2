//! Sessions cut into shards: whatever happens to the processes, what is collected has the bytes of one run with one
//! thread. A mannequin at half size, seen by the two cameras of one head; one frame is missing.

use crate::lab::FOURDBODY;
use crate::simd_paths::render;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Everything of a result that must be the same, by path.
type Files = BTreeMap<PathBuf, Vec<u8>>;

/// Frame sets of the session.
pub const TRIGGERS: u64 = 7;

/// Photographs and calibration, and what one run with one thread makes of them.
pub struct Fixture {
    dir: tempfile::TempDir,
    expected: Files,
}

impl Fixture {
    pub fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let images = render(dir.path());
        for camera in images.read_dir().expect("a directory") {
            let folder = camera.expect("an entry").path();
            for trigger in 2..TRIGGERS {
                let name = |trigger: u64| folder.join(format!("{trigger:06}.png"));
                std::fs::copy(name(trigger % 2), name(trigger)).expect("writable");
            }
        }
        std::fs::remove_file(images.join("h0_low/000004.png")).expect("there is such a frame");
        let fixture = Self { dir, expected: Files::new() };
        let done = fixture.run("one", &["--jobs", "1"]);
        assert_eq!(done.status.code(), Some(3), "{}", text(&done));
        let expected = fixture.files("one");
        assert_eq!(expected.len(), 13 + 7 + 2, "{:?}", expected.keys());
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
        command.arg("--calibration").arg(self.path("calibration.json")).args(options);
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn run(&self, name: &str, options: &[&str]) -> Output {
        self.command(name, options).output().expect("starts")
    }

    fn start(&self, name: &str, options: &[&str]) -> Child {
        self.command(name, options).spawn().expect("starts")
    }

    /// The files of a result, without what is only of its shards.
    fn files(&self, name: &str) -> Files {
        let out = self.path(name);
        let mut files = Files::new();
        for folder in ["clouds", "merged", "."] {
            for entry in out.join(folder).read_dir().expect("a directory") {
                let path = entry.expect("an entry").path();
                let own = path.file_name().expect("a name").to_string_lossy().into_owned();
                if path.is_file() && !own.starts_with("summary-") {
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

    /// Whether the clouds in a directory are those of one run.
    pub fn assert_clouds(&self, out: &Path) {
        let mut count = 0;
        for (file, bytes) in self.expected.iter().filter(|(file, _)| !file.starts_with(".")) {
            let found = std::fs::read(out.join(file)).unwrap_or_default();
            assert!(found == *bytes, "{} differs: {} and {} bytes", file.display(), found.len(), bytes.len());
            count += 1;
        }
        assert_eq!(count, 13 + 7);
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
        let partial = |name: &Path| name.to_string_lossy().ends_with(".partial");
        // A killed process may leave a temporary file, which is not taken for a result.
        let leftover: Vec<PathBuf> =
            fixture.files("shards").into_keys().filter(|name| partial(name)).collect();
        leftover.iter().for_each(|name| {
            std::fs::remove_file(fixture.path("shards").join(name)).expect("it was there");
        });
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
    refused(&["--collect", "2"], 2, &["--shard 0/2: ", "lacks triggers 4, 6"]);
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
