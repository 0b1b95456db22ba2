// SPDX-License-Identifier: MIT OR Apache-2.0
//! A stream that has heard nothing yet.
//!
//! A packet socket takes every datagram of its interface for its own between its creation and the setting of its
//! filter: answers of other cameras, on loopback anything. Aravis 0.8.26 reads a block id out of such a datagram and
//! takes it for the newest; up to 100 good frames behind that id are then thrown away. So a stream that heard
//! something before its camera was told to send is made anew.
//!
//! Where others send without a pause no packet socket may ever be quiet. A UDP socket hears what is sent to its own
//! port alone, and is taken then, at the cost of more processor time.

use super::{Camera, CameraError, FrameStream, StreamOptions};
use crate::config::SocketMode;
use crate::host::frame_memory::Block;
use std::io;
use std::time::{Duration, Instant};

/// What a socket took before its filter was set must have been counted after this time: the ring hands over what it
/// holds within a few milliseconds.
const SETTLE: Duration = Duration::from_millis(40);
/// So often a stream is made anew, with either kind of socket.
const ATTEMPTS: usize = 4;

/// A fresh stream and whether it is quiet: `false` when each of several attempts heard something, although the camera
/// was not told to send. Its acquisition must not run.
///
/// # Errors
/// As [`Camera::create_stream`]; or there is no memory for frames.
pub fn quiet_stream(
    camera: &mut dyn Camera,
    mut blocks: impl FnMut() -> io::Result<Vec<Block>>,
    options: &StreamOptions,
) -> Result<(Box<dyn FrameStream>, bool), CameraError> {
    let mut options = options.clone();
    loop {
        for attempt in 1..=ATTEMPTS {
            let blocks = blocks().map_err(|e| CameraError::Memory(e.to_string()))?;
            let mut stream = camera.create_stream(blocks, &options)?;
            let settled = Instant::now() + SETTLE;
            while Instant::now() < settled {
                drop(stream.next(SETTLE / 4));
            }
            let last = attempt == ATTEMPTS && options.socket == SocketMode::Standard;
            let heard = stream.activity();
            if heard == 0 || last {
                return Ok((stream, heard == 0));
            }
            tracing::debug!(attempt, heard, "a fresh stream heard foreign packets: another one");
        }
        tracing::warn!(
            "others are sending all the time on a camera's interface: its stream gets a UDP socket"
        );
        options.socket = SocketMode::Standard;
    }
}
