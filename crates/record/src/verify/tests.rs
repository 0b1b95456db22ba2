// SPDX-License-Identifier: MIT OR Apache-2.0
//! A model of honest sessions, and of forged ones in which every checksum is right.

use super::{Finding, Report, Severity, verify};
use crate::base::ids::{CameraId, TriggerIndex};
use crate::layout::{ACTIONS_AT_ONCE, GapCause, NodeEvent, PTP_STATUS, WarmUp};
use crate::simultaneous::TriggerRow;
use crate::verdict::Status;
use forge::{Forge, Forgery, all};
use take::{Happens, PERIOD, Take};

mod forge;
mod take;

/// A directory in memory where there is one: hundreds of recordings that are synced take their time on a disk.
fn quick_dir() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a temporary directory")
}

fn verified(takes: &[&Take]) -> Report {
    let dir = quick_dir();
    let session = dir.path().join("walk");
    takes.iter().for_each(|take| take.write(&session));
    verify(&session, &|_, _| ()).expect("readable")
}

fn text(report: &Report) -> String {
    report.findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

/// Whatever honest devices and a busy host do, nothing of it contradicts itself.
#[test]
fn honest_recordings_are_good() {
    use Happens::*;
    let period = PERIOD;
    // With what is expected at worst. A camera without stamps may lose its count, or the rhythm of its warm-up.
    let kinds: [(Happens, Option<Severity>); 31] = [
        (Nothing, None),
        (Pauses(30), Some(Severity::Unconfirmed)),
        (Pauses(300), Some(Severity::Unconfirmed)),
        (PausesOfEach(300), Some(Severity::Unconfirmed)),
        (Batches(5), Some(Severity::Unconfirmed)),
        (Batches(9), Some(Severity::Unconfirmed)),
        (Late, None),
        (ReportsHeldUp(400), None),
        (Endless, None),
        (BeforeRecord(40), None),
        (BeforeRecord(2_000), None),
        (StampWrong(60_000_000), None),
        (StampWrong(period), None),
        (StampWrong(-period), None),
        (StampAbsent, None),
        (ClockSet(period), None),
        (ClockSet(-period), None),
        (ClockSet(3 * period), None),
        (ClockSet(7_000_000_000), None),
        (ClockSet(-1_700_000), None),
        (Lost, Some(Severity::Loss)),
        (Ignored, Some(Severity::Loss)),
        (GivenUp, Some(Severity::Loss)),
        (Away, Some(Severity::Loss)),
        (RowsLost, Some(Severity::Loss)),
        (MissesFirst, Some(Severity::Loss)),
        (WakesLate(3), None),
        (WakesLate(9), Some(Severity::Loss)),
        (EverySecond, Some(Severity::Loss)),
        (Extra, Some(Severity::Unconfirmed)),
        (IdJump, Some(Severity::Unconfirmed)),
    ];
    for seed in 0..3 {
        for (happens, worst) in kinds {
            let report = verified(&[&Take::honest(happens, seed)]);
            assert!(report.worst <= worst, "{happens:?}, seed {seed}: {:?}\n{}", report.worst, text(&report));
            // A host that stands still in the warm-up takes its rhythm from the one camera that arrivals alone place.
            if worst == Some(Severity::Unconfirmed) && !matches!(happens, Extra | IdJump) {
                let without_stamps =
                    |finding: &Finding| finding.camera.as_ref().is_some_and(|id| id.as_str() == "h1_up");
                assert!(
                    report.findings.iter().all(without_stamps),
                    "{happens:?}, seed {seed}: {}",
                    text(&report)
                );
            }
        }
        let report = verified(&[&Take::honest(IdRepeated, seed)]);
        assert!(report.worst < Some(Severity::Corrupt), "{seed}: {}", text(&report));
    }
}

/// A camera of the takes that gives no stamps.
const WITHOUT_STAMPS: &str = "h1_up";

/// Changes when frames of a camera's warm-up arrived, by their places among them.
fn rearrived(take: &mut Take, camera: &str, change: impl Fn(usize, &[u64]) -> u64) {
    let of = |event: &NodeEvent| {
        let camera = event.camera.as_ref().is_some_and(|id| id.as_str() == camera);
        WarmUp::of(event).filter(|sample| camera && matches!(sample, WarmUp::Frame { .. }))
    };
    let frames: Vec<(usize, WarmUp)> =
        (0..take.events.len()).filter_map(|place| Some((place, of(&take.events[place])?))).collect();
    let arrivals: Vec<u64> = frames
        .iter()
        .filter_map(|(_, frame)| match frame {
            WarmUp::Frame { host_time_ns, .. } => Some(*host_time_ns),
            _ => None,
        })
        .collect();
    for (number, (place, frame)) in frames.iter().enumerate() {
        let WarmUp::Frame { block, camera_time_ns, .. } = *frame else { continue };
        let host_time_ns = change(number, &arrivals);
        let event = &take.events[*place];
        take.events[*place] = WarmUp::Frame { block, camera_time_ns, host_time_ns }
            .event(event.camera.clone(), event.host_time_ns);
    }
}

/// The node found the rhythm in the first frames of a camera without stamps; then the host stood still.
#[test]
fn a_rhythm_that_was_found_stays_found() {
    let mut take = Take::honest(Happens::Nothing, 4);
    rearrived(&mut take, WITHOUT_STAMPS, |number, at| {
        at[number] + if number + 2 >= at.len() { 25_000_000 } else { 0 }
    });
    let report = verified(&[&take]);
    assert!(report.worst.is_none(), "{}", text(&report));
}

/// Two frames of a camera without stamps came at once: the first fits the trigger of the second.
#[test]
fn one_frame_that_was_held_up_with_the_next_hides_no_rhythm() {
    for held in 1..7 {
        let mut take = Take::honest(Happens::Nothing, 4);
        rearrived(&mut take, WITHOUT_STAMPS, |number, at| at[number + usize::from(number == held)]);
        let report = verified(&[&take]);
        assert!(report.worst.is_none(), "{held}: {}", text(&report));
    }
}

/// The node does not ask how many periods a host stood still before it took the frames of the warm-up, but how long.
#[test]
fn a_warm_up_that_is_taken_late_has_its_rhythm() {
    let mut take = Take::honest(Happens::Nothing, 4);
    rearrived(&mut take, "h0_up", |number, at| at[number] + 10 * PERIOD as u64);
    let report = verified(&[&take]);
    assert!(report.worst.is_none(), "{}", text(&report));
}

/// Each forgery of an honest recording contradicts something, and what is said names the camera and the triggers.
#[test]
fn no_forged_recording_is_good() {
    let (forgeries, mut passed) = (all(), Vec::new());
    println!("{} forgeries", forgeries.len());
    assert!(forgeries.len() >= 50);
    for (number, Forgery { what, of, forge, expected, camera, triggers }) in forgeries.into_iter().enumerate()
    {
        let mut take = Take::honest(of, number as u64);
        forge(&mut take);
        let report = verified(&[&take]);
        let named = report.findings.iter().any(|finding| {
            let at = camera.is_none() || finding.camera.as_ref().map(CameraId::as_str) == camera;
            let within = triggers.is_none_or(|(from, to)| {
                finding.triggers.is_some_and(|(first, last)| first <= to && last >= from)
            });
            finding.severity >= expected && at && within
        });
        if report.worst < Some(expected) || !named {
            passed.push(format!("{what}: {:?}\n{}", report.worst, text(&report)));
        }
    }
    assert!(passed.is_empty(), "{} forgeries were believed:\n{}", passed.len(), passed.join("\n\n"));
}

/// The nodes of a session against each other.
#[test]
fn two_nodes_hear_one_unit() {
    let node_b = |take: &Take| {
        let mut other = take.clone();
        other.header.node = "b".into();
        for (place, camera) in other.header.cameras.iter_mut().enumerate() {
            let name = format!("h{}_{}", 2 + place / 2, ["up", "low"][place % 2]);
            let old = std::mem::replace(&mut camera.id, CameraId(name));
            let own = |camera: &Option<CameraId>| camera.as_ref() == Some(&old);
            other
                .samples
                .iter_mut()
                .filter(|s| own(&s.camera))
                .for_each(|s| s.camera = Some(camera.id.clone()));
            other
                .events
                .iter_mut()
                .filter(|e| own(&e.camera))
                .for_each(|e| e.camera = Some(camera.id.clone()));
        }
        other
    };
    let honest = Take::honest(Happens::Nothing, 7);
    let b = node_b(&honest);
    let report = verified(&[&honest, &b]);
    assert_eq!(report.worst, None, "{}", text(&report));
    // A session of its own, half an hour later; the same session, of which everything stands a trigger later; another
    // warm-up.
    let other = node_b(&Take::honest(Happens::Nothing, 8));
    let mut later = b.clone();
    forge::half_an_hour(&mut later);
    let mut shifted = b.clone();
    forge::relabel_all(&mut shifted, 1);
    let mut warm_up = b;
    forge::each_warm_up_trigger(&mut warm_up, |ns| ns + 1_000_000);
    for (what, forged) in [("other", other), ("later", later), ("shifted", shifted), ("warm-up", warm_up)] {
        let report = verified(&[&honest, &forged]);
        assert_eq!(report.worst, Some(Severity::Corrupt), "{what}: {}", text(&report));
    }
}

/// What rests on one source is reported as unconfirmed, and is not called good.
#[test]
fn one_source_alone_is_not_enough() {
    let strip = |take: &mut Take, what: fn(&NodeEvent) -> bool| take.events.retain(|event| !what(event));
    let warm_up: fn(&NodeEvent) -> bool = |event| WarmUp::of(event).is_some();
    let frames: fn(&NodeEvent) -> bool = |event| matches!(WarmUp::of(event), Some(WarmUp::Frame { .. }));
    let forge: [(&str, Forge); 5] = [
        ("without a warm-up", Box::new(move |take| strip(take, warm_up))),
        ("without the warm-up's frames", Box::new(move |take| strip(take, frames))),
        (
            "without a warm-up and readings",
            Box::new(move |take| {
                strip(take, warm_up);
                take.samples.clear();
            }),
        ),
        ("without a trigger table", Box::new(|take| take.rows.clear())),
        ("without stamps", Box::new(|take| take.frames[0].values_mut().for_each(|seen| seen.camera_ns = 0))),
    ];
    for (what, forge) in forge {
        let mut take = Take::honest(Happens::Nothing, 3);
        forge(&mut take);
        let report = verified(&[&take]);
        assert!(report.is_unconfirmed(), "{what}: {}", text(&report));
        assert!(report.worst >= Some(Severity::Unconfirmed), "{what}: {}", text(&report));
    }
}

/// Exposures by actions that PTP schedules rest on PTP. Where it did not keep a camera's clock, camera and triggers are
/// named: by the node's event, or where that is not there, by the recorded statuses. Triggers by wire rest on no PTP.
#[test]
fn exposures_that_rest_on_no_ptp_are_named() {
    let of = |uid: &str, events: &[NodeEvent]| {
        let mut take = Take::honest(Happens::Nothing, 3);
        take.header.hsu.as_mut().expect("a unit").uid = uid.to_owned();
        let mut said = |row: Option<usize>, status: &str| {
            let at = row.map(|row| take.rows[row].host_time_ns + PERIOD.unsigned_abs() / 2);
            take.events.push(NodeEvent {
                host_time_ns: at.unwrap_or(take.rows[0].host_time_ns - 1_000_000_000),
                kind: PTP_STATUS.to_owned(),
                camera: Some("h0_up".into()),
                trigger: None,
                message: status.to_owned(),
            });
        };
        said(None, "Slave");
        said(Some(50), "Listening");
        said(Some(70), "Faulty");
        said(Some(100), "Slave");
        take.events.extend(events.iter().cloned());
        verified(&[&take])
    };
    let action = "action-commands.";
    let unnamed = of(action, &[]);
    let [finding] = &unnamed.findings[..] else { panic!("{}", text(&unnamed)) };
    assert_eq!(finding.severity, Severity::Unconfirmed);
    assert!(finding.to_string().contains("camera h0_up triggers 5"), "{finding}");
    let (first, last) = finding.triggers.expect("triggers");
    assert!((51..54).contains(&first) && (99..102).contains(&last), "{finding}");
    assert_eq!(of("0123456789abcdef", &[]).worst, None, "triggers by wire");
    let mut at_once = TriggerRow::all(0, 0).event("h0_up".into(), "", 0);
    at_once.kind = ACTIONS_AT_ONCE.to_owned();
    assert_eq!(of(action, &[at_once]).worst, None);

    // The node names them: then its verdict lists them, and `verify` finds the same in the files.
    let named = of(action, &[TriggerRow::all(49, 101).event("h0_up".into(), "PTP was Listening", 0)]);
    let [finding] = &named.findings[..] else { panic!("{}", text(&named)) };
    assert_eq!((finding.severity, finding.triggers), (Severity::Unconfirmed, Some((49, 101))));
    let verdict = &named.recordings[0].verdict;
    assert_eq!(verdict.not_simultaneous, ["h0_up, triggers 49 to 101: PTP was Listening"]);
    assert_eq!(verdict.status, Status::Unconfirmed);
}

/// Imported images have no clocks: what is said of them rests on their files' names, and no header makes images of
/// frames.
#[test]
fn imports_rest_on_names() {
    let mut take = Take::honest(Happens::Nothing, 5);
    take.header.hsu = None;
    let report = verified(&[&take]);
    assert_eq!(report.worst, Some(Severity::Corrupt), "{}", text(&report));
    (take.rows, take.samples, take.events) = (Vec::new(), Vec::new(), Vec::new());
    for (place, frames) in take.frames.iter_mut().enumerate() {
        frames.remove(&(100 + place as i64));
        take.gaps[place].insert(100 + place as i64, GapCause::NotRecorded);
    }
    let report = verified(&[&take]);
    assert!(report.imported && report.worst <= Some(Severity::Loss), "{}", text(&report));
    assert!(text(&report).contains("rests on their files' names alone"), "{}", text(&report));
}

/// Numbers that no recording has are named, and neither believed nor a reason to stop.
#[test]
fn absurd_numbers_are_named() {
    type Change = fn(&mut Take);
    let changes: [(&str, Change); 12] = [
        ("triggers per second", |take| take.header.trigger_rate_hz = 1e300),
        ("triggers per second", |take| take.header.trigger_rate_hz = -50.0),
        ("triggers per second", |take| take.header.trigger_rate_hz = 1e-300),
        ("created at", |take| take.header.created_ns = u64::MAX),
        ("trigger", |take| take.rows[17].hsu_time_ns = u64::MAX),
        ("trigger", |take| take.rows[17].host_time_ns = 0),
        ("trigger", |take| take.rows[17].index = TriggerIndex(u64::MAX)),
        ("h0_up", |take| take.frames[0].get_mut(&9).expect("a frame").block = u64::MAX),
        ("h0_up", |take| take.frames[0].get_mut(&9).expect("a frame").camera_ns = u64::MAX),
        ("h0_up", |take| take.frames[0].get_mut(&9).expect("a frame").host_ns = u64::MAX),
        ("clock", |take| take.samples[3].device_time_ns = u64::MAX),
        ("clock", |take| take.samples[3].host_receive_ns = 0),
    ];
    for (place, (expected, change)) in changes.into_iter().enumerate() {
        let mut take = Take::honest(Happens::Nothing, 11);
        change(&mut take);
        let report = verified(&[&take]);
        assert!(report.worst >= Some(Severity::Unconfirmed), "{place} {expected}: {}", text(&report));
        assert!(text(&report).contains(expected), "{place} {expected}: {}", text(&report));
    }
}
