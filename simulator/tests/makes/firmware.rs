// SPDX-License-Identifier: MIT OR Apache-2.0
//! Registers: bounds, increments, locks, selectors, commands, user sets.

use crate::bench::{Bench, DENIED, HEIGHT, INVALID, OK, PROTECTED, WIDTH, any};
use fourdbody_simulator::gige::Make;
use fourdbody_simulator::gige::make::Table;
use fourdbody_simulator::gige::{Exposures, Habits};
use std::path::Path;
use std::time::{Duration, Instant};

#[test]
fn numbers_keep_their_bounds_and_increments() {
    let mut bench = Bench::new((1, 1), any(&[]), Habits::default());
    for (name, value, status) in [
        ("Width", "32", OK),
        ("Width", "30", INVALID),
        ("Width", "12", INVALID),
        ("Width", "68", INVALID),
        ("Height", "46", OK),
        ("OffsetX", "32", OK),
        ("OffsetX", "36", INVALID),
        ("Gain", "25", INVALID),
        ("ExposureTime", "5", INVALID),
        ("PixelFormat", "BayerRG8", INVALID),
    ] {
        assert_eq!(bench.set(name, value), status, "{name} = {value}");
    }
    assert_eq!((bench.integer("Width"), bench.integer("OffsetX")), (32, 32));
    let maximum = bench.make.register("WidthMax").expect("there").0;
    assert_eq!(bench.write(maximum, &[0; 8]), PROTECTED);
    // The packet size is rounded down to four bytes, and has a largest value that is not the wire's.
    let size = |bench: &mut Bench, size: u32| bench.write(0x0d04, &size.to_be_bytes());
    assert_eq!((size(&mut bench, 1402), size(&mut bench, 1504)), (OK, INVALID));
    let read = bench.read(0x0d04, 4).expect("there");
    assert_eq!(u32::from_be_bytes(read.try_into().expect("4 bytes")) & 0xffff, 1400);
}

#[test]
fn exposures_are_rounded_told_and_clamped_as_the_camera_likes() {
    let step = Habits { exposure_step: Duration::from_micros(35), ..Habits::default() };
    let cases = [
        (Exposures::Rounded, 1015.0, INVALID),
        (Exposures::Asked, 1000.0, INVALID),
        (Exposures::Clamped, 1015.0, OK),
    ];
    for (host, (exposures, read_back, beyond)) in (2..).zip(cases) {
        let mut bench = Bench::new((1, host), any(&[]), Habits { exposures, ..step });
        bench.set_all(&[("ExposureTime", "1000")]);
        assert_eq!(bench.float("ExposureTime"), read_back, "{exposures:?}");
        assert_eq!(bench.integer("ExposureTimeRaw"), read_back as i64, "{exposures:?}");
        assert_eq!(bench.set("ExposureTime", "2000000"), beyond, "{exposures:?}");
    }
}

#[test]
fn what_is_automatic_or_runs_is_locked() {
    let mut bench = Bench::new((1, 6), any(&[("ExposureAuto", "Continuous")]), Habits::default());
    assert_eq!(bench.set("ExposureTime", "500"), DENIED);
    assert_eq!(bench.set("ExposureTimeRaw", "500"), DENIED);
    bench.set_all(&[("ExposureAuto", "Off"), ("ExposureTime", "500"), ("GainAuto", "Continuous")]);
    assert_eq!(bench.set("Gain", "1"), DENIED);
    assert_eq!(bench.execute("TriggerSoftware"), DENIED, "it is there only for its source");
    bench.set_all(&[("GainAuto", "Off"), ("Gain", "1")]);
    bench.triggered();
    for (name, value) in [("Width", "32"), ("PixelFormat", "Mono12p"), ("BinningVertical", "2")] {
        assert_eq!(bench.set(name, value), DENIED, "{name}");
    }
    assert_eq!(bench.set("ExposureTime", "600"), OK);
    assert_eq!(bench.execute("AcquisitionStop"), OK);
    assert_eq!(bench.set("Width", "32"), OK);
}

#[test]
fn every_entry_of_a_selector_has_its_own_values() {
    let mut bench = Bench::new((1, 7), any(&[]), Habits::default());
    bench.set_all(&[
        ("TriggerSelector", "AcquisitionStart"),
        ("TriggerMode", "On"),
        ("TriggerSource", "Line2"),
    ]);
    bench.set_all(&[("TriggerSelector", "FrameStart")]);
    assert_eq!((bench.integer("TriggerMode"), bench.integer("TriggerSource")), (0, 0));
    bench.set_all(&[("TriggerSelector", "AcquisitionStart")]);
    assert_eq!((bench.integer("TriggerMode"), bench.integer("TriggerSource")), (1, 2));
}

#[test]
fn a_user_set_brings_a_known_state_back_and_commands_may_take_their_time() {
    let left = [("Gain", "6"), ("BinningHorizontal", "2"), ("TriggerMode[AcquisitionStart]", "On")];
    let slow = Habits { command_ms: 300, ..Habits::default() };
    let mut bench = Bench::new((1, 8), any(&left), slow);
    assert_eq!(bench.integer("Width"), WIDTH as i64 / 2);
    bench.set_all(&[("UserSetSelector", "Default")]);
    assert_eq!(bench.execute("UserSetLoad"), OK);
    assert_eq!((bench.integer("UserSetLoad"), bench.float("Gain")), (1, 6.0), "not done yet");
    let start = Instant::now();
    while bench.integer("UserSetLoad") != 0 {
        assert!(start.elapsed() < Duration::from_secs(20), "never done");
    }
    assert_eq!((bench.float("Gain"), bench.integer("BinningHorizontal")), (0.0, 1));
    assert_eq!((bench.integer("Width"), bench.integer("Height")), (WIDTH as i64, HEIGHT as i64));
    bench.set_all(&[("TriggerSelector", "AcquisitionStart")]);
    assert_eq!(bench.integer("TriggerMode"), 0);
}

#[test]
fn a_set_that_was_saved_is_another_state_than_the_factorys() {
    let mut bench = Bench::new((1, 9), any(&[]), Habits::default());
    bench.set_all(&[("Gain", "3"), ("UserSetSelector", "UserSet1")]);
    assert_eq!(bench.execute("UserSetSave"), OK);
    bench.set_all(&[("Gain", "9")]);
    assert_eq!(bench.execute("UserSetLoad"), OK);
    assert_eq!(bench.float("Gain"), 3.0);
    bench.set_all(&[("UserSetSelector", "Default")]);
    assert_eq!(bench.execute("UserSetLoad"), OK);
    assert_eq!(bench.float("Gain"), 0.0);
}

#[test]
fn habits_name_makes_and_wrong_ones_are_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    std::fs::write(dir.path().join("any.json"), crate::bench::ANY).expect("a file");
    let parse = |keys: &str| {
        Make::parse_all(&format!("[[habit]]\ncamera = \"h0_up\"\n{keys}"), dir.path())
            .map_err(|e| e.to_string())
    };
    let makes = parse(
        "like = \"any.json\"\nwired_to = \"Line2\"\nwithout = [\"LUTEnable\"]\nstamp = \"exposure_end\"\n\
         left_over = { Gain = 6.0, ReverseX = true, \"TriggerMode[AcquisitionStart]\" = \"On\" }",
    );
    assert_eq!(makes.expect("valid").keys().collect::<Vec<_>>(), ["h0_up"]);
    assert!(parse("clock = \"still\"").expect("valid").is_empty(), "its habits are another's to read");
    for (keys, words) in [
        ("like = \"none.json\"", "none.json"),
        ("wired_to = \"Line1\"", "belong to a camera with like"),
        ("like = \"any.json\"\nwired_to = \"Line9\"", "Software, Line1, Line2"),
        ("like = \"any.json\"\nwithout = [\"Width\"]", "every camera has it"),
        ("like = \"any.json\"\nleft_over = { Gain = \"high\" }", "expected a number"),
        ("like = \"any.json\"\nleft_over = { GainAuto = \"Sometimes\" }", "expected one of Off, Continuous"),
        ("like = \"any.json\"\nleft_over = { \"Gain[All]\" = 3.0 }", "no selector of Gain"),
        ("like = \"any.json\"\nleft_over = { GevSCPSPacketSize = 3 }", "no user leaves behind"),
        ("like = \"any.json\"\nleft_over = { UserSetLoad = 1 }", "a command leaves nothing"),
    ] {
        let error = parse(keys).expect_err(keys);
        assert!(error.contains(words) && error.contains("h0_up"), "{keys}: {error}");
    }
    assert!(Make::load(Path::new("/nowhere.json")).is_err());
}

/// Features that select each other, or many that select many.
#[test]
fn tables_that_make_no_sense_end() {
    let row = |place: usize| {
        let selects: Vec<String> = (0..40).map(|other| format!("\"S{other:02}Selector\"")).collect();
        let entries: Vec<String> = (0..50).map(|entry| format!("\"E{entry}\"")).collect();
        let (entries, selects) = (entries.join(","), selects.join(","));
        format!(
            "\"S{place:02}Selector\": {{\"type\": \"enumeration\", \"entries\": [{entries}], \"selects\": [{selects}]}},"
        )
    };
    let rows: String = (0..40).map(row).collect();
    let text = crate::bench::ANY.replacen("\"features\": {", &format!("\"features\": {{{rows}"), 1);
    let make = Make::new(Table::parse(&text).expect("a table")).expect("a make");
    let make = make.left_over("S39Selector", "E7").expect("an entry");
    let mut bench = Bench::new((1, 10), make, Habits::default());
    assert_eq!(bench.set("S00Selector", "E3"), OK);
    assert_eq!(bench.integer("S00Selector"), 3);
}

/// A camera whose triggers and sets of settings are numbers in registers.
fn of_numbers() -> Make {
    let text = crate::bench::ANY
        .replace(
            "\"TriggerSelector\": {\"type\": \"enumeration\",",
            "\"TriggerSelector\": {\"type\": \"enumeration\", \"same_register_as\": [\"TriggerOverlap\"],",
        )
        .replace(
            "\"entries\": [\"Off\", \"ReadOut\"]}",
            "\"entries\": [\"Off\", \"ReadOut\"], \"available_if\": true, \"available_with\": [\"TriggerMode\"]}",
        )
        .replace(
            "\"UserSetLoad\": {\"type\": \"command\"}",
            "\"UserSetLoad\": {\"type\": \"command\", \"command_value\": {\"of\": [\"UserSetSelector\"]}, \"can_be_read\": true}",
        );
    Make::new(Table::parse(&text).expect("a table")).expect("a make")
}

#[test]
fn a_selector_that_is_a_number_has_one_mode_and_undoes_the_overlap() {
    let mut bench = Bench::new((1, 20), of_numbers(), Habits::default());
    assert_eq!(bench.set("TriggerOverlap", "ReadOut"), DENIED, "it is there only while the trigger is on");
    bench.set_all(&[("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerOverlap", "ReadOut")]);
    assert_eq!(bench.integer("TriggerOverlap"), 1);
    bench.set_all(&[("TriggerSelector", "AcquisitionStart")]);
    assert_eq!((bench.integer("TriggerMode"), bench.integer("TriggerOverlap")), (1, 0));
}

#[test]
fn the_number_of_a_set_stays_in_its_register() {
    let mut bench = Bench::new((1, 21), of_numbers(), Habits::default());
    bench.set_all(&[("Gain", "3"), ("UserSetSelector", "Default")]);
    let (address, _) = bench.make.register("UserSetLoad").expect("there");
    assert_eq!(bench.integer("UserSetLoad"), 0, "what is written for the default set is there before it");
    assert_ne!(bench.write(address, &1u32.to_be_bytes()), OK, "another set than the selected one");
    assert_eq!(bench.write(address, &0u32.to_be_bytes()), OK);
    assert_eq!(bench.float("Gain"), 0.0);
    bench.set_all(&[("UserSetSelector", "UserSet1")]);
    assert_eq!(bench.write(address, &1u32.to_be_bytes()), OK);
    assert_eq!(bench.integer("UserSetLoad"), 1, "for ever");
}
