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
use super::windows::{self, Windows};
use super::{
    absolute, cloud, curvature, demodulate, edges, marker_number, marker_paper, mask, period, quality,
    run_ends, simd, uncertainty, unwrap_paper,
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
    /// The paper's section 4.1: one spanning tree guided by Qm, one shift by the marker's median.
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

/// The absolute phase with what the points need beside it.
struct Resolved {
    absolute: Plane<f32>,
    orders: Orders,
    marker: Plane<u8>,
    /// Runs of the object: nothing is known outside of them.
    runs: Runs,
    windows: Windows,
    period: Plane<f32>,
    /// Around the marker: not 0.
    zone: Plane<u8>,
    planes: Vec<(&'static str, Plane<f32>)>,
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

    /// Also gives every point its standard uncertainty.
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
            Err(refused) => *refused,
        }
    }

    /// The absolute phases of one frame by itself; NaN where there is none, any number beside its runs.
    pub fn absolute(&self, image: Mono8<'_>) -> Result<Prepared, Box<Reconstruction>> {
        let mut prepared = self.settled(image)?;
        std::mem::take(&mut prepared.orders).apply(&mut prepared.absolute);
        Ok(prepared)
    }

    /// One frame whose orders no other camera has been asked for.
    fn settled(&self, image: Mono8<'_>) -> Result<Prepared, Box<Reconstruction>> {
        let mut prepared = self.prepare(image)?;
        if self.method == Method::Joint {
            let view = View { id: "", triangulator: &self.triangulator, head: 0, prepared: &mut prepared };
            if let Err(reason) = fringe_order::settle(&mut [view], fringe_order::MARGIN) {
                return Err(prepared.refuse(reason));
            }
        }
        Ok(prepared)
    }

    /// Finds the phases of one frame; the error is the refusal of a frame that shows nothing.
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
        let mut buffers = BUFFERS.take();
        let roi = clock.time("mask", || {
            let Buffers { mask, object, .. } = &mut buffers;
            match self.method {
                Method::Joint => mask::envelope(image, pair.period_px, mask, object),
                Method::Paper => mask::otsu(image, pair.period_px, mask, object),
            }
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
        let resolved = match self.method {
            Method::Joint => self.joint(&part, (runs, &lit), roi, &mut clock, &mut counts),
            Method::Paper => Ok(self.paper(&part, runs, &mut clock, &mut counts)),
        };
        let Resolved { absolute, orders, marker, runs, windows, period, zone, planes } = match resolved {
            Ok(resolved) => resolved,
            Err(reason) => return Err(refused(clock, counts, reason)),
        };
        Ok(Prepared {
            roi,
            absolute,
            table: Arc::clone(&self.table),
            regions: Regions::default(),
            orders,
            marker,
            image: part,
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
        if self.method != Method::Paper {
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
        }
        let doubts = expected.map(|expected| {
            let rows = pair.marker_period_px;
            clock.time("uncertainty", || uncertainty::doubts(&absolute, &windows, &expected, &zone, rows))
        });
        let frame = (pair.camera.width, pair.camera.height);
        let known = cloud::KnownPixels { absolute: &absolute, runs: &runs, light: &windows.light, roi };
        let size = self.frame().map(|px| px as u16);
        let map = clock.time("quantize", || cloud::phase_map(&known, doubts.as_ref(), size));
        let cloud = clock.time("points", || cloud::make(&self.table, &map));
        if self.method != Method::Paper {
            let Windows { strength, light, misfit } = windows;
            [strength, light].into_iter().for_each(|plane| WORDS.give(plane));
            [misfit, period].into_iter().for_each(|plane| PLANES.give(plane));
            [marker, zone].into_iter().for_each(|plane| BYTES.give(plane));
        }
        BYTES.give(image);
        if self.keep_maps {
            planes.push(("Fm", absolute));
        } else if self.method != Method::Paper {
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

    fn joint(
        &self,
        image: &Plane<u8>,
        (runs, lit): (Runs, &Runs),
        roi: Roi,
        clock: &mut Clock,
        counts: &mut Counts,
    ) -> Result<Resolved, String> {
        let pair = self.triangulator.pair();
        let object = self.keep_maps.then(|| painted(&runs, image));
        let image = Mono8::from(image);
        let mut buffers = BUFFERS.take();
        let memory = (&mut buffers.front, &PLANES, &WORDS, &BYTES);
        let keep = front::Keep { energy: self.keep_maps, beside: self.keep_maps || self.uncertainty };
        let front = front::run(image, (runs, lit), pair, &self.gains, keep, memory, clock);
        let Front { runs, period, windows, wrapped, zone, cores, energy, known } = front;
        counts.phase = known;
        let mut marker = BYTES.take(image.width(), image.height());
        clock.time("anchors", || {
            let mut pieces = MarkerPieces::new(cores);
            marker_number::assign(&mut pieces, roi, pair);
            counts.dashes = dashes::check(&mut pieces, &wrapped, &windows.light, roi, &self.triangulator);
            counts.marker = pieces.paint(&mut marker);
        });
        if counts.dashes.contradict() {
            BUFFERS.give(buffers);
            counts.refused = known;
            let Dashes { stretches, elsewhere, .. } = counts.dashes;
            return Err(format!(
                "expected the marker's dashes where the calibration has them, found {elsewhere} of {stretches} stretches of them elsewhere; {WHY_ELSEWHERE}"
            ));
        }
        let kept = object.map(|object| (object, wrapped.clone()));
        let mut absolute = wrapped;
        let orders = clock.time("order", || Orders::cut(&mut absolute, &period, lit, pair));
        BUFFERS.give(buffers);
        counts.refused = known;
        let mut planes = Vec::new();
        if let Some((object, wrapped)) = kept {
            let amplitude = period::measure(image, &object, pair.period_px).amplitude;
            let stability = period::stability(&period, &runs, pair.period_px);
            let vertical = quality::verticality(image, &runs, &period);
            let border = quality::border(&object, &runs);
            let normalized = quality::normalized_amplitude(&amplitude, &runs);
            let quality = quality::quality([&border, &normalized, &vertical, &stability], &runs);
            let number = |plane: &Plane<u8>| convert(plane, f32::from);
            planes = vec![
                ("Om", number(&object)),
                ("Pm", period.clone()),
                ("Am", number(&amplitude)),
                ("Sm", stability),
                ("Wm", wrapped),
                ("Vm", vertical),
                ("Bm", border),
                ("Qm", quality),
                ("Em", energy.unwrap_or_default()),
                ("Mm", number(&marker)),
                ("misfit", windows.misfit.clone()),
            ];
        }
        Ok(Resolved { absolute, orders, marker, runs, windows, period, zone, planes })
    }

    /// Section 4.1 of the paper as it stands.
    fn paper(&self, image: &Plane<u8>, runs: Runs, clock: &mut Clock, counts: &mut Counts) -> Resolved {
        let pair = self.triangulator.pair();
        let object = &painted(&runs, image);
        let image = Mono8::from(image);
        let periods = clock.time("period", || period::measure(image, object, pair.period_px));
        let (period, amplitude) = (&periods.period, &periods.amplitude);
        let stability = clock.time("stability", || period::stability(period, &runs, pair.period_px));
        let (wrapped, windows) =
            clock.time("phase", || windows::demodulate(image, &runs, period, &self.gains, pair.sign));
        counts.phase = known(&wrapped, &runs);
        let vertical = clock.time("verticality", || quality::verticality(image, &runs, period));
        let border = clock.time("border", || quality::border(object, &runs));
        let quality = clock.time("quality", || {
            let amplitude = quality::normalized_amplitude(amplitude, &runs);
            quality::quality([&border, &amplitude, &vertical, &stability], &runs)
        });
        let unwrapped = clock.time("unwrap", || unwrap_paper::unwrap(&wrapped, &quality, &runs));
        let (energy, segment) = clock.time("marker", || marker_paper::marker(image, object, &runs, pair));
        counts.marker = segment.as_slice().iter().filter(|&&x| x != 0).count();
        let shift = marker_paper::shift(&unwrapped, &wrapped, &segment, pair);
        let relative = self.keep_maps.then(|| unwrapped.clone());
        let mut absolute = unwrapped;
        for v in 0..runs.height() {
            for run in runs.row(v) {
                let phases = absolute.row_mut(v)[run.columns()].iter_mut();
                phases.for_each(|phase| *phase += shift.unwrap_or(f32::NAN));
            }
        }
        counts.refused = counts.phase - known(&absolute, &runs);
        let mut planes = Vec::new();
        if self.keep_maps {
            planes = vec![
                ("Om", convert(object, f32::from)),
                ("Pm", period.clone()),
                ("Am", convert(amplitude, f32::from)),
                ("Sm", stability),
                ("Wm", wrapped),
                ("Vm", vertical),
                ("Bm", border),
                ("Qm", quality),
                ("Um", relative.unwrap_or_default()),
                ("Em", energy),
                ("Mm", convert(&segment, f32::from)),
            ];
        }
        let orders = Orders::default();
        let zone = Plane::filled(absolute.width(), absolute.height(), 0);
        Resolved { absolute, orders, marker: segment, runs, windows, period: periods.period, zone, planes }
    }
}

/// Pixels of the runs whose phase is known.
fn known(phase: &Plane<f32>, runs: &Runs) -> usize {
    simd::dispatch(
        #[inline(always)]
        || {
            let mut known = 0;
            for v in 0..runs.height() {
                for run in runs.row(v) {
                    let mut here = 0u32;
                    for x in &phase.row(v)[run.columns()] {
                        here += u32::from(!x.is_nan());
                    }
                    known += here as usize;
                }
            }
            known
        },
    )
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

/// A plane of numbers for the map dump.
pub(super) fn convert<T: Copy>(plane: &Plane<T>, number: impl Fn(T) -> f32) -> Plane<f32> {
    let data = plane.as_slice().iter().map(|&x| number(x)).collect();
    Plane::from_vec(plane.width(), plane.height(), data).unwrap_or_else(|| Plane::filled(0, 0, 0.0))
}
