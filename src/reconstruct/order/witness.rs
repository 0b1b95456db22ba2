//! What the other cameras say about a place in space.
//!
//! All cameras photograph the same instant. A surface that one of them claims must look right to each of the others: at
//! the pixel where it would be seen there is the same surface, or something before it. A claimed surface that stands
//! before what another camera sees there, or where that camera looks past the body, is not there. Places are compared by
//! the phase of the other camera's own projector: the phase that it casts on the place against the one that is seen.

use super::cells::Cells;
use crate::image::Plane;
use crate::reconstruct::pair::Pair;
use crate::reconstruct::roi::Roi;
use nalgebra::{Point3, Vector3};
use std::f32::consts::TAU;

/// Phases of the same surface differ by less, rad.
const SAME_RAD: f32 = 0.8;

/// Phases of different surfaces differ by more, rad; what lies between says nothing.
const OTHER_RAD: f32 = 1.6;

/// Background must be as wide around a place, px: outlines are not sharp.
const BACKGROUND_PX: f64 = 10.0;

/// A camera as a witness for the others.
#[derive(Debug)]
pub struct Witness<'a> {
    /// Camera, projector and pattern.
    pub pair: &'a Pair,
    /// Which head it belongs to.
    pub head: usize,
    /// Where its planes lie in the frame.
    pub roi: Roi,
    /// Unwrapped phase, up to the orders of the pieces; NaN where it is unknown.
    pub phase: Plane<f32>,
    /// Not 0 on the object.
    pub object: &'a Plane<u8>,
    /// Its nodes.
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
    pub fn new(
        pair: &'a Pair,
        head: usize,
        roi: Roi,
        phase: Plane<f32>,
        object: &'a Plane<u8>,
        cells: Cells,
    ) -> Self {
        let middle =
            Point3::from((Vector3::from(pair.volume_min_m) + Vector3::from(pair.volume_max_m)) / 2.0);
        let from = pair.camera.centre();
        let cast = |distance: f64| {
            let at = middle + (middle - from).normalize() * distance;
            pair.projector.project(&at).map_or(0.0, |[column, _]| pair.pattern.phase(column))
        };
        let towards = (cast(0.01) - cast(-0.01)).signum() as f32;
        Self { pair, head, roi, phase, object, cells, towards }
    }

    /// What the camera has where it would see `world`.
    pub fn look(&self, world: &Point3<f64>) -> Sight {
        let Some([u, v]) = self.pair.camera.project(world) else { return Sight::Nothing };
        let margin = BACKGROUND_PX;
        let (w, h) = (self.pair.camera.width as f64, self.pair.camera.height as f64);
        if !(margin..w - margin).contains(&u) || !(margin..h - margin).contains(&v) {
            return Sight::Nothing;
        }
        let around = [(0.0, 0.0), (-margin, 0.0), (margin, 0.0), (0.0, -margin), (0.0, margin)];
        let (x, y) = (u.floor() as usize, v.round() as usize);
        if self.object_at(x, y) {
            return self.node_at(x, y, (u - u.floor()) as f32, world);
        }
        let object =
            around.iter().any(|(a, b)| self.object_at((u + a).round() as usize, (v + b).round() as usize));
        if object { Sight::Nothing } else { Sight::Past }
    }

    fn object_at(&self, u: usize, v: usize) -> bool {
        let inside = u >= self.roi.u && v >= self.roi.v;
        inside
            && u - self.roi.u < self.roi.width
            && v - self.roi.v < self.roi.height
            && self.object.at(u - self.roi.u, v - self.roi.v) != 0
    }

    fn node_at(&self, u: usize, v: usize, part: f32, world: &Point3<f64>) -> Sight {
        let (u, v) = (u - self.roi.u, v - self.roi.v);
        let row = self.phase.row(v);
        let node = self.cells.node.at(u, v);
        let Some([column, _]) = self.pair.projector.project(world).filter(|_| node != 0) else {
            return Sight::Nothing;
        };
        let step = row.get(u + 1).map_or(f32::NAN, |next| next - row[u]);
        // Across a step there is nothing to interpolate; NaN is no step either.
        let step = if step.abs() < TAU / 3.0 { step } else { 0.0 };
        Sight::Node(node - 1, row[u] + part * step - self.pair.pattern.phase(column) as f32)
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
