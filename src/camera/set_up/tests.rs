// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera made up of features with values, locks and habits, set up as a node file says.

use super::{SetUp, changed, set_up};
use crate::camera::CameraError;
use crate::camera::description::{Access, Bounds, Description, Feature, Kind};
use crate::camera::features::{Failed, Features};
use crate::camera::profile::Wishes;
use crate::camera::profile::tests::{Made, made, wishes};
use crate::config::{FeatureSetting, FeatureValue};
use std::cell::RefCell;
use std::collections::BTreeMap;

/// A camera that keeps what is written; triggers are kept behind their selector.
struct Fake {
    made: Made,
    values: RefCell<BTreeMap<String, FeatureValue>>,
    /// What it has after its settings of delivery were loaded.
    delivery: BTreeMap<String, FeatureValue>,
    /// Exposures are whole multiples of this.
    line_us: f64,
    /// What it refuses.
    stubborn: Vec<&'static str>,
}

const DEVICE: &str = "PixelFormat=Mono8,Mono12 Width:int Height:int OffsetX:int OffsetY:int PayloadSize:int!ro \
                      ExposureTime:float:us Gain:float:dB ExposureAuto=Off,Continuous GammaEnable:bool ReverseX:bool \
                      AcquisitionMode=Continuous,SingleFrame TriggerMode=Off,On TriggerSource=Line1,Line2,Software \
                      TriggerActivation=RisingEdge,FallingEdge TriggerSelector=AcquisitionStart,FrameStart \
                      UserSetSelector=Default,UserSet1 UserSetLoad:cmd";

fn text(value: &str) -> FeatureValue {
    FeatureValue::Text(value.to_owned())
}

impl Fake {
    fn new() -> Self {
        let values = [
            ("PixelFormat", text("Mono12")),
            ("Width", FeatureValue::Integer(640)),
            ("Height", FeatureValue::Integer(480)),
            ("OffsetX", FeatureValue::Integer(8)),
            ("OffsetY", FeatureValue::Integer(0)),
            ("ExposureTime", FeatureValue::Float(20_000.0)),
            ("Gain", FeatureValue::Float(12.0)),
            ("ExposureAuto", text("Continuous")),
            ("GammaEnable", FeatureValue::Flag(true)),
            ("ReverseX", FeatureValue::Flag(true)),
            ("AcquisitionMode", text("SingleFrame")),
            ("TriggerSelector", text("AcquisitionStart")),
            ("TriggerMode@AcquisitionStart", text("On")),
            ("TriggerMode@FrameStart", text("Off")),
            ("TriggerSource@AcquisitionStart", text("Software")),
            ("TriggerSource@FrameStart", text("Software")),
            ("TriggerActivation@AcquisitionStart", text("RisingEdge")),
            ("TriggerActivation@FrameStart", text("FallingEdge")),
            ("UserSetSelector", text("UserSet1")),
        ];
        let values: BTreeMap<String, FeatureValue> =
            values.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        Self {
            made: made(DEVICE),
            delivery: BTreeMap::new(),
            values: RefCell::new(values),
            line_us: 0.0,
            stubborn: Vec::new(),
        }
    }

    fn key(&self, feature: &str) -> String {
        let behind = ["TriggerMode", "TriggerSource", "TriggerActivation"].contains(&feature);
        match self.values.borrow().get("TriggerSelector") {
            Some(selected) if behind => format!("{feature}@{selected}"),
            _ => feature.to_owned(),
        }
    }

    fn has_now(&self, feature: &str) -> FeatureValue {
        self.read(feature).expect("readable")
    }
}

impl Description for Fake {
    fn names(&self) -> Vec<String> {
        self.made.names()
    }

    fn feature(&self, name: &str) -> Option<Feature> {
        self.made.feature(name)
    }
}

impl Features for Fake {
    fn has(&self, feature: &str) -> bool {
        self.made.0.contains_key(feature)
    }

    fn is_available(&self, feature: &str) -> bool {
        self.has(feature)
    }

    fn read(&self, feature: &str) -> Result<FeatureValue, Failed> {
        let number = |name| match self.values.borrow().get(name) {
            Some(FeatureValue::Integer(value)) => *value,
            _ => 0,
        };
        if feature == "PayloadSize" {
            let wide = self.values.borrow().get("PixelFormat") == Some(&text("Mono12"));
            return Ok(FeatureValue::Integer(number("Width") * number("Height") * if wide { 2 } else { 1 }));
        }
        self.values
            .borrow()
            .get(&self.key(feature))
            .cloned()
            .ok_or(Failed::Refused("not readable".to_owned()))
    }

    fn write(&self, feature: &str, value: &FeatureValue) -> Result<(), Failed> {
        let known = self.made.feature(feature).ok_or(Failed::Refused("unknown".to_owned()))?;
        if known.access == Access::Read || self.stubborn.contains(&feature) {
            return Err(Failed::Refused("access denied".to_owned()));
        }
        if feature == "UserSetLoad" {
            self.values.borrow_mut().extend(self.delivery.clone());
            return Ok(());
        }
        let value = match (value, known.kind) {
            (FeatureValue::Float(us), Kind::Float) if feature == "ExposureTime" && self.line_us > 0.0 => {
                FeatureValue::Float((us / self.line_us).ceil() * self.line_us)
            }
            (FeatureValue::Integer(value), Kind::Float) => FeatureValue::Float(*value as f64),
            _ => value.clone(),
        };
        let key = self.key(feature);
        self.values.borrow_mut().insert(key, value);
        Ok(())
    }

    fn bounds_now(&self, feature: &str) -> Bounds {
        match feature {
            "ExposureTime" => Bounds { min: Some(10.0), max: Some(1e6), step: None },
            "Width" => Bounds { min: Some(8.0), max: Some(1920.0), step: Some(8.0) },
            _ => Bounds::default(),
        }
    }

    fn integer(&self, feature: &str) -> Result<i64, Failed> {
        match self.read(feature)? {
            FeatureValue::Integer(value) => Ok(value),
            _ => Err(Failed::Refused("no number".to_owned())),
        }
    }

    fn text(&self, feature: &str) -> Result<String, Failed> {
        self.read(feature).map(|value| value.to_string())
    }

    fn set_text(&self, feature: &str, value: &str) -> Result<(), Failed> {
        self.write(feature, &text(value))
    }

    fn execute(&self, feature: &str) -> Result<(), Failed> {
        Err(Failed::Refused(format!("{feature} is no such command")))
    }

    fn is_done(&self, _command: &str) -> Option<bool> {
        None
    }

    fn entries(&self, feature: &str) -> Vec<String> {
        self.made.feature(feature).map_or_else(Vec::new, |known| known.entries)
    }

    fn has_registers(&self) -> bool {
        false
    }

    fn register(&self, _address: u64) -> Result<u32, Failed> {
        Err(Failed::Refused("none".to_owned()))
    }

    fn set_register(&self, _address: u64, _value: u32) -> Result<(), Failed> {
        Err(Failed::Refused("none".to_owned()))
    }
}

fn wanted() -> Wishes {
    let mut wishes = wishes();
    wishes.words.trigger_line = Some("Line1".to_owned());
    wishes
}

fn problems(outcome: Result<SetUp, CameraError>) -> Vec<String> {
    match outcome.expect_err("problems") {
        CameraError::SetUp { problems } => problems,
        error => panic!("{error}"),
    }
}

#[test]
fn what_the_last_user_left_is_mended_and_told() {
    let fake = Fake::new();
    let done = set_up(&fake, &wanted()).expect("set up");
    for (feature, expected) in [
        ("PixelFormat", text("Mono8")),
        ("Width", FeatureValue::Integer(1920)),
        ("OffsetX", FeatureValue::Integer(0)),
        ("ExposureTime", FeatureValue::Float(1000.0)),
        ("Gain", FeatureValue::Float(0.0)),
        ("ExposureAuto", text("Off")),
        ("GammaEnable", FeatureValue::Flag(false)),
        ("ReverseX", FeatureValue::Flag(false)),
        ("AcquisitionMode", text("Continuous")),
        ("TriggerSelector", text("FrameStart")),
        ("TriggerMode", text("On")),
        ("TriggerSource", text("Line1")),
        ("TriggerActivation", text("RisingEdge")),
    ] {
        assert_eq!(fake.has_now(feature), expected, "{feature}");
    }
    fake.set_text("TriggerSelector", "AcquisitionStart").expect("settable");
    assert_eq!(fake.has_now("TriggerMode"), text("Off"), "one trigger alone is on");
    let told = done.told.join("; ");
    for words in
        ["ExposureAuto was Continuous and is set to Off", "GammaEnable was true", "ReverseX was true"]
    {
        assert!(told.contains(words), "{told}");
    }
    assert_eq!((done.contract.size, done.contract.offset), ((1920, 1200), (0, 0)));
    // A settled camera has nothing to tell.
    assert_eq!(set_up(&fake, &wanted()).expect("again").told, [""; 0]);
}

#[test]
fn a_selector_that_can_only_be_read_says_which_trigger_there_is() {
    let mut fake = Fake::new();
    fake.made.0.get_mut("TriggerSelector").expect("there").access = Access::Read;
    let all = problems(set_up(&fake, &wanted())).join("\n");
    assert!(all.contains("TriggerMode is On for AcquisitionStart, expected for FrameStart"), "{all}");
    fake.values.borrow_mut().insert("TriggerSelector".to_owned(), text("FrameStart"));
    set_up(&fake, &wanted()).expect("set up");
    assert_eq!((fake.has_now("TriggerMode"), fake.has_now("TriggerSource")), (text("On"), text("Line1")));
}

#[test]
fn settings_of_delivery_are_loaded_first() {
    let mut fake = Fake::new();
    fake.delivery = [("ExposureAuto", text("Off")), ("GammaEnable", FeatureValue::Flag(false))]
        .map(|(name, value)| (name.to_owned(), value))
        .into();
    let done = set_up(&fake, &wanted()).expect("set up");
    assert_eq!(fake.has_now("UserSetSelector"), text("Default"));
    assert!(!done.told.iter().any(|told| told.contains("Auto") || told.contains("Gamma")), "{:?}", done.told);
}

#[test]
fn an_exposure_is_rounded_within_its_tolerance_and_refused_beyond() {
    let mut fake = Fake::new();
    fake.line_us = 35.0;
    let done = set_up(&fake, &wanted()).expect("1015 is near enough");
    assert!(done.told.iter().any(|told| told.contains("exposure_us = 1000: the camera takes 1015 us")));
    let exposure = done.settings.iter().find(|setting| setting.feature == "ExposureTime").expect("set");
    assert_eq!(exposure.actual, FeatureValue::Float(1015.0));
    let mut strict = wanted();
    strict.words.exposure_tolerance_us = Some(10.0);
    let problems = problems(set_up(&fake, &strict));
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].contains("say exposure_us = 1015, or exposure_tolerance_us = 15"), "{problems:?}");
}

#[test]
fn every_problem_is_named_at_once_with_its_remedy() {
    let mut fake = Fake::new();
    fake.stubborn = vec!["GammaEnable", "PixelFormat"];
    fake.made.0.get_mut("ReverseX").expect("there").access = Access::Read;
    let mut wishes = wanted();
    wishes.words.trigger_line = Some("Line0".to_owned());
    wishes.words.exposure_us = Some(2e6);
    wishes.raw = vec![
        FeatureSetting { feature: "BlackLevl".to_owned(), value: FeatureValue::Integer(1) },
        FeatureSetting { feature: "UserSetSelector".to_owned(), value: text("UserSet7") },
    ];
    let problems = problems(set_up(&fake, &wishes));
    let all = problems.join("\n");
    println!("{all}");
    for words in [
        "`Line0` is not an entry of TriggerSource: Line1, Line2, Software; say trigger_line = \"Line1\"",
        "ExposureTime takes 10 to 1000000 us now, asked for exposure_us = 2000000",
        "PixelFormat cannot be set to Mono8: the camera refuses it (access denied)",
        "GammaEnable is true, expected false, and cannot be set (the camera refuses it: access denied)",
        "ReverseX is true, expected false, and cannot be set (it can only be read)",
        "feature BlackLevl: asked for 1, the camera has no such feature; nearest names",
        "`UserSet7` is not an entry of UserSetSelector: Default, UserSet1",
        "PayloadSize is 4608000, expected 2304000",
    ] {
        assert!(all.contains(words), "{words:?} missing in\n{all}");
    }
    assert_eq!(problems.len(), 8, "each is told once: {all}");
}

#[test]
fn what_changes_while_a_session_runs_is_named() {
    let fake = Fake::new();
    let done = set_up(&fake, &wanted()).expect("set up");
    assert_eq!(changed(&fake, &done.watched).expect("answers"), []);
    fake.write("Gain", &FeatureValue::Float(6.0)).expect("writable");
    fake.write("ExposureAuto", &text("Continuous")).expect("writable");
    let changed = changed(&fake, &done.watched).expect("answers");
    let names: Vec<&str> = changed.iter().map(|(name, ..)| name.as_str()).collect();
    assert_eq!(names, ["ExposureAuto", "Gain"]);
    assert_eq!(changed[1].2, "6");
}
