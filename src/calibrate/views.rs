//! From the photographs of a session to what the calibration uses: which position of the board, lit white or with
//! fringes; the circles of the one, the phase of the other. Whatever cannot be used is named with its reason.

use super::board::Board;
use super::ellipse::least_squares;
use super::lattice::{Sighting, identify};
use super::spots::find_spots;
use super::{Calibration, Observation};
use crate::ids::{CameraId, TriggerIndex};
use crate::image::{Mono8, Plane};
use crate::reconstruct::pair::Pair;
use crate::reconstruct::pipeline::{Method, Pipeline};
use crate::reconstruct::triangulate::Triangulator;
use crate::reconstruct::{Frame, FrameSource};
use nalgebra::{SVector, Vector3};
use rayon::iter::{IntoParallelRefIterator, ParallelIterator};
use std::f64::consts::TAU;

/// What lights the board in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Light {
    /// Nothing.
    Dark,
    /// White, evenly or not.
    White,
    /// The fringe pattern.
    Fringes,
}

/// A camera's view of the board, lit white.
#[derive(Debug, Clone)]
pub struct View {
    /// The circles.
    pub sightings: Vec<Sighting>,
    /// The absolute phase over the frame with fringes, rad; NaN where it is not known.
    pub phase: Option<Plane<f32>>,
}

/// The board at one place: a white frame, and the frame with fringes that follows it.
#[derive(Debug, Clone)]
pub struct Position {
    /// The white frames' trigger.
    pub white: TriggerIndex,
    /// The fringe frames' trigger.
    pub fringes: Option<TriggerIndex>,
    /// By camera, in the calibration's order.
    pub views: Vec<Option<View>>,
}

/// Something that was left out, or looks wrong.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    /// The camera.
    pub camera: CameraId,
    /// The frame.
    pub trigger: TriggerIndex,
    /// What was found and what to do.
    pub message: String,
}

/// Darker than this all over is dark, grey levels.
const DARK: u8 = 24;
/// Fringes change the light by at least this share over half a period.
const FRINGE_CONTRAST: f32 = 0.12;
/// Edges wider than this are out of focus or moved, px.
const BLUR_PX: f64 = 3.0;
/// At this grey level the sensor is taken to be saturated.
const SATURATED: f64 = 253.0;
/// Circles below which a view says too little.
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
    let middle = contrasts.len() / 2;
    let (_, median, _) = contrasts.select_nth_unstable_by(middle, f32::total_cmp);
    if *median > FRINGE_CONTRAST { Light::Fringes } else { Light::White }
}

/// Looks through a session. `nominal` is the rig's geometry, good to a few per cent.
pub fn look(
    source: &dyn FrameSource,
    nominal: &Calibration,
    board: &Board,
) -> Result<(Vec<Position>, Vec<Finding>), String> {
    let cameras: Vec<CameraId> = nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let pipelines: Vec<Pipeline> = nominal
        .cameras()
        .map(|(head, camera)| {
            Pair::new(head, camera, nominal)
                .map(|pair| Pipeline::new(Triangulator::new(pair), Method::Anchored, false))
        })
        .collect::<Result<_, _>>()?;
    let work: Vec<(u64, usize)> = source
        .triggers()
        .flat_map(|trigger| (0..cameras.len()).map(move |camera| (trigger, camera)))
        .collect();
    let looked: Vec<Result<Looked, String>> = work
        .par_iter()
        .map(|&(trigger, camera)| {
            look_at_frame(source, &cameras[camera], TriggerIndex(trigger), &pipelines[camera], board)
        })
        .collect();
    let mut findings = Vec::new();
    let mut positions: Vec<Position> = Vec::new();
    for (&(trigger, camera), looked) in work.iter().zip(looked) {
        let trigger = TriggerIndex(trigger);
        let finding = |message: String| Finding { camera: cameras[camera].clone(), trigger, message };
        match looked? {
            Looked::Nothing(message) => findings.extend(message.map(finding)),
            Looked::White(view) => {
                if positions.last().is_none_or(|last| last.white != trigger) {
                    let views = (0..cameras.len()).map(|_| None).collect();
                    positions.push(Position { white: trigger, fringes: None, views });
                }
                if let Some(position) = positions.last_mut() {
                    position.views[camera] = Some(view);
                }
            }
            Looked::Fringes(phase) => {
                let position = positions
                    .last_mut()
                    .filter(|p| p.white < trigger && p.fringes.is_none_or(|f| f == trigger));
                match position.and_then(|p| Some((&mut p.fringes, p.views[camera].as_mut()?))) {
                    Some((fringes, view)) => {
                        *fringes = Some(trigger);
                        view.phase = Some(phase);
                    }
                    None => findings.push(finding(
                        "fringes without a usable white frame of the same position before them; left out"
                            .to_owned(),
                    )),
                }
            }
        }
    }
    Ok((positions, findings))
}

enum Looked {
    Nothing(Option<String>),
    White(View),
    Fringes(Plane<f32>),
}

fn look_at_frame(
    source: &dyn FrameSource,
    camera: &CameraId,
    trigger: TriggerIndex,
    pipeline: &Pipeline,
    board: &Board,
) -> Result<Looked, String> {
    let frame = source.frame(camera, trigger)?;
    let image = match &frame {
        Frame::Image(image) => *image,
        Frame::Owned(plane) => Mono8::from(plane),
        Frame::Gap(cause) => return Ok(Looked::Nothing(Some(format!("no frame ({cause}); left out")))),
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
        Light::Dark => Looked::Nothing(None),
        Light::White => look_at_circles(image, board),
        Light::Fringes => match pipeline.prepare(image) {
            Ok(prepared) if prepared.counts.marker > 0 => {
                let mut phase = Plane::filled(image.width(), image.height(), f32::NAN);
                let roi = prepared.roi;
                for v in 0..roi.height {
                    phase.row_mut(roi.v + v)[roi.u..roi.u + roi.width].copy_from_slice(prepared.absolute.row(v));
                }
                Looked::Fringes(phase)
            }
            Ok(_) => Looked::Nothing(Some("fringes without a marker: their order is not known; left out. Is the pattern that of the rig?".to_owned())),
            Err(refused) => Looked::Nothing(Some(format!("fringes cannot be used ({:?}); left out", refused.outcome))),
        },
    })
}

fn look_at_circles(image: Mono8<'_>, board: &Board) -> Looked {
    let spots = find_spots(image);
    let sightings = match identify(&spots, board) {
        Ok(sightings) => sightings,
        Err(reason) => return Looked::Nothing(Some(format!("{reason}; left out"))),
    };
    let median = |value: &dyn Fn(&Sighting) -> f64| {
        let mut values: Vec<f64> = sightings.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let (blur, outside) = (median(&|s| s.spot.blur_px), median(&|s| s.spot.outside));
    if sightings.len() < LEAST_CIRCLES {
        return Looked::Nothing(Some(format!(
            "only {} circles, expected at least {LEAST_CIRCLES}; left out",
            sightings.len()
        )));
    }
    if blur > BLUR_PX {
        return Looked::Nothing(Some(format!(
            "blurred: edges are {blur:.1} px wide, expected at most {BLUR_PX}; left out. Hold the board still, check the focus"
        )));
    }
    if outside >= SATURATED {
        return Looked::Nothing(Some(format!(
            "saturated: the white is at grey level {outside:.0}; left out. Reduce exposure or light"
        )));
    }
    Looked::White(View { sightings, phase: None })
}

/// Half the window in which the phase around a board point is fitted, px.
const WINDOW: i64 = 8;
/// Share of the window that must have a phase.
const FILLED: f64 = 0.7;
/// Periods around the marker that are left out: its modulation pulls the phase.
const MARKER_PERIODS: f64 = 1.5;

/// The panel column that lights the board at pixel (u, v), and its standard deviation, panel px.
pub fn column_at(phase: &Plane<f32>, [u, v]: [f64; 2], pair: &Pair) -> Option<(f64, f64)> {
    let (column, row) = (u.round() as i64, v.round() as i64);
    let inside = |at: i64, size: usize| at >= WINDOW && at + WINDOW < size as i64;
    if !(inside(column, phase.width()) && inside(row, phase.height())) {
        return None;
    }
    let mut rows = Vec::with_capacity(((2 * WINDOW + 1) * (2 * WINDOW + 1)) as usize);
    for y in row - WINDOW..=row + WINDOW {
        for x in column - WINDOW..=column + WINDOW {
            let value = f64::from(phase.at(x as usize, y as usize));
            if !value.is_nan() {
                rows.push((Vector3::new(1.0, x as f64 - u, y as f64 - v), value));
            }
        }
    }
    let side = (2 * WINDOW + 1) as f64;
    if (rows.len() as f64) < FILLED * side * side {
        return None;
    }
    let fit: SVector<f64, 3> = least_squares(rows.iter().copied())?;
    let sum: f64 = rows.iter().map(|(row, value)| (row.dot(&fit) - value).powi(2)).sum();
    let rms = (sum / rows.len() as f64).sqrt();
    // A step of the fringe order, or an edge, lies in the window.
    if rms > 0.3 {
        return None;
    }
    let from_marker = (fit[0] / TAU - f64::from(pair.pattern.marker_index)).abs();
    if from_marker < MARKER_PERIODS {
        return None;
    }
    // Neighbouring phases share most of their pixels: count one in so many as independent.
    let independent = rows.len() as f64 / pair.period_px.max(1.0) as f64;
    let sigma = rms.max(0.005) / independent.sqrt() * pair.pattern.period_px / TAU;
    Some((pair.pattern.column(fit[0]), sigma))
}

/// A phase observation of the projector.
pub fn phase_observation(
    projector: usize,
    board: usize,
    point: nalgebra::Point3<f64>,
    column: f64,
    sigma_px: f64,
) -> Observation {
    Observation { device: projector, board, point, measured: [column, 0.0], sigma_px, columns_only: true }
}
