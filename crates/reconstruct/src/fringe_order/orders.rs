// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fringe orders of a frame's patches, and how certain they are.

use super::patches::{CELL_PX, Patches, Surface};
use crate::base::image::Plane;
use crate::kernels::pixel_runs::Runs;
use crate::kernels::simd;
use crate::triangulate::camera_projector::CameraProjector;

/// How certain the fringe order of each pixel is.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Regions {
    /// Column and row of the image at which the cells begin.
    pub(super) origin: (usize, usize),
    /// Cells in a row of the region of interest.
    pub(super) columns: usize,
    /// Patches that have an order: cell, pixels within it, by how much the order leads any other. Cell by cell.
    pub(super) patches: Vec<(u32, u64, f32)>,
}

impl Regions {
    /// The margin of the order at a pixel of the frame, such as a cloud's `pixel`; 0 where there is none.
    pub fn margin_at(&self, [u, v]: [u16; 2]) -> f32 {
        let place = usize::from(u).checked_sub(self.origin.0).zip(usize::from(v).checked_sub(self.origin.1));
        let Some((u, v)) = place.filter(|(u, _)| u / CELL_PX < self.columns) else { return 0.0 };
        let cell = (v / CELL_PX * self.columns + u / CELL_PX) as u32;
        let bit = 1u64 << (v % CELL_PX * CELL_PX + u % CELL_PX);
        let first = self.patches.partition_point(|patch| patch.0 < cell);
        let mut patches = self.patches[first..].iter().take_while(|patch| patch.0 == cell);
        patches.find(|patch| patch.1 & bit != 0).map_or(0.0, |patch| patch.2)
    }
}

/// A frame's patches and their fringe orders. Patches are cut while their phases are in the cache; their orders are
/// added when the phases are read again.
#[derive(Debug, Default)]
pub struct Orders {
    pub(super) patches: Patches,
    /// What to add to the phases of each patch, rad; NaN where there is no order, and for all patches before
    /// [`super::solve`].
    pub(super) shift: Vec<f32>,
}

impl Orders {
    /// Cuts a frame's wrapped phases into patches: they become those unwrapped within each cell.
    pub(crate) fn cut(
        phase: &mut Plane<f32>,
        period: &Plane<f32>,
        object: &Runs,
        pair: &CameraProjector,
    ) -> Self {
        let patches = Patches::cut(&mut Surface { phase, period, object, sign: pair.sign });
        let shift = vec![f32::NAN; patches.all.len()];
        Self { patches, shift }
    }

    /// Adds the orders to the phases.
    pub(crate) fn apply(&self, phase: &mut Plane<f32>) {
        simd::dispatch(
            #[inline(always)]
            || self.patches.shift(phase, &self.shift),
        );
    }
}
