// SPDX-License-Identifier: MIT OR Apache-2.0
//! `arv-camera-test-0.8` while packets get lost: its own options decide what it asks for again.

use crate::third_party_camera::{counters_of, options, start, stream_counters};
use fourdbody_simulator::gige::CameraOptions;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// A camera whose every fourth frame loses one packet on its first way.
fn lossy(address: [u8; 4]) -> CameraOptions {
    let mut options = options(address);
    options.lose = Some(Arc::new(|block, packet| block % 4 == 0 && packet == 4));
    options
}

#[test]
fn without_resends_every_lossy_frame_fails_and_no_other() {
    let camera = start(lossy([127, 21, 8, 1]));
    let arguments = ["--no-packet-socket", "-f", "30", "-i", "2500", "-r"];
    let Some((printed, counters)) = stream_counters(&camera, &arguments) else { return };
    let (failed, completed) = (counters["n_failures"], counters["n_completed_buffers"]);
    assert_eq!((counters["n_resend_requests"], counters["n_resent_packets"]), (0, 0), "{printed}");
    assert_eq!(camera.statistics().packets_resent.load(Relaxed), 0);
    // One frame in four, give or take the ends of the stream.
    assert!(completed > 20 && failed.abs_diff(completed / 3) <= 2, "{failed} failed:\n{printed}");
}

/// Version 0.8.26 takes `-q`, the largest share of a frame's packets to ask for again, and does not act on it
/// (tried: 0, 0.1 and 1): all of them are asked for.
#[test]
fn half_the_packets_of_a_frame_are_sent_again() {
    let mut options = options([127, 21, 8, 2]);
    options.lose = Some(Arc::new(|block, packet| block % 4 == 0 && packet % 2 == 1));
    let camera = start(options);
    let arguments = ["--no-packet-socket", "-f", "30", "-i", "1500", "-l", "2"];
    let Some((printed, counters)) = stream_counters(&camera, &arguments) else { return };
    let (resent, completed) = (counters["n_resent_packets"], counters["n_completed_buffers"]);
    // 53 payload packets a frame: 26 or 27 of them every fourth frame.
    assert!(completed > 20 && resent >= (completed / 4).saturating_sub(1) * 26, "{printed}");
    assert_eq!((counters["n_failures"], counters["n_missing_packets"]), (0, 0), "{printed}");
}

/// Nothing is lost on purpose: frames of 2.3 MB meet the kernel's default buffer of 208 KiB, because the
/// program is not told to raise it (`-a`) and must not use a packet socket. What the socket drops is sent again.
#[test]
fn what_a_small_socket_buffer_drops_is_sent_again() {
    let mut options = options([127, 21, 8, 3]);
    let images = fourdbody_simulator::gige::TestImages::new(1920, 1200, 3, 4);
    options.images = Arc::new(images);
    let camera = start(options);
    let address = camera.address().to_string();
    let arguments = [
        "-n",
        &address,
        "--duration",
        "4",
        "-j",
        "never",
        "--no-packet-socket",
        "-f",
        "4",
        "-i",
        "9000",
        "-m",
        "1000",
        "-p",
        "20",
        "-q",
        "2.0",
        "-l",
        "5",
    ];
    let Some((printed, counters)) = counters_of(&arguments) else { return };
    let (resent, completed) = (counters["n_resent_packets"], counters["n_completed_buffers"]);
    assert!(resent > 0, "a default buffer that holds whole frames? {printed}");
    assert!(completed >= 4, "{printed}");
    assert!(camera.statistics().packets_resent.load(Relaxed) >= resent);
    assert_eq!(camera.statistics().resends_unavailable.load(Relaxed), 0, "{printed}");
}
