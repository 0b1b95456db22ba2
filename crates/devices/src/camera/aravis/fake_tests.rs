// SPDX-License-Identifier: MIT OR Apache-2.0
//! Aravis' own fake camera through this backend. It is no GigE Vision camera, as USB3 Vision cameras are none: no
//! packets, no registers with its controller. Other differences of USB3 cameras have not been tested.

use super::AravisCameras;
use crate::camera::profile::tests::wishes;
use crate::camera::{Camera, CameraBackend, CameraError, StreamOptions, Transfer, Wishes, quiet_stream};
use crate::config::{Pixel, SocketMode};
use crate::host::frame_memory::Pool;
use std::time::{Duration, Instant};

const SIZE: (usize, usize) = (256, 128);

/// `None`, with a printed reason, where Aravis was built without it.
fn fake() -> Option<Box<dyn Camera>> {
    // SAFETY: the name lives for ever, and Aravis serializes access to its interfaces.
    unsafe { aravis_sys::arv_enable_interface(c"Fake".as_ptr()) };
    match AravisCameras.open("Fake_1") {
        Ok(camera) => Some(camera),
        Err(error) => {
            println!("skipped: Aravis has no fake camera here ({error})");
            None
        }
    }
}

/// Requirements for a free-running camera of this pixel format.
fn free_running(pixel: Pixel) -> Wishes {
    // Its values are scaled by the exposure, by one at 10 ms.
    let mut wishes = Wishes { size: SIZE, triggered: false, exposure_us: 10_000.0, ..wishes() };
    wishes.words.pixel = Some(pixel);
    wishes
}

#[test]
fn a_camera_without_packets_and_registers_says_who_it_is_and_what_it_has() {
    let Some(mut camera) = fake() else { return };
    assert_eq!((camera.identity().vendor.as_str(), camera.identity().model.as_str()), ("Aravis", "Fake"));
    assert!(camera.is_alive() && camera.not_ours().is_none());
    assert!(camera.state().expect("read").contains_key("Width"));
    assert!(camera.image_size().is_ok());
    assert_eq!(camera.test_packet_size(9000).expect("no test"), None);
    assert!(camera.sample_clock().expect("answers").is_none());
    assert!(camera.why_no_clock().is_some());
    assert!(camera.trigger_lines().contains(&"Line0".to_owned()));
}

#[test]
fn what_it_cannot_be_set_to_is_refused_by_name() {
    let Some(mut camera) = fake() else { return };
    let mut wishes = Wishes { size: SIZE, ..wishes() };
    wishes.words.trigger_line = Some("Line9".to_owned());
    wishes.words.pixel = Some(Pixel::Mono12p);
    let Err(CameraError::SetUp { problems }) = camera.set_up(&wishes) else { panic!("it has neither") };
    let all = problems.join("\n");
    for words in ["`Line9` is not an entry of TriggerSource: ", "`Mono12p` is not an entry of PixelFormat: "]
    {
        assert!(all.contains(words), "{words:?} missing in\n{all}");
    }
}

/// Its pixels are numbers that follow from place and frame, in 8 bits and in 16.
#[test]
fn its_frames_arrive_and_16_bits_become_8() {
    for pixel in [Pixel::Mono8, Pixel::Mono16] {
        let Some(mut camera) = fake() else { return };
        let contract = camera.set_up(&free_running(pixel)).expect("set up").contract;
        assert_eq!((contract.pixel, contract.size), (pixel, SIZE));
        let pool = Pool::new(false, 0);
        let options =
            StreamOptions { contract, packet_bytes: 9000, socket: SocketMode::Auto, period_ns: 40_000_000 };
        let blocks = || pool.take(contract.pixels(), contract.received_bytes(), 8);
        let (mut stream, _) = quiet_stream(camera.as_mut(), blocks, &options).expect("a stream");
        camera.start().expect("started");
        let until = Instant::now() + Duration::from_secs(20);
        let mut frames = 0;
        while frames < 5 && Instant::now() < until {
            let Some(frame) = stream.next(Duration::from_millis(100)) else { continue };
            assert_eq!(frame.transfer, Transfer::Complete, "{pixel:?}");
            for (at, value) in frame.block.pixels().iter().enumerate().step_by(7) {
                let sum = at % SIZE.0 + at / SIZE.0 + frame.block_id.0 as usize;
                let expected = if pixel == Pixel::Mono8 { sum % 255 } else { (256 * sum % 65_535) >> 8 };
                assert_eq!(usize::from(*value), expected, "{pixel:?} {at}");
            }
            frames += 1;
        }
        assert!(
            stream.activity() >= 5 && stream.counters().iter().any(|(name, _)| name == "n_completed_buffers")
        );
        assert!(stream.counters().iter().all(|(name, _)| !name.contains("packets")), "it has none");
        camera.stop().expect("stopped");
        assert_eq!(frames, 5, "{pixel:?}");
    }
}
