// SPDX-License-Identifier: MIT OR Apache-2.0
//! Do the pixels of a recorded frame show the camera and the instant that it is recorded under?

use crate::gige::TestImages;
use fourdbody::base::ids::TriggerIndex;
use fourdbody::record::RecordingReader;

/// What is wrong with the pixels of the frame at `trigger`, when all cameras send [`TestImages`] with
/// [`TestImages::DISTINCT`] instants and this one has been given the number `stamp`. Gaps have no pixels.
pub fn wrong(recording: &RecordingReader, camera: usize, trigger: u64, stamp: u32) -> Option<String> {
    let Ok(Ok(frame)) = recording.frame(camera, TriggerIndex(trigger)) else { return None };
    let found = match TestImages::identify(frame.image.as_slice(), frame.image.width()) {
        Ok(found) => found,
        Err(torn) => return Some(format!("its pixels are not one test image: {torn}")),
    };
    let distinct = TestImages::DISTINCT as u64;
    (found.camera != stamp || u64::from(found.instant) != trigger % distinct).then(|| {
        format!(
            "its pixels show camera {} at instant {}, expected camera {stamp} at {} (instants modulo {distinct})",
            found.camera,
            found.instant,
            trigger % distinct
        )
    })
}
