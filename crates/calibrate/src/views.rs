// SPDX-License-Identifier: MIT OR Apache-2.0
//! Judges the photographs of a session: whether the board is lit white or with fringes, the circles in white light, and
//! the phase in fringes. A photograph that cannot be used is named with its reason.
//!
//! [`look_at_frame`] judges a frame by itself, [`super::positions::arrange`] brings the frames of a position together.

use super::board::Board;
use super::estimate::median;
use super::findings::{Finding, Kind, Refusal};
use super::lattice::{Sighting, identify};
use super::observed::{DARK, Looked, Phase, Position, View};
use super::positions::arrange;
use super::spots::find_spots;
use super::start::board_pose;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::{Mono8, Plane};
use crate::data::{Calibration, Frame, FrameSource};
use crate::geometry::Device;
use crate::reconstruct::pipeline::{Method, Pipeline, Workspace};
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use crate::reconstruct::triangulate::triangulator::Triangulator;
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use std::sync::Arc;

/// What lights the board in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Light {
    Dark,
    /// White light, even or not.
    White,
    Fringes,
}

/// Fringes change the light by at least this share over half a period.
const FRINGE_CONTRAST: f32 = 0.12;
/// Edges wider than this are out of focus or moved, px.
const BLUR_PX: f64 = 2.5;
/// At this grey level the sensor is taken to be saturated.
const SATURATED: f64 = 253.0;
/// Share of saturated circles above which a view is left out; fewer are left out one by one.
const MOST_SATURATED: f64 = 0.25;
/// Fewest circles of a view that is used.
const LEAST_CIRCLES: usize = 30;

/// What lights the board: fringes of about `period_px` columns, or not.
pub fn light_of(image: Mono8<'_>, period_px: f32) -> Light {
    let half = ((period_px / 2.0).round() as usize).max(1);
    let mut contrasts = Vec::new();
    let mut lightest = 0;
    for v in (0..image.height()).step_by(7) {
        let row = image.row(v);
        for u in (0..row.len().saturating_sub(half)).step_by(3) {
            let (a, b) = (f32::from(row[u]), f32::from(row[u + half]));
            lightest = lightest.max(row[u]);
            if a + b > 2.0 * f32::from(DARK) {
                contrasts.push((a - b).abs() / (a + b));
            }
        }
    }
    if lightest < DARK || contrasts.len() < 1000 {
        return Light::Dark;
    }
    // Not the middle: a good part of the board may be hidden. Edges of circles take less than a sixth.
    let place = contrasts.len() * 7 / 10;
    let (_, contrast, _) = contrasts.select_nth_unstable_by(place, f32::total_cmp);
    if *contrast > FRINGE_CONTRAST { Light::Fringes } else { Light::White }
}

/// One pipeline for every camera, in the calibration's order. The nominal geometry has no rows, so dashes are not
/// checked.
pub fn pipelines(nominal: &Calibration) -> Result<Vec<Pipeline>, String> {
    let workspace = Arc::new(Workspace::default());
    let pipeline = |pair| {
        let triangulator = Triangulator::new(CameraProjector { rows: None, is_shallow: false, ..pair });
        Pipeline::new(triangulator, Method::Joint, false).with_workspace(Arc::clone(&workspace))
    };
    nominal
        .cameras()
        .map(|(head, camera)| CameraProjector::new(head, camera, nominal).map(pipeline))
        .collect()
}

/// Looks through a session. `nominal` is the rig's geometry, good to a few per cent. An error means that the source
/// cannot be read, or is of another rig.
pub fn look(
    source: &dyn FrameSource,
    nominal: &Calibration,
    board: &Board,
) -> Result<(Vec<Position>, Vec<Finding>), String> {
    let cameras: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let pipelines = pipelines(nominal)?;
    let work: Vec<(u64, usize)> = source
        .triggers()
        .flat_map(|trigger| (0..cameras.len()).map(move |camera| (trigger, camera)))
        .collect();
    let looked: Vec<Looked> = work
        .par_iter()
        .map(|&(trigger, camera)| {
            if !source.cameras().contains(&cameras[camera]) {
                return Ok(Looked::Missing("the session does not have this camera".to_owned()));
            }
            let frame = source.frame(&cameras[camera], TriggerIndex(trigger))?;
            look_at_frame(&frame, &cameras[camera], &pipelines[camera], board)
        })
        .collect::<Result<_, String>>()?;
    let frames =
        work.into_iter().zip(looked).map(|((trigger, camera), l)| (TriggerIndex(trigger), camera, l));
    Ok(arrange(frames.collect(), nominal, board))
}

/// Judges one frame by itself. An error means that the frame is of another rig.
pub fn look_at_frame(
    frame: &Frame<'_>,
    camera: &CameraId,
    pipeline: &Pipeline,
    board: &Board,
) -> Result<Looked, String> {
    let image = match frame {
        Frame::Image(image) => *image,
        Frame::Owned(plane) => Mono8::from(plane),
        Frame::Gap(cause) => return Ok(Looked::Missing(cause.clone())),
    };
    let pair = pipeline.triangulator().pair();
    if (image.width(), image.height()) != (pair.camera.width, pair.camera.height) {
        return Err(format!(
            "camera {camera}: frames of {} x {}, the rig has {} x {}; is this the rig of the session?",
            image.width(),
            image.height(),
            pair.camera.width,
            pair.camera.height
        ));
    }
    Ok(match light_of(image, pair.period_px) {
        Light::Dark => Looked::Dark,
        Light::White => Looked::White(look_at_circles(image, board, &pair.camera)),
        Light::Fringes => Looked::Fringes { image: owned(image), phase: look_at_fringes(image, pipeline) },
    })
}

fn owned(image: Mono8<'_>) -> Plane<u8> {
    let mut plane = Plane::filled(image.width(), image.height(), 0);
    plane.as_mut_slice().copy_from_slice(image.as_slice());
    plane
}

fn look_at_fringes(image: Mono8<'_>, pipeline: &Pipeline) -> Result<Phase, Refusal> {
    let (prepared, in_patches) = pipeline.absolute(image).map_err(|refused| {
        Refusal::new(Kind::NoPhase, format!("the fringes give no phase ({:?})", refused.outcome))
    })?;
    let mut plane = Plane::filled(image.width(), image.height(), f32::NAN);
    let mut by_marker = Plane::filled(image.width(), image.height(), false);
    let roi = prepared.roi;
    for v in 0..roi.height {
        // Values beside the runs are undefined.
        for u in prepared.runs().row(v).iter().flat_map(|run| run.columns()) {
            let absolute = prepared.absolute.at(u, v);
            let phase = if absolute.is_nan() { in_patches.at(u, v) } else { absolute };
            plane.set(roi.u + u, roi.v + v, phase);
            by_marker.set(roi.u + u, roi.v + v, !absolute.is_nan());
        }
    }
    Ok(Phase { plane, by_marker, marker: prepared.counts.marker > 0 })
}

fn look_at_circles(image: Mono8<'_>, board: &Board, camera: &Device) -> Result<View, Refusal> {
    let spots = find_spots(image);
    let mut sightings = identify(&spots, board)?;
    let all = sightings.len();
    let blur = median(sightings.iter().map(|s| s.spot.blur_px));
    if blur > BLUR_PX {
        return Err(Refusal::new(
            Kind::Blurred,
            format!(
                "blurred: edges are {blur:.1} px wide, expected at most {BLUR_PX}. Hold the board still, check the focus"
            ),
        ));
    }
    sightings.retain(|s| s.spot.outside < SATURATED);
    let saturated = all - sightings.len();
    if saturated as f64 > MOST_SATURATED * all as f64 {
        return Err(Refusal::new(
            Kind::Saturated,
            format!(
                "saturated: the white around {saturated} of {all} circles is at grey level {SATURATED:.0} or more. Reduce exposure or light"
            ),
        ));
    }
    if sightings.len() < LEAST_CIRCLES {
        let found = sightings.len();
        return Err(Refusal::new(
            Kind::FewCircles,
            format!("only {found} circles, expected at least {LEAST_CIRCLES}. Show more of the board"),
        ));
    }
    check_sizes(&sightings, board, camera)?;
    Ok(View {
        sightings,
        phase: None,
        confirmed: Vec::new(),
        white: Some(owned(image)),
        light: Vec::new(),
        ridge: Vec::new(),
    })
}

/// Circles may seem larger or smaller than in the board file by this share, as blooming makes them.
const SIZE_SHARE: f64 = 0.04;
/// Circles may seem larger or smaller by this many px in addition.
const SIZE_PX: f64 = 0.4;

/// The pitch gives the distance, the distance the size: another board of the same code has another proportion.
fn check_sizes(sightings: &[Sighting], board: &Board, camera: &Device) -> Result<(), Refusal> {
    let Some(pose) = board_pose(board, sightings, &camera.lens) else {
        return Err(Refusal::new(
            Kind::FewCircles,
            "the circles do not determine where the board is. Show more of it",
        ));
    };
    let ratios: Vec<(f64, f64)> = sightings
        .iter()
        .filter_map(|s| {
            let expected = outline_radius(board, s.circle, &pose, camera)?;
            Some((s.spot.ellipse.radius() / expected, expected))
        })
        .collect();
    let ratio = median(ratios.iter().map(|(ratio, _)| *ratio));
    let limit = SIZE_SHARE + SIZE_PX / median(ratios.iter().map(|(_, radius)| *radius)).max(1.0);
    if (ratio - 1.0).abs() <= limit {
        return Ok(());
    }
    Err(Refusal::new(
        Kind::CircleSize,
        format!(
            "circles are {:.0} % as large as in the board file for their distance from each other, expected 100 +- {:.0} %. Is it the file of this board?",
            100.0 * ratio,
            100.0 * limit
        ),
    ))
}

/// Radius of a circle of the same area as the circle's image, px.
fn outline_radius(
    board: &Board,
    circle: usize,
    camera_from_board: &Isometry3<f64>,
    camera: &Device,
) -> Option<f64> {
    let circle = board.circles().get(circle)?;
    let centre = camera_from_board * Point3::from(circle.centre_m);
    let turned = |axis: Vector3<f64>| camera_from_board.rotation * axis;
    let columns =
        nalgebra::Matrix3::from_columns(&[turned(Vector3::x()), turned(Vector3::y()), centre.coords]);
    let ideal = super::ellipse::image_of_circle(&columns, circle.radius_m)?;
    let (x, y) = (centre.x / centre.z, centre.y / centre.z);
    let [[a, b], [c, d]] = camera.lens.jacobian(x, y);
    Some(ideal.radius() * (camera.lens.fx * camera.lens.fy * (a * d - b * c).abs()).sqrt())
}
