// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rows of a frame added up, so that a frame takes a part of the time: the image before the first stage, and the
//! calibration that goes with it. Fringes run along the rows of the scene and across the columns of the image, so
//! that sums of few rows lose little of them.

use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::{Mono8, Plane};
use crate::data::{Frame, FrameSource, LostPart, SessionIdentity, SourceStatement};
use std::ops::Range;
use std::path::PathBuf;

/// Rows that may be added up: the marker, which changes along the columns, must be left, and a device that has turned
/// must be noticed (docs/design/reconstruction.md, Fewer rows).
pub const MOST_ROWS: usize = 3;

/// A source whose frames are those of another one, with fewer rows.
pub struct BinnedSource {
    source: Box<dyn FrameSource>,
    rows: usize,
}

impl BinnedSource {
    /// A source in which `rows` rows of `source` make one row; with 1 that is the source itself.
    pub fn around(source: Box<dyn FrameSource>, rows: usize) -> Box<dyn FrameSource> {
        if rows > 1 { Box::new(Self { source, rows }) } else { source }
    }
}

impl FrameSource for BinnedSource {
    fn cameras(&self) -> &[CameraId] {
        self.source.cameras()
    }

    fn triggers(&self) -> Range<u64> {
        self.source.triggers()
    }

    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
        let frame = self.source.frame(camera, trigger)?;
        let image = frame.image().map(|image| binned(image, self.rows));
        Ok(image.map_or(frame, Frame::Owned))
    }

    fn identity(&self) -> Result<SessionIdentity, String> {
        self.source.identity()
    }

    fn left_out(&self) -> &[PathBuf] {
        self.source.left_out()
    }

    fn lost(&self) -> &[LostPart] {
        self.source.lost()
    }

    fn statement(&self) -> Option<SourceStatement> {
        self.source.statement()
    }

    fn trigger_time_ns(&self, trigger: TriggerIndex) -> Option<u64> {
        self.source.trigger_time_ns(trigger)
    }

    fn time_base(&self) -> Option<String> {
        self.source.time_base()
    }
}

/// Means of this number of rows each, rounded; rows at the end that do not fill one are left out.
fn binned(image: Mono8<'_>, rows: usize) -> Plane<u8> {
    let (width, height) = (image.width(), image.height() / rows);
    let mut out = Plane::filled(width, height, 0u8);
    let mut sums = vec![0u16; width];
    for v in 0..height {
        sums.fill(rows as u16 / 2);
        for from in v * rows..(v + 1) * rows {
            sums.iter_mut().zip(image.row(from)).for_each(|(sum, &x)| *sum += u16::from(x));
        }
        for (to, &sum) in out.row_mut(v).iter_mut().zip(&sums) {
            *to = (sum / rows as u16) as u8;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::binned;
    use crate::base::image::{Mono8, Plane};
    use crate::config::Rig;
    use crate::data::Calibration;
    use std::path::Path;

    #[test]
    fn rows_are_means() {
        let image = Plane::from_vec(2, 5, vec![1, 10, 2, 20, 3, 30, 4, 41, 255, 255]).expect("ten pixels");
        let found = binned(Mono8::from(&image), 2);
        assert_eq!((found.width(), found.height(), found.as_slice()), (2, 2, &[2, 15, 4, 36][..]));
        let bright = Plane::filled(3, 4, 255u8);
        assert_eq!(binned(Mono8::from(&bright), 4).as_slice(), [255; 3]);
    }

    #[test]
    fn lines_of_sight_are_those_of_the_middle_of_the_rows() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        let whole = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        for rows in 1..=super::MOST_ROWS {
            let middle = (rows as f64 - 1.0) / 2.0;
            let binned = (whole.clone().with_binned_rows(rows), middle);
            let single = (whole.clone().with_every_nth_row(rows), 0.0);
            for (less, first) in [binned, single] {
                for ((_, a), (_, b)) in whole.cameras().zip(less.cameras()) {
                    assert_eq!(b.device.height, a.device.height / rows);
                    for (u, v) in [(3.0, 0.0), (1100.0, 71.0), (1900.0, (b.device.height - 1) as f64)] {
                        let of_rows = a.device.ray(u, v * rows as f64 + first);
                        let (expected, found) = (of_rows.expect("a ray"), b.device.ray(u, v).expect("a ray"));
                        assert!((expected.at(2.0) - found.at(2.0)).norm() < 1e-9);
                    }
                }
            }
        }
    }
}
