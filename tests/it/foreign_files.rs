// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is no file, or has no end, under the names of files that others may write: it costs neither memory nor time, and what
//! is printed of it steers no terminal.
//!
//! Each command runs in a process of its own, which may have so much memory and no more, and is ended where it waits.

use crate::lab::{FOURDBODY, small_rig};
use crate::recording::{frame, header, options, trigger};
use fourdbody::record::{MAX_TRIGGERS, Recording};
use std::io::Read;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// What a process may write to, bytes.
const MEMORY: u64 = 512 << 20;
/// A command that has not ended by then waits for something.
const PATIENCE: Duration = Duration::from_secs(60);

/// Exit code, output and errors of a command; no code where it was ended, by a signal or by this test.
fn run(args: &[&str], stdin: Stdio) -> (Option<i32>, String) {
    let mut command = Command::new(FOURDBODY);
    command
        .args(args)
        .stdin(stdin)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .env("RAYON_NUM_THREADS", "2");
    // SAFETY: only a system call, between fork and exec.
    unsafe {
        command.pre_exec(|| {
            let limit = libc::rlimit { rlim_cur: MEMORY, rlim_max: MEMORY };
            match libc::setrlimit(libc::RLIMIT_DATA, &raw const limit) {
                0 => Ok(()),
                _ => Err(std::io::Error::last_os_error()),
            }
        });
    }
    let mut child = command.spawn().expect("it starts");
    let mut pipes: Vec<Box<dyn Read + Send>> =
        vec![Box::new(child.stdout.take().expect("piped")), Box::new(child.stderr.take().expect("piped"))];
    let readers: Vec<_> = pipes
        .drain(..)
        .map(|mut pipe| {
            std::thread::spawn(move || {
                let mut bytes = Vec::new();
                let _ = pipe.read_to_end(&mut bytes);
                String::from_utf8_lossy(&bytes).into_owned()
            })
        })
        .collect();
    let deadline = Instant::now() + PATIENCE;
    let status = loop {
        match child.try_wait().expect("a child") {
            Some(status) => break status,
            None if Instant::now() > deadline => {
                child.kill().expect("a child");
                break child.wait().expect("a child");
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    let text: String = readers.into_iter().map(|reader| reader.join().expect("it reads")).collect();
    (status.code(), text)
}

/// What may have the name of a file and is none, or has no end.
const KINDS: [&str; 5] = ["device", "pipe", "socket", "directory", "sparse"];

/// Puts one of them under a path, in place of what was there.
fn put(kind: &str, path: &Path) {
    let _ = std::fs::remove_file(path);
    let _ = std::fs::remove_dir(path);
    match kind {
        "device" => symlink("/dev/zero", path).expect("linked"),
        "pipe" => {
            let name = std::ffi::CString::new(path.as_os_str().as_bytes()).expect("no zero in it");
            // SAFETY: a C string that lives for the duration of the call.
            assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
        }
        "socket" => drop(std::os::unix::net::UnixListener::bind(path).expect("made")),
        "directory" => std::fs::create_dir(path).expect("made"),
        "sparse" => std::fs::File::create(path).and_then(|file| file.set_len(1 << 42)).expect("made"),
        other => panic!("{other}"),
    }
}

/// A directory with a rig and a calibration that fits it.
fn place() -> (tempfile::TempDir, impl Fn(&str) -> String) {
    let dir = tempfile::tempdir().expect("a directory");
    let at = {
        let dir = dir.path().to_owned();
        move |name: &str| dir.join(name).display().to_string()
    };
    std::fs::write(at("rig.toml"), small_rig(20.0)).expect("written");
    let rig = fourdbody::config::Rig::load(at("rig.toml").as_ref()).expect("a rig");
    fourdbody::data::Calibration::nominal(&rig).save(at("calibration.json").as_ref()).expect("written");
    (dir, at)
}

#[test]
fn a_command_that_is_given_no_file_ends_with_an_error() {
    let (dir, at) = place();
    for folder in ["result/phases", "images/h0_up", "sessions", "clouds/clouds"] {
        std::fs::create_dir_all(at(folder)).expect("made");
    }
    std::fs::copy(at("calibration.json"), at("result/calibration.json")).expect("copied");
    let [rig, images, out, x] = ["rig.toml", "images", "out", "x"].map(&at);
    let [json, ply, map, result] = ["x.json", "x.ply", "result/phases/h0_up_000000.phase", "result"].map(&at);
    // Where it lies, and the command that reads it.
    let cases: Vec<(&str, Vec<&str>)> = vec![
        (&x, vec!["check-config", &x]),
        (&x, vec!["pattern", "--rig", &x, "--out", &out]),
        (&x, vec!["board", "--board", &x, "--out", &out]),
        (&x, vec!["prune", "--config", &x]),
        (&x, vec!["doctor", "--config", &x]),
        (&x, vec!["worker", "--config", &x, "--once"]),
        (&x, vec!["info", &x]),
        (&x, vec!["import", "--rig", &x, "--images", &images, "--out", &out]),
        (&json, vec!["reconstruct", &images, "--calibration", &json, "--out", &out]),
        (&json, vec!["cameras", "diff", &json, &json]),
        (&ply, vec!["view", &ply, "--out", &out]),
        (&map, vec!["export", &result, "--to", "ply", "--out", &out]),
    ];
    let image = at("images/h0_up/000000.png");
    for kind in KINDS {
        put(kind, image.as_ref());
        let (code, text) = run(&["import", "--rig", &rig, "--images", &images, "--out", &out], Stdio::null());
        assert!(
            code.is_some_and(|code| code != 0) || text.contains("missing"),
            "{kind}: import: {code:?}: {text}"
        );
        let _ = std::fs::remove_dir_all(&out);
        for (path, args) in &cases {
            put(kind, path.as_ref());
            let (code, text) = run(args, Stdio::null());
            assert!(code.is_some_and(|code| (1..=5).contains(&code)), "{kind}: {args:?}: {code:?}: {text}");
            assert!(!text.contains("panicked"), "{kind}: {args:?}: {text}");
        }
        put(kind, x.as_ref());
    }
    drop(dir);
}

fn worker_file() -> &'static str {
    "format = 1\nresults = \"results\"\ncalibration = \"calibration.json\"\narchive = \"archive\"\n[[node]]\nname = \"a\"\n\
     sessions_dir = \"sessions\"\n[work]\nreserve_mib = 0\n"
}

/// What the worker keeps is on a share, as a rule.
#[test]
fn a_worker_whose_own_files_are_none_does_not_wait_for_them() {
    for name in ["lock", "first", "state.json", "calibration-history.jsonl", "calibration-history.lock"] {
        for kind in KINDS {
            let (_dir, at) = place();
            std::fs::create_dir_all(at("sessions")).expect("made");
            std::fs::create_dir_all(at("results/.worker")).expect("made");
            std::fs::write(at("worker.toml"), worker_file()).expect("written");
            put(kind, at(&format!("results/.worker/{name}")).as_ref());
            let (code, text) = run(&["worker", "--config", &at("worker.toml"), "--once"], Stdio::null());
            assert!(code.is_some(), "{name}: {kind}: {text}");
            let (code, text) = run(&["worker", "--config", &at("worker.toml"), "--state"], Stdio::null());
            assert!(code.is_some(), "{name}: {kind}: {text}");
        }
    }
}

#[test]
fn what_a_file_announces_takes_no_memory_that_it_does_not_fill() {
    let (_dir, at) = place();
    std::fs::create_dir_all(at("images/h0_up")).expect("made");
    // A picture of a million columns and rows in some bytes.
    let mut png: Vec<u8> = b"\x89PNG\r\n\x1a\n".to_vec();
    let chunk = |kind: &[u8; 4], data: &[u8]| {
        let mut crc = crc32fast::Hasher::new();
        crc.update(kind);
        crc.update(data);
        [&(data.len() as u32).to_be_bytes()[..], kind, data, &crc.finalize().to_be_bytes()].concat()
    };
    let header = [&1_000_000u32.to_be_bytes()[..], &1_000_000u32.to_be_bytes(), &[8, 0, 0, 0, 0]].concat();
    png.extend(chunk(b"IHDR", &header));
    png.extend(chunk(b"IDAT", &[0x78, 0x9c, 3, 0, 0, 0, 0, 1]));
    png.extend(chunk(b"IEND", &[]));
    std::fs::write(at("images/h0_up/000000.png"), png).expect("written");
    let (code, text) = run(
        &["import", "--rig", &at("rig.toml"), "--images", &at("images"), "--out", &at("out")],
        Stdio::null(),
    );
    assert!(code.is_some_and(|code| code != 0), "{code:?}: {text}");
    assert!(text.contains("1000000 x 1000000"), "{text}");
    // A cloud of a hundred million points, none of which was written.
    let cloud = fourdbody::data::Cloud {
        position_m: vec![[1.0; 3]],
        normal: vec![[0.0, 0.0, 1.0]],
        intensity: vec![0.5],
        pixel: vec![[1, 1]],
        ..fourdbody::data::Cloud::default()
    };
    fourdbody::formats::ply::save(at("x.ply").as_ref(), &cloud, &[]).expect("written");
    let whole = std::fs::read(at("x.ply")).expect("readable");
    let header = &whole[..whole.len() - 32];
    for points in [100_000_000u64, 1 << 40] {
        let text = String::from_utf8_lossy(header)
            .replace("element vertex 1\n", &format!("element vertex {points}\n"));
        std::fs::write(at("x.ply"), &text).expect("written");
        let file = std::fs::File::options().write(true).open(at("x.ply")).expect("there");
        file.set_len(text.len() as u64 + 32 * points.min(100_000_000)).expect("made");
        let (code, text) = run(&["view", &at("x.ply"), "--out", &at("x.png")], Stdio::null());
        assert!(code.is_some_and(|code| code != 0), "{points}: {code:?}: {text}");
        assert!(text.contains("a point of zeros") || text.contains("expected at most"), "{points}: {text}");
    }
    // A calibration of a camera with a billion columns.
    let rig = fourdbody::config::Rig::load(at("rig.toml").as_ref()).expect("a rig");
    let mut calibration = fourdbody::data::Calibration::nominal(&rig);
    calibration.heads[0].cameras[0].device.width = 1_000_000_000;
    calibration.save(at("calibration.json").as_ref()).expect("written");
    let calibration = at("calibration.json");
    let args = ["reconstruct", &at("images"), "--calibration", &calibration, "--out", &at("clouds")];
    let (code, text) = run(&args, Stdio::null());
    assert_eq!(code, Some(2), "{text}");
    assert!(text.contains("1000000000") && text.contains("16384"), "{text}");
}

/// A number in a file of some kilobytes: sixteen million triggers of eight cameras would be gigabytes of a table, and as much memory.
#[test]
fn an_export_is_no_larger_than_what_its_recording_tells() {
    let (_dir, at) = place();
    let cameras = ["h0_up", "h0_low", "h1_up", "h1_low", "h2_up", "h2_low", "h3_up", "h3_low"];
    let mut recording =
        Recording::create(at("walk/node-a").as_ref(), header("a", &cameras, None), options(1 << 30))
            .expect("a new recording");
    for index in [0, MAX_TRIGGERS - 1] {
        let (meta, message) = frame("h0_up", 0, index);
        recording.trigger(&trigger(index)).expect("recorded");
        recording.frame(0, &meta, &message).expect("recorded");
    }
    recording.tick().expect("kept");
    drop(recording);
    let (walk, out) = (at("walk"), at("out"));
    let (code, text) = run(&["export", &walk, "--to", "png,csv", "--out", &out], Stdio::null());
    assert_eq!(code, Some(4), "{text}");
    let table = std::fs::metadata(Path::new(&out).join("timing.csv")).expect("a table").len();
    assert!(table < 10_000, "{table} bytes");
    assert!(Path::new(&out).join("h0_up/000000.png").exists(), "{text}");
}

/// As `[]` is a remark without a rating, it was a job without a session and a state of a worker that has nothing to do.
#[test]
fn a_list_is_no_state_of_a_worker() {
    let (dir, at) = place();
    std::fs::create_dir_all(at("results/.worker")).expect("made");
    std::fs::create_dir_all(at("results/walk")).expect("made");
    std::fs::write(at("results/.worker/state.json"), "[]").expect("written");
    std::fs::write(at("results/walk/job.json"), "[]").expect("written");
    let results: PathBuf = dir.path().join("results");
    assert_eq!(fourdbody::worker::state::WorkerState::load(&results), None);
    assert_eq!(fourdbody::worker::state::Job::load(&results, "walk"), None);
}

/// Keys, values and comments of a file that somebody else has written.
#[test]
fn what_is_printed_of_a_file_steers_no_terminal_and_makes_no_lines() {
    let (_dir, at) = place();
    let rig = small_rig(20.0);
    let forged = "\\u001b[2J\\u009b1m\\u202e\\r\\nrig.toml: ok";
    let cases = [
        format!("\"{forged}\" = 1\n{rig}"),
        rig.replacen("trigger_rate_hz = 20.0", &format!("trigger_rate_hz = \"{forged}\""), 1),
        format!("# \u{1b}[2J\n{rig}"),
        format!("\u{1b}[2J = 7\n{rig}"),
    ];
    for (i, text) in cases.iter().enumerate() {
        std::fs::write(at("rig.toml"), text).expect("written");
        for args in [
            vec!["pattern", "--rig", &at("rig.toml"), "--out", &at("out")],
            vec!["check-config", &at("rig.toml")],
        ] {
            let (code, shown) = run(&args, Stdio::null());
            assert_eq!(code, Some(2), "{i}: {args:?}: {shown:?}");
            assert!(!shown.contains(['\u{1b}', '\u{9b}', '\u{202e}', '\r']), "{i}: {args:?}: {shown:?}");
            assert!(!shown.lines().any(|line| line.starts_with("rig.toml: ok")), "{i}: {args:?}: {shown:?}");
        }
    }
    // A directory is named by whoever makes it.
    std::fs::write(at("rig.toml"), &rig).expect("written");
    let out = at("out\u{1b}[2J\nrig.toml: ok");
    let (code, shown) = run(&["pattern", "--rig", &at("rig.toml"), "--out", &out], Stdio::null());
    assert_eq!(code, Some(0), "{shown:?}");
    assert!(
        !shown.contains('\u{1b}') && !shown.lines().any(|line| line.starts_with("rig.toml: ok")),
        "{shown:?}"
    );
}
