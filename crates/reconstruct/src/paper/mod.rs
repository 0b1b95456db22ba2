// SPDX-License-Identifier: MIT OR Apache-2.0
//! Section 4.1 of the paper as it stands: one photograph to absolute phase, the boxes of its Figure 5 in their order.
//!
//! It is there to compare the default method with, and to be read beside the paper's text. So its maps are whole
//! planes that bear the paper's names, its stages are loops over pixels, and time is no concern. What the paper leaves
//! open is settled where it comes up, and listed in `docs/design/reconstruction.md`.

pub(crate) mod marker;
pub(crate) mod mask;
pub(crate) mod period;
pub(crate) mod phase;
mod planes;
pub(crate) mod quality;
pub(crate) mod unwrap;

use super::counts::Counts;
use super::fringe_order::Regions;
use super::kernels::pixel_runs::Runs;
use super::kernels::region_of_interest::Roi;
use super::kernels::stage_times::Clock;
use super::outcome::{Maps, NO_OBJECT, Outcome, Reconstruction, outcome_of};
use super::phase::window_quality::light_steps;
use super::triangulate::camera_projector::CameraProjector;
use super::triangulate::points::{self, KnownPixels};
use super::triangulate::ray_table::RayTable;
use crate::base::image::{Mono8, Plane};

/// The version of this method in `reconstruct.json`: raised whenever the same frames may give other points.
pub const ALGORITHM: u32 = 31;

/// What a summary states under `unchecked` of results by this method.
pub const UNCHECKED: &str =
    "the paper's method: each camera's fringe orders follow from its own marker alone";

/// What Section 4.1 makes of a photograph; all planes are as large as that.
#[derive(Debug)]
pub(crate) struct AbsolutePhase {
    /// Fm, rad; NaN where it is unknown, and everywhere without a marker.
    pub fm: Plane<f32>,
    /// Mean light over one fringe, DN: the intensity of the cloud's points.
    pub light: Plane<f32>,
    /// Pixel counts. A pixel with a wrapped phase and no absolute one counts as refused.
    pub counts: Counts,
    /// Om to Mm by name; Em is what Mm is cut from. Their units stand where they are made.
    pub maps: Vec<(&'static str, Plane<f32>)>,
}

/// Section 4.1 for a photograph by the camera of `pair`.
pub(crate) fn absolute_phase(image: Mono8<'_>, pair: &CameraProjector) -> AbsolutePhase {
    let om = mask::object(image, pair.period_px);
    let (pm, am) = period::measure(image, &om, pair.period_px);
    let sm = period::stability(&pm, pair.period_px);
    let (wm, light) = phase::demodulate(image, &om, &pm, pair.sign);
    let (vm, bm) = (quality::verticality(image, &pm), quality::border(&om));
    let qm = quality::quality(&om, [&bm, &am, &vm, &sm]);
    let um = unwrap::unwrap(&wm, &qm);
    let (em, mm) = marker::find(image, &om, pair.marker_period_px, pair.marker_contrast);
    let shift = marker::shift(&um, &wm, &mm, pair.pattern.marker_index);
    let fm = um.map(|phase| phase + shift.unwrap_or(f32::NAN));
    let set = |plane: &Plane<f32>| plane.as_slice().iter().filter(|&&x| x > 0.0).count();
    let known = |plane: &Plane<f32>| plane.as_slice().iter().filter(|x| !x.is_nan()).count();
    let (object, marker, phase) = (set(&om), set(&mm), known(&wm));
    let counts = Counts { object, marker, phase, refused: phase - known(&fm), ..Counts::default() };
    let names = ["Om", "Pm", "Am", "Sm", "Wm", "Vm", "Bm", "Qm", "Um", "Em", "Mm"];
    let maps = names.into_iter().zip([om, pm, am, sm, wm, vm, bm, qm, um, em, mm]).collect();
    AbsolutePhase { fm, light, counts, maps }
}

/// The cloud of one photograph, made from Fm as every method's is; `table` is the camera's. With the maps on request.
pub(super) fn reconstruct(
    image: Mono8<'_>,
    pair: &CameraProjector,
    table: &RayTable,
    keep_maps: bool,
) -> Reconstruction {
    let mut clock = Clock::default();
    let AbsolutePhase { fm, light, mut counts, maps: mut planes } =
        clock.time("paper", || absolute_phase(image, pair));
    let (width, height) = (image.width(), image.height());
    let roi = Roi { u: 0, v: 0, width, height };
    let runs = Runs::of(&fm.map(|phase| u8::from(!phase.is_nan())));
    let known = KnownPixels { absolute: &fm, runs: &runs, light: &light.map(light_steps), roi };
    let size = [width as u16, height as u16];
    let phase = clock.time("quantize", || points::phase_map(&known, None, size));
    let cloud = clock.time("points", || points::make(table, &phase));
    counts.points = cloud.len();
    let outcome = match counts.object {
        0 => Outcome::Refused(NO_OBJECT.to_owned()),
        _ => outcome_of(&counts),
    };
    planes.push(("Fm", fm));
    let maps = keep_maps.then_some(Maps { roi, frame: (width, height), planes });
    Reconstruction { cloud, phase, outcome, counts, regions: Regions::default(), stages: clock.0, maps }
}
