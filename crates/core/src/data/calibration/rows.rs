// SPDX-License-Identifier: MIT OR Apache-2.0
//! The calibration of frames that have fewer rows than the camera gives.

use super::Calibration;

impl Calibration {
    /// The calibration of frames in which each row is the mean of `rows` rows (at least 1) of the photograph: row r
    /// lies in the middle of the rows from r times `rows` on.
    #[must_use]
    pub fn with_binned_rows(self, rows: usize) -> Self {
        self.with_rows_apart(rows, |height| height / rows, (rows as f64 - 1.0) / 2.0)
    }

    /// The calibration of frames of which rows 0, n, 2 n, ... are there.
    #[must_use]
    pub fn with_every_nth_row(self, n: usize) -> Self {
        self.with_rows_apart(n, |height| height.div_ceil(n), 0.0)
    }

    /// The calibration of rows that are `rows` apart, the first of them at `first`.
    fn with_rows_apart(mut self, rows: usize, height: impl Fn(usize) -> usize, first: f64) -> Self {
        let n = rows as f64;
        for camera in self.heads.iter_mut().flat_map(|head| &mut head.cameras) {
            let device = &mut camera.device;
            device.height = height(device.height);
            device.lens.fy /= n;
            device.lens.cy = (device.lens.cy - first) / n;
        }
        self
    }
}
