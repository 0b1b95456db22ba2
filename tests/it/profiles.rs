// SPDX-License-Identifier: MIT OR Apache-2.0
//! Node files' words in the features of real cameras: the tables of published descriptions in `../shared/data/cameras`.

use fourdbody::camera::description::{Access, Description, Feature, Kind};
use fourdbody::camera::profile::{Amount, Link, Plan, Wishes, must_be, resolve};
use fourdbody::config::{CameraWords, Channel};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A table of a published description.
pub struct Table(BTreeMap<String, Feature>);

impl Table {
    /// Reads a camera's table from its JSON file.
    pub fn read(path: &Path) -> Self {
        let text = std::fs::read_to_string(path).expect("readable");
        let table: Value = serde_json::from_str(&text).expect("JSON");
        let features = table["features"].as_object().expect("features");
        Self(features.iter().map(|(name, facts)| (name.clone(), feature(facts))).collect())
    }
}

fn feature(facts: &Value) -> Feature {
    let entries = facts["entries"].as_array().into_iter().flatten();
    Feature {
        kind: match facts["type"].as_str() {
            Some("integer") => Kind::Integer,
            Some("float") => Kind::Float,
            Some("boolean") => Kind::Boolean,
            Some("enumeration") => Kind::Enumeration,
            Some("command") => Kind::Command,
            Some("string") => Kind::Text,
            _ => Kind::Other,
        },
        access: match facts["access"].as_str() {
            Some("RO") => Access::Read,
            Some("WO") => Access::Write,
            _ => Access::ReadWrite,
        },
        unit: facts["unit"].as_str().map(str::to_owned),
        entries: entries.filter_map(|entry| entry.as_str().map(str::to_owned)).collect(),
    }
}

impl Description for Table {
    fn names(&self) -> Vec<String> {
        self.0.keys().cloned().collect()
    }

    fn feature(&self, name: &str) -> Option<Feature> {
        self.0.get(name).cloned()
    }
}

/// Where the tables are; `None` where they are not on this machine.
pub fn tables() -> Option<PathBuf> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/cameras");
    if dir.is_dir() {
        return Some(dir);
    }
    eprintln!("skipped: no tables of cameras in ../shared/data/cameras");
    None
}

/// The tables of more cameras, with what their registers share; else those that there are.
#[cfg(feature = "aravis")]
pub fn all_tables() -> Option<PathBuf> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/camera-tables");
    if dir.is_dir() { Some(dir) } else { tables() }
}

/// What the shipped node file says, with this trigger line.
pub fn wishes(line: &str) -> Wishes {
    Wishes {
        words: CameraWords { trigger_line: Some(line.to_owned()), ..CameraWords::default() },
        raw: Vec::new(),
        exposure_us: 1000.0,
        size: (1920, 1200),
        channel: Channel::G,
        triggered: true,
        action: None,
        link: Link { cameras: 1, packet_bytes: 9000, period_ns: 8_333_333 },
    }
}

fn short(plan: &Plan) -> Vec<String> {
    let amount = |amount: &Amount| match amount {
        Amount::Value(value) => value.to_string(),
        Amount::Near { wanted, unit, .. } => format!("{wanted}{unit}"),
        Amount::Least => "least".to_owned(),
    };
    plan.writes.iter().map(|write| format!("{}={}", write.feature, amount(&write.amount))).collect()
}

/// What becomes of a table: the writes that matter, or the features that keep the camera from being used.
enum Expected {
    Set(&'static [&'static str]),
    Refused(&'static [&'static str]),
}

use Expected::{Refused, Set};

/// Every table, with its trigger line.
const EXPECTED: [(&str, &str, Expected); 18] = [
    (
        "avt_gt1930",
        "Line1",
        Set(&["ExposureTimeAbs=1000us", "Gain=0dB", "TriggerSelector=FrameStart", "TriggerOverlap=ReadOut"]),
    ),
    (
        "avt_mako_g507b",
        "Line1",
        Set(&["ExposureTimeAbs=1000us", "Gain=0dB", "TriggerSource=Line1", "TriggerOverlap=ReadOut"]),
    ),
    (
        "basler_a2a2600_20gmbas",
        "Line1",
        Set(&["ExposureTime=1000us", "TriggerSelector=FrameStart", "TriggerSource=Line1"]),
    ),
    (
        "basler_aca1920_25gm",
        "Line1",
        Set(&[
            "ExposureTimeAbs=1000us",
            "GainRaw=least",
            "TriggerSelector=AcquisitionStart",
            "TriggerSelector=FrameStart",
        ]),
    ),
    (
        "basler_sca1400_30gm",
        "Line1",
        Set(&["ExposureTimeAbs=1000us", "GainRaw=least", "TriggerSelector=FrameStart"]),
    ),
    ("baumer_hxg20", "Line0", Set(&["ExposureTime=1000us", "Gain=0dB", "TriggerSource=Line0"])),
    ("flir_a35", "Line0", Refused(&["ExposureTime", "TriggerMode"])),
    (
        "flir_bfs_pge_88s6m",
        "Line0",
        Set(&["ExposureTime=1000us", "Gain=0dB", "TriggerSelector=FrameStart", "TriggerOverlap=ReadOut"]),
    ),
    (
        "flir_orx_10g_51s5m",
        "Line0",
        Set(&["ExposureTime=1000us", "TriggerSelector=FrameStart", "TriggerOverlap=ReadOut"]),
    ),
    (
        "hikrobot",
        "Line0",
        Set(&["ExposureTime=1000us", "Gain=0dB", "TriggerSelector=FrameStart", "OverlapMode=On"]),
    ),
    ("jai_rm_6740ge", "Line0", Refused(&["ExposureTime", "TriggerMode", "ExposureMode"])),
    (
        "pco1600",
        "ExtTrig",
        Set(&["TriggerSelector=ExposureStart", "TriggerSource=ExtTrig", "TriggerMode=On"]),
    ),
    ("pgr_flea3_ge_28s4c", "Line0", Set(&["ExposureTime=1000us", "Gain=0dB", "TriggerSource=Line0"])),
    (
        "pgr_gs3_pge_23s6c",
        "Line0",
        Set(&["ExposureTime=1000us", "TriggerSelector=FrameStart", "TriggerOverlap=ReadOut"]),
    ),
    ("sony_cvc_eh6300", "auto", Refused(&["PixelFormat", "ExposureTime"])),
    (
        "svs_evo4050",
        "auto",
        Set(&["ExposureTime=1000us", "TriggerSource=Line1", "TriggerSelector=FrameStart"]),
    ),
    (
        "tis_dmk_33gx174",
        "auto",
        Set(&["ExposureTime=1000us", "TriggerSource=Line1", "TriggerSelector=FrameStart"]),
    ),
    (
        "viewworks_vnp604",
        "Line0",
        Set(&["ExposureTime=1000us", "TriggerSelector=ExposureStart", "TriggerSource=Line0"]),
    ),
];

#[test]
fn every_table_is_resolved_or_refused_by_the_feature_that_it_lacks() {
    let Some(dir) = tables() else { return };
    let mut found: Vec<String> = std::fs::read_dir(&dir)
        .expect("a folder")
        .filter_map(|entry| entry.ok()?.file_name().to_str()?.strip_suffix(".json").map(str::to_owned))
        .collect();
    found.sort();
    assert_eq!(found, EXPECTED.map(|(name, ..)| name.to_owned()), "every table has an expectation");
    for (name, line, expected) in &EXPECTED {
        let table = Table::read(&dir.join(format!("{name}.json")));
        let plan = resolve(&table, &wishes(line));
        let (musts, must_troubles) = must_be(&table, &wishes(line));
        let refused: Vec<&str> =
            plan.troubles.iter().chain(&must_troubles).map(|trouble| trouble.feature.as_str()).collect();
        println!(
            "{name}: {:?}\n  {}",
            short(&plan),
            musts.iter().map(|m| m.feature.clone()).collect::<Vec<_>>().join(" ")
        );
        plan.troubles.iter().chain(&must_troubles).for_each(|trouble| println!("  {trouble}"));
        match expected {
            Set(writes) => {
                assert_eq!(refused, [""; 0], "{name}");
                let plan = short(&plan);
                for write in *writes {
                    assert!(plan.iter().any(|done| done == write), "{name}: {write} missing in {plan:?}");
                }
                assert_eq!(plan.last().map(String::as_str), Some("TriggerMode=On"), "{name}");
            }
            Refused(features) => assert_eq!(refused, *features, "{name}"),
        }
    }
}

#[test]
fn a_line_that_a_table_does_not_have_is_refused_with_those_that_it_has() {
    let Some(dir) = tables() else { return };
    let mut refused = Vec::new();
    for (name, ..) in &EXPECTED {
        let table = Table::read(&dir.join(format!("{name}.json")));
        let plan = resolve(&table, &wishes("Line0"));
        let of_line = plan.troubles.iter().find(|trouble| trouble.feature == "TriggerSource");
        if let Some(trouble) = of_line {
            refused.push(*name);
            println!("{name}: {trouble}");
            let has = table.feature("TriggerSource").map_or_else(Vec::new, |source| source.entries);
            let named = has.iter().take(4).all(|entry| trouble.message.contains(entry.as_str()));
            assert!(trouble.message.contains("Line0") && named, "{name}: {trouble}");
        }
    }
    assert_eq!(
        refused,
        [
            "avt_gt1930",
            "avt_mako_g507b",
            "basler_a2a2600_20gmbas",
            "basler_aca1920_25gm",
            "basler_sca1400_30gm",
            "pco1600",
            "sony_cvc_eh6300",
            "svs_evo4050",
            "tis_dmk_33gx174"
        ]
    );
}
