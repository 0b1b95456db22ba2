// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames: which triggers give one, when it is stamped, and what a state that somebody left makes of it.

use crate::bench::{Bench, HEIGHT, OK, WIDTH, any};
use fourdbody_simulator::gige::{Habits, Make, StampPoint, TestImages};
use std::time::Duration;

const PERIOD: Duration = Duration::from_millis(20);
const WIDTH_OF_PULSE: Duration = Duration::from_millis(1);
const MONO8: u32 = 0x0108_0001;

fn left(host: u8, left_over: &[(&str, &str)]) -> Bench {
    let nominal = Some(Duration::from_millis(1));
    let mut bench = Bench::new((2, host), any(left_over), Habits { nominal, ..Habits::default() });
    // Locked while it is automatic or sequenced.
    if !left_over.iter().any(|(name, _)| ["ExposureAuto", "ExposureTime"].contains(name)) {
        bench.set_all(&[("ExposureTime", "1000")]);
    }
    bench
}

#[test]
fn a_camera_that_nobody_has_touched_sends_the_light() {
    let mut bench = left(1, &[]);
    bench.triggered();
    bench.pulses(5, PERIOD, WIDTH_OF_PULSE);
    let frames = bench.frames();
    assert_eq!(frames.len(), 5);
    for (instant, frame) in (0..).zip(&frames) {
        assert_eq!((frame.payload_type, frame.format, frame.width, frame.height), (1, MONO8, WIDTH, HEIGHT));
        assert_eq!(frame.bytes, bench.light(instant));
        assert_eq!(
            TestImages::identify(&frame.bytes, WIDTH).map(|stamp| i64::from(stamp.instant)),
            Ok(instant)
        );
    }
}

#[test]
fn only_the_wire_of_the_trigger_source_triggers() {
    let mut bench = left(2, &[]);
    bench.set_all(&[("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Line2")]);
    assert_eq!(bench.execute("AcquisitionStart"), OK);
    bench.pulses(3, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frames(), []);
    let make = any(&[]).wired_to("Line2").expect("an entry");
    assert!(any(&[]).wired_to("Line7").is_err());
    let mut bench = Bench::new((2, 3), make, Habits::default());
    bench.set_all(&[("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Line2")]);
    assert_eq!(bench.execute("AcquisitionStart"), OK);
    bench.pulses(3, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frames().len(), 3);
}

#[test]
fn a_trigger_of_the_acquisition_that_is_left_on_keeps_frames_away() {
    for (host, entry) in [(4, "AcquisitionStart"), (5, "FrameBurstStart")] {
        let mode = format!("TriggerMode[{entry}]");
        let mut bench = left(host, &[(&mode, "On")]);
        bench.triggered();
        bench.pulses(3, PERIOD, WIDTH_OF_PULSE);
        assert_eq!(bench.frames(), [], "{entry}");
        assert_eq!(bench.execute("AcquisitionStop"), OK);
        bench.set_all(&[("TriggerSelector", entry), ("TriggerMode", "Off")]);
        bench.triggered();
        bench.pulses(3, PERIOD, WIDTH_OF_PULSE);
        assert_eq!(bench.frames().len(), 3, "{entry}");
    }
}

#[test]
fn activation_delay_and_overlap_decide_when_and_whether() {
    let mut bench = left(6, &[("TriggerActivation", "AnyEdge")]);
    bench.triggered();
    bench.pulses(3, PERIOD, Duration::from_millis(5));
    assert_eq!(bench.frames().len(), 6, "a pulse has two edges");
    assert_eq!(bench.execute("AcquisitionStop"), OK);
    bench.set_all(&[("TriggerActivation", "FallingEdge"), ("TriggerDelay", "2000")]);
    assert_eq!(bench.execute("AcquisitionStart"), OK);
    let start = bench.pulses(1, PERIOD, Duration::from_millis(5));
    let frame = bench.frame().expect("a frame");
    assert_eq!(frame.timestamp, bench.camera.clock().at(start + Duration::from_millis(7)) / 8);
    assert_eq!(bench.execute("AcquisitionStop"), OK);
    // 48 rows are read in 245 us: pulses 1.1 ms apart with exposures of 1 ms fit only where the two overlap.
    bench.set_all(&[("TriggerActivation", "RisingEdge"), ("TriggerDelay", "0")]);
    for (overlap, frames) in [("ReadOut", 20), ("Off", 10)] {
        bench.set_all(&[("TriggerOverlap", overlap)]);
        assert_eq!(bench.execute("AcquisitionStart"), OK);
        bench.pulses(20, Duration::from_micros(1100), WIDTH_OF_PULSE);
        assert_eq!(bench.frames().len(), frames, "{overlap}");
        assert_eq!(bench.execute("AcquisitionStop"), OK);
    }
}

#[test]
fn a_frame_rate_that_is_left_on_paces_triggers() {
    let mut bench = left(7, &[("AcquisitionFrameRateEnable", "true"), ("AcquisitionFrameRate", "25")]);
    bench.triggered();
    bench.pulses(10, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frames().len(), 5, "50 Hz at the most 25");
}

#[test]
fn single_frames_end_and_bursts_and_commands_trigger() {
    let mut bench = left(8, &[("AcquisitionMode", "SingleFrame")]);
    bench.triggered();
    bench.pulses(4, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frames().len(), 1);
    let mut bench = left(9, &[]);
    bench.set_all(&[
        ("TriggerSelector", "FrameBurstStart"),
        ("TriggerMode", "On"),
        ("TriggerSource", "Line1"),
    ]);
    assert_eq!(bench.execute("AcquisitionStart"), OK);
    bench.pulses(3, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frames().len(), 3, "a burst of one");
    let mut bench = left(10, &[]);
    bench.set_all(&[("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Software")]);
    assert_eq!(bench.execute("AcquisitionStart"), OK);
    bench.pulses(3, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frames(), []);
    assert_eq!(bench.execute("TriggerSoftware"), OK);
    assert_eq!(bench.frames().len(), 1);
}

/// Where in a frame the stamp is taken, and when the frame goes out.
#[test]
fn stamps_mean_what_the_camera_means() {
    let (exposure, readout, late) =
        (Duration::from_millis(4), Duration::from_millis(3), Duration::from_millis(40));
    let cases = [
        (StampPoint::ExposureStart, Some(Duration::ZERO)),
        (StampPoint::ExposureEnd, Some(exposure)),
        (StampPoint::ReadoutStart, Some(exposure + readout)),
        (StampPoint::LeaderSent, None),
    ];
    for (host, (stamp, after)) in (20..).zip(cases) {
        let habits = Habits { stamp, readout_late: readout, send_late: late, ..Habits::default() };
        let mut bench = Bench::new((2, host), any(&[]), habits);
        bench.set_all(&[("ExposureTime", "4000")]);
        bench.triggered();
        let edge = bench.pulses(1, PERIOD, WIDTH_OF_PULSE);
        let frame = bench.frame().expect("a frame");
        let clock = |at| bench.camera.clock().at(edge + at) / 8;
        match after {
            Some(after) => assert_eq!(frame.timestamp, clock(after), "{stamp:?}"),
            None => assert!(frame.timestamp >= clock(exposure + late), "not before it was sent"),
        }
    }
}

/// Mean grey value of the pixels beside the stamps of the test images.
fn mean(bytes: &[u8]) -> f64 {
    bytes.iter().map(|grey| f64::from(*grey)).sum::<f64>() / bytes.len() as f64
}

#[test]
fn what_somebody_left_spoils_the_picture_until_a_user_set_is_loaded() {
    let cases: [&[(&str, &str)]; 12] = [
        &[("GammaEnable", "true")],
        &[("LUTEnable", "true")],
        &[("GainAuto", "Continuous")],
        &[("ExposureAuto", "Continuous")],
        &[("Gain", "6")],
        &[("ReverseX", "true")],
        &[("BinningHorizontal", "2"), ("BinningVertical", "2")],
        &[("DecimationHorizontal", "2")],
        &[("TestPattern", "Ramp")],
        &[("ExposureMode", "TriggerWidth")],
        &[("SequencerMode", "On"), ("ExposureTime", "1000")],
        &[("ChunkModeActive", "true")],
    ];
    for (host, left_over) in (30..).zip(cases) {
        let mut bench = left(host, left_over);
        bench.triggered();
        bench.pulses(2, PERIOD, Duration::from_micros(500));
        let frames = bench.frames();
        assert_eq!(frames.len(), 2, "{left_over:?}");
        let (frame, light) = (&frames[1], bench.light(1));
        assert_ne!(frame.bytes, light, "{left_over:?}");
        let grey = mean(&frame.bytes) - mean(&light);
        match left_over[0].0 {
            "GammaEnable" | "GainAuto" | "ExposureAuto" | "Gain" => {
                assert!(grey > 5.0, "{left_over:?}: {grey}")
            }
            "ExposureMode" | "SequencerMode" => assert!(grey < -5.0, "{left_over:?}: {grey}"),
            "ReverseX" => {
                let mirrored = light.chunks(WIDTH).flat_map(|row| row.iter().rev().copied());
                assert_eq!(frame.bytes, mirrored.collect::<Vec<_>>());
            }
            "BinningHorizontal" => assert_eq!((frame.width, frame.height), (WIDTH / 2, HEIGHT / 2)),
            "DecimationHorizontal" => {
                assert_eq!((frame.width, frame.height), (WIDTH / 2, HEIGHT));
                assert_eq!(frame.bytes, light.iter().step_by(2).copied().collect::<Vec<_>>());
            }
            "TestPattern" => assert_eq!(frame.bytes[..4], [0, 1, 2, 3]),
            "ChunkModeActive" => {
                assert_eq!((frame.payload_type, frame.bytes.len()), (0x4001, WIDTH * HEIGHT + 8));
                assert_eq!(bench.integer("PayloadSize"), (WIDTH * HEIGHT + 8) as i64);
            }
            _ => {}
        }
        assert_eq!(bench.execute("AcquisitionStop"), OK);
        bench.set_all(&[("UserSetSelector", "Default")]);
        assert_eq!(bench.execute("UserSetLoad"), OK);
        bench.set_all(&[("ExposureTime", "1000")]);
        bench.triggered();
        bench.pulses(2, PERIOD, Duration::from_micros(500));
        let frames = bench.frames();
        assert_eq!(frames.len(), 2, "{left_over:?}");
        assert_eq!(frames[1].bytes, bench.light(1), "{left_over:?}");
    }
}

#[test]
fn exposures_that_are_far_from_the_lights_change_the_level() {
    let mut bench = left(50, &[]);
    for (exposure, brighter) in [("1020", 0.0), ("2000", 1.0), ("300", -1.0)] {
        bench.set_all(&[("ExposureTime", exposure)]);
        bench.triggered();
        bench.pulses(1, PERIOD, WIDTH_OF_PULSE);
        let grey = mean(&bench.frame().expect("a frame").bytes) - mean(&bench.light(0));
        assert_eq!(if grey.abs() < 1e-9 { 0.0 } else { grey.signum() }, brighter, "{exposure} us: {grey}");
        assert_eq!(bench.execute("AcquisitionStop"), OK);
    }
}

#[test]
fn offsets_and_wide_pixels_are_in_the_frame() {
    let mut bench = left(51, &[]);
    bench.set_all(&[("Width", "32"), ("OffsetX", "16"), ("PixelFormat", "Mono12p")]);
    bench.triggered();
    bench.pulses(1, PERIOD, WIDTH_OF_PULSE);
    let frame = bench.frame().expect("a frame");
    assert_eq!((frame.format, frame.width, frame.bytes.len()), (0x010c_0047, 32, 48 * HEIGHT));
    // Two pixels in three bytes, the lowest bit first; the light is in the upper 8 of 12 bits.
    let upper = [frame.bytes[1] << 4 | frame.bytes[0] >> 4, frame.bytes[2]];
    assert_eq!(upper, bench.light(0)[16..18]);
}

#[test]
fn clocks_count_in_their_own_ticks_and_ids_have_their_own_width() {
    let habits = Habits { tick_ns: 16, ..Habits::default() };
    let mut bench = Bench::new((2, 60), any(&[]), habits);
    bench.triggered();
    let edge = bench.pulses(1, PERIOD, WIDTH_OF_PULSE);
    let frame = bench.frame().expect("a frame");
    assert_eq!(frame.timestamp, bench.camera.clock().at(edge) / 16);
    assert_eq!(bench.read(0x093c, 8), Ok(62_500_000u64.to_be_bytes().to_vec()));
    let habits = Habits { extended_ids: true, ..Habits::default() };
    let mut bench = Bench::new((2, 61), any(&[]), habits);
    assert_eq!(bench.read(0x0960, 4), Ok(vec![0x40, 0, 0, 0]));
}

#[test]
fn a_camera_can_lack_what_its_table_has() {
    let table = any(&[]).table().clone();
    assert!(table.clone().without("Width").is_err() && table.clone().without("PixelFormat[Mono7]").is_err());
    let table = table.without("PixelFormat[Mono8]").and_then(|t| t.without("GevTimestampValue"));
    let make = Make::new(table.expect("both are there")).expect("a make");
    assert!(make.register("GevTimestampValue").is_none());
    let mut bench = Bench::new((2, 62), make, Habits::default());
    assert_eq!(bench.integer("PixelFormat"), 0x010c_0047, "the first that is left");
    bench.triggered();
    bench.pulses(1, PERIOD, WIDTH_OF_PULSE);
    assert_eq!(bench.frame().expect("a frame").format, 0x010c_0047);
}
