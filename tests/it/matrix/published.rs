// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras behind published descriptions: each is new, and left over by its last user in every way that it has; the product
//! sets it up through Aravis, and another implementation of GenICam says what was really set.
//!
//! `make matrix DESCRIPTIONS=DIR` runs all files of DIR; without it those in `tests/it/data/descriptions` are run, which are ours.

use super::bench::{Bench, Prepared, python};
use super::{EXPOSURE_US, End, SIZE, figures, is_helpful, write_summary};
use fourdbody::camera::profile::Link;
use fourdbody::camera::{AravisCameras, CameraBackend, CameraError, Wishes};
use fourdbody::config::CameraWords;
use fourdbody_simulator::gige::described::Word;
use fourdbody_simulator::gige::{CameraOptions, Described, SimulatedCamera, TestImages};
use fourdbody_simulator::images::ImageSource;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What became of one description in one state.
struct Case {
    description: String,
    state: String,
    make: String,
    end: End,
    judged: bool,
}

fn descriptions() -> Vec<PathBuf> {
    let own = || Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/data/descriptions");
    let dir = match std::env::var_os("FOURDBODY_DESCRIPTIONS").filter(|dir| !dir.is_empty()) {
        Some(dir) => PathBuf::from(dir),
        None => {
            println!("skipped: published descriptions (make matrix DESCRIPTIONS=DIR); ours alone are run");
            own()
        }
    };
    let entries = std::fs::read_dir(&dir).unwrap_or_else(|error| panic!("{}: {error}", dir.display()));
    let mut files: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    let is_one = |path: &PathBuf| {
        path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("xml") || ending.eq_ignore_ascii_case("zip"))
    };
    files.retain(is_one);
    files.sort();
    assert!(!files.is_empty(), "{}: expected descriptions, *.xml or *.zip", dir.display());
    files
}

/// What a node file says that is wired as the camera can be.
fn wishes(line: Option<&str>) -> Wishes {
    Wishes {
        words: CameraWords { trigger_line: line.map(str::to_owned), ..CameraWords::default() },
        raw: Vec::new(),
        exposure_us: EXPOSURE_US,
        size: SIZE,
        triggered: true,
        action: None,
        link: Link { cameras: 1, packet_bytes: 9000, period_ns: 50_000_000 },
    }
}

/// Sets the camera up over the network; else why that cannot be, in the node's own words.
fn set_up(described: &Arc<Described>, address: Ipv4Addr, line: Option<&str>) -> Result<(), String> {
    let images = Arc::new(TestImages::new(SIZE.0, SIZE.1, 1, 8));
    let mut camera = CameraOptions::new("PUBLISHED", address, images as Arc<dyn ImageSource>);
    camera.described = Some(Arc::clone(described));
    let simulated = SimulatedCamera::start(camera).expect("its address is free");
    let mut opened = AravisCameras.open(&address.to_string()).map_err(|error| error.to_string())?;
    let outcome = match opened.set_up(&wishes(line)) {
        Ok(_) => Ok(()),
        Err(CameraError::SetUp { problems }) => Err(problems.join("\n")),
        Err(error) => Err(error.to_string()),
    };
    drop(opened);
    drop(simulated);
    outcome
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
    match set_up(described, address, line) {
        Err(refusal) if is_helpful(&refusal) => (End::Refused(refusal), false),
        Err(refusal) => (End::Unclear(refusal), false),
        Ok(()) => match bench.judge(described, line) {
            Ok(judged) if judged.wrong.is_empty() => {
                assert!(judged.found.contains_key("triggers"), "it says what it found");
                (End::Right, true)
            }
            Ok(judged) => (End::SilentlyWrong(judged.wrong.join("; ")), true),
            Err(error) => (End::Unclear(error), false),
        },
    }
}

fn run_description(python: &Path, file: &Path, number: u8, cases: &mut Vec<Case>) {
    let description = file.file_name().expect("a name").to_string_lossy().into_owned();
    let (mut bench, prepared) = match Bench::open(python, file) {
        Ok(opened) => opened,
        Err(error) => {
            let (make, state) = ("no GenICam".to_owned(), "new".to_owned());
            return cases.push(Case { description, state, make, end: End::Unclear(error), judged: false });
        }
    };
    let vendor = prepared.about.vendor.as_deref().unwrap_or("?");
    let make = format!("{vendor} ({})", prepared.about.kind);
    let described = Arc::new(Described::load(file).expect("as just read"));
    let new = prepared.memory.as_slice();
    // Its own user set would bring back what was left: only the program can mend it.
    let left = prepared.left.iter().map(|left| (left.name.as_str(), (left.memory.as_slice(), None)));
    let all = prepared.left.last().map(|left| ("everything, and delivered", (left.memory.as_slice(), Some(new))));
    for (state, words) in [("new", (new, Some(new)))].into_iter().chain(left).chain(all) {
        let address = Ipv4Addr::new(127, 0, 229, 1 + number);
        let (end, judged) = run_state(&mut bench, &described, &prepared, words, address);
        if end != End::Right {
            println!("{description}, {state}: {end:?}");
        }
        cases.push(Case {
            description: description.clone(),
            state: state.to_owned(),
            make: make.clone(),
            end,
            judged,
        });
    }
}

/// Descriptions by make, as new ones and in all states: right, refused by name, unclear, silently wrong.
fn table(cases: &[Case]) -> String {
    let mut makes: BTreeMap<&str, [[usize; 4]; 2]> = BTreeMap::new();
    for case in cases {
        let column = match case.end {
            End::Right => 0,
            End::Refused(_) | End::Told(_) => 1,
            End::Unclear(_) => 2,
            End::SilentlyWrong(_) => 3,
        };
        let row = makes.entry(&case.make).or_default();
        row[1][column] += 1;
        if case.state == "new" {
            row[0][column] += 1;
        }
    }
    let mut text = String::from("| make | descriptions | right | refused | unclear | wrong | states | right | refused | unclear | wrong |\n|---|---|---|---|---|---|---|---|---|---|---|\n");
    for (make, [new, all]) in makes {
        let cells = |of: [usize; 4]| format!("{} | {} | {} | {} | {}", of.iter().sum::<usize>(), of[0], of[1], of[2], of[3]);
        let _ = writeln!(text, "| {make} | {} | {} |", cells(new), cells(all));
    }
    text
}

#[test]
fn published_descriptions_are_set_right_by_another_implementation() {
    let Some(python) = python() else { return };
    let mut cases = Vec::new();
    for (number, file) in (0u8..=250).cycle().zip(descriptions()) {
        run_description(&python, &file, number % 250, &mut cases);
    }
    let table = table(&cases);
    println!("{table}");
    let ends: Vec<(String, End)> =
        cases.iter().map(|case| (format!("{}, {}", case.description, case.state), case.end.clone())).collect();
    let judged = cases.iter().filter(|case| case.judged).count();
    let figures = figures(&ends, judged);
    println!("{figures:#}");
    write_summary("published", &ends, &figures);
    if let Some(summary) = super::summary() {
        std::fs::write(summary.with_file_name("makes.md"), &table).expect("writable");
    }
    let wrong: Vec<String> = ends
        .iter()
        .filter(|(_, end)| matches!(end, End::SilentlyWrong(_)))
        .map(|(name, end)| format!("{name}: {end:?}"))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    if std::env::var_os("FOURDBODY_DESCRIPTIONS").is_none_or(|dir| dir.is_empty()) {
        // Ours are made so that all is right.
        assert!(ends.iter().all(|(_, end)| *end == End::Right), "{ends:?}");
    }
}
