// SPDX-License-Identifier: MIT OR Apache-2.0
//! `verify` on both nodes' recordings together: pairs that do not belong together are told apart, each by its own words.

use crate::lab::fourdbody;
use crate::recording::{begin, end, frame, header, options, trigger};
use fourdbody::base::ids::{NodeId, TriggerIndex};
use fourdbody::data::FrameSource;
use fourdbody::record::verify::{Report, Severity, verify};
use fourdbody::record::{GapCause, Recording, RecordingHeader, SessionReader, TriggerRecord, node_dir};
use std::path::Path;

const TRIGGERS: u64 = 24;

fn record(dir: &Path, header: RecordingHeader, triggers: u64, row: impl Fn(u64) -> Option<TriggerRecord>) {
    let mut recording = Recording::create(dir, header.clone(), options(1 << 30)).expect("created");
    begin(&mut recording, &header);
    for index in 0..triggers {
        if let Some(row) = row(index) {
            recording.trigger(&row).expect("recorded");
        }
        for (number, camera) in header.cameras.iter().enumerate() {
            let (meta, message) = frame(camera.id.as_str(), number, index);
            recording.frame(number, &meta, &message).expect("recorded");
        }
    }
    recording.finish(end(triggers)).expect("finished");
}

fn node_a(session: &Path) {
    let path = node_dir(session, &NodeId::from("a"));
    record(&path, header("a", &["h0_up", "h0_low"], Some(TRIGGERS)), TRIGGERS, |n| Some(trigger(n)));
}

fn header_b() -> RecordingHeader {
    header("b", &["h2_up", "h2_low"], Some(TRIGGERS))
}

/// A session with a good node a, and a node b that is made like this.
fn with_b(make_b: impl Fn(&Path)) -> Report {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    node_a(&session);
    make_b(&node_dir(&session, &NodeId::from("b")));
    verify(&session, &|_, _| ()).expect("readable")
}

fn texts(report: &Report) -> String {
    report.findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

#[test]
fn a_pair_that_belongs_together_agrees_in_so_many_words() {
    let report = with_b(|path| record(path, header_b(), TRIGGERS, |n| Some(trigger(n))));
    assert_eq!((report.worst, texts(&report).as_str()), (None, ""));
    let [compared] = report.compared.as_slice() else { panic!("{report:#?}") };
    assert!(compared.agree);
    assert_eq!((compared.table_rows, compared.rows_that_differ), (TRIGGERS, 0));
    assert_eq!(
        compared.to_string(),
        "nodes a and b agree: session 5f0c, 24 triggers, 24 rows of the HSU's table are equal"
    );
}

/// Each of these makes a pair wrong in one way, and the finding says which.
#[test]
fn every_mismatch_has_a_finding_of_its_own() {
    type Change = fn(&mut RecordingHeader);
    let changes: [(Change, &str); 7] = [
        (|h| h.session_id = "another".to_owned(), "the session's id is another, but 5f0c on node a"),
        (|h| h.session = "walk-02".into(), "the session's name is walk-02, but walk-01 on node a"),
        (|h| h.trigger_rate_hz = 60.0, "the trigger rate is 60, but 120 on node a"),
        (|h| h.expected_triggers = None, "the number of triggers requested is until stop, but 24 on node a"),
        (
            |h| h.hsu.as_mut().expect("an HSU").uid = "hsu-2".to_owned(),
            "the HSU is hsu-2, but hsu-1 on node a",
        ),
        (|h| h.rig_text.push_str("# edited\n"), "its rig file differs from that of node a"),
        (|h| h.cameras[1].id = "h0_low".into(), "camera h0_low: is recorded on node a as well"),
    ];
    for (change, expected) in changes {
        let mut header = header_b();
        change(&mut header);
        let report = with_b(|path| record(path, header.clone(), TRIGGERS, |n| Some(trigger(n))));
        let text = texts(&report);
        assert_eq!(report.worst, Some(Severity::Corrupt), "{expected}: {text}");
        assert!(
            text.contains(&format!("corrupt: node b: {expected}"))
                || text.contains(&format!("corrupt: node b {expected}")),
            "{expected:?} missing in\n{text}"
        );
        assert!(!report.compared[0].agree, "{expected}");
        // What is wrong by itself (a rate that is not the table's, a camera of the other node) is found as well.
        let names_a = |message: &str| message.contains("on node a") || message.contains("of node a");
        let against_a = report.findings.iter().filter(|f| names_a(&f.message)).count();
        assert_eq!(against_a, 1, "{expected}: {text}");
    }
}

#[test]
fn trigger_counts_and_tables_that_differ_are_named_with_their_triggers() {
    let one_more = with_b(|path| {
        let mut header = header_b();
        header.expected_triggers = Some(TRIGGERS);
        record(path, header, TRIGGERS + 1, |n| Some(trigger(n)));
    });
    let text = texts(&one_more);
    assert!(text.contains("the number of triggers is 25, but 24 on node a"), "{text}");
    assert!(text.contains("the HSU's trigger count is 25, but 24 on node a"), "{text}");

    // Frame k of node b is the instant k + 1 of node a: each node by itself is consistent.
    let shifted = with_b(|path| {
        record(path, header_b(), TRIGGERS, |n| {
            Some(TriggerRecord { index: trigger(n).index, ..trigger(n + 1) })
        });
    });
    assert_eq!(shifted.compared[0].rows_that_differ, TRIGGERS);
    assert!(
        texts(&shifted).contains("triggers 0 to 23: 24 triggers have another HSU time"),
        "{}",
        texts(&shifted)
    );

    let one_row = with_b(|path| {
        record(path, header_b(), TRIGGERS, |n| {
            Some(TriggerRecord { hsu_time_ns: trigger(n).hsu_time_ns + u64::from(n == 7), ..trigger(n) })
        });
    });
    let text = texts(&one_row);
    assert!(text.contains("corrupt: node b trigger 7: 1 triggers have another HSU time"), "{text}");

    let flags = with_b(|path| {
        record(path, header_b(), TRIGGERS, |n| {
            Some(TriggerRecord { flags: u32::from(n == 3), ..trigger(n) })
        });
    });
    assert!(
        texts(&flags).contains("node b trigger 3:") && texts(&flags).contains("flags 0x1"),
        "{}",
        texts(&flags)
    );

    // A row that one node has not heard is loss; the rest still agrees.
    let lost = with_b(|path| record(path, header_b(), TRIGGERS, |n| (n != 9).then(|| trigger(n))));
    assert_eq!((lost.worst, lost.compared[0].agree), (Some(Severity::Loss), true));
    assert_eq!(lost.compared[0].table_rows, TRIGGERS - 1);
    assert!(
        texts(&lost).contains("loss: node b trigger 9: no row in the HSU's trigger table"),
        "{}",
        texts(&lost)
    );
}

#[test]
fn a_recording_in_the_other_nodes_directory_and_one_that_cannot_be_read_are_named() {
    let report = with_b(|path| {
        record(path, header("a", &["h0_up", "h0_low"], Some(TRIGGERS)), TRIGGERS, |n| Some(trigger(n)));
    });
    let text = texts(&report);
    assert_eq!(report.worst, Some(Severity::Corrupt));
    assert!(text.contains("its recording lies in the directory of node b"), "{text}");
    assert!(text.contains("camera h0_up: is recorded on node a as well"), "{text}");

    let report = with_b(|path| {
        std::fs::create_dir(path).expect("a new directory");
        std::fs::write(path.join("segment-000.mcap"), b"no recording at all").expect("written");
    });
    let text = texts(&report);
    assert_eq!((report.worst, report.recordings.len()), (Some(Severity::Corrupt), 1), "{text}");
    assert!(text.contains("corrupt: node b:") && text.contains("no segment has a readable header"), "{text}");
    assert!(!text.contains("its recording is not here"), "{text}");
}

/// A session in which these nodes ended as told: (name, cameras, triggers, the HSU's count, why it was broken off).
type Ending<'a> = (&'a str, [&'a str; 2], u64, Option<u64>, Option<&'a str>);

fn ended(endings: [Ending<'_>; 2]) -> (Report, tempfile::TempDir) {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    for (node, cameras, triggers, counted, reason) in endings {
        let header = header(node, &cameras, Some(TRIGGERS));
        let path = node_dir(&session, &NodeId::from(node));
        let mut recording = Recording::create(&path, header.clone(), options(1 << 30)).expect("created");
        begin(&mut recording, &header);
        for index in 0..triggers {
            recording.trigger(&trigger(index)).expect("recorded");
            for (number, camera) in cameras.iter().enumerate() {
                let (meta, message) = frame(camera, number, index);
                recording.frame(number, &meta, &message).expect("recorded");
            }
        }
        let mut end = end(triggers);
        (end.triggers_emitted, end.aborted) = (counted, reason.map(str::to_owned));
        recording.finish(end).expect("finished");
    }
    (verify(&session, &|_, _| ()).expect("readable"), dir)
}

const A: [&str; 2] = ["h0_up", "h0_low"];
const B: [&str; 2] = ["h2_up", "h2_low"];

/// A node that lost its link for good knows neither how many triggers there were nor that there were more than it heard
/// of. It says that it was broken off, and the other node knows the rest.
#[test]
fn a_node_broken_off_without_the_count_is_loss_whichever_it_is() {
    let all = (TRIGGERS, Some(TRIGGERS), None);
    let short = (18, None, Some("the link to the HSU is lost"));
    let node = |name, cameras, (triggers, counted, reason)| (name, cameras, triggers, counted, reason);
    for ((report, dir), lost, whole, triggers) in [
        (ended([node("a", A, all), node("b", B, short)]), "b", "a", [TRIGGERS, 18]),
        (ended([node("a", A, short), node("b", B, all)]), "a", "b", [18, TRIGGERS]),
    ] {
        let text = texts(&report);
        assert_eq!(report.worst, Some(Severity::Loss), "{text}");
        let expected = format!(
            "loss: node {lost} triggers 18 to 23: no outcomes: it was aborted and does not have the HSU's count (the link to \
             the HSU is lost); node {whole} has 24 triggers"
        );
        assert!(text.contains(&expected), "{expected:?} missing in\n{text}");
        assert_eq!((report.compared[0].agree, report.compared[0].triggers), (true, triggers));
        let [on_a, on_b] = triggers;
        let said = report.compared[0].to_string();
        assert!(said.contains(&format!("{on_a} triggers on node a and {on_b} on node b, 18 rows")), "{said}");
        // To readers the session is as long as the whole recording, and the short one's outcomes say why.
        let reader = SessionReader::open(&dir.path().join("walk-01")).expect("readable");
        assert_eq!(reader.triggers(), 0..TRIGGERS);
        let outcome = |camera: &str, index| {
            let outcome = reader.recorded_frame(&camera.into(), TriggerIndex(index)).expect("an outcome");
            outcome.map(|_| ())
        };
        let (of_lost, of_whole) = if lost == "a" { (A, B) } else { (B, A) };
        assert_eq!((outcome(of_lost[0], 17), outcome(of_whole[0], 18)), (Ok(()), Ok(())));
        assert_eq!(outcome(of_lost[1], 18), Err(GapCause::Aborted));
    }
}

/// The same numbers, but nothing that says why: one of the two is wrong.
#[test]
fn fewer_triggers_without_a_reason_or_against_the_count_are_corrupt() {
    let reason = Some("the link to the HSU is lost");
    let all = ("a", A, TRIGGERS, Some(TRIGGERS), None);
    for (other, what) in [
        (("b", B, 18, None, None), "nobody broke it off"),
        (("b", B, 18, Some(18), reason), "the HSU told it another count"),
        (("b", B, TRIGGERS + 2, None, reason), "it has more than the HSU counted"),
    ] {
        let (report, _dir) = ended([all, other]);
        assert_eq!(report.worst, Some(Severity::Corrupt), "{what}: {}", texts(&report));
        assert!(!report.compared[0].agree, "{what}");
    }
}

/// Each PC's part was copied to a place of its own.
#[test]
fn nodes_at_two_paths_are_compared_as_well() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| dir.path().join(name);
    node_a(&path("pc-a"));
    record(&path("pc-b/node-b"), header_b(), TRIGGERS, |n| Some(trigger(n)));
    let mut other = header_b();
    other.session_id = "another".to_owned();
    record(&path("pc-c/node-b"), other, TRIGGERS, |n| Some(trigger(n)));
    let mut elsewhere = header_b();
    (elsewhere.session_id, elsewhere.session) = ("third".to_owned(), "walk-09".into());
    record(&path("pc-d/node-b"), elsewhere, TRIGGERS, |n| Some(trigger(n)));
    let run = |b: &str| {
        let [a, b] = [path("pc-a/node-a"), path(b)].map(|path| path.display().to_string());
        let output = fourdbody(&["verify", &a, &b]);
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let (code, text) = run("pc-b/node-b");
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("nodes a and b agree: session 5f0c"), "{text}");
    let (code, text) = run("pc-c/node-b");
    assert_eq!(code, Some(4), "{text}");
    assert!(
        text.contains("corrupt: node b: the session's id is another") && text.contains("do NOT agree"),
        "{text}"
    );
    let (code, text) = run("pc-d/node-b");
    assert_eq!(code, Some(0), "two sessions are verified one by one: {text}");
    assert!(!text.contains("agree:"), "{text}");
}
