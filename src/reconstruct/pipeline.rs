//! One frame to one directional cloud: the stages in their order, each timed.

use super::dashes::{self, Dashes};
use super::demodulate::Gains;
use super::fringe_order::{self, Orders, Regions, View};
use super::front::{self, Front, Planes};
use super::marker_phase::Bias;
use super::marker_pieces::MarkerPieces;
use super::outcome::{NO_OBJECT, WHY_ELSEWHERE, outcome_of};
use super::pool::Pool;
use super::rays::RayTable;
use super::roi::Roi;
use super::runs::Runs;
use super::timings::Clock;
use super::triangulate::Triangulator;
use super::windows::Windows;
use super::{
    absolute, cloud, curvature, demodulate, edges, marker_number, mask, paper, run_ends, uncertainty,
};
use crate::export::{Cloud, PhaseMap, STEPS_PER_LEVEL};
use crate::image::{Mono8, Plane};
use std::sync::Arc;
use std::time::Duration;

pub use super::outcome::{Counts, Outcome};

/// How the absolute phase is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// The fringe orders of all cameras of a trigger together ([`super::fringe_order`]).
    Joint,
    /// The paper's section 4.1, each frame by itself ([`super::paper`]).
    Paper,
}

/// Everything that one frame gives.
#[derive(Debug)]
pub struct Reconstruction {
    /// The directional cloud, in the world frame.
    pub cloud: Cloud,
    /// What the cloud follows from, given the calibration.
    pub phase: PhaseMap,
    /// Whether there is one.
    pub outcome: Outcome,
    /// How it went.
    pub counts: Counts,
    /// Pieces of surface and how certain their fringe orders are; for each point see [`Regions::margin_at`].
    pub regions: Regions,
    /// Time of each stage, in order.
    pub stages: Vec<(&'static str, Duration)>,
    /// The maps, where they were asked for.
    pub maps: Option<Maps>,
}

/// The maps of a frame, on its region of interest.
#[derive(Debug)]
pub struct Maps {
    /// Where they lie in the frame.
    pub roi: Roi,
    /// Columns and rows of the whole frame.
    pub frame: (usize, usize),
    /// Named maps: Om, Pm, Am, Sm, Wm, Vm, Bm, Qm, Um, Mm, Fm as far as the method has them. NaN: undefined.
    pub planes: Vec<(&'static str, Plane<f32>)>,
}

/// Reconstructs the frames of one camera.
#[derive(Debug)]
pub struct Pipeline {
    triangulator: Triangulator,
    table: Arc<RayTable>,
    gains: Gains,
    bias: Bias,
    method: Method,
    keep_maps: bool,
    uncertainty: bool,
}

/// What the stages of one frame use again for the next.
#[derive(Debug, Default)]
struct Buffers {
    object: Runs,
    mask: mask::Buffers,
    front: front::Buffers,
}

/// Of all cameras: a thread that goes from one to the next finds its memory there.
static BUFFERS: Pool<Buffers> = Pool::new();
static PLANES: Planes<f32> = Planes::new();
static WORDS: Planes<u16> = Planes::new();
static BYTES: Planes<u8> = Planes::new();

/// A frame whose phase is known but for its fringe orders: [`fringe_order::settle`] finds these before [`Pipeline::finish`] makes the
/// cloud.
#[derive(Debug)]
pub struct Prepared {
    /// Where the object is; all planes cover this part of the frame.
    pub roi: Roi,
    /// Phase, rad, absolute but for [`Prepared::orders`]; NaN where it is not known. Far beside the runs it is any number.
    pub absolute: Plane<f32>,
    /// Lines of sight of the camera.
    pub(super) table: Arc<RayTable>,
    /// How certain its orders are.
    pub regions: Regions,
    /// Its patches, and their orders.
    pub(super) orders: Orders,
    /// Not 0 on marker cores.
    pub marker: Plane<u8>,
    /// How it went so far.
    pub counts: Counts,
    /// Runs of the object without what is over-exposed: nothing is known outside of them.
    runs: Runs,
    windows: Windows,
    /// The photograph.
    image: Plane<u8>,
    period: Plane<f32>,
    /// Around the marker: not 0.
    zone: Plane<u8>,
    planes: Vec<(&'static str, Plane<f32>)>,
    clock: Clock,
}

impl Prepared {
    /// No cloud is made of the frame, for this reason.
    pub fn refuse(self, reason: String) -> Box<Reconstruction> {
        let mut counts = self.counts;
        counts.refused = counts.phase;
        refused(self.clock, counts, reason)
    }

    /// Phases as they are within each patch, whatever their fringe orders: for comparisons of phases alone.
    #[must_use]
    pub fn without_orders(mut self) -> Self {
        self.orders.forget();
        self
    }

    /// Fringe period Pm, px.
    pub fn period(&self) -> &Plane<f32> {
        &self.period
    }

    /// Runs of the object without what is over-exposed.
    pub fn runs(&self) -> &Runs {
        &self.runs
    }

    /// Light over one period around a pixel that has a phase, by its place in the region of interest, row by row, DN.
    pub(super) fn light_dn(&self, pixel: usize) -> f32 {
        let light = self.windows.light.at(pixel % self.roi.width, pixel / self.roi.width);
        f32::from(light) / STEPS_PER_LEVEL
    }

    /// Notes a frame's share of work that was done for several.
    pub fn add_time(&mut self, stage: &'static str, time: Duration) {
        self.clock.0.push((stage, time));
    }
}

impl Pipeline {
    /// A pipeline for one camera.
    pub fn new(triangulator: Triangulator, method: Method, keep_maps: bool) -> Self {
        let pair = triangulator.pair();
        let (bias, table) = (Bias::new(&pair.pattern), Arc::new(RayTable::new(pair)));
        let pixels = pair.camera.width * pair.camera.height;
        PLANES.make_room(pixels);
        WORDS.make_room(pixels);
        BYTES.make_room(pixels);
        Self { triangulator, table, gains: Gains::new(), bias, method, keep_maps, uncertainty: false }
    }

    /// Also gives every point its standard uncertainty, which the paper's method has none of.
    #[must_use]
    pub fn with_uncertainty(self, uncertainty: bool) -> Self {
        Self { uncertainty, ..self }
    }

    /// What it triangulates with.
    pub fn triangulator(&self) -> &Triangulator {
        &self.triangulator
    }

    /// Columns and rows of its frames.
    pub fn frame(&self) -> [usize; 2] {
        let camera = &self.triangulator.pair().camera;
        [camera.width, camera.height]
    }

    /// Reconstructs one frame by itself: its fringe orders have no other witness than its own marker.
    pub fn run(&self, image: Mono8<'_>) -> Reconstruction {
        match self.settled(image) {
            Ok(prepared) => self.finish(prepared),
            Err(made) => *made,
        }
    }

    /// The absolute phases of one frame by itself; NaN where there is none, any number beside its runs. The error is that
    /// of [`Pipeline::prepare`], or the refusal of a frame whose orders contradict each other.
    pub fn absolute(&self, image: Mono8<'_>) -> Result<Prepared, Box<Reconstruction>> {
        let mut prepared = self.settled(image)?;
        std::mem::take(&mut prepared.orders).apply(&mut prepared.absolute);
        Ok(prepared)
    }

    /// One frame whose orders no other camera has been asked for.
    fn settled(&self, image: Mono8<'_>) -> Result<Prepared, Box<Reconstruction>> {
        let mut prepared = self.prepare(image)?;
        let view = View { id: "", triangulator: &self.triangulator, head: 0, prepared: &mut prepared };
        match fringe_order::settle(&mut [view], fringe_order::MARGIN) {
            Ok(()) => Ok(prepared),
            Err(reason) => Err(prepared.refuse(reason)),
        }
    }

    /// Finds the phases of one frame. The error is what no other camera has a part in: the refusal of a frame that shows
    /// nothing, and all that the paper's method makes of any frame.
    pub fn prepare(&self, image: Mono8<'_>) -> Result<Prepared, Box<Reconstruction>> {
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
        let mut buffers = BUFFERS.take();
        let roi = clock.time("mask", || {
            let Buffers { mask, object, .. } = &mut buffers;
            mask::envelope(image, pair.period_px, mask, object);
            // What is over-exposed hides the background from the other cameras: it belongs to the region, too.
            Roi::of(&mask.lit).filter(|_| !object.all().is_empty())
        });
        let Some(roi) = roi else {
            BUFFERS.give(buffers);
            return Err(refused(clock, counts, NO_OBJECT.to_owned()));
        };
        let (runs, lit, part) = clock.time("cut", || {
            let (runs, lit) = (roi.cut_runs(&buffers.object), roi.cut_runs(&buffers.mask.lit));
            let mut part = BYTES.take(roi.width, roi.height);
            roi.cut(image, &mut part);
            (runs, lit, part)
        });
        BUFFERS.give(buffers);
        counts.object = runs.area();
        self.phases(part, (runs, &lit), roi, clock, counts)
    }

    /// The phases of the part of a frame that holds the object, whose runs these are: without and with what is over-exposed.
    fn phases(
        &self,
        image: Plane<u8>,
        (runs, lit): (Runs, &Runs),
        roi: Roi,
        mut clock: Clock,
        mut counts: Counts,
    ) -> Result<Prepared, Box<Reconstruction>> {
        let pair = self.triangulator.pair();
        let object = self.keep_maps.then(|| painted(&runs, &image));
        let part = Mono8::from(&image);
        let mut buffers = BUFFERS.take();
        let memory = (&mut buffers.front, &PLANES, &WORDS, &BYTES);
        let keep = front::Keep { energy: self.keep_maps, beside: self.keep_maps || self.uncertainty };
        let front = front::run(part, (runs, lit), pair, &self.gains, keep, memory, &mut clock);
        let Front { runs, period, windows, wrapped, zone, cores, energy, known } = front;
        counts.phase = known;
        counts.refused = known;
        let mut marker = BYTES.take(roi.width, roi.height);
        clock.time("anchors", || {
            let mut pieces = MarkerPieces::new(cores);
            marker_number::assign(&mut pieces, roi, pair);
            counts.dashes = dashes::check(&mut pieces, &wrapped, &windows.light, roi, &self.triangulator);
            counts.marker = pieces.paint(&mut marker);
        });
        if counts.dashes.contradict() {
            BUFFERS.give(buffers);
            let Dashes { stretches, elsewhere, .. } = counts.dashes;
            let reason = format!(
                "expected the marker's dashes where the calibration has them, found {elsewhere} of {stretches} stretches of them elsewhere; {WHY_ELSEWHERE}"
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
        let orders = clock.time("order", || Orders::cut(&mut absolute, &period, lit, pair));
        BUFFERS.give(buffers);
        let (table, regions) = (Arc::clone(&self.table), Regions::default());
        Ok(Prepared {
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
    pub fn finish(&self, prepared: Prepared) -> Reconstruction {
        let Prepared {
            roi,
            mut absolute,
            regions,
            orders,
            mut counts,
            runs,
            mut windows,
            mut period,
            image,
            zone,
            mut planes,
            mut clock,
            marker,
            ..
        } = prepared;
        let pair = self.triangulator.pair();
        // What the edges find, where uncertainties are asked for.
        let mut expected =
            self.uncertainty.then(|| Plane::filled(absolute.width(), absolute.height(), f32::NAN));
        clock.time("order", || orders.apply(&mut absolute));
        counts.phase += clock.time("run_ends", || {
            let (runs, zone, gains) = (&runs, &zone, &self.gains);
            let input = run_ends::Input { image: &image, runs, zone, gains, sign: pair.sign };
            run_ends::complete(&input, &mut absolute, &mut windows, &mut period)
        });
        counts.dropped = clock.time("select", || {
            self.bias.correct(&mut absolute);
            absolute::select(
                &mut absolute,
                &runs,
                &period,
                &windows,
                pair.sign,
                &absolute::Settings::default(),
            )
        });
        clock.time("curvature", || {
            let rows = (demodulate::ROWS as f32, pair.marker_period_px);
            curvature::correct(&mut absolute, &runs, &windows, &period, &zone, rows);
        });
        counts.dropped += clock.time("edges", || {
            let (settings, expected) = (edges::Settings::default(), expected.as_mut());
            edges::refine(&mut absolute, &runs, &windows, &period, &zone, pair.sign, &settings, expected)
        });
        let doubts = expected.map(|expected| {
            let rows = pair.marker_period_px;
            clock.time("uncertainty", || uncertainty::doubts(&absolute, &windows, &expected, &zone, rows))
        });
        let frame = (pair.camera.width, pair.camera.height);
        let known = cloud::KnownPixels { absolute: &absolute, runs: &runs, light: &windows.light, roi };
        let size = self.frame().map(|px| px as u16);
        let map = clock.time("quantize", || cloud::phase_map(&known, doubts.as_ref(), size));
        let cloud = clock.time("points", || cloud::make(&self.table, &map));
        let Windows { strength, light, misfit } = windows;
        [strength, light].into_iter().for_each(|plane| WORDS.give(plane));
        [misfit, period].into_iter().for_each(|plane| PLANES.give(plane));
        [marker, zone, image].into_iter().for_each(|plane| BYTES.give(plane));
        if self.keep_maps {
            planes.push(("Fm", absolute));
        } else {
            PLANES.give(absolute);
        }
        Reconstruction {
            outcome: outcome_of(&cloud, &counts),
            cloud,
            phase: map,
            counts,
            regions,
            stages: clock.0,
            maps: self.keep_maps.then_some(Maps { roi, frame, planes }),
        }
    }
}

fn refused(clock: Clock, counts: Counts, reason: String) -> Box<Reconstruction> {
    Box::new(Reconstruction {
        cloud: Cloud::default(),
        phase: PhaseMap::default(),
        outcome: Outcome::Refused(reason),
        counts,
        regions: Regions::default(),
        stages: clock.0,
        maps: None,
    })
}

/// The object as a mask as large as the image.
fn painted(runs: &Runs, image: &Plane<u8>) -> Plane<u8> {
    let mut mask = Plane::filled(image.width(), image.height(), 0);
    runs.paint(&mut mask);
    mask
}
