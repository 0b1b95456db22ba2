// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras behind published descriptions: each is new, and left over by its last user in every way that it has; the product
//! sets it up through Aravis, and another implementation of GenICam says what was really set.
//!
//! `make matrix DESCRIPTIONS=DIR` runs all files of DIR; without it those in `tests/it/data/descriptions` are run, which are ours.

use super::bench::{Bench, Judged, Prepared, python};
use super::{CAMERAS, EXPOSURE_US, End, RATE_HZ, SIZE, TRIGGERS};
use super::{figures, in_doubt, is_helpful, judge, wishes, write_summary};
use crate::lab::{fourdbody, host, options, own_network, rig_of, say, start, start_nodes, text_of};
use fourdbody::camera::{AravisCameras, CameraBackend, CameraError, Wishes};
use fourdbody::config::{Mosaic, Pixel};
use fourdbody::data::FrameSource;
use fourdbody::record::SessionReader;
use fourdbody_simulator::gige::described::Word;
use fourdbody_simulator::gige::gvsp::{FORMATS, MONO8};
use fourdbody_simulator::gige::settings::{Edge, Settings, TriggerSource};
use fourdbody_simulator::gige::{CameraOptions, Described, SimulatedCamera, TestImages};
use fourdbody_simulator::images::ImageSource;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::Ipv4Addr;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The state of a camera that nobody has used.
const NEW: &str = "new";

/// A new one again, with what its refusal says is to be left to the camera's own settings.
const AS_ADVISED: &str = "new, as its refusal advises";

/// What became of one description in one state.
struct Case {
    description: String,
    state: String,
    make: String,
    end: End,
    judged: bool,
}

/// A selector changes no frame.
const SEEN_BY_NOBODY: &str = "another user set";

fn asked_for() -> Option<PathBuf> {
    std::env::var_os("FOURDBODY_DESCRIPTIONS").filter(|dir| !dir.is_empty()).map(PathBuf::from)
}

/// Whether the descriptions are ours.
fn is_own() -> bool {
    asked_for().is_none()
}

fn descriptions() -> Vec<PathBuf> {
    let own = || Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/data/descriptions");
    let dir = match asked_for() {
        Some(dir) => dir,
        None => {
            println!("skipped: published descriptions (make matrix DESCRIPTIONS=DIR); ours alone are run");
            own()
        }
    };
    let entries = std::fs::read_dir(&dir).unwrap_or_else(|error| panic!("{}: {error}", dir.display()));
    let mut files: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    let is_one = |path: &PathBuf| {
        path.extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("xml") || ending.eq_ignore_ascii_case("zip"))
    };
    files.retain(is_one);
    files.sort();
    assert!(!files.is_empty(), "{}: expected descriptions, *.xml or *.zip", dir.display());
    files
}

/// The text of a panic, for the report.
fn words_of(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().cloned();
    text.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned())).unwrap_or_default()
}

/// What a node does with a camera before a session.
#[derive(Clone, Copy)]
enum Step {
    SetUp,
    ReadState,
}

/// Does it over the network; else why that cannot be, in the node's own words.
fn do_alone(what: Step, described: &Arc<Described>, address: Ipv4Addr, wishes: &Wishes) -> Result<(), End> {
    let images = Arc::new(TestImages::new(SIZE.0, SIZE.1, 1, 8));
    let mut camera = CameraOptions::new("PUBLISHED", address, images as Arc<dyn ImageSource>);
    camera.described = Some(Arc::clone(described));
    let _simulated = SimulatedCamera::start(camera).expect("its address is free");
    let done = catch_unwind(|| {
        let mut opened = AravisCameras.open(&address.to_string())?;
        match what {
            Step::SetUp => opened.set_up(wishes).map(drop),
            Step::ReadState => opened.state().map(drop),
        }
    });
    match done {
        Ok(Ok(_)) => Ok(()),
        Ok(Err(CameraError::SetUp { problems })) => {
            let refusal = problems.join("\n");
            Err(if is_helpful(&refusal) { End::Refused(refusal) } else { End::Unclear(refusal) })
        }
        Ok(Err(error)) => Err(End::Unclear(error.to_string())),
        Err(panic) => Err(End::Crashed(words_of(&*panic))),
    }
}

fn run_state(
    bench: &mut Bench,
    described: &Arc<Described>,
    prepared: &Prepared,
    state: (&[Word], Option<&[Word]>),
    address: Ipv4Addr,
) -> (End, bool) {
    let (memory, delivered) = state;
    described.set(prepared.facts.clone(), memory.to_vec(), delivered.map(<[Word]>::to_vec));
    let line = prepared.line.as_deref();
    match do_alone(Step::SetUp, described, address, &wishes(line)) {
        Err(end) => (end, false),
        Ok(()) => match bench.judge(described, line, None) {
            Ok(judged) if judged.wrong.is_empty() => {
                assert!(judged.found.contains_key("triggers"), "it says what it found");
                (End::Right, true)
            }
            Ok(judged) => (End::SilentlyWrong(judged.wrong.join("; ")), true),
            Err(error) => (End::Unclear(error), false),
        },
    }
}

/// The word for a plane of colour, which is said and not left.
const PIXEL: &str = "pixel";

/// The words that a refusal leaves to the camera's own settings, or has said; `None` where it has another remedy beside.
fn advised(refusal: &str) -> Option<Vec<String>> {
    let word = |line: &str| {
        if line.contains("pixel = \"bayer8\"") {
            return Some(PIXEL.to_owned());
        }
        let (_, behind) = line.split_once("left_to_settings = [\"")?;
        Some(behind.split_once('"')?.0.to_owned())
    };
    refusal.lines().map(word).collect()
}

/// Sets up a new camera once more, as a refusal advises; the settings that it leaves to the camera are not made.
fn run_advised(
    bench: &mut Bench,
    described: &Arc<Described>,
    prepared: &Prepared,
    left: Vec<String>,
    address: Ipv4Addr,
) -> (End, bool) {
    let new = &prepared.memory;
    described.set(prepared.facts.clone(), new.clone(), Some(new.clone()));
    let line = prepared.line.as_deref();
    let mut wishes = wishes(line);
    if left.iter().any(|word| word == PIXEL) {
        wishes.words.pixel = Some(Pixel::Bayer8(Mosaic::default()));
        wishes.size = (SIZE.0 / 2, SIZE.1 / 2);
    }
    wishes.words.left_to_settings = left.iter().filter(|word| *word != PIXEL).cloned().collect();
    if let Err(end) = do_alone(Step::SetUp, described, address, &wishes) {
        return (end, false);
    }
    match bench.judge_beside(described, line, &left) {
        Ok(judged) if judged.wrong.is_empty() => (End::Right, true),
        Ok(judged) => (End::SilentlyWrong(judged.wrong.join("; ")), true),
        Err(error) => (End::Unclear(error), false),
    }
}

/// One that was set up right as a new one, and can record.
struct Ready {
    description: String,
    make: String,
    bench: Bench,
    described: Arc<Described>,
    prepared: Prepared,
}

/// Notes a case, and says what is not right.
fn note(cases: &mut Vec<Case>, description: &str, state: &str, make: &str, (end, judged): (End, bool)) {
    if end != End::Right {
        println!("{description}, {state}: {end:?}");
    }
    let (description, state, make) = (description.to_owned(), state.to_owned(), make.to_owned());
    cases.push(Case { description, state, make, end, judged });
}

fn run_description(python: &Path, file: &Path, address: Ipv4Addr, cases: &mut Vec<Case>) -> Option<Ready> {
    let description = file.file_name().expect("a name").to_string_lossy().into_owned();
    let (mut bench, prepared) = match Bench::open(python, file) {
        Ok(opened) => opened,
        Err(error) => {
            note(cases, &description, NEW, "no GenICam", (End::Unclear(error), false));
            return None;
        }
    };
    if prepared.about.kind == "other" {
        println!("skipped: {description} is neither of a GigE nor of a USB3 Vision camera");
        return None;
    }
    let vendor = prepared.about.vendor.as_deref().unwrap_or("?");
    let make = format!("{vendor} ({})", prepared.about.kind);
    let described = Arc::new(Described::load(file).expect("as just read"));
    let new = prepared.memory.as_slice();
    // Its own user set would bring back what was left: only the program can mend it.
    let left = prepared.left.iter().map(|left| (left.name.as_str(), (left.memory.as_slice(), None)));
    let all =
        prepared.left.last().map(|left| ("everything, and delivered", (left.memory.as_slice(), Some(new))));
    let mut is_ready = false;
    for (state, words) in [(NEW, (new, Some(new)))].into_iter().chain(left).chain(all) {
        let (end, judged) = run_state(&mut bench, &described, &prepared, words, address);
        is_ready |= state == NEW && end == End::Right;
        if state == NEW && is_own() {
            for left in prepared.left.iter().filter(|left| left.name != SEEN_BY_NOBODY) {
                let line = prepared.line.as_deref();
                let judged = bench.judge_after(&described, line, &left.name).expect("it reads");
                assert!(!judged.wrong.is_empty(), "{description}: the judge does not see {}", left.name);
            }
        }
        if state == NEW {
            let end = match do_alone(Step::ReadState, &described, address, &wishes(None)) {
                Ok(()) => End::Right,
                Err(end) => end,
            };
            // One that cannot be read cannot record.
            is_ready &= end == End::Right;
            note(cases, &description, "all its state", &make, (end, false));
        }
        if state == NEW
            && let End::Refused(refusal) = &end
            && let Some(left) = advised(refusal)
        {
            let end = run_advised(&mut bench, &described, &prepared, left, address);
            note(cases, &description, AS_ADVISED, &make, end);
        }
        note(cases, &description, state, &make, (end, judged));
    }
    is_ready.then_some(Ready { description, make, bench, described, prepared })
}

/// The form of its pixels.
fn format_of(judged: &Judged) -> Option<&str> {
    judged.found.get("PixelFormat").and_then(Value::as_str)
}

/// The way in which a camera takes frames whose registers say this.
fn working(judged: &Judged, line: Option<&str>) -> Settings {
    let number = |name: &str| judged.found.get(name).and_then(Value::as_f64);
    let size = |name: &str, otherwise: usize| number(name).map_or(otherwise as u32, |number| number as u32);
    let exposure_us = number("exposure_us").unwrap_or(EXPOSURE_US);
    let mut settings =
        Settings::new(size("Width", SIZE.0), size("Height", SIZE.1)).with_times(exposure_us, 100.0);
    let triggers = judged.found.get("triggers").and_then(Value::as_object);
    if let Some(trigger) = triggers.and_then(|on| on.values().next()) {
        settings.triggered = true;
        let source = trigger["TriggerSource"].as_str();
        settings.source = if source == line { TriggerSource::Line0 } else { TriggerSource::Software };
        let edge = trigger["TriggerActivation"].as_str().unwrap_or("RisingEdge");
        settings.edge = if edge.starts_with("Falling") { Edge::Falling } else { Edge::Rising };
    }
    let code = |(name, code): &(&str, u32)| (Some(*name) == format_of(judged)).then_some(*code);
    settings.pixel_format = FORMATS.iter().find_map(code).unwrap_or(MONO8);
    settings.picture.offset = (size("OffsetX", 0), size("OffsetY", 0));
    settings
}

/// A session of up to eight of them, that work as their registers say after a set-up alone.
fn record(group: &mut [Ready]) -> Vec<(End, bool)> {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut options = options(rig_of(RATE_HZ, SIZE), dir.path());
    let mut formats = Vec::new();
    for (number, ready) in (1..).zip(group.iter_mut()) {
        let Ready { bench, described, prepared, .. } = ready;
        let (new, line) = (&prepared.memory, prepared.line.as_deref());
        described.set(prepared.facts.clone(), new.clone(), Some(new.clone()));
        do_alone(Step::SetUp, described, host(options.first_address, 100 + number), &wishes(line))
            .map_err(|end| format!("{end:?}"))
            .expect("as it could be before");
        let judged = bench.judge(described, line, None).expect("as it could be before");
        described.set(prepared.facts.clone(), new.clone(), Some(new.clone()));
        described.work_as(working(&judged, line));
        formats.push(format_of(&judged).unwrap_or("Mono8").to_lowercase());
    }
    let named = || CAMERAS.iter().zip(group.iter());
    options.described = named().map(|(id, ready)| ((*id).to_owned(), Arc::clone(&ready.described))).collect();
    let laboratory = start(&options, SIZE);
    for (place, (id, ready)) in named().enumerate() {
        let file = &laboratory.nodes[place / 4].path;
        if let Some(line) = &ready.prepared.line {
            say(file, id, &format!("trigger_line = {line:?}"));
        }
        say(file, id, &format!("exposure_us = {EXPOSURE_US:?}"));
        say(file, id, &format!("pixel = {:?}", formats[place]));
    }
    let mut nodes = start_nodes(&laboratory);
    let triggers = TRIGGERS.to_string();
    let captured =
        fourdbody(&["capture", "--nodes", &laboratory.urls(), "--triggers", &triggers, "--name", "matrix"]);
    nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    let Ok(reader) = SessionReader::open(&dir.path().join("sessions/matrix")) else {
        let text = text_of(&captured);
        return group.iter().map(|_| (End::Told(format!("no session: {text}")), false)).collect();
    };
    let packet = Some(options.packet_bytes);
    let ends = group.iter_mut().zip(1..).zip(reader.cameras()).map(|((ready, number), camera)| {
        let after = ready.bench.judge(&ready.described, ready.prepared.line.as_deref(), packet);
        match (judge(&reader, camera, number, SIZE), after) {
            ((Some(wrong), _), _) => (End::SilentlyWrong(wrong), true),
            (_, Ok(after)) if !after.wrong.is_empty() => (End::SilentlyWrong(after.wrong.join("; ")), true),
            (_, Err(error)) => (End::Unclear(error), false),
            ((None, gaps), _) if !gaps.is_empty() => (End::Told(gaps.join(", ")), true),
            _ if in_doubt(&reader, camera) => (End::Told("in doubt".to_owned()), true),
            _ => (End::Right, true),
        }
    });
    ends.collect()
}

/// Descriptions by make, as new ones and in all states: right, refused by name, unclear, silently wrong.
fn table(cases: &[Case]) -> String {
    let mut makes: BTreeMap<&str, [[usize; 5]; 2]> = BTreeMap::new();
    for case in cases {
        let column = match case.end {
            End::Right => 0,
            End::Refused(_) | End::Told(_) => 1,
            End::Unclear(_) => 2,
            End::SilentlyWrong(_) => 3,
            End::Crashed(_) => 4,
        };
        let row = makes.entry(&case.make).or_default();
        row[1][column] += 1;
        if case.state == NEW {
            row[0][column] += 1;
        }
    }
    let mut text = String::from(
        "| make | descriptions | right | refused | unclear | wrong | crashed | states | right | refused | unclear | wrong | crashed |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for (make, [new, all]) in makes {
        let cells = |of: [usize; 5]| {
            format!(
                "{} | {} | {} | {} | {} | {}",
                of.iter().sum::<usize>(),
                of[0],
                of[1],
                of[2],
                of[3],
                of[4]
            )
        };
        let _ = writeln!(text, "| {make} | {} | {} |", cells(new), cells(all));
    }
    text
}

#[test]
fn published_descriptions_are_set_right_by_another_implementation() {
    let Some(python) = python() else { return };
    let mut cases = Vec::new();
    let network = own_network();
    let files: Vec<(u8, PathBuf)> = (0u8..240).cycle().zip(descriptions()).collect();
    for files in files.chunks(8) {
        let tried = files.iter().filter_map(|(number, file)| {
            run_description(&python, file, host(network, 1 + number), &mut cases)
        });
        let mut ready: Vec<Ready> = tried.collect();
        if ready.is_empty() {
            continue;
        }
        let recorded = catch_unwind(AssertUnwindSafe(|| record(&mut ready)));
        let crashed = |panic: Box<dyn std::any::Any + Send>| {
            let words: String = words_of(&*panic).chars().take(200).collect();
            ready.iter().map(|_| (End::Crashed(format!("one of a session: {words}")), false)).collect()
        };
        let ends: Vec<(End, bool)> = recorded.unwrap_or_else(crashed);
        for (Ready { description, make, .. }, (end, judged)) in ready.into_iter().zip(ends) {
            note(&mut cases, &description, "recorded", &make, (end, judged));
        }
    }
    let table = table(&cases);
    println!("{table}");
    let ends: Vec<(String, End)> = cases
        .iter()
        .map(|case| (format!("{}, {}", case.description, case.state), case.end.clone()))
        .collect();
    let judged = cases.iter().filter(|case| case.judged).count();
    let figures = figures(&ends, judged);
    println!("{figures:#}");
    write_summary("published", &ends, &figures);
    if let Some(summary) = super::summary() {
        std::fs::write(summary.with_file_name("makes.md"), &table).expect("writable");
    }
    let wrong: Vec<String> = ends
        .iter()
        .filter(|(_, end)| matches!(end, End::SilentlyWrong(_) | End::Crashed(_)))
        .map(|(name, end)| format!("{name}: {end:?}"))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    if is_own() {
        // Ours are made so that all is right.
        assert!(ends.iter().all(|(_, end)| *end == End::Right), "{ends:?}");
    }
}
