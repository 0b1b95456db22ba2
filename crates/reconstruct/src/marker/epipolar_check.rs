// SPDX-License-Identifier: MIT OR Apache-2.0
//! Do the marker's dashes lie where the calibration has them?
//!
//! A phase names a column of the panel. Nothing in a photograph of fringes shows whether the calibration that makes a
//! point of it is this camera's, or whose light it is. The dashes do: the marker's column and a line of sight meet in
//! one point, which the calibration puts on one *row* of the panel, and there the dashes have one phase. No fringe
//! order and no other camera has a part in that (it is the epipolar constraint, read from the marker). With the right
//! calibration they lie within hundredths of a row of it; with another camera's, or under another projector's light,
//! anywhere, and not in the same place along the marker.
//!
//! The calibration must have brought the panel's rows into line with the dashes (`CalibratedHead::rows`): fringes
//! alone do not determine them. Where it has not, nothing is checked.
//!
//! The marker is looked at in stretches of two dashes. A piece of which no more than half of the stretches look like
//! dashes at their place is something else and no anchor; a frame of whose dashes most lie elsewhere is refused.

use super::pieces::MarkerPieces;
use crate::base::image::Plane;
use crate::kernels::region_of_interest::Roi;
use crate::phase::window_quality;
use crate::triangulate::triangulator::Triangulator;
use nalgebra::{Matrix4, Vector4};
use std::f64::consts::TAU;

/// Length of a stretch, in periods of the dashes on the panel.
const STRETCH: f64 = 2.0;

/// Fewest image rows of a stretch: four numbers are fitted to their light.
const LEAST_ROWS: usize = 7;

/// Rows of the image that a stretch may lack in one place, at most.
const GAP_ROWS: usize = 2;

/// A stretch agrees when its dashes lie within this of their place, rad: an eighth of their period, a row of the
/// shipped panel, which is far more than calibrations are wrong by.
const MOST_OFFSET: f64 = TAU / 8.0;

/// It also lies within this of the median of the frame's stretches, rad: those of another camera wander along the
/// marker.
const MOST_SPREAD: f64 = 0.25;

/// A stretch looks like dashes if the remainder of its light, after offset, slope and dashes, is less than this share
/// of the dashes (RMS to amplitude).
const MOST_REMAINDER: f64 = 0.5;

/// Fewest stretches, of those that look like dashes, by which a whole frame is judged.
const LEAST_STRETCHES: u32 = 3;

/// An offset that is worth a remark, px of the panel: calibrations from photographs are right within hundredths of one.
pub const REMARKABLE_PX: f32 = 0.3;

/// How the dashes of a frame agree with the calibration.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Dashes {
    /// Stretches that were looked at.
    pub stretches: u32,
    /// Those that lie where the calibration has them.
    pub agreeing: u32,
    /// Those that look like dashes and lie elsewhere; the others are too faint to judge, or no dashes.
    pub displaced: u32,
    /// How much further along the panel's rows than there most of these lie, px of the panel, in thousandths.
    pub offset_px: Option<f32>,
}

impl Dashes {
    /// Whether enough of the marker is seen to judge by.
    fn is_enough(&self) -> bool {
        self.agreeing + self.displaced >= LEAST_STRETCHES
    }

    /// Whether most of the marker lies elsewhere.
    pub fn contradict(&self) -> bool {
        self.is_enough() && self.agreeing < self.displaced
    }

    /// Whether the dashes of most cameras contradict a calibration, and not by a single one of them: then those that
    /// agree do so by chance.
    pub fn most_contradict<'a>(cameras: impl Iterator<Item = &'a Self>) -> bool {
        let (mut seen, mut contradicting) = (0, 0);
        for dashes in cameras.filter(|dashes| dashes.is_enough()) {
            seen += 1;
            contradicting += usize::from(dashes.contradict());
        }
        contradicting >= 2 && 2 * contradicting > seen
    }
}

/// A row of the image that crosses the marker.
#[derive(Debug, Clone, Copy)]
pub struct Crossing {
    /// The row of the image.
    pub v: usize,
    /// The panel's row that the calibration names, px.
    pub row: f64,
    /// The distance before the projector, m.
    pub distance: f64,
    /// Light over one period of the fringes, DN.
    pub light: f64,
}

/// Checks each piece of the marker, and sets the number of those that lie elsewhere to 0. `wrapped`, rad, and `light`,
/// in steps of `window_quality`, cover the same part `roi` of the frame.
pub(crate) fn check(
    marker: &mut MarkerPieces,
    wrapped: &Plane<f32>,
    light: &Plane<u16>,
    roi: Roi,
    triangulator: &Triangulator,
) -> Dashes {
    let pair = triangulator.pair();
    let Some(rows) = pair.rows else { return Dashes::default() };
    let mut crossings = vec![Vec::new(); marker.pieces.len()];
    for (v, columns, piece) in marker.runs() {
        let off = |u: &usize| wrapped.at(*u, v).abs();
        let Some(u) = columns.min_by(|a, b| off(a).total_cmp(&off(b))) else { continue };
        let number = usize::from(marker.number[piece]).wrapping_sub(1);
        let Some(fringe) = pair.markers.get(number) else { continue };
        let phase = TAU * f64::from(*fringe) + f64::from(wrapped.at(u, v));
        let Some((row, distance)) = triangulator.panel_row(roi.u + u, roi.v + v, phase) else { continue };
        let row = rows.of(row, distance);
        let light = f64::from(window_quality::light(light.at(u, v)));
        crossings[piece].push(Crossing { v, row, distance, light });
    }
    let period = pair.pattern.marker_period_px;
    let seen: Vec<Vec<Stretch>> = crossings
        .iter()
        .map(|crossings| stretches_of(crossings, period).filter_map(|x| Stretch::of(x, period)).collect())
        .collect();
    let mut offsets: Vec<f64> = seen.iter().flatten().filter(|x| x.is_near()).map(|x| x.offset).collect();
    offsets.sort_unstable_by(f64::total_cmp);
    let usual = offsets.get(offsets.len() / 2).copied();
    let agrees =
        |x: &&Stretch| x.is_near() && usual.is_some_and(|usual| (x.offset - usual).abs() <= MOST_SPREAD);
    let mut all = Dashes::default();
    for (stretches, number) in seen.iter().zip(&mut marker.number) {
        let agreeing = stretches.iter().filter(agrees).count();
        // One of two may agree by chance.
        if !stretches.is_empty() && 2 * agreeing <= stretches.len() {
            *number = 0;
        }
        all.stretches += stretches.len() as u32;
        all.agreeing += agreeing as u32;
        all.displaced += stretches.iter().filter(|x| x.is_clear() && !agrees(x)).count() as u32;
    }
    all.offset_px = usual.map(|usual| ((usual / TAU * period * 1e3).round() / 1e3) as f32);
    all
}

/// Cuts the crossings of a piece, by rising image row, into stretches of two periods; what is left over at the
/// end of each is dropped.
pub fn stretches_of(crossings: &[Crossing], period: f64) -> impl Iterator<Item = &[Crossing]> {
    let whole = move |first: usize, next: usize| {
        (crossings[next].row - crossings[first].row).abs() >= STRETCH * period && next - first >= LEAST_ROWS
    };
    let mut first = 0;
    std::iter::from_fn(move || {
        for next in first + 1..crossings.len() {
            // Rows that go back, too: there the next marker begins.
            if crossings[next].v.wrapping_sub(crossings[next - 1].v) > 1 + GAP_ROWS {
                first = next;
            } else if whole(first, next) {
                let stretch = &crossings[first..next];
                first = next;
                return Some(stretch);
            }
        }
        first = crossings.len();
        None
    })
}

/// The dashes of a stretch.
#[derive(Debug, Clone, Copy)]
pub struct Stretch {
    /// How far behind their place on the panel they lie, rad of their period.
    pub offset: f64,
    /// What the light has beside offset, slope and dashes: RMS relative to the dashes' amplitude.
    remainder: f64,
}

impl Stretch {
    /// By the offset, slope, cosine and sine of the dashes' phase that fit the light best; `None` where the rows do not
    /// separate these.
    pub fn of(crossings: &[Crossing], period: f64) -> Option<Self> {
        let middle = crossings[crossings.len() / 2].row;
        let terms = |crossing: &Crossing| {
            let (sin, cos) = (TAU * crossing.row / period).sin_cos();
            Vector4::new(1.0, (crossing.row - middle) / period, cos, sin)
        };
        let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for crossing in crossings {
            let terms = terms(crossing);
            normal += terms * terms.transpose();
            right += terms * crossing.light;
        }
        let found = normal.cholesky()?.solve(&right);
        let amplitude = found[2].hypot(found[3]);
        let squares: f64 = crossings.iter().map(|x| (terms(x).dot(&found) - x.light).powi(2)).sum();
        let remainder = (squares / crossings.len() as f64).sqrt() / amplitude;
        // They are brightest at phase 0.
        Some(Self { offset: found[3].atan2(found[2]), remainder })
    }

    /// Whether its light looks like dashes.
    pub fn is_clear(&self) -> bool {
        self.remainder <= MOST_REMAINDER
    }

    /// Whether it looks like dashes near their place.
    fn is_near(&self) -> bool {
        self.offset.abs() <= MOST_OFFSET && self.is_clear()
    }
}

#[cfg(test)]
mod tests {
    use super::{Dashes, check};
    use crate::base::image::Plane;
    use crate::config::Rig;
    use crate::data::{Calibration, PanelRows, STEPS_PER_LEVEL};
    use crate::kernels::pixel_runs::Runs;
    use crate::kernels::region_of_interest::Roi;
    use crate::marker::pieces::MarkerPieces;
    use crate::triangulate::camera_projector::CameraProjector;
    use crate::triangulate::triangulator::Triangulator;
    use std::f64::consts::TAU;
    use std::ops::Range;
    use std::path::Path;

    const ROI: Roi = Roi { u: 700, v: 400, width: 500, height: 300 };

    fn pair(camera: usize) -> CameraProjector {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        let calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        let head = &calibration.heads[0];
        let pair = CameraProjector::new(head, &head.cameras[camera], &calibration).expect("a usable pair");
        CameraProjector { rows: Some(PanelRows::exact()), ..pair }
    }

    /// The marker on a plane through the middle of the volume, as a camera sees it: its pixels, wrapped phases and
    /// light. `shift` of the panel's rows the dashes lie further than they should; rows for which `still` holds have
    /// none.
    fn marker(
        pair: &CameraProjector,
        shift: f64,
        still: impl Fn(usize) -> bool,
    ) -> (Plane<u8>, Plane<f32>, Plane<u16>) {
        let (w, h) = (ROI.width, ROI.height);
        let mut anchor = Plane::filled(w, h, 0u8);
        let mut wrapped = Plane::filled(w, h, 0f32);
        let mut light = Plane::filled(w, h, 0u16);
        let marker = TAU * f64::from(pair.pattern.marker_index);
        for v in 0..h {
            for u in 0..w {
                let ray = pair.camera.ray((ROI.u + u) as f64, (ROI.v + v) as f64).expect("inside the image");
                let (from, to) = (ray.at(0.0), ray.at(1.0));
                let point = ray.at((1.0 - from.z) / (to.z - from.z));
                let [column, row] = pair.projector.project(&point).expect("before the projector");
                let phase = pair.pattern.phase(column) - marker;
                if phase.abs() < 1.5 {
                    anchor.set(u, v, 1);
                    wrapped.set(u, v, phase as f32);
                    let dashes = (TAU * (row - shift) / pair.pattern.marker_period_px).cos();
                    let level = 60.0 * (1.0 + if still(v) { 0.0 } else { 0.25 * dashes });
                    // Whole steps, as noise.
                    light.set(u, v, (level * f64::from(STEPS_PER_LEVEL)) as u16);
                }
            }
        }
        assert!(anchor.as_slice().iter().any(|&x| x != 0), "the marker is in this part of the image");
        (anchor, wrapped, light)
    }

    /// The check of the dashes of a photograph with these anchors, and the anchors that are left.
    fn left(photograph: &(Plane<u8>, Plane<f32>, Plane<u16>), pair: CameraProjector) -> (Dashes, Plane<u8>) {
        let (anchor, wrapped, light) = photograph;
        let mut pieces = MarkerPieces::new(Runs::of(anchor));
        pieces.number.fill(1);
        let dashes = check(&mut pieces, wrapped, light, ROI, &Triangulator::new(pair));
        let mut left = anchor.clone();
        assert_eq!(pieces.paint(&mut left), count(&left, 0..ROI.height));
        (dashes, left)
    }

    fn count(anchor: &Plane<u8>, rows: Range<usize>) -> usize {
        rows.map(|v| anchor.row(v).iter().filter(|&&x| x != 0).count()).sum()
    }

    fn checked(seen_by: usize, calibrated: usize, shift: f64) -> (Dashes, usize) {
        let (dashes, left) = left(&marker(&pair(seen_by), shift, |_| false), pair(calibrated));
        (dashes, count(&left, 0..ROI.height))
    }

    #[test]
    fn dashes_lie_where_the_right_calibration_has_them_and_tell_how_far_off_they_are() {
        for shift in [0.0, 0.5, -0.5, 0.8] {
            let (dashes, left) = checked(0, 0, shift);
            println!("{shift}: {dashes:?}, {left} px left");
            assert!(dashes.stretches >= 8 && dashes.agreeing == dashes.stretches && !dashes.contradict());
            let offset = f64::from(dashes.offset_px.expect("known"));
            assert!((offset - shift).abs() < 0.02, "{shift}: {offset}");
            assert!(left > 1000);
        }
    }

    #[test]
    fn another_camera_and_a_device_that_has_moved_are_noticed() {
        for (name, (dashes, left)) in [
            ("the head's other camera", checked(0, 1, 0.0)),
            ("moved by a row and a half", checked(0, 0, 1.5)),
        ] {
            println!("{name}: {dashes:?}, {left} px left");
            assert!(dashes.contradict() && left == 0, "{name}");
        }
    }

    #[test]
    fn only_the_piece_that_is_no_marker_is_dropped() {
        // Two pieces: in the upper the light does not change along the fringe.
        let mut photograph = marker(&pair(0), 0.0, |v| v < 80);
        photograph.0.row_mut(80).fill(0);
        let (dashes, left) = left(&photograph, pair(0));
        println!("{dashes:?}");
        assert!(dashes.agreeing < dashes.stretches && !dashes.contradict());
        let lower = 81..ROI.height;
        assert_eq!((count(&left, 0..80), count(&left, lower.clone())), (0, count(&photograph.0, lower)));
    }

    #[test]
    fn a_frame_without_a_marker_contradicts_nothing() {
        let mut photograph = marker(&pair(0), 0.0, |_| false);
        photograph.0.as_mut_slice().fill(0);
        let (dashes, _) = left(&photograph, pair(0));
        assert_eq!(dashes, Dashes::default());
        assert!(!dashes.contradict());
    }

    #[test]
    fn without_the_panels_rows_nothing_is_checked() {
        let photograph = marker(&pair(0), 0.0, |_| false);
        let found = left(&photograph, CameraProjector { rows: None, ..pair(1) });
        assert_eq!(found, (Dashes::default(), photograph.0));
    }

    #[test]
    fn most_cameras_decide_and_one_alone_does_not() {
        let of = |agreeing, displaced| Dashes { stretches: 10, agreeing, displaced, offset_px: None };
        // Of faint ones most are neither.
        let (good, bad, unseen) = (of(10, 0), of(1, 9), of(0, 2));
        for (cameras, most) in [
            (vec![bad], false),
            (vec![bad, good], false),
            (vec![bad, bad, good], true),
            (vec![bad, bad, good, good], false),
            (vec![bad, bad, unseen, unseen, unseen], true),
            (vec![unseen, unseen], false),
        ] {
            assert_eq!(Dashes::most_contradict(cameras.iter()), most, "{cameras:?}");
        }
    }
}
