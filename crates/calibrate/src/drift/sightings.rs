// SPDX-License-Identifier: MIT OR Apache-2.0
//! Places of a body that two cameras see, from the phase maps of one instant: what drift is measured with.

use crate::data::{Calibration, PhaseMap, STEPS_PER_FRINGE};
use crate::geometry::Device;
use nalgebra::{Point3, Vector3};
use std::f64::consts::TAU;

/// One camera's phase at a place, and another one's where it sees the same place by the calibration.
#[derive(Debug, Clone)]
pub(super) struct Sighting {
    /// The camera whose pixel it is, by its place in the calibration.
    pub camera: usize,
    /// That pixel: column and row.
    pub pixel: [f64; 2],
    /// Its distance from the camera by the calibration, m.
    pub distance_m: f64,
    /// Absolute phase of the camera at that pixel, rad.
    pub phase: f64,
    /// The other camera, by its place in the calibration.
    pub other: usize,
    /// Where that one sees the place by the calibration, px.
    pub at: [f64; 2],
    /// Absolute phase of that camera there, rad, and how it changes along rows and columns, rad/px.
    pub other_phase: f64,
    pub other_slope: [f64; 2],
    /// Whether the place takes no part in the fit, so that it can judge it.
    pub held_back: bool,
}

/// Side of the squares of the image whose places are held back together, px: errors of neighbours are alike.
const HELD_BACK_PX: usize = 96;

/// One in so many squares is held back.
const HELD_BACK_IN: usize = 4;

/// Distance of the places that are compared, along rows and columns, px: neighbours have most of their error in common.
const STEP_PX: usize = 24;

/// Largest difference of two cameras that counts, rad: beyond it they see two surfaces, or one is a fringe off.
const SAME_SURFACE_RAD: f64 = 1.5;

/// The phases of one camera, pixel by pixel.
struct Phases {
    width: usize,
    height: usize,
    /// Phase of each pixel in steps; [`NONE`] where there is none.
    steps: Vec<i32>,
}

const NONE: i32 = i32::MIN;

impl Phases {
    fn new(map: &PhaseMap) -> Self {
        let [width, height] = map.frame.map(usize::from);
        let mut steps = vec![NONE; width * height];
        let mut next = map.phase.iter();
        for run in &map.runs {
            let first = usize::from(run.row) * width + usize::from(run.first);
            let row = steps.get_mut(first..first + usize::from(run.length)).into_iter().flatten();
            row.zip(next.by_ref()).for_each(|(to, from)| *to = *from);
        }
        Self { width, height, steps }
    }

    /// The paraboloid through the nine pixels around one (least squares); `None` where one of them is unknown.
    fn around(&self, u: usize, v: usize) -> Option<Paraboloid> {
        if u == 0 || v == 0 || u + 1 >= self.width || v + 1 >= self.height {
            return None;
        }
        let mut fit = Paraboloid { phase: 0.0, slope: [0.0; 2], bend: [0.0; 3] };
        for (k, row) in (v - 1..=v + 1).enumerate() {
            for (i, steps) in self.steps[row * self.width + u - 1..][..3].iter().enumerate() {
                if *steps == NONE {
                    return None;
                }
                let phase = TAU / f64::from(STEPS_PER_FRINGE) * f64::from(*steps);
                let (x, y) = (i as f64 - 1.0, k as f64 - 1.0);
                fit.phase += phase * (5.0 - 3.0 * (x * x + y * y)) / 9.0;
                fit.slope[0] += phase * x / 6.0;
                fit.slope[1] += phase * y / 6.0;
                fit.bend[0] += phase * (x * x - 2.0 / 3.0);
                fit.bend[1] += phase * (y * y - 2.0 / 3.0);
                fit.bend[2] += phase * x * y / 4.0;
            }
        }
        Some(fit)
    }
}

/// A phase (rad), its slopes along rows and columns (rad/px) and how these change: along rows, along columns, both
/// (rad/px^2).
struct Paraboloid {
    phase: f64,
    slope: [f64; 2],
    bend: [f64; 3],
}

impl Paraboloid {
    /// Phase and slopes at a distance (x, y) from its middle, px.
    fn beside(&self, [x, y]: [f64; 2]) -> (f64, [f64; 2]) {
        let [xx, yy, xy] = self.bend;
        let [sx, sy] = self.slope;
        let phase = self.phase + sx * x + sy * y + (xx * x * x + yy * y * y) / 2.0 + xy * x * y;
        (phase, [sx + xx * x + xy * y, sy + yy * y + xy * x])
    }
}

/// The line of sight of a pixel, camera axes.
pub(super) fn sight(camera: &Device, [u, v]: [f64; 2]) -> Option<Vector3<f64>> {
    let [x, y] = camera.lens.undistort(u, v)?;
    Some(Vector3::new(x, y, 1.0).normalize())
}

/// The point on a camera's line of sight that a column of its projector lights: its distance, m. `sight` in camera
/// axes, from near `start_m` on.
pub(super) fn distance(
    camera: &Device,
    projector: &Device,
    sight: &Vector3<f64>,
    column: f64,
    start_m: f64,
) -> Option<f64> {
    let pose = camera.world_from_device.isometry();
    let (from, along) = (camera.centre(), pose.rotation * sight);
    let off = |t: f64| projector.project(&(from + along * t)).map(|[u, _]| u - column);
    let (mut a, mut b) = (start_m, start_m + 1e-3);
    let (mut fa, mut fb) = (off(a)?, off(b)?);
    for _ in 0..20 {
        if fb.abs() < 1e-9 || fa == fb {
            break;
        }
        let next = b - fb * (b - a) / (fb - fa);
        (a, fa) = (b, fb);
        b = next;
        fb = off(b)?;
    }
    (fb.abs() < 1e-6 && b > 0.0).then_some(b)
}

/// Where a line of sight is at a distance, world.
pub(super) fn place(camera: &Device, sight: &Vector3<f64>, distance_m: f64) -> Point3<f64> {
    camera.centre() + camera.world_from_device.isometry().rotation * sight * distance_m
}

/// All sightings of one instant, whose number decides which are held back. Maps come with their camera's place in the
/// calibration.
pub(super) fn of(calibration: &Calibration, instant: usize, maps: &[(usize, PhaseMap)]) -> Vec<Sighting> {
    let cameras: Vec<_> = calibration.cameras().collect();
    let phases: Vec<(usize, Phases)> = maps.iter().map(|(camera, map)| (*camera, Phases::new(map))).collect();
    let middle = (Vector3::from(calibration.volume_min_m) + Vector3::from(calibration.volume_max_m)) / 2.0;
    let grid = |size: usize| (STEP_PX / 2..size).step_by(STEP_PX);
    let mut found = Vec::new();
    for &(camera, ref own) in &phases {
        let (head, device) = (cameras[camera].0, &cameras[camera].1.device);
        let start_m = (device.centre().coords - middle).norm();
        for (u, v) in grid(own.height).flat_map(|v| grid(own.width).map(move |u| (u, v))) {
            let pixel = [u as f64, v as f64];
            // Along every row and column of squares another one is held back, in other instants others.
            let square = u / HELD_BACK_PX + 2 * (v / HELD_BACK_PX) + camera + instant;
            let held_back = square.is_multiple_of(HELD_BACK_IN);
            let located = || {
                let phase = own.around(u, v)?.phase;
                let seen = sight(device, pixel)?;
                let column = calibration.pattern.column(phase);
                Some((phase, seen, distance(device, &head.projector, &seen, column, start_m)?))
            };
            let Some((phase, seen, distance_m)) = located() else { continue };
            let point = place(device, &seen, distance_m);
            let seen_by = |&(other, ref theirs): &(usize, Phases)| {
                let (head, device) = (cameras[other].0, &cameras[other].1.device);
                let at = device.project(&point).filter(|at| device.contains(*at))?;
                let nearest = at.map(|x| x.round().max(0.0) as usize);
                let seen = theirs.around(nearest[0], nearest[1])?;
                let [column, _] = head.projector.project(&point)?;
                let beside = [at[0] - nearest[0] as f64, at[1] - nearest[1] as f64];
                let (other_phase, other_slope) = seen.beside(beside);
                let same = (other_phase - calibration.pattern.phase(column)).abs() < SAME_SURFACE_RAD;
                same.then_some(Sighting {
                    camera,
                    pixel,
                    distance_m,
                    phase,
                    other,
                    at,
                    other_phase,
                    other_slope,
                    held_back,
                })
            };
            found.extend(phases.iter().filter(|x| x.0 != camera).filter_map(seen_by));
        }
    }
    found
}
