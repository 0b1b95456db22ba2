//! Directional clouds of one trigger to one merged cloud.

use crate::export::Cloud;

/// Puts directional clouds together, each with its camera's number (its place in the calibration), in the
/// order given. Nothing is thinned out or averaged: where two cameras see a patch, both see it there.
pub fn merge<'a>(clouds: impl IntoIterator<Item = (u8, &'a Cloud)>) -> Cloud {
    let mut merged = Cloud::default();
    for (camera, cloud) in clouds {
        merged.merge(cloud, camera);
    }
    merged
}
