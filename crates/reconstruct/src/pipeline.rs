// SPDX-License-Identifier: MIT OR Apache-2.0
//! One frame to one directional cloud: the stages in their order, each timed.

use super::counts::Counts;
use super::fringe_order::unwrapped_frame::UnwrappedFrame;
use super::fringe_order::{self, MostDifference, Orders, Regions, View};
use super::kernels::buffer_pool::{PlanePools, Pool};
use super::kernels::pixel_runs::Runs;
use super::kernels::region_of_interest::Roi;
use super::kernels::stage_times::Clock;
use super::marker::bias::Bias;
use super::marker::epipolar_check::{self, Dashes};
use super::marker::number;
use super::marker::pieces::MarkerPieces;
use super::outcome::{Maps, NO_OBJECT, Outcome, Reconstruction, WHY_ELSEWHERE, outcome_of};
use super::phase::demodulate::{self, Gains};
use super::refine::{FrameMaps, albedo_edges, curvature, extend_runs, select, uncertainty};
use super::triangulate::points;
use super::triangulate::ray_table::RayTable;
use super::triangulate::triangulator::Triangulator;
use super::wrapped_phase::{self, Front};
use super::{mask, paper};
use crate::base::image::{Mono8, Plane};
use crate::data::{Cloud, PhaseMap};
use std::sync::Arc;

/// How the absolute phase is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// The fringe orders of all cameras of a trigger together ([`super::fringe_order`]).
    Joint,
    /// The paper's section 4.1, each frame by itself ([`super::paper`]).
    Paper,
}

/// Reconstructs the frames of one camera.
///
/// It is made once for a camera of a calibration, by [`crate::Reconstructor`] or by whoever reconstructs a session,
/// and holds the camera's tables, which take longer to make than a frame to reconstruct. It is not changed by frames,
/// so that any number of threads may use it at once. [`Pipeline::prepare`] finds the phases of a frame,
/// [`crate::frame_set::settle`] the fringe orders of all frames of a trigger, [`Pipeline::finish`] the cloud.
#[derive(Debug)]
pub struct Pipeline {
    triangulator: Triangulator,
    table: Arc<RayTable>,
    gains: Gains,
    bias: Bias,
    method: Method,
    keep_maps: bool,
    uncertainty: bool,
    counting: bool,
    workspace: Arc<Workspace>,
}

/// Memory that the stages of one frame leave to the next, of any camera and on any thread. Whoever runs several
/// pipelines gives all of them the same ([`Pipeline::with_workspace`]).
#[derive(Debug, Default)]
pub struct Workspace {
    buffers: Pool<Buffers>,
    planes: PlanePools,
}

#[derive(Debug, Default)]
struct Buffers {
    object: Runs,
    mask: mask::Buffers,
    front: wrapped_phase::Buffers,
}

impl Pipeline {
    /// A pipeline for the camera of `triangulator`. With `keep_maps` each result holds the maps of all stages.
    pub fn new(triangulator: Triangulator, method: Method, keep_maps: bool) -> Self {
        let pair = triangulator.pair();
        let (bias, table) = (Bias::new(&pair.pattern), Arc::new(RayTable::new(pair)));
        let (gains, workspace) = (Gains::new(), Arc::default());
        let (uncertainty, counting) = (false, false);
        Self { triangulator, table, gains, bias, method, keep_maps, uncertainty, counting, workspace }
    }

    /// Uses this memory instead of memory of its own.
    #[must_use]
    pub fn with_workspace(self, workspace: Arc<Workspace>) -> Self {
        Self { workspace, ..self }
    }

    /// Also gives every point its standard uncertainty, m. The paper's method has none.
    #[must_use]
    pub fn with_uncertainty(self, uncertainty: bool) -> Self {
        Self { uncertainty, ..self }
    }

    /// Points are only counted, where `counting`: the phase map gives the same cloud at any time. The paper's method
    /// makes the cloud all the same.
    #[must_use]
    pub fn counting(self, counting: bool) -> Self {
        Self { counting, ..self }
    }

    /// The geometry of the camera and its projector, solved exactly.
    pub fn triangulator(&self) -> &Triangulator {
        &self.triangulator
    }

    /// Columns and rows of its frames.
    pub fn frame(&self) -> [usize; 2] {
        let camera = &self.triangulator.pair().camera;
        [camera.width, camera.height]
    }

    /// Reconstructs one frame by itself: its fringe orders follow from its own marker alone.
    pub fn run(&self, image: Mono8<'_>) -> Reconstruction {
        match self.ordered(image) {
            Ok(prepared) => self.finish(prepared),
            Err(made) => *made,
        }
    }

    /// The absolute phases of one frame by itself; NaN where there is none, any number beside its runs. Then all
    /// phases as they are within each patch, which may lack whole turns. The error is that of [`Pipeline::prepare`],
    /// or the refusal of a frame whose orders contradict each other.
    pub fn absolute(&self, image: Mono8<'_>) -> Result<(UnwrappedFrame, Plane<f32>), Box<Reconstruction>> {
        let mut prepared = self.ordered(image)?;
        let in_patches = prepared.absolute.clone();
        std::mem::take(&mut prepared.orders).apply(&mut prepared.absolute);
        Ok((prepared, in_patches))
    }

    /// The phases of one frame, whose fringe orders are found without other cameras.
    fn ordered(&self, image: Mono8<'_>) -> Result<UnwrappedFrame, Box<Reconstruction>> {
        let mut prepared = self.prepare(image)?;
        let view = View { id: "", triangulator: &self.triangulator, head: 0, prepared: &mut prepared };
        match fringe_order::solve(&mut [view], fringe_order::MARGIN, MostDifference::of_rows(1)) {
            Ok(_) => Ok(prepared),
            Err(reason) => Err(refuse(prepared, reason)),
        }
    }

    /// Finds the phases of one frame. The error is a finished result: the refusal of a frame that shows nothing, and
    /// what the paper's method, which needs no other camera, makes of any frame.
    pub fn prepare(&self, image: Mono8<'_>) -> Result<UnwrappedFrame, Box<Reconstruction>> {
        let mut clock = Clock::default();
        let mut counts = Counts::default();
        let pair = self.triangulator.pair();
        let (expected, found) = (self.frame(), [image.width(), image.height()]);
        if found != expected {
            let reason =
                format!("expected a frame of {expected:?} pixels, as the calibration has, found {found:?}");
            return Err(refused(clock, counts, reason));
        }
        if self.method == Method::Paper {
            return Err(Box::new(paper::reconstruct(image, pair, &self.table, self.keep_maps)));
        }
        self.workspace.planes.make_room(expected[0] * expected[1]);
        let mut buffers = self.workspace.buffers.take();
        let roi = clock.time("mask", || {
            let Buffers { mask, object, .. } = &mut buffers;
            mask::envelope(image, pair.period_px, mask, object);
            // What is over-exposed hides the background from the other cameras: it belongs to the region, too.
            Roi::of(&mask.lit).filter(|_| !object.all().is_empty())
        });
        let Some(roi) = roi else {
            self.workspace.buffers.give(buffers);
            return Err(refused(clock, counts, NO_OBJECT.to_owned()));
        };
        let (runs, good, part) = clock.time("cut", || {
            let (runs, good) = (roi.cut_runs(&buffers.mask.lit), roi.cut_runs(&buffers.object));
            let mut part = self.workspace.planes.bytes.take(roi.width, roi.height);
            roi.cut(image, &mut part);
            (runs, good, part)
        });
        self.workspace.buffers.give(buffers);
        counts.object = runs.area();
        self.phases(part, (runs, &good), roi, clock, counts)
    }

    /// The phases of the part of a frame that holds the object, whose runs these are: all of them, and without what is
    /// over-exposed.
    fn phases(
        &self,
        image: Plane<u8>,
        (runs, good): (Runs, &Runs),
        roi: Roi,
        mut clock: Clock,
        mut counts: Counts,
    ) -> Result<UnwrappedFrame, Box<Reconstruction>> {
        let pair = self.triangulator.pair();
        let object = self.keep_maps.then(|| painted(&runs, &image));
        let part = Mono8::from(&image);
        let mut buffers = self.workspace.buffers.take();
        let memory = (&mut buffers.front, &self.workspace.planes);
        let keep = wrapped_phase::Keep {
            energy: self.keep_maps,
            define_outside_runs: self.keep_maps || self.uncertainty,
        };
        let front = wrapped_phase::run(part, (&runs, good), pair, &self.gains, keep, memory, &mut clock);
        let Front { period, windows, wrapped, zone, cores, energy, known } = front;
        counts.phase = known;
        counts.refused = known;
        let mut marker = self.workspace.planes.bytes.take(roi.width, roi.height);
        clock.time("anchors", || {
            let mut pieces = MarkerPieces::new(cores);
            number::assign(&mut pieces, roi, pair);
            counts.dashes =
                epipolar_check::check(&mut pieces, &wrapped, &windows.light, roi, &self.triangulator);
            counts.marker = pieces.paint(&mut marker);
        });
        if counts.dashes.contradict() {
            self.workspace.buffers.give(buffers);
            let Dashes { stretches, displaced, .. } = counts.dashes;
            let reason = format!(
                "expected the marker's dashes where the calibration has them, found {displaced} of {stretches} \
                 stretches of them elsewhere; {WHY_ELSEWHERE}"
            );
            return Err(refused(clock, counts, reason));
        }
        let mut planes = Vec::new();
        if let Some(object) = object {
            // Of the maps by which the paper unwraps this method needs none: they are for people to look at.
            let om = object.map(f32::from);
            let (_, am) = paper::period::measure(part, &om, pair.period_px);
            let sm = paper::period::stability(&period, pair.period_px);
            let (vm, bm) = (paper::quality::verticality(part, &period), paper::quality::border(&om));
            let qm = paper::quality::quality(&om, [&bm, &am, &vm, &sm]);
            let (pm, wm, mm) = (period.clone(), wrapped.clone(), marker.map(f32::from));
            let names = ["Om", "Pm", "Am", "Sm", "Wm", "Vm", "Bm", "Qm", "Em", "Mm", "misfit"];
            let maps =
                [om, pm, am, sm, wm, vm, bm, qm, energy.unwrap_or_default(), mm, windows.misfit.clone()];
            planes = names.into_iter().zip(maps).collect();
        }
        let mut absolute = wrapped;
        let orders = clock.time("order", || Orders::cut(&mut absolute, &period, &runs, pair));
        self.workspace.buffers.give(buffers);
        let (table, regions) = (Arc::clone(&self.table), Regions::default());
        Ok(UnwrappedFrame {
            roi,
            absolute,
            table,
            regions,
            orders,
            marker,
            image,
            counts,
            runs,
            windows,
            period,
            zone,
            planes,
            clock,
        })
    }

    /// Makes the cloud of an unwrapped frame.
    pub fn finish(&self, prepared: UnwrappedFrame) -> Reconstruction {
        let UnwrappedFrame { roi, regions, orders, image, marker, zone, runs, .. } = prepared;
        let UnwrappedFrame {
            mut absolute, mut counts, mut windows, mut period, mut planes, mut clock, ..
        } = prepared;
        let pair = self.triangulator.pair();
        // The errors that the edges expect, where uncertainties are wanted.
        let mut expected =
            self.uncertainty.then(|| Plane::filled(absolute.width(), absolute.height(), f32::NAN));
        clock.time("order", || orders.apply(&mut absolute));
        counts.phase += clock.time("run_ends", || {
            let (runs, zone, gains) = (&runs, &zone, &self.gains);
            let input = extend_runs::Input { image: &image, runs, zone, gains, sign: pair.sign };
            extend_runs::complete(&input, &mut absolute, &mut windows, &mut period)
        });
        let maps =
            FrameMaps { runs: &runs, windows: &windows, period: &period, zone: &zone, sign: pair.sign };
        counts.dropped = clock.time("select", || {
            self.bias.correct(&mut absolute);
            select::select(&mut absolute, maps)
        });
        clock.time("curvature", || {
            curvature::correct(&mut absolute, maps, (demodulate::ROWS as f32, pair.marker_period_px));
        });
        counts.dropped +=
            clock.time("edges", || albedo_edges::refine(&mut absolute, maps, expected.as_mut()));
        let sigma_codes = expected.map(|expected| {
            let rows = pair.marker_period_px;
            let differs_rad = counts.differs_rad;
            clock.time("uncertainty", || {
                uncertainty::sigma_codes(&absolute, maps, &expected, rows, differs_rad)
            })
        });
        let known = points::KnownPixels { absolute: &absolute, runs: &runs, light: &windows.light, roi };
        let size = self.frame().map(|px| px as u16);
        let phase = clock.time("quantize", || points::phase_map(&known, sigma_codes.as_ref(), size));
        let cloud = clock.time("points", || match self.counting {
            true => {
                counts.points = points::count(&self.table, &phase);
                Cloud::default()
            }
            false => points::make(&self.table, &phase),
        });
        if !self.counting {
            counts.points = cloud.len();
        }
        let memory = &self.workspace.planes;
        [windows.strength, windows.light].into_iter().for_each(|plane| memory.words.give(plane));
        [windows.misfit, period].into_iter().for_each(|plane| memory.floats.give(plane));
        [marker, zone, image].into_iter().for_each(|plane| memory.bytes.give(plane));
        let maps = if self.keep_maps {
            planes.push(("Fm", absolute));
            Some(Maps { roi, frame: (pair.camera.width, pair.camera.height), planes })
        } else {
            memory.floats.give(absolute);
            None
        };
        let outcome = outcome_of(&counts);
        Reconstruction { cloud, phase, outcome, counts, regions, stages: clock.0, maps }
    }
}

/// No cloud is made of this frame, for this reason.
pub fn refuse(prepared: UnwrappedFrame, reason: String) -> Box<Reconstruction> {
    let mut counts = prepared.counts;
    counts.refused = counts.phase;
    refused(prepared.clock, counts, reason)
}

fn refused(clock: Clock, counts: Counts, reason: String) -> Box<Reconstruction> {
    let (cloud, phase, regions) = (Cloud::default(), PhaseMap::default(), Regions::default());
    let (outcome, stages) = (Outcome::Refused(reason), clock.0);
    Box::new(Reconstruction { cloud, phase, outcome, counts, regions, stages, maps: None })
}

/// The object as a mask as large as the image.
fn painted(runs: &Runs, image: &Plane<u8>) -> Plane<u8> {
    let mut mask = Plane::filled(image.width(), image.height(), 0);
    runs.paint(&mut mask);
    mask
}
