// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera in memory, with features, values, locks and habits, set up as a node file requests.

use super::{SetUp, changed, set_up};
use crate::camera::description::{Access, Bounds, Description, Feature, Kind};
use crate::camera::error::CameraError;
use crate::camera::features::{Failed, Features};
use crate::camera::profile::Wishes;
use crate::camera::profile::tests::{Made, made, wishes};
use crate::config::{Channel, FeatureSetting, FeatureValue, Mosaic, Pixel};
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;

/// A camera that keeps what is written; triggers are kept behind their selector.
struct Fake {
    made: Made,
    values: RefCell<BTreeMap<String, FeatureValue>>,
    /// What it has after its settings of delivery were loaded.
    delivery: BTreeMap<String, FeatureValue>,
    /// Exposures are whole multiples of this.
    line_us: f64,
    /// Features that it refuses to set.
    stubborn: Vec<&'static str>,
    habits: Habits,
}

/// Behaviour of some cameras that no description contains.
#[derive(Default)]
struct Habits {
    /// Whether `UserSetLoad` reports to be done, before and after it is executed.
    done: Option<(Option<bool>, Option<bool>)>,
    loaded: Cell<bool>,
    /// It goes on changing after that.
    restless: Cell<i64>,
    /// There is one trigger mode, whatever is selected.
    one_mode: bool,
    /// To select a trigger is to set its mode's number, which the overlap is a part of.
    one_number: bool,
    /// These are there only while the trigger is on.
    with_trigger: Vec<&'static str>,
    /// It makes this of every packet size; 0: it refuses.
    packets: Option<i64>,
    /// It has these entries of `TriggerSelector` while another model of triggers is chosen.
    legacy: Option<Vec<String>>,
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
            habits: Habits::default(),
        }
    }

    fn key(&self, feature: &str) -> String {
        let behind = ["TriggerMode", "TriggerSource", "TriggerActivation"].contains(&feature);
        match self.values.borrow().get("TriggerSelector") {
            _ if self.habits.one_mode && behind => format!("{feature}@FrameStart"),
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
        let standard = || self.values.borrow().get("TriggerControlImplementation") == Some(&text("Standard"));
        let feature = self.made.feature(name)?;
        match &self.habits.legacy {
            Some(entries) if name == "TriggerSelector" && !standard() => {
                Some(Feature { entries: entries.clone(), ..feature })
            }
            _ => Some(feature),
        }
    }
}

impl Features for Fake {
    fn has(&self, feature: &str) -> bool {
        self.made.0.contains_key(feature)
    }

    fn is_available(&self, feature: &str) -> bool {
        let needs = self.habits.with_trigger.contains(&feature);
        self.has(feature) && (!needs || self.read("TriggerMode").is_ok_and(|mode| mode == text("On")))
    }

    fn read(&self, feature: &str) -> Result<FeatureValue, Failed> {
        let number = |name| match self.values.borrow().get(name) {
            Some(FeatureValue::Integer(value)) => *value,
            _ => 0,
        };
        if feature == "Width" && self.habits.restless.get() > 0 {
            self.habits.restless.set(self.habits.restless.get() + 1);
            return Ok(FeatureValue::Integer(self.habits.restless.get()));
        }
        if feature == "PayloadSize" {
            let wide = self.values.borrow().get("PixelFormat") == Some(&text("Mono12"));
            let image = number("Width") * number("Height") * if wide { 2 } else { 1 };
            return Ok(FeatureValue::Integer(image + number("Appended")));
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
        if feature == "TriggerSelector" && self.habits.one_number {
            self.values.borrow_mut().insert("TriggerOverlap".to_owned(), text("Off"));
        }
        if feature == "GevSCPSPacketSize" {
            let made = self.habits.packets.unwrap_or(9000);
            if made == 0 {
                return Err(Failed::Refused("out of range".to_owned()));
            }
            self.values.borrow_mut().insert(feature.to_owned(), FeatureValue::Integer(made));
            return Ok(());
        }
        if feature == "UserSetLoad" {
            self.habits.loaded.set(true);
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
        let (before, after) = self.habits.done?;
        if self.habits.loaded.get() { after } else { before }
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
fn what_the_last_user_left_is_mended_with_a_remark() {
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
    let remarks = done.remarks.join("; ");
    for words in
        ["ExposureAuto was Continuous and is set to Off", "GammaEnable was true", "ReverseX was true"]
    {
        assert!(remarks.contains(words), "{remarks}");
    }
    assert_eq!((done.contract.size, done.contract.offset), ((1920, 1200), (0, 0)));
    // A camera that is set already gets no remark.
    assert_eq!(set_up(&fake, &wanted()).expect("again").remarks, [""; 0]);
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
    assert!(
        !done.remarks.iter().any(|remarks| remarks.contains("Auto") || remarks.contains("Gamma")),
        "{:?}",
        done.remarks
    );
}

/// A camera of which something stands at a value that it only lets read.
fn fixed(feature: &str, form: &str, value: FeatureValue) -> Fake {
    let mut fake = Fake::new();
    fake.made.0.extend(made(&format!("{feature}:{form}!ro")).0);
    fake.values.borrow_mut().insert(feature.to_owned(), value);
    fake
}

#[test]
fn deeper_grey_gets_a_remark_and_its_lower_byte_must_come_first() {
    let mut twelve = wanted();
    twelve.words.pixel = Some(Pixel::Mono12);
    let done = set_up(&Fake::new(), &twelve).expect("set up");
    assert_eq!((done.contract.pixel, done.contract.received_bytes()), (Pixel::Mono12, 2 * 1920 * 1200));
    assert!(
        done.remarks.iter().any(|remarks| remarks.contains("the lower 4 are lost")),
        "{:?}",
        done.remarks
    );
    // A format that raw settings name is used as it is.
    let mut left = wanted();
    left.words.left_to_settings = vec!["pixel".to_owned()];
    left.raw = vec![FeatureSetting { feature: "PixelFormat".to_owned(), value: text("Mono12") }];
    assert_eq!(set_up(&Fake::new(), &left).expect("set up").contract.pixel, Pixel::Mono12);

    let fake = fixed("GevSCPSBigEndian", "bool", FeatureValue::Flag(true));
    let all = problems(set_up(&fake, &twelve)).join("\n");
    assert!(all.contains("sends the upper byte of each value first (GevSCPSBigEndian)"), "{all}");
    set_up(&fake, &wanted()).expect("8 bits have no order");
}

/// Which pixels are of the head's colour follows from the name that the camera has for its mosaic in the end.
#[test]
fn a_plane_of_colour_is_half_as_large_and_the_calibrations_pixels_are_named() {
    let mosaic = |format: &str| {
        let mut fake = Fake::new();
        fake.made.0.extend(made(&format!("PixelFormat=Mono8,{format}")).0);
        fake
    };
    let mut plane = Wishes { size: (960, 600), channel: Channel::B, ..wanted() };
    plane.words.pixel = Some(Pixel::Bayer8(Mosaic::RG));
    for (format, place) in [("BayerRG8", (1, 1)), ("BayerGB8", (1, 0)), ("BayerBG8", (0, 0))] {
        let done = set_up(&mosaic(format), &plane).expect("set up");
        assert_eq!((done.contract.size, done.contract.sent_size()), ((960, 600), (1920, 1200)));
        assert_eq!((done.contract.pixel.name(), done.contract.place), (format, place));
        let remarks = done.remarks.join("; ");
        let (u, v) = place;
        let pixels = format!("is pixel (2u + {u}, 2v + {v}) of the camera");
        assert!(remarks.contains("recorded, 960 x 600") && remarks.contains(&pixels), "{remarks}");
        assert!(!remarks.contains("makes grey of several pixels"), "{remarks}");
    }
    let mut odd = mosaic("BayerRG8");
    odd.made.0.get_mut("OffsetX").expect("there").access = Access::Read;
    odd.values.borrow_mut().insert("OffsetX".to_owned(), FeatureValue::Integer(3));
    let all = problems(set_up(&odd, &plane)).join("\n");
    assert!(all.contains("OffsetX is 3 and OffsetY is 0, expected even ones"), "{all}");
}

#[test]
fn chunks_that_stay_on_get_room_and_other_bytes_do_not() {
    let fake = fixed("ChunkModeActive", "bool", FeatureValue::Flag(true));
    fake.values.borrow_mut().insert("Appended".to_owned(), FeatureValue::Integer(24));
    let done = set_up(&fake, &wanted()).expect("set up");
    assert_eq!((done.contract.chunk_room, done.contract.received_bytes()), (24, 1920 * 1200 + 24));
    let remarks = done.remarks.join("; ");
    for words in ["ChunkModeActive is true, expected false, and cannot be set", "up to 24 bytes of chunks"] {
        assert!(remarks.contains(words), "{remarks}");
    }
    fake.values.borrow_mut().insert("ChunkModeActive".to_owned(), FeatureValue::Flag(false));
    let all = problems(set_up(&fake, &wanted())).join("\n");
    assert!(all.contains("PayloadSize is 2304024, expected 2304000"), "{all}");
}

#[test]
fn an_exposure_is_rounded_within_its_tolerance_and_refused_beyond() {
    let mut fake = Fake::new();
    fake.line_us = 35.0;
    let done = set_up(&fake, &wanted()).expect("1015 is near enough");
    assert!(
        done.remarks.iter().any(|remarks| remarks.contains("exposure_us = 1000: the camera takes 1015 us"))
    );
    let exposure = done.settings.iter().find(|setting| setting.feature == "ExposureTime").expect("set");
    assert_eq!(exposure.actual, FeatureValue::Float(1015.0));
    let mut strict = wanted();
    strict.words.exposure_tolerance_us = Some(10.0);
    let problems = problems(set_up(&fake, &strict));
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].contains("set exposure_us = 1015, or exposure_tolerance_us = 15"), "{problems:?}");
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
        "`Line0` is not an entry of TriggerSource: Line1, Line2, Software; set trigger_line = \"Line1\"",
        "ExposureTime takes 10 to 1000000 us now, requested exposure_us = 2000000",
        "PixelFormat cannot be set to Mono8: the camera refuses it (access denied)",
        "GammaEnable is true, expected false, and cannot be set (the camera refuses it: access denied)",
        "ReverseX is true, expected false, and cannot be set (it can only be read)",
        "feature BlackLevl: requested 1, the camera has no such feature; nearest names",
        "`UserSet7` is not an entry of UserSetSelector: Default, UserSet1",
        "PayloadSize is 4608000, expected 2304000",
    ] {
        assert!(all.contains(words), "{words:?} missing in\n{all}");
    }
    assert_eq!(problems.len(), 8, "each is reported once: {all}");
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

/// A camera with further features, each with a value.
fn with(features: &str, values: &[(&str, FeatureValue)]) -> Fake {
    let mut fake = Fake::new();
    fake.made.0.extend(made(features).0);
    fake.values.borrow_mut().extend(values.iter().map(|(name, value)| ((*name).to_owned(), value.clone())));
    fake
}

#[test]
fn a_load_that_never_reports_its_end_is_settled_and_read_back() {
    // The register may hold 0 for the default set before and after; another number stays there for ever.
    for done in [(Some(false), Some(false)), (Some(true), Some(false))] {
        let mut fake = Fake::new();
        fake.habits.done = Some(done);
        fake.delivery = [("ExposureAuto".to_owned(), text("Off"))].into();
        let set = set_up(&fake, &wanted()).expect("set up");
        let remarks = set.remarks.join("; ");
        assert!(
            remarks.contains(
                "UserSetLoad of Default never reports that it is done; it changed ExposureAuto, and"
            ),
            "{remarks}"
        );
        assert_eq!(fake.has_now("ExposureTime"), FeatureValue::Float(1000.0));
    }
    // A camera that reports the end is trusted at once, without a remark.
    let mut fake = Fake::new();
    fake.habits.done = Some((Some(true), Some(true)));
    let set = set_up(&fake, &wanted()).expect("set up");
    assert!(!set.remarks.join("; ").contains("UserSetLoad"), "{:?}", set.remarks);
}

#[test]
fn a_status_in_progress_before_the_load_is_ignored() {
    let fake = with("UserSetLoadStatus=InProgress,Success!ro", &[("UserSetLoadStatus", text("InProgress"))]);
    set_up(&fake, &wanted()).expect("set up");
}

#[test]
fn a_camera_that_goes_on_changing_is_still_loading() {
    let mut fake = Fake::new();
    fake.habits.done = Some((Some(false), Some(false)));
    fake.habits.restless.set(1);
    let all = problems(set_up(&fake, &wanted())).join("\n");
    assert!(all.contains("UserSetLoad is not done after 5 s"), "{all}");
}

#[test]
fn a_mode_that_is_one_for_all_triggers_is_looked_at_once() {
    let mut fake = Fake::new();
    fake.habits.one_mode = true;
    set_up(&fake, &wanted()).expect("set up");
    assert_eq!(
        (fake.has_now("TriggerSelector"), fake.has_now("TriggerMode")),
        (text("FrameStart"), text("On"))
    );
    // Two that are on by themselves are two all the same, and stay as they were.
    let fake = Fake::new();
    let mut wishes = wanted();
    let raw = |feature: &str, value: &str| FeatureSetting { feature: feature.to_owned(), value: text(value) };
    wishes.raw = vec![raw("TriggerSelector", "AcquisitionStart"), raw("TriggerMode", "On")];
    let all = problems(set_up(&fake, &wishes)).join("\n");
    assert!(
        all.contains("TriggerMode is On for AcquisitionStart and FrameStart, expected for one alone"),
        "{all}"
    );
    for entry in ["FrameStart", "AcquisitionStart"] {
        fake.set_text("TriggerSelector", entry).expect("settable");
        assert_eq!(fake.has_now("TriggerMode"), text("On"), "{entry}");
    }
}

#[test]
fn what_comes_with_the_trigger_is_set_after_it() {
    let mut fake = with("TriggerOverlap=Off,ReadOut", &[("TriggerOverlap", text("Off"))]);
    fake.habits.with_trigger = vec!["TriggerOverlap"];
    let done = set_up(&fake, &wanted()).expect("set up");
    assert_eq!(fake.has_now("TriggerOverlap"), text("ReadOut"));
    assert!(done.watched.contains_key("TriggerOverlap"));
    // What never comes is named.
    let mut fake = Fake::new();
    fake.habits.with_trigger = vec!["Gain"];
    fake.stubborn = vec!["TriggerMode"];
    let all = problems(set_up(&fake, &wanted())).join("\n");
    assert!(all.contains("Gain is not available as the camera is set: gain_db sets it"), "{all}");
}

#[test]
fn what_selecting_a_trigger_has_undone_is_set_again() {
    let mut fake = with("TriggerOverlap=Off,ReadOut", &[("TriggerOverlap", text("Off"))]);
    fake.habits.one_mode = true;
    fake.habits.one_number = true;
    fake.habits.with_trigger = vec!["TriggerOverlap"];
    set_up(&fake, &wanted()).expect("set up");
    assert_eq!(fake.has_now("TriggerOverlap"), text("ReadOut"));
}

#[test]
fn packet_sizes_are_the_cameras_or_refused_by_name() {
    let size = [("GevSCPSPacketSize", FeatureValue::Integer(1500))];
    let mut fake = with("GevSCPSPacketSize:int", &size);
    fake.habits.packets = Some(8164);
    let remarks = set_up(&fake, &wanted()).expect("set up").remarks.join("; ");
    assert!(remarks.contains("packet_bytes = 9000: the camera takes 8164 bytes"), "{remarks}");
    fake.habits.packets = Some(0);
    let all = problems(set_up(&fake, &wanted())).join("\n");
    assert!(
        all.contains("GevSCPSPacketSize cannot be set to 9000: the camera refuses it (out of range)"),
        "{all}"
    );
    assert!(all.contains("set packet_bytes = 8164") && !all.contains("power"), "{all}");
}

#[test]
fn a_camera_that_has_the_packet_size_already_is_not_set() {
    let mut fake = with("GevSCPSPacketSize:int", &[("GevSCPSPacketSize", FeatureValue::Integer(9000))]);
    fake.habits.packets = Some(0);
    set_up(&fake, &wanted()).expect("set up");
}

#[test]
fn triggers_that_come_with_another_model_of_triggers_are_there_once_it_is_chosen() {
    let model = [("TriggerControlImplementation", text("Legacy"))];
    let mut fake = with("TriggerControlImplementation=Legacy,Standard", &model);
    fake.habits.legacy = Some(vec!["AcquisitionStart".to_owned(), "LineStart".to_owned()]);
    set_up(&fake, &wanted()).expect("set up");
    assert_eq!(fake.has_now("TriggerSelector"), text("FrameStart"));
    assert_eq!(fake.has_now("TriggerMode"), text("On"));
}

#[test]
fn a_colour_sensor_that_sends_grey_gets_a_remark() {
    let filter = |value: &str| with("PixelColorFilter=None,BayerRG!ro", &[("PixelColorFilter", text(value))]);
    let remarks = |fake: &Fake| set_up(fake, &wanted()).expect("set up").remarks.join("; ");
    assert!(remarks(&filter("BayerRG")).contains("the sensor sees colours (PixelColorFilter is BayerRG)"));
    assert!(!remarks(&filter("None")).contains("colours"));
    assert!(remarks(&with("PixelFormat=Mono8,BayerRG8", &[])).contains("PixelFormat also has BayerRG8"));
}
