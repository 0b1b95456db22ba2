// SPDX-License-Identifier: MIT OR Apache-2.0
//! Test images whose every row has the numbers of the camera and the instant that it shows.

use crate::images::ImageSource;

/// Bytes at the start of each row: camera (4), row number of the scene (4), both big-endian.
const STAMP: usize = 8;

/// A gradient that moves up by one row per instant. Each row begins with its stamp, so that a receiver can
/// tell the camera, the instant, and any row that is not where it belongs. Memory is one image and one row
/// for every further instant: image k is the scene from row k on.
#[derive(Debug)]
pub struct TestImages {
    width: usize,
    height: usize,
    distinct: usize,
    scene: Vec<u8>,
}

/// The numbers that a test image carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TestStamp {
    /// The camera number given to [`TestImages::new`].
    pub camera: u32,
    /// The instant, modulo the number of distinct images.
    pub instant: u32,
}

impl TestImages {
    /// Number of distinct images by default.
    pub const DISTINCT: usize = 4096;

    /// Images of this size for this camera; `distinct` instants look different, then they repeat. Sizes
    /// are raised to what a stamp needs: eight columns, one row, one instant.
    pub fn new(width: usize, height: usize, camera: u32, distinct: usize) -> Self {
        let (width, height, distinct) = (width.max(STAMP), height.max(1), distinct.max(1));
        let mut scene = Vec::with_capacity(width * (height + distinct - 1));
        super::net::prefer_huge_pages(scene.spare_capacity_mut());
        for row in 0..height + distinct - 1 {
            scene.extend(camera.to_be_bytes());
            scene.extend((row as u32).to_be_bytes());
            let shade = row.wrapping_mul(3).wrapping_add(camera as usize * 37);
            scene.extend((STAMP..width).map(|column| (column.wrapping_add(shade) & 0xff) as u8));
        }
        Self { width, height, distinct, scene }
    }

    /// Reads the stamps of a received image with `width` columns and checks every row.
    ///
    /// # Errors
    /// The first row that does not belong to the image that the first row announces.
    pub fn identify(image: &[u8], width: usize) -> Result<TestStamp, String> {
        let mut first = None;
        for (row, pixels) in image.chunks_exact(width.max(STAMP)).enumerate() {
            let word = |at: usize| pixels.get(at..at + 4).and_then(|b| <[u8; 4]>::try_from(b).ok());
            let (Some(camera), Some(number)) = (word(0), word(4)) else {
                return Err(format!("row {row} has no room for a stamp"));
            };
            let found = (u32::from_be_bytes(camera), u32::from_be_bytes(number));
            let (camera, start) = *first.get_or_insert(found);
            let expected = (camera, start.wrapping_add(row as u32));
            if found != expected {
                return Err(format!(
                    "row {row} is stamped {found:?}, expected {expected:?} (camera, scene row)"
                ));
            }
        }
        let (camera, instant) = first.ok_or("the image has no row")?;
        Ok(TestStamp { camera, instant })
    }
}

impl ImageSource for TestImages {
    fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn pixels(&self, instant: i64) -> &[u8] {
        let start = instant.rem_euclid(self.distinct as i64) as usize * self.width;
        &self.scene[start..start + self.width * self.height]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_say_what_they_are() {
        let images = TestImages::new(32, 20, 3, 100);
        for (instant, expected) in [(0, 0), (57, 57), (100, 0), (-1, 99), (i64::MIN, 92)] {
            let stamp = TestImages::identify(images.pixels(instant), 32);
            assert_eq!(stamp, Ok(TestStamp { camera: 3, instant: expected }));
        }
        let mut torn = images.pixels(4).to_vec();
        torn[32 * 10..].copy_from_slice(&images.pixels(5)[32 * 10..]);
        assert!(TestImages::identify(&torn, 32).is_err(), "rows of two instants must not pass");
    }
}
