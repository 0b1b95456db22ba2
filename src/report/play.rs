// SPDX-License-Identifier: MIT OR Apache-2.0
//! All reconstructed frame sets of a session inside the report's page, for its player (`web/player.js`).
//!
//! Each frame set is a script element of its own, `set-0`, `set-1`..., in the order of triggers: the first one can be shown
//! while the page is still read. Its text is base64 of a zlib stream of twelve planes of bytes: low and high bytes of x, y and
//! z in tenths of a millimetre, each told as the difference from the point before; the normal in three planes, intensity,
//! camera, uncertainty, as [`encode`] has them. Points lie along a space-filling curve, so that differences are small.

use crate::batch::result::{Clouds, Place};
use crate::data::Cloud;
use crate::preview::quick_look::{POINT_BYTES, POINTS_MAX, encode};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flate2::Compression;
use flate2::write::ZlibEncoder;
use rayon::prelude::*;
use std::io::Write;
use std::path::Path;

/// Frame sets that are packed at a time, which bounds the memory.
const AT_ONCE: usize = 8;

/// The frame sets of a reconstruction, and how many points of each the page gets.
pub struct Playing {
    clouds: Clouds,
    sets: Vec<(u64, Place)>,
    points_each: usize,
}

impl Playing {
    /// The merged clouds of `result`, the directory of `fourdbody reconstruct`. Together they have at most `most_bytes`
    /// bytes of points before they are packed, and each at most [`POINTS_MAX`] points.
    pub fn open(result: &Path, most_bytes: u64) -> Result<Self, String> {
        let clouds = Clouds::open(result)?;
        let sets: Vec<_> = clouds.merged.iter().map(|(trigger, place)| (*trigger, place.clone())).collect();
        if sets.is_empty() {
            return Err(format!(
                "{}: expected merged clouds or phase maps, found none: reconstruct the session first",
                result.display()
            ));
        }
        let share = most_bytes / sets.len() as u64 / POINT_BYTES as u64;
        let points_each = usize::try_from(share).unwrap_or(usize::MAX).clamp(1, POINTS_MAX);
        Ok(Self { clouds, sets, points_each })
    }

    /// The triggers that have a cloud, ascending.
    pub fn triggers(&self) -> impl Iterator<Item = u64> + '_ {
        self.sets.iter().map(|(trigger, _)| *trigger)
    }

    /// Points that a frame set has at most.
    pub fn points_each(&self) -> usize {
        self.points_each
    }

    /// Writes the elements. `progress` hears of the frame sets that are done, and of how many.
    pub fn write(&self, out: &mut impl Write, progress: impl Fn(u64, u64)) -> Result<(), String> {
        for (chunk, sets) in self.sets.chunks(AT_ONCE).enumerate() {
            let packed: Vec<Vec<u8>> =
                sets.par_iter().map(|(_, place)| self.packed(place)).collect::<Result<_, _>>()?;
            for (i, packed) in packed.iter().enumerate() {
                let place = chunk * AT_ONCE + i;
                let text = STANDARD.encode(packed);
                writeln!(out, "<script type=\"application/octet-stream\" id=\"set-{place}\">{text}</script>")
                    .map_err(|e| format!("the page cannot be written: {e}"))?;
                progress(place as u64 + 1, self.sets.len() as u64);
            }
        }
        Ok(())
    }

    fn packed(&self, place: &Place) -> Result<Vec<u8>, String> {
        let (_, cloud) = self.clouds.load(place)?;
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
        let written = encoder.write_all(&planes(&along_a_curve(&cloud, self.points_each)));
        written.and_then(|()| encoder.finish()).map_err(|e| format!("points cannot be packed: {e}"))
    }
}

/// At most `most` points, evenly left out, in the order of a space-filling curve (Morton's): 12 bytes each.
fn along_a_curve(cloud: &Cloud, most: usize) -> Vec<[u8; POINT_BYTES]> {
    let bytes = encode(cloud, most);
    let (points, _) = bytes.as_chunks::<POINT_BYTES>();
    let mut points = points.to_vec();
    points.sort_by_cached_key(|point| {
        // From the least place that there is, so that nothing is negative.
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
