//! Registers: bounds, increments, locks, selectors, commands, user sets.

use crate::bench::{Bench, DENIED, HEIGHT, INVALID, OK, PROTECTED, WIDTH, any};
use fourdbody_simulator::gige::{Exposures, Habits};
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
