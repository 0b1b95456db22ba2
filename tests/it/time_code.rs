// SPDX-License-Identifier: MIT OR Apache-2.0
//! Linear time code on an input of the HSU: it begins in the middle of a session, jumps and stops, and every trigger has the
//! code that was played then, or none.

use crate::lab::{self, assert_contains, fourdbody, text_of};
use fourdbody::base::ids::TriggerIndex;
use fourdbody::export::inputs;
use fourdbody::record::{HeardTimeCode, SessionReader};
use fourdbody_simulator::hsu::LtcSource;
use fourdbody_simulator::laboratory::{Laboratory, LaboratoryOptions};
use hsu_firmware_proto::TimeCode;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const RATE_HZ: f64 = 40.0;
const TRIGGERS: u64 = 240;

fn source(text: &str) -> LtcSource {
    text.parse().expect("a source")
}

fn laboratory(dir: &Path, ltc: Option<LtcSource>) -> Laboratory {
    let options = lab::options(lab::small_rig(RATE_HZ), dir);
    lab::start_laboratory(&LaboratoryOptions { time_code_input: Some(3), ltc, ..options })
}

/// The `time_code` of each trigger, as `export --to csv` has it.
fn exported(session: &Path, out: &Path) -> BTreeMap<u64, String> {
    let (session, out) = (session.display().to_string(), out.display().to_string());
    let exported = fourdbody(&["export", &session, "--to", "csv", "--out", &out]);
    assert!(exported.status.success(), "{}", text_of(&exported));
    let table = std::fs::read_to_string(Path::new(&out).join("timing.csv")).expect("a table");
    let mut lines = table.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = lines.next().expect("a header");
    let place = header.iter().position(|name| *name == "time_code").expect("the column");
    let mut codes = BTreeMap::new();
    for row in lines {
        assert_eq!(row.len(), header.len());
        let code = codes.entry(row[0].parse().expect("a trigger")).or_insert_with(|| row[place].to_owned());
        assert_eq!(code, row[place], "all cameras of a trigger have the same");
    }
    codes
}

/// How far what was exported is after the truth, frames.
fn frames_off(exported: &str, (code, fraction): (TimeCode, f64), per_second: u8) -> f64 {
    let (found, thousandths) = exported.split_once('.').expect("a fraction");
    let found = TimeCode::parse(found).expect("a code");
    let thousandths: f64 = thousandths.parse().expect("a number");
    let ahead = f64::from(code.until(found, per_second).expect("of the rate"));
    let behind = f64::from(found.until(code, per_second).expect("of the rate"));
    // The cut of the last digit is no error.
    let whole = if ahead <= behind { ahead } else { -behind };
    whole + thousandths / 1000.0 + 0.0005 - fraction
}

#[test]
fn every_trigger_has_the_code_that_was_played_or_none() {
    let dir = tempfile::tempdir().expect("a directory");
    let laboratory = laboratory(dir.path(), None);
    let mut nodes = lab::start_nodes(&laboratory);
    let capture = Command::new(lab::FOURDBODY)
        .args(["capture", "--nodes", &laboratory.urls(), "--name", "scored", "--json"])
        .args(["--triggers", &TRIGGERS.to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .expect("it starts");
    let hsu = &laboratory.hsu;
    let warm_up = |fired: u64| fired.saturating_sub(hsu.fired());
    let deadline = Instant::now() + Duration::from_secs(90);
    let wait_for = |fired: u64| {
        while warm_up(fired) > 0 {
            assert!(Instant::now() < deadline, "the train stands still");
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    wait_for(60);
    hsu.play(Some(source("3:09:59:58:20@25")));
    hsu.input(5, true);
    wait_for(150);
    hsu.play(Some(source("3:23:59:59:10@25")));
    wait_for(220);
    hsu.play(None);
    let captured = capture.wait_with_output().expect("it ends");
    assert!(captured.status.success(), "{}", text_of(&captured));

    let session = dir.path().join("sessions/scored");
    assert_eq!(fourdbody(&["verify", &session.display().to_string()]).status.code(), Some(0));
    let reader = SessionReader::open(&session).expect("a session");
    let edges: Vec<u8> = inputs::edges(&reader).values().map(|edge| edge.line).collect();
    assert_eq!(edges, [5], "the edges of time code are not told");
    for recording in reader.recordings() {
        let heard = recording.events.iter().filter_map(HeardTimeCode::of).count();
        // The first and the last of each piece, and one a second.
        assert!((4..=4 + 8).contains(&heard), "{heard}");
    }

    let codes = exported(&session, &dir.path().join("table"));
    assert_eq!(codes.len() as u64, TRIGGERS);
    let (mut with, mut without, mut around) = (0, 0, 0);
    for (&trigger, code) in &codes {
        let time_ns = reader.recordings()[0].triggers[&TriggerIndex(trigger)].hsu_time_ns;
        let Some(truth) = hsu.time_code_at(time_ns) else {
            assert_eq!(code, "", "trigger {trigger}: nothing was played");
            without += 1;
            continue;
        };
        if code.is_empty() {
            // The first frame of each piece teaches where the next begins; the last is cut.
            let frame_ns = 40_000_000;
            let played =
                [time_ns.saturating_sub(2 * frame_ns), time_ns + frame_ns].map(|at| hsu.time_code_at(at));
            let follows = |codes: [Option<(TimeCode, f64)>; 2]| {
                let [Some((before, _)), Some((after, _))] = codes else { return false };
                before.until(after, 25) == Some(3)
            };
            assert!(!follows(played), "trigger {trigger} has no code, and {truth:?} was played");
            around += 1;
            continue;
        }
        let off = frames_off(code, truth, 25);
        assert!(off.abs() < 0.002, "trigger {trigger}: {code}, and {truth:?} was played");
        with += 1;
    }
    assert!(with > 120 && without > 50 && around < 20, "{with} with, {without} without, {around} around");
    let said = text_of(&fourdbody(&["info", &session.display().to_string()]));
    assert_contains(&said, &["time code   09:59:5", "in 2 pieces; ", "triggers have one"]);
    let page = dir.path().join("page.html").display().to_string();
    fourdbody(&["report", &session.display().to_string(), "--out", &page]);
    assert_contains(&std::fs::read_to_string(page).expect("a page"), &["<dt>time code</dt><dd>09:59:5"]);

    // A session in silence says so, and a session that time code would start is refused.
    let next = ["capture", "--nodes", &laboratory.urls(), "--triggers", "5", "--name"];
    let silent = lab::capture_whole(&laboratory, "silent", 5, &[]);
    assert!(silent.status.success(), "{}", text_of(&silent));
    assert_contains(&text_of(&silent), &["no time code came on input 3"]);
    let status = fourdbody(&["status", "--nodes", &laboratory.urls()]);
    assert_contains(&text_of(&status), &["no time code came on input 3"]);
    let reader = SessionReader::open(&dir.path().join("sessions/silent")).expect("a session");
    for recording in reader.recordings() {
        let told: Vec<&str> = recording
            .events
            .iter()
            .filter(|event| event.kind.starts_with("time_code"))
            .map(|event| event.message.as_str())
            .collect();
        assert_eq!(told, ["no time code came on input 3"]);
    }
    let refused = fourdbody(&[&next[..], &["refused", "--start-on", "3"]].concat());
    assert!(!refused.status.success());
    assert_contains(&text_of(&refused), &["input 3 carries time code"]);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
}

#[test]
fn nodes_that_name_different_inputs_are_told_and_the_session_has_one_of_them() {
    let dir = tempfile::tempdir().expect("a directory");
    // 29.97 frames a second, at the minute where two numbers are left out.
    let laboratory = laboratory(dir.path(), Some(source("3:17:58:58;00@29.97")));
    let other = &laboratory.nodes[1].path;
    let text = std::fs::read_to_string(other).expect("a node file");
    std::fs::write(other, text.replace("time_code_input = 3", "time_code_input = 8")).expect("writable");
    let checked = fourdbody(&["check-config", &other.display().to_string()]);
    assert_eq!(checked.status.code(), Some(2));
    assert_contains(&text_of(&checked), &["hsu.time_code_input", "0 to 7"]);
    std::fs::write(other, text.replace("time_code_input = 3", "time_code_input = 4")).expect("writable");

    let _nodes = lab::start_nodes(&laboratory);
    let captured = lab::capture_whole(&laboratory, "both", 80, &[]);
    assert!(captured.status.success(), "{}", text_of(&captured));
    let session = dir.path().join("sessions/both");
    let reader = SessionReader::open(&session).expect("a session");
    let absent =
        reader.recordings().iter().flat_map(|recording| &recording.events).filter(|event| {
            event.kind == "time_code_absent" && event.message.contains("give both node files")
        });
    assert_eq!(absent.count(), 1);
    // Whoever came first was heard.
    let heard = reader.recordings()[0].events.iter().any(|event| HeardTimeCode::of(event).is_some());
    let codes = exported(&session, &dir.path().join("table"));
    // A busy node hears of the first code when triggers have fired: these have none.
    let mut known = 0;
    for (trigger, code) in &codes {
        if !heard || code.is_empty() && known == 0 {
            assert_eq!(code, "");
            continue;
        }
        known += 1;
        let time_ns = reader.recordings()[0].triggers[&TriggerIndex(*trigger)].hsu_time_ns;
        let truth = laboratory.hsu.time_code_at(time_ns).expect("it was played all the time");
        assert!(frames_off(code, truth, 30).abs() < 0.002, "trigger {trigger}: {code}, {truth:?} was played");
    }
    assert!(!heard || known >= codes.len() / 2, "{known} of {} triggers have a code", codes.len());
}
