// SPDX-License-Identifier: MIT OR Apache-2.0
//! A frame set as few bytes for a browser, which `web/player.js` unpacks.
//!
//! A zlib stream of twelve planes of bytes: low and high bytes of x, y and z in tenths of a millimetre, each stored as
//! the difference from the point before; the normal in three planes, intensity, camera, uncertainty, as [`encode`] has
//! them. Points lie along a space-filling curve, so that differences are small.

use crate::data::Cloud;
use crate::preview::quick_look::{POINT_BYTES, encode};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use std::io::Write;

/// At most `most` points of a merged cloud.
///
/// # Errors
/// The points cannot be packed.
pub fn packed(cloud: &Cloud, most: usize) -> Result<Vec<u8>, String> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    let written = encoder.write_all(&planes(&along_a_curve(cloud, most)));
    written.and_then(|()| encoder.finish()).map_err(|e| format!("points cannot be packed: {e}"))
}

/// At most `most` points, evenly left out, in the order of a space-filling curve (Morton's): 12 bytes each.
fn along_a_curve(cloud: &Cloud, most: usize) -> Vec<[u8; POINT_BYTES]> {
    let bytes = encode(cloud, most);
    let (points, _) = bytes.as_chunks::<POINT_BYTES>();
    let mut points = points.to_vec();
    points.sort_by_cached_key(|point| {
        // Offset so that nothing is negative.
        let axis = |i: usize| u64::from(u16::from_le_bytes([point[i], point[i + 1]]) ^ 0x8000);
        spread(axis(0)) | spread(axis(2)) << 1 | spread(axis(4)) << 2
    });
    points
}

/// The 16 low bits, each three places from the next.
fn spread(bits: u64) -> u64 {
    (0..16).map(|i| (bits >> i & 1) << (3 * i)).sum()
}

/// The points' bytes plane by plane, places as differences.
fn planes(points: &[[u8; POINT_BYTES]]) -> Vec<u8> {
    let count = points.len();
    let mut planes = vec![0; count * POINT_BYTES];
    let mut before = [0u16; 3];
    for (i, point) in points.iter().enumerate() {
        for (axis, before) in before.iter_mut().enumerate() {
            let at = u16::from_le_bytes([point[2 * axis], point[2 * axis + 1]]);
            let [low, high] = at.wrapping_sub(*before).to_le_bytes();
            (planes[2 * axis * count + i], planes[(2 * axis + 1) * count + i]) = (low, high);
            *before = at;
        }
        for byte in 6..POINT_BYTES {
            planes[byte * count + i] = point[byte];
        }
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::{along_a_curve, planes};
    use crate::data::Cloud;
    use crate::preview::quick_look::{POINT_BYTES, encode};
    use proptest::prelude::*;

    /// What the player does with the planes.
    fn unpacked(planes: &[u8]) -> Vec<[u8; POINT_BYTES]> {
        let count = planes.len() / POINT_BYTES;
        let mut at = [0u16; 3];
        let point = |i: usize| {
            let mut point: [u8; POINT_BYTES] = std::array::from_fn(|byte| planes[byte * count + i]);
            for (axis, at) in at.iter_mut().enumerate() {
                *at = at.wrapping_add(u16::from_le_bytes([point[2 * axis], point[2 * axis + 1]]));
                point[2 * axis..2 * axis + 2].copy_from_slice(&at.to_le_bytes());
            }
            point
        };
        (0..count).map(point).collect()
    }

    fn cloud(places: &[[f32; 3]]) -> Cloud {
        Cloud {
            position_m: places.to_vec(),
            normal: vec![[0.0, 0.6, -0.8]; places.len()],
            intensity: vec![0.25; places.len()],
            pixel: vec![[0, 0]; places.len()],
            camera: vec![3; places.len()],
            sigma_m: vec![2e-4; places.len()],
        }
    }

    proptest! {
        #[test]
        fn every_point_comes_back_once(places in prop::collection::vec(prop::array::uniform3(-3.2f32..3.2), 0..200)) {
            let cloud = cloud(&places);
            let curve = along_a_curve(&cloud, usize::MAX);
            prop_assert_eq!(unpacked(&planes(&curve)), curve.clone());
            let bytes = encode(&cloud, usize::MAX);
            let mut points = bytes.as_chunks::<POINT_BYTES>().0.to_vec();
            let mut found = curve;
            points.sort_unstable();
            found.sort_unstable();
            prop_assert_eq!(found, points);
        }

        #[test]
        fn never_more_points_than_asked(count in 0usize..400, most in 1usize..100) {
            let places: Vec<[f32; 3]> = (0..count).map(|i| [i as f32 * 1e-3, 0.0, 1.0]).collect();
            let kept = along_a_curve(&cloud(&places), most).len();
            prop_assert!(kept <= most && (count == 0 || kept > 0));
        }
    }
}
