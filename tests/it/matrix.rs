// SPDX-License-Identifier: MIT OR Apache-2.0
//! Many cameras in many states: each table of a real camera, whatever its last user left, with stamps at different points of a
//! frame, is recorded right by the simulator's truth, or refused before the start by feature, value and remedy.
//!
//! `make matrix` runs all of it; without `FOURDBODY_MATRIX` a part is run.

mod bench;
mod published;

use crate::lab::{fourdbody, host, options, own_network, rig_of, say, start, start_nodes, text_of};
use crate::profiles::{Table, all_tables, tables};
use fourdbody::base::ids::{CameraId, TriggerIndex};
use fourdbody::camera::description::Description;
use fourdbody::camera::profile::Link;
use fourdbody::camera::{AravisCameras, CameraBackend, CameraError, Wishes};
use fourdbody::config::{CameraWords, Channel};
use fourdbody::data::FrameSource;
use fourdbody::record::{SETTING_CHANGED, SessionReader, UNCONFIRMED};
use fourdbody_simulator::gige::{
    CameraOptions, Exposures, Form, Habits, Make, Payload, SimulatedCamera, StampPoint, TestImages,
};
use fourdbody_simulator::images::ImageSource;
use fourdbody_simulator::laboratory::LaboratoryOptions;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Narrower sensors are not what any table allows.
const SIZE: (usize, usize) = (640, 400);
const RATE_HZ: f64 = 20.0;
const TRIGGERS: u64 = 16;
const EXPOSURE_US: f64 = 1000.0;
/// The cameras of the shipped rig, in its order.
pub const CAMERAS: [&str; 8] = ["h0_up", "h0_low", "h1_up", "h1_low", "h2_up", "h2_low", "h3_up", "h3_low"];

/// What a last user may have left, in the spellings of all tables; those that a camera has are set.
const LEFT_OVER: [(&str, &[(&str, &str)]); 14] = [
    ("nothing", &[]),
    ("automatic", &[("ExposureAuto", "Continuous"), ("GainAuto", "Continuous")]),
    ("curves", &[("GammaEnable", "true"), ("GammaEnabled", "true"), ("Gamma", "0.5"), ("LUTEnable", "true")]),
    ("mirrored", &[("ReverseX", "true"), ("ReverseY", "true")]),
    ("binned", &[("BinningHorizontal", "2"), ("DecimationVertical", "2"), ("BinningVertical", "X2")]),
    ("another trigger", &[("TriggerMode[AcquisitionStart]", "On"), ("TriggerMode[FrameBurstStart]", "On")]),
    ("one frame", &[("AcquisitionMode", "SingleFrame")]),
    ("exposed by the trigger", &[("ExposureMode", "TriggerWidth")]),
    (
        "paced",
        &[
            ("AcquisitionFrameRateEnable", "true"),
            ("AcquisitionFrameRateEnabled", "true"),
            ("AcquisitionFrameRate", "3.0"),
        ],
    ),
    ("chunks", &[("ChunkModeActive", "true")]),
    (
        "test image",
        &[
            ("TestImageSelector", "Testimage1"),
            ("TestImageSelector", "TestImage1"),
            ("TestImageSelector", "GreyVerticalRamp"),
            ("TestPattern", "Testimage1"),
            ("TestPattern", "GreyHorizontalRamp"),
            ("TestPattern", "Increment"),
        ],
    ),
    (
        "sequence",
        &[
            ("SequencerMode", "On"),
            ("SequenceEnable", "true"),
            ("BoSequencerEnable", "On"),
            ("SeqEnable", "true"),
        ],
    ),
    ("amplified", &[("Gain", "12"), ("GainRaw", "45")]),
    ("delayed", &[("TriggerDelay", "9000.0"), ("TriggerDelayAbs", "9000.0")]),
];

/// Where in a frame the stamp is taken, up to more than half a period after the trigger.
fn stamps() -> [(&'static str, Habits); 4] {
    let ms = Duration::from_millis;
    let stamp = |stamp| Habits { stamp, ..Habits::default() };
    [
        ("stamped at the start", stamp(StampPoint::ExposureStart)),
        ("stamped at the end", stamp(StampPoint::ExposureEnd)),
        ("stamped at the readout", Habits { readout_late: ms(12), ..stamp(StampPoint::ReadoutStart) }),
        ("stamped late", Habits { send_late: ms(27), ..stamp(StampPoint::LeaderSent) }),
    ]
}

/// What became of a case.
#[derive(Debug, Clone, PartialEq)]
enum End {
    Right,
    Refused(String),
    /// Refused without feature, value or remedy.
    Unclear(String),
    /// The product panicked, or its node did not come to an end.
    Crashed(String),
    /// Frames are missing, and the recording says which and why.
    Told(String),
    SilentlyWrong(String),
}

#[derive(Clone)]
struct Case {
    name: String,
    make: Option<Arc<Make>>,
    line: String,
    habits: Habits,
}

/// What a node file says that is wired as the camera can be.
fn wishes(line: Option<&str>) -> Wishes {
    Wishes {
        words: CameraWords { trigger_line: line.map(str::to_owned), ..CameraWords::default() },
        raw: Vec::new(),
        exposure_us: EXPOSURE_US,
        size: SIZE,
        channel: Channel::G,
        triggered: true,
        action: None,
        link: Link { cameras: 1, packet_bytes: 9000, period_ns: 50_000_000 },
    }
}

/// The entry of `TriggerSource` that the simulator's wire is put to.
fn line_of(table: &Table) -> String {
    let entries = table.feature("TriggerSource").map_or_else(Vec::new, |source| source.entries);
    let first = |is: &dyn Fn(&str) -> bool| entries.iter().find(|entry| is(entry)).cloned();
    first(&|entry| entry == "Line0")
        .or_else(|| first(&|entry| entry == "Line1"))
        .or_else(|| first(&|entry| entry.starts_with("Line") || entry.starts_with("Ext")))
        .unwrap_or_else(|| "auto".to_owned())
}

/// A copy of a table whose camera has no settings of delivery to go back to.
pub fn without_user_sets(file: &Path, dir: &Path) -> PathBuf {
    let text = std::fs::read_to_string(file).expect("readable");
    let mut table: Value = serde_json::from_str(&text).expect("JSON");
    let features = table["features"].as_object_mut().expect("features");
    features.retain(|name, _| !name.starts_with("UserSet"));
    let copy = dir.join(file.file_name().expect("a name"));
    std::fs::write(&copy, table.to_string()).expect("writable");
    copy
}

/// The tables of cameras of GigE Vision; the simulator speaks nothing else.
fn gige_tables() -> Vec<PathBuf> {
    let Some(tables) = all_tables() else { return Vec::new() };
    let mut names: Vec<PathBuf> =
        std::fs::read_dir(tables).expect("a folder").map(|entry| entry.expect("an entry").path()).collect();
    let is_one = |path: &PathBuf| {
        let text = std::fs::read_to_string(path).expect("readable");
        let table: Value = serde_json::from_str(&text).expect("JSON");
        table["features"].as_object().is_some_and(|all| all.keys().any(|name| name.starts_with("Gev")))
    };
    names.retain(|path| path.extension().is_some_and(|extension| extension == "json") && is_one(path));
    names.sort();
    names
}

/// A part of the tables, as `FOURDBODY_MATRIX_TABLES` says: `even`, `odd` (by place), or parts of names with commas between.
fn chosen(names: Vec<PathBuf>) -> Vec<PathBuf> {
    let said = std::env::var("FOURDBODY_MATRIX_TABLES").unwrap_or_default();
    let is_chosen = |place: usize, path: &Path| match said.as_str() {
        "" => true,
        "even" => place.is_multiple_of(2),
        "odd" => !place.is_multiple_of(2),
        parts => {
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            parts.split(',').any(|part| name.contains(part))
        }
    };
    names
        .into_iter()
        .enumerate()
        .filter(|(place, path)| is_chosen(*place, path))
        .map(|(_, path)| path)
        .collect()
}

fn cases(dir: &Path, whole: bool) -> Vec<Case> {
    let names = chosen(gige_tables());
    let mut cases = Vec::new();
    for (place, file) in names.iter().enumerate() {
        let name = file.file_stem().expect("a name").to_string_lossy().into_owned();
        let line = line_of(&Table::read(file));
        let bare = without_user_sets(file, dir);
        for (number, (left, features)) in LEFT_OVER.iter().enumerate() {
            for (file, how) in [(file, ""), (&bare, ", no user sets")] {
                let mut make = Make::load(file).expect("a table");
                let mut left_any = features.is_empty();
                for (feature, value) in *features {
                    if let Ok(changed) = Make::load(file).expect("a table").left_over(feature, value) {
                        drop(changed);
                        make = make.left_over(feature, value).expect("as just tried");
                        left_any = true;
                    }
                }
                // Without anything left there is nothing to go back from, and a part is a part.
                let part = whole
                    || (number + place).is_multiple_of(LEFT_OVER.len())
                        && (number % 2 == 0) == how.is_empty();
                if !left_any || !part {
                    continue;
                }
                let (stamp, habits) = stamps()[(number + place) % 4];
                cases.push(Case {
                    name: format!("{name}, {left} left{how}, {stamp}"),
                    make: Some(Arc::new(make)),
                    line: line.clone(),
                    habits,
                });
            }
        }
        // One new camera of each is set up and records, whatever else is left out.
        let of_new = stamps().into_iter().enumerate().filter(|(at, _)| whole || *at == place % 4);
        for (_, (stamp, habits)) in of_new {
            let make = Some(Arc::new(Make::load(file).expect("a table")));
            cases.push(Case { name: format!("{name}, new, {stamp}"), make, line: line.clone(), habits });
        }
    }
    cases
}

/// Cameras that are slow, or take other exposures than asked.
fn slow_and_stepped() -> Vec<Case> {
    let Some(tables) = tables() else { return Vec::new() };
    let us = Duration::from_micros;
    let habits = [
        ("slow", Habits { command_ms: 400, answer_late_ms: 15, ..Habits::default() }),
        ("ticks of 16 ns", Habits { tick_ns: 16, ..Habits::default() }),
        ("ids of 64 bits", Habits { extended_ids: true, ..Habits::default() }),
        ("exposures in steps", Habits { exposure_step: us(35), ..Habits::default() }),
        (
            "exposures in steps, read back as asked",
            Habits { exposure_step: us(16), exposures: Exposures::Asked, ..Habits::default() },
        ),
        (
            "exposures in steps beyond the tolerance",
            Habits { exposure_step: us(300), exposures: Exposures::Clamped, ..Habits::default() },
        ),
    ];
    let makes = [("basler_aca1920_25gm", "Line1"), ("flir_bfs_pge_88s6m", "Line0")];
    let of = |(name, line): (&str, &str)| {
        let make = Arc::new(Make::load(&tables.join(format!("{name}.json"))).expect("a table"));
        habits.map(|(habit, habits)| Case {
            name: format!("{name}, {habit}"),
            make: Some(Arc::clone(&make)),
            line: line.to_owned(),
            habits,
        })
    };
    makes.into_iter().flat_map(of).collect()
}

/// Frames that are something else than a session records, by what the camera says of itself or only by what it sends.
fn variants() -> Vec<Case> {
    const MONO16: u32 = 0x0110_0007;
    let plain = Form::default();
    let forms = [
        ("Mono16", Form { format: MONO16, told: MONO16, ..plain }),
        ("Mono16 in the leader", Form { told: MONO16, ..plain }),
        ("padded rows", Form { padding: 4, ..plain }),
        ("chunks", Form { appended: 16, payload: Payload::ImageWithChunks, ..plain }),
        ("bytes appended", Form { appended: 16, ..plain }),
        ("short packets", Form { short: 4, ..plain }),
    ];
    let case =
        |name: &str, habits| Case { name: name.to_owned(), make: None, line: "Line0".to_owned(), habits };
    // No feature says that packets are shorter than asked.
    let said = forms[..forms.len() - 1]
        .iter()
        .map(|(name, form)| case(&format!("{name}, said"), Habits { power_on: *form, ..Habits::default() }));
    let sent = forms.iter().map(|(name, form)| {
        case(&format!("{name}, sent"), Habits { frames: Some((4, *form)), ..Habits::default() })
    });
    said.chain(sent).collect()
}

/// Whether a camera can be set up alone; else why not, in the node's own words.
fn set_up_alone(case: &Case, address: Ipv4Addr) -> Result<(), String> {
    let images = Arc::new(TestImages::new(SIZE.0, SIZE.1, 1, 8));
    let mut camera = CameraOptions::new("MATRIX", address, images as Arc<dyn ImageSource>);
    camera.make = case.make.clone();
    camera.habits = Habits { nominal: Some(Duration::from_micros(EXPOSURE_US as u64)), ..case.habits };
    let simulated = SimulatedCamera::start(camera).expect("its address is free");
    let wishes = wishes(Some(&case.line));
    let mut opened = AravisCameras.open(&address.to_string()).map_err(|error| error.to_string())?;
    let outcome = match opened.set_up(&wishes) {
        Ok(_) => Ok(()),
        Err(CameraError::SetUp { problems }) => Err(problems.join("\n")),
        Err(error) => panic!("{}: {error}", case.name),
    };
    drop(opened);
    drop(simulated);
    outcome
}

/// Whether a refusal names a feature, says what was found or asked, and what to do.
fn is_helpful(refusal: &str) -> bool {
    let remedies = ["say ", "set ", "use ", "switch ", "correct", "change ", "have the", "look ", "rig file"];
    let found = [
        "expected",
        "is not an entry of",
        "requested",
        "no feature",
        "has no",
        "nearest",
        "not available",
        "several",
    ];
    let has = |line: &str, words: &[&str]| words.iter().any(|word| line.contains(word));
    refusal.lines().all(|line| has(line, &remedies) && has(line, &found))
}

/// How far an image is from the one of this camera and instant, with the brightness that fits it best.
fn distance(image: &[u8], of: &[u8]) -> (f64, f64) {
    let (mut cross, mut square) = (0.0, 0.0);
    for (a, b) in image.iter().zip(of) {
        cross += f64::from(*a) * f64::from(*b);
        square += f64::from(*b) * f64::from(*b);
    }
    let level = cross / square.max(1.0);
    let off: f64 =
        image.iter().zip(of).map(|(a, b)| (f64::from(*a) - (f64::from(*b) * level).min(255.0)).abs()).sum();
    (off / image.len() as f64, level)
}

/// What is wrong with the frames of a camera, by the simulator's truth; and its gaps, by cause.
pub fn judge(
    session: &SessionReader,
    camera: &CameraId,
    number: u32,
    size: (usize, usize),
) -> (Option<String>, Vec<String>) {
    let truth = TestImages::new(size.0, size.1, number, TestImages::DISTINCT);
    let mut gaps = Vec::new();
    for trigger in session.triggers() {
        let frame = match session.recorded_frame(camera, TriggerIndex(trigger)).expect("intact") {
            Ok(frame) => frame,
            Err(cause) => {
                gaps.push(format!("{trigger} {cause}"));
                continue;
            }
        };
        let near = |k: i64| distance(frame.image.as_slice(), truth.pixels(trigger as i64 + k));
        let (off, level) = near(0);
        let nearest = (-2..=2).min_by(|a, b| near(*a).0.total_cmp(&near(*b).0)).unwrap_or(0);
        // Within the tolerance of an exposure, which is told.
        if off > 2.0 || nearest != 0 || !(0.97..1.03).contains(&level) {
            return (
                Some(format!("trigger {trigger}: off by {off:.1}, level {level:.3}, like {nearest:+}")),
                gaps,
            );
        }
    }
    (None, gaps)
}

/// Whether the recording itself says that a camera's frames rest on one witness, or that its settings changed.
fn in_doubt(session: &SessionReader, camera: &CameraId) -> bool {
    let mut events = session.recordings().iter().flat_map(|recording| &recording.events);
    events.any(|event| {
        [UNCONFIRMED, SETTING_CHANGED].contains(&event.kind.as_str()) && event.camera.as_ref() == Some(camera)
    })
}

/// Sessions of eight cameras each.
fn record(group: &[Case], dir: &Path) -> Vec<End> {
    let of = |place: usize| group.get(place);
    let named = CAMERAS.iter().enumerate();
    let options = LaboratoryOptions {
        makes: named
            .clone()
            .filter_map(|(place, id)| Some(((*id).to_owned(), of(place)?.make.clone()?)))
            .collect(),
        habits: named.filter_map(|(place, id)| Some(((*id).to_owned(), of(place)?.habits))).collect(),
        make_words: false,
        ..options(rig_of(RATE_HZ, SIZE), dir)
    };
    let laboratory = start(&options, SIZE);
    for (place, case) in group.iter().enumerate() {
        let file = &laboratory.nodes[place / 4].path;
        say(file, CAMERAS[place], &format!("trigger_line = {:?}", case.line));
        say(file, CAMERAS[place], &format!("exposure_us = {EXPOSURE_US:?}"));
    }
    let mut nodes = start_nodes(&laboratory);
    let triggers = TRIGGERS.to_string();
    let captured =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", "matrix"]);
    let text = text_of(&captured);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let session = dir.join("sessions/matrix");
    let Ok(reader) = SessionReader::open(&session) else {
        let names: Vec<&str> = group.iter().map(|case| case.name.as_str()).collect();
        println!("{names:?}: {text}");
        return group
            .iter()
            .enumerate()
            .map(|(place, _)| match text.contains(&format!("camera {}: ", CAMERAS[place])) {
                true => End::Refused(text.clone()),
                false => End::Told(format!("another camera of the session was refused: {text}")),
            })
            .collect();
    };
    let ends = group.iter().zip(1..).zip(reader.cameras()).map(|((_, number), camera)| {
        match judge(&reader, camera, number, SIZE) {
            (Some(wrong), _) => End::SilentlyWrong(wrong),
            (None, gaps) if !gaps.is_empty() => End::Told(gaps.join(", ")),
            (None, _) if in_doubt(&reader, camera) => End::Told("in doubt".to_owned()),
            (None, _) => End::Right,
        }
    });
    ends.collect()
}

/// Where `make matrix` wants its figures.
fn summary() -> Option<PathBuf> {
    std::env::var_os("FOURDBODY_MATRIX").map(PathBuf::from)
}

/// How many cases had which end.
fn figures(ends: &[(String, End)], judged_by_another: usize) -> Value {
    let count = |is: fn(&End) -> bool| ends.iter().filter(|(_, end)| is(end)).count();
    json!({
        "cases": ends.len(),
        "complete_and_right": count(|end| *end == End::Right),
        "refused": count(|end| matches!(end, End::Refused(_))),
        "told_gaps": count(|end| matches!(end, End::Told(_))),
        "silently_wrong": count(|end| matches!(end, End::SilentlyWrong(_))),
        "unclear": count(|end| matches!(end, End::Unclear(_))),
        "crashes": count(|end| matches!(end, End::Crashed(_))),
        "judged_by_another": judged_by_another,
    })
}

/// Adds the figures of one part to the summary, and writes down what became of each of its cases.
fn write_summary(part: &str, ends: &[(String, End)], figures: &Value) {
    static PARTS: Mutex<BTreeMap<String, Value>> = Mutex::new(BTreeMap::new());
    let Some(summary) = summary() else { return };
    let dir = summary.parent().expect("a folder");
    std::fs::create_dir_all(dir).expect("writable");
    let lines: String = ends.iter().map(|(name, end)| format!("{name}\t{end:?}\n")).collect();
    std::fs::write(dir.join(format!("{part}.txt")), lines).expect("writable");
    let mut parts = PARTS.lock().expect("no part fails while it writes");
    parts.insert(part.to_owned(), figures.clone());
    let mut whole = json!({
        "commit": commit(), "seed": 0,
        "machine": format!("{}, {} cores", std::env::consts::ARCH, std::thread::available_parallelism().map_or(0, usize::from)),
    });
    for (key, _) in figures.as_object().into_iter().flatten() {
        let sum: u64 = parts.values().filter_map(|part| part[key].as_u64()).sum();
        whole[key] = json!(sum);
    }
    whole["parts"] = json!(*parts);
    std::fs::write(&summary, format!("{whole:#}\n")).expect("writable");
}

fn commit() -> String {
    let asked = std::process::Command::new("git").args(["rev-parse", "HEAD"]).output();
    asked.map(|out| String::from_utf8_lossy(&out.stdout).trim().to_owned()).unwrap_or_default()
}

#[test]
fn no_camera_is_silently_wrong() {
    let whole = summary().is_some();
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut all = cases(dir.path(), whole);
    if all.is_empty() {
        return;
    }
    all.extend(slow_and_stepped());
    all.extend(variants());
    let mut ends: BTreeMap<String, End> = BTreeMap::new();
    let mut accepted = Vec::new();
    let network = own_network();
    // Most of the time a camera is waited for.
    for (group, cases) in all.chunks(4).enumerate() {
        let set_up = |(place, case)| {
            let number = (group * 4 + place) % 248;
            set_up_alone(case, host(network, 1 + number as u8))
        };
        let outcomes: Vec<Result<(), String>> = std::thread::scope(|scope| {
            let threads: Vec<_> =
                cases.iter().enumerate().map(|each| scope.spawn(move || set_up(each))).collect();
            threads.into_iter().map(|thread| thread.join().expect("set up or refused")).collect()
        });
        for (case, outcome) in cases.iter().zip(outcomes) {
            match outcome {
                Ok(()) => accepted.push(case.clone()),
                Err(refusal) => {
                    assert!(is_helpful(&refusal), "{}: {refusal}", case.name);
                    println!("{}: refused: {refusal}", case.name);
                    ends.insert(case.name.clone(), End::Refused(refusal));
                }
            }
        }
    }
    println!("{} cases, {} of them refused when set up", all.len(), ends.len());
    for (number, group) in accepted.chunks(8).enumerate() {
        let dir = dir.path().join(format!("session-{number}"));
        for (case, end) in group.iter().zip(record(group, &dir)) {
            println!("{}: {end:?}", case.name);
            ends.insert(case.name.clone(), end);
        }
        drop(std::fs::remove_dir_all(&dir));
    }
    let ends: Vec<(String, End)> = ends.into_iter().collect();
    let figures = figures(&ends, 0);
    println!("{figures:#}");
    write_summary("tables", &ends, &figures);
    let bad: Vec<String> = ends
        .iter()
        .filter(|(_, end)| matches!(end, End::SilentlyWrong(_)))
        .map(|(name, end)| format!("{name}: {end:?}"))
        .collect();
    assert!(bad.is_empty(), "{}", bad.join("\n"));
    // Frames that are not what their camera says are gaps. A stamp that is taken when a busy host sends is as unsteady as the
    // host, and what it leaves in doubt is given up. Nothing else may lose a frame.
    let lost: Vec<&String> = ends
        .iter()
        .filter(|(name, end)| match end {
            End::Told(gaps) => {
                let doubt =
                    gaps.split(", ").all(|gap| gap.ends_with("identity_mismatch") || gap == "in doubt");
                !(name.ends_with(", sent") || doubt && name.contains("stamped late"))
            }
            _ => false,
        })
        .map(|(name, _)| name)
        .collect();
    assert!(lost.is_empty(), "{lost:?}");
    assert_eq!(ends.len(), all.len());
}
