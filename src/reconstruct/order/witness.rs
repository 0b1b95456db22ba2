//! What the other cameras say about a place in space.
//!
//! All cameras photograph the same instant. A surface that one of them claims must look right to each of the others: at
//! the pixel where it would be seen there is the same surface, or something before it. A claimed surface that stands
//! before what another camera sees there, or where that camera looks past the body, is not there. Places are compared by
//! the phase of the other camera's own projector: the phase that it casts on the place against the one that is seen.

use super::cells::{CELL_PX, Cells, Glimpse};
use crate::reconstruct::pair::Pair;
use crate::reconstruct::roi::Roi;
use nalgebra::{Point3, Vector3};
use std::f32::consts::TAU;

/// Phases of the same surface differ by less, rad.
const SAME_RAD: f32 = 0.8;

/// Phases of different surfaces differ by more, rad; what lies between says nothing.
const OTHER_RAD: f32 = 1.6;

/// Background must be as wide around a place, px: outlines are not sharp.
const BACKGROUND_PX: f32 = 10.0;

/// A camera as a witness for the others.
#[derive(Debug)]
pub struct Witness<'a> {
    /// Camera, projector and pattern.
    pub pair: &'a Pair,
    /// Which head it belongs to.
    pub head: usize,
    /// Where its planes lie in the frame.
    pub roi: Roi,
    /// Its nodes, and the pixels with the phase that it has unwrapped, up to the orders of the pieces.
    pub cells: Cells,
    /// Sign of the projected phase's change with the distance from the camera.
    towards: f32,
}

/// What a camera has at the pixel where it would see a place.
#[derive(Debug, Clone, Copy)]
pub enum Sight {
    /// Nothing that could be said.
    Nothing,
    /// It looks past the object there.
    Past,
    /// A node, and its phase there less the one that is cast on the place, rad.
    Node(u32, f32),
}

/// What a camera has around the pixel where it would see a place.
#[derive(Debug, Clone, Copy)]
pub struct Glance {
    /// Column and row in the frame.
    u: f32,
    v: f32,
    cell: Glimpse,
}

impl Glance {
    /// Nowhere.
    pub const NONE: Self = Self { u: f32::NAN, v: f32::NAN, cell: Glimpse::Beside };
}

/// What a place is, compared with the surface that a camera sees along the same ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Cannot be said.
    Nothing,
    /// The same surface.
    Agrees,
    /// Before it: the camera would not see its surface if the place were there.
    Before,
    /// Behind it, so that the camera cannot see it.
    Behind,
    /// Beside the body.
    Past,
}

impl<'a> Witness<'a> {
    /// A witness with the phase that it has unwrapped so far.
    pub fn new(pair: &'a Pair, head: usize, roi: Roi, cells: Cells) -> Self {
        let middle =
            Point3::from((Vector3::from(pair.volume_min_m) + Vector3::from(pair.volume_max_m)) / 2.0);
        let from = pair.camera.centre();
        let cast = |distance: f64| {
            let at = middle + (middle - from).normalize() * distance;
            pair.projector.project(&at).map_or(0.0, |[column, _]| pair.pattern.phase(column))
        };
        let towards = (cast(0.01) - cast(-0.01)).signum() as f32;
        Self { pair, head, roi, cells, towards }
    }

    /// Reads what the camera has at a place of its frame. What is read decides nothing here, so that the reads of all
    /// cameras are under way together: they lie far apart, and waiting for one after the other is what looking costs.
    #[inline(always)]
    pub fn glance(&self, u: f32, v: f32) -> Glance {
        let (x, y) = self.pixel(u, v);
        Glance { u, v, cell: self.cells.glimpse(x, y) }
    }

    /// The pixel of the region of interest that shows a place of the frame, between it and the next. What lies before the
    /// first becomes a number beyond all; NaN anything: `see` looks at the place before all else.
    #[inline(always)]
    fn pixel(&self, u: f32, v: f32) -> (usize, usize) {
        ((u as usize).wrapping_sub(self.roi.u), ((v + 0.5) as usize).wrapping_sub(self.roi.v))
    }

    /// What the camera has where it would see a place, by what was read there and the phase that its projector casts on
    /// the place, rad.
    #[inline(always)]
    pub fn see(&self, glance: &Glance, cast: f32) -> Sight {
        let Glance { u, v, cell } = *glance;
        let margin = BACKGROUND_PX;
        let (w, h) = (self.pair.camera.width as f32, self.pair.camera.height as f32);
        if !(margin..w - margin).contains(&u) || !(margin..h - margin).contains(&v) {
            return Sight::Nothing;
        }
        match cell {
            Glimpse::Whole { .. } if cast.is_nan() => Sight::Nothing,
            Glimpse::Whole { node, phase, steps } => {
                let (x, y) = self.pixel(u, v);
                let left = (x - x % CELL_PX + self.roi.u) as f32;
                let top = (y - y % CELL_PX + self.roi.v) as f32;
                Sight::Node(node, phase + ((u - left) * steps[0] + (v - top) * steps[1]) - cast)
            }
            Glimpse::Mixed => self.see_closely(u, v, cast),
            Glimpse::Beside => self.past(u, v),
        }
    }

    /// The same where a cell's pixels have to be asked.
    fn see_closely(&self, u: f32, v: f32, cast: f32) -> Sight {
        let (x, y) = self.pixel(u, v);
        let (here, right) = self.cells.pixels.at(x, y);
        match here.node() {
            None if !here.is_object() => self.past(u, v),
            None => Sight::Nothing,
            Some(_) if cast.is_nan() => Sight::Nothing,
            Some(node) => {
                let step = right.phase - here.phase;
                // Across a step there is nothing to interpolate; NaN is no step either.
                let step = if step.abs() < TAU / 3.0 { step } else { 0.0 };
                let part = u - (u as usize) as f32;
                Sight::Node(node, here.phase + part * step - cast)
            }
        }
    }

    /// Whether there is background around a place that is none of the object's.
    fn past(&self, u: f32, v: f32) -> Sight {
        let margin = BACKGROUND_PX;
        let around = [(-margin, 0.0), (margin, 0.0), (0.0, -margin), (0.0, margin)];
        let object = |(a, b): (f32, f32)| {
            let (x, y) = self.pixel(u + a + 0.5, v + b);
            match self.cells.glimpse(x, y) {
                Glimpse::Beside => false,
                Glimpse::Whole { .. } => true,
                Glimpse::Mixed => self.cells.pixels.at(x, y).0.is_object(),
            }
        };
        // Columns are rounded here: so is the place itself, which may be a pixel further right.
        if object((0.0, 0.0)) || around.into_iter().any(object) { Sight::Nothing } else { Sight::Past }
    }

    /// What a place is, when the phase seen there is `ahead` of the one cast on it, rad.
    pub fn judge(&self, ahead: f32) -> Verdict {
        if ahead.abs() < SAME_RAD {
            Verdict::Agrees
        } else if ahead.abs() < OTHER_RAD {
            Verdict::Nothing
        } else if (ahead > 0.0) == (self.towards > 0.0) {
            // The surface seen has the phase of places farther away.
            Verdict::Before
        } else {
            Verdict::Behind
        }
    }
}
