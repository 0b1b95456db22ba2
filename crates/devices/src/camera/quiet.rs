// SPDX-License-Identifier: MIT OR Apache-2.0
//! Fresh streams that have received nothing yet.
//!
//! A packet socket receives every datagram of its interface between its creation and the setting of its filter:
//! answers of other cameras, and on loopback any traffic. Aravis 0.8.26 reads a block id from such a datagram and
//! takes it for the newest; up to 100 good frames behind that id are then thrown away. So a stream that received
//! something before its camera was started is made anew.
//!
//! Where others send without a pause, no packet socket is ever quiet. A UDP socket receives only what is sent to its
//! own port, and is used then, at the cost of more processor time.

use super::backend::{Camera, FrameStream, StreamOptions};
use super::error::CameraError;
use crate::config::SocketMode;
use crate::host::frame_memory::Block;
use std::io;
use std::time::{Duration, Instant};

/// Wait until packets that arrived before the filter was set are counted: the socket's ring hands them over within a
/// few milliseconds.
const SETTLE: Duration = Duration::from_millis(40);
/// Attempts to get a quiet stream, with either kind of socket.
const ATTEMPTS: usize = 4;

/// A fresh stream, and whether it is quiet: `false` when each of several attempts received something. The camera's
/// acquisition must not run.
///
/// # Errors
/// As [`Camera::create_stream`], or there is no memory for frames.
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
            let received = stream.activity();
            if received == 0 || last {
                return Ok((stream, received == 0));
            }
            tracing::debug!(attempt, received, "a fresh stream received foreign packets: it is made anew");
        }
        tracing::warn!(
            "others are sending all the time on a camera's interface: its stream gets a UDP socket"
        );
        options.socket = SocketMode::Standard;
    }
}
