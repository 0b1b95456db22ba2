// SPDX-License-Identifier: MIT OR Apache-2.0
//! The files of a result: they carry the times of their session, and each is held against its name, its session and the summary.

use crate::lab::text_of;
use crate::reused::{Place, json, reconstruct, run};
use fourdbody::formats::phase_file;
use fourdbody::formats::ply;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Output;

const TRIGGERS: u64 = 3;

/// A session of three triggers at this rate; every frame set shows the same.
fn session(place: &Place, name: &str, rate_hz: f64) -> PathBuf {
    let rig = std::fs::read_to_string(place.path("rig.toml")).expect("a rig");
    let mut rig: toml::Table = rig.parse().expect("valid");
    rig.insert("trigger_rate_hz".to_owned(), rate_hz.into());
    std::fs::write(place.path("rig.toml"), rig.to_string()).expect("writable");
    for camera in ["h0_up", "h0_low"] {
        let image = |trigger: u64| place.path(&format!("images/{camera}/{trigger:06}.png"));
        for trigger in 1..TRIGGERS {
            std::fs::copy(image(0), image(trigger)).expect("writable");
        }
    }
    place.session(name)
}

fn export(from: &Path, out: &Path, options: &[&str]) -> Output {
    let words: Vec<&str> = ["export"].iter().chain(options).copied().collect();
    run(&words, &[("", from), ("--out", out)])
}

fn log_times(path: &Path) -> Vec<u64> {
    let bytes = std::fs::read(path).expect("a sequence");
    mcap::MessageStream::new(&bytes)
        .expect("intact")
        .map(|message| message.expect("intact").log_time)
        .collect()
}

/// `code`, and all of these words.
fn ends(output: &Output, code: i32, words: &[&str]) {
    let text = text_of(output);
    assert_eq!(output.status.code(), Some(code), "{text}");
    words.iter().for_each(|word| assert!(text.contains(word), "{word:?} missing in {text}"));
}

/// Maps, clouds, sequences and players of a session of 20 Hz have its times, without `--session`.
#[test]
fn what_is_reconstructed_carries_the_times_of_the_session() {
    let place = Place::new();
    let session = session(&place, "slow", 20.0);
    let (maps, clouds) = (place.path("maps"), place.path("clouds"));
    ends(&reconstruct(&place, &session, &maps, &["--format", "phase"]), 0, &[]);
    ends(&reconstruct(&place, &session, &clouds, &["--format", "ply"]), 0, &[]);
    let summary = json(&maps.join("summary.json"));
    let base = summary["time_base"].as_str().expect("the clock is named");
    assert!(base.contains("node a") && base.contains("20 Hz"), "{base}");
    let began = summary["triggers"][0]["time_ns"].as_u64().expect("a time");
    assert!(began > 1_700_000_000_000_000_000, "{began} ns: long ago");
    let times: Vec<u64> = (0..TRIGGERS).map(|trigger| began + trigger * 50_000_000).collect();
    for (trigger, &time) in (0..).zip(&times) {
        assert_eq!(summary["triggers"][trigger]["time_ns"], time);
        let map = maps.join(format!("phases/h0_up_{trigger:06}.phase"));
        assert_eq!(phase_file::load_statement(&map).expect("a map").time_ns, Some(time));
        let header = |name: &str| ply::load_header(&clouds.join(name)).expect("a cloud");
        for name in [format!("clouds/h0_low_{trigger:06}.ply"), format!("merged/{trigger:06}.ply")] {
            assert_eq!(header(&name).comment("time_ns"), Some(time.to_string().as_str()), "{name}");
        }
    }
    assert_eq!(log_times(&clouds.join("sequence.mcap")), times);
    // All of a result's maps, chosen ones, stored clouds, and clouds that lie alone.
    let out = |name: &str| place.path(name).join("sequence.mcap");
    ends(&export(&maps, &place.path("all"), &[]), 0, &[]);
    ends(&export(&maps, &place.path("of-maps"), &["--to", "mcap,glb"]), 0, &[]);
    ends(&export(&clouds, &place.path("of-clouds"), &["--to", "mcap"]), 0, &[]);
    ends(&export(&place.path("all"), &place.path("again"), &["--to", "mcap"]), 0, &[]);
    for name in ["all", "of-maps", "of-clouds", "again"] {
        assert_eq!(log_times(&out(name)), times, "{name}");
    }
    let glb = std::fs::read(place.path("of-maps/merged/000001.glb")).expect("written");
    assert!(String::from_utf8_lossy(&glb).contains(&format!("time_ns {}", times[1])));
    let sequence = fourdbody::play::Sequence::open(&maps).expect("can be played").described(120.0, 10);
    assert_eq!(sequence.seconds, [0.0, 0.05, 0.1]);
    assert!((sequence.trigger_rate_hz - 20.0).abs() < 1e-9);
    // Another session's times are not taken.
    let other = place.session("other");
    let mcap = ["--to", "mcap", "--session", &other.display().to_string()];
    ends(&export(&maps, &place.path("never"), &mcap), 4, &["other", "slow"]);
    // Images have no times: those of the sequence are made up, which is said.
    let images = place.path("of-images");
    ends(&reconstruct(&place, &place.path("images"), &images, &["--rate-hz", "20"]), 0, &["MADE UP"]);
    assert_eq!(log_times(&images.join("sequence.mcap")), [0, 50_000_000, 100_000_000]);
    ends(&export(&images, &place.path("made-up"), &["--to", "mcap", "--rate-hz", "20"]), 0, &["MADE UP"]);
}

/// What is missing costs exit code 3, what is foreign 4, and both are named: by `export`, `view` and `report --play`.
#[test]
fn what_is_missing_or_foreign_among_the_files_of_a_result_is_named() {
    let place = Place::new();
    let sessions = [session(&place, "first", 20.0), place.session("second")];
    let results = ["first", "second"].map(|name| place.path(&format!("of-{name}")));
    for (session, result) in sessions.iter().zip(&results) {
        ends(&reconstruct(&place, session, result, &["--format", "phase,ply"]), 0, &[]);
        // Phase maps alone.
        for folder in ["clouds", "merged"] {
            std::fs::rename(result.join(folder), result.join(format!("{folder}-aside"))).expect("there");
        }
    }
    let [own, foreign] = &results;
    let map = |result: &Path, camera: &str, trigger: u64| {
        result.join(format!("phases/{camera}_{trigger:06}.phase"))
    };
    let whole = std::fs::read(map(own, "h0_up", 1)).expect("a map");
    let count = std::cell::Cell::new(0);
    let all = |code: i32, words: &[&str]| {
        count.set(count.get() + 1);
        let out = |name: &str| place.path(&format!("{name}-{}", count.get()));
        let (picture, page) = (place.path("picture.png"), place.path("page.html"));
        ends(&export(own, &out("all"), &[]), code, words);
        ends(&export(own, &out("glb"), &["--to", "glb"]), code, words);
        ends(&export(own, &out("mcap"), &["--to", "mcap", "--clouds", "directional"]), code, words);
        ends(&run(&["view", "--trigger", "1"], &[("", own), ("--out", &picture)]), code, words);
        let play = [("", sessions[0].as_path()), ("--clouds", own), ("--out", &page)];
        ends(&run(&["report", "--play"], &play), code, words);
    };
    all(0, &[]);
    std::fs::remove_file(map(own, "h0_up", 1)).expect("there");
    all(3, &["MISSING", "h0_up", "trigger 1"]);
    // Of another trigger, another camera, another session; and the right one under a name too many.
    for (from, words) in [
        (map(own, "h0_up", 2), ["trigger 2", "expected trigger 1"]),
        (map(own, "h0_low", 1), ["h0_up", "h0_low"]),
        (map(foreign, "h0_up", 1), ["of session", "expected session"]),
    ] {
        std::fs::copy(from, map(own, "h0_up", 1)).expect("writable");
        all(4, &words);
    }
    std::fs::write(map(own, "h0_up", 1), &whole).expect("writable");
    let twice = own.join("phases/h0_up_1.phase");
    std::fs::write(&twice, &whole).expect("writable");
    ends(&export(own, &place.path("twice"), &[]), 4, &["h0_up_1.phase", "h0_up_000001.phase"]);
    std::fs::remove_file(&twice).expect("there");
    all(0, &[]);
    // A summary of something else; one that says otherwise; none.
    let path = own.join("summary.json");
    let text = std::fs::read_to_string(&path).expect("a summary");
    std::fs::copy(foreign.join("summary.json"), &path).expect("writable");
    all(4, &["second", "first"]);
    let mut summary: Value = serde_json::from_str(&text).expect("JSON");
    let frame = &mut summary["triggers"][1]["frames"][0];
    frame["points"] = (frame["points"].as_u64().expect("points") - 1).into();
    std::fs::write(&path, summary.to_string()).expect("writable");
    all(4, &["summary.json states"]);
    summary = serde_json::from_str(&text).expect("JSON");
    summary["triggers"].as_array_mut().expect("triggers").remove(2);
    std::fs::write(&path, summary.to_string()).expect("writable");
    ends(&export(own, &place.path("unknown"), &["--to", "pcd"]), 3, &["LEFT OUT", "trigger 2"]);
    assert!(!place.path("unknown/merged/000002.pcd").exists());
    std::fs::remove_file(&path).expect("there");
    ends(
        &export(own, &place.path("unfinished"), &["--to", "pcd"]),
        3,
        &["summary.json", "not been finished"],
    );
    std::fs::write(&path, &text).expect("writable");
    // The same of stored clouds.
    for folder in ["clouds", "merged"] {
        std::fs::rename(own.join(format!("{folder}-aside")), own.join(folder)).expect("there");
    }
    let cloud = |result: &Path, name: &str| result.join(format!("clouds/h0_low_{name}.ply"));
    all_of_clouds(&place, own, 0, &[]);
    let aside = foreign.join("clouds-aside/h0_low_000001.ply");
    for (from, words) in [
        (cloud(own, "000002"), ["trigger 2", "expected trigger 1"]),
        (aside, ["of session", "expected session"]),
    ] {
        std::fs::copy(from, cloud(own, "000001")).expect("writable");
        all_of_clouds(&place, own, 4, &words);
    }
    let one = run(&["view"], &[("", &cloud(own, "000001")), ("--out", &place.path("picture.png"))]);
    ends(&one, 4, &["of session"]);
    std::fs::remove_file(cloud(own, "000001")).expect("there");
    all_of_clouds(&place, own, 3, &["MISSING", "h0_low", "trigger 1"]);
    // A merged cloud of another trigger.
    std::fs::copy(own.join("merged/000002.ply"), own.join("merged/000001.ply")).expect("writable");
    let merged = run(&["view", "--trigger", "1"], &[("", own), ("--out", &place.path("picture.png"))]);
    ends(&merged, 4, &["trigger 2", "expected trigger 1"]);
}

fn all_of_clouds(place: &Place, own: &Path, code: i32, words: &[&str]) {
    let out = place.path("pcd");
    let _ = std::fs::remove_dir_all(&out);
    ends(&export(own, &out, &["--to", "pcd"]), code, words);
}
