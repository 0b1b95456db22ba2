//! A stream that has heard nothing yet.
//!
//! A packet socket takes every datagram of its interface for its own between its creation and the setting of its
//! filter: answers of other cameras, on loopback anything. Aravis 0.8.26 reads a block id out of such a datagram and
//! takes it for the newest; up to 100 good frames behind that id are then thrown away. So a stream that heard
//! something before its camera was told to send is made anew.

use super::{Camera, CameraError, FrameStream, StreamOptions};
use crate::acquire::pool::Block;
use std::time::{Duration, Instant};

/// What a socket took before its filter was set must have been counted after this time: the ring hands over what it
/// holds within a few milliseconds.
const SETTLE: Duration = Duration::from_millis(40);
/// So often a stream is made anew. Beside cameras that are sending already no stream may ever be quiet.
const ATTEMPTS: usize = 5;

/// A fresh stream and whether it is quiet: `false` when each of several attempts heard something, although the camera
/// was not told to send. Its acquisition must not run.
///
/// # Errors
/// As [`Camera::create_stream`].
pub fn quiet_stream(
    camera: &mut dyn Camera,
    mut blocks: impl FnMut() -> Vec<Block>,
    options: &StreamOptions,
) -> Result<(Box<dyn FrameStream>, bool), CameraError> {
    let mut attempt = 1;
    loop {
        let mut stream = camera.create_stream(blocks(), options)?;
        let settled = Instant::now() + SETTLE;
        while Instant::now() < settled {
            drop(stream.next(SETTLE / 4));
        }
        let quiet = stream.heard() == 0;
        if quiet || attempt == ATTEMPTS {
            return Ok((stream, quiet));
        }
        tracing::debug!(attempt, heard = stream.heard(), "a fresh stream heard foreign packets: another one");
        attempt += 1;
    }
}
