// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stages 1 and 2 of section 4.2: cameras of a head, then the phase of each camera-projector pair. [`super::global`] is
//! the third.
//!
//! 1. *Cameras*: circles seen by both cameras of a head, any number of positions of the board. Measured centres are
//!    those of the outlines; the centre of a circle's image is not the image of its centre, so the difference under the
//!    current estimate is taken off, and the adjustment repeated.
//! 2. *Phase*: the absolute phase at points of the white field between the circles is the panel column that lights
//!    them: the projector is adjusted like a camera that sees columns only, together with the cameras.
//!
//! Each kind of observation weighs as much as its own residuals justify: its standard deviation is theirs.

use super::bundle::{Adjusted, DeviceModel, Model, Observation, Prior, adjust};
use super::ellipse::{Ellipse, image_of_circle};
use super::phases::{LEAST_PHASE_POINTS, LEAST_PHASES};
use super::rigging::{Excluded, HeadResult, Rigging, StageError};
use super::start::{board_pose, is_same_position};
use crate::geometry::Device;
use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use std::f64::consts::TAU;

/// Standard deviation of a circle's centre at the start, px; afterwards it is that of the residuals.
const CIRCLE_SIGMA_PX: f64 = 0.02;
/// Fewest positions that each camera of a head must have seen itself.
const LEAST_VIEWS: usize = 4;
/// How often centres are corrected in stage 1.
const CAMERA_ROUNDS: usize = 3;
/// How often phases are sampled anew in stage 2.
const PHASE_ROUNDS: usize = 2;

impl Rigging<'_> {
    /// Stages 1 and 2 of one head; views that contradict the others are left out, as long as they are few.
    pub(super) fn calibrate_head(&self, head: usize) -> Result<HeadResult, StageError> {
        let mut excluded = Excluded::default();
        let mut findings = Vec::new();
        loop {
            let result = self.attempt(head, &excluded)?;
            let worse = excluded.contradicting(self, &result);
            if worse.is_empty() {
                self.check(&result)?;
                let misread = self.misread(&result, &excluded);
                findings.extend(misread.iter().map(|view| self.misread_finding(head, view)));
                return Ok(HeadResult { misread, findings, ..result });
            }
            findings.extend(worse);
            excluded.check(self, head)?;
        }
    }

    /// Stages 1 and 2 with all views that are not excluded.
    fn attempt(&self, head: usize, excluded: &Excluded) -> Result<HeadResult, StageError> {
        let refused = |error| StageError::Refused(format!("head {}: {error}", self.head_name(head)));
        let (positions, boards) = self.starting_boards(head, excluded)?;
        let mut model = Model { devices: self.starting_devices(head), boards };
        let mut circles = self.circles(head, &positions, excluded);
        let priors = self.priors(head);
        let (projector, cameras) = (model.devices.len() - 1, self.nominal.heads[head].cameras.len());
        for _ in 0..CAMERA_ROUNDS {
            let observations = self.corrected(&model, &circles);
            // Nothing observes the projector yet: it stays as it is.
            let adjusted = adjust(model, &observations, &priors, 0).map_err(refused)?;
            for camera in 0..cameras {
                let spread = spread(&adjusted, &observations, |i| observations[i].device == camera);
                let mine = circles.iter_mut().filter(|(o, _)| o.device == camera);
                mine.for_each(|(o, _)| o.sigma_px *= spread);
            }
            model = adjusted.model;
        }
        self.settle_orders(head, &positions, &mut model, excluded)?;
        let (mut last, mut phase_scale) = (None, 1.0);
        for _ in 0..PHASE_ROUNDS {
            let mut observations = self.corrected(&model, &circles);
            let mut phase_cameras = Vec::new();
            for camera in 0..cameras {
                let phases = self.phases(head, camera, &positions, &model, excluded);
                phase_cameras.resize(phase_cameras.len() + phases.len(), camera);
                observations.extend(
                    phases.into_iter().map(|o| Observation { sigma_px: o.sigma_px * phase_scale, ..o }),
                );
            }
            self.check_phases(head, &observations[circles.len()..], positions.len())?;
            let adjusted = adjust(model, &observations, &priors, 0).map_err(refused)?;
            phase_scale *= spread(&adjusted, &observations, |i| observations[i].device == projector);
            model = adjusted.model.clone();
            last = Some((adjusted, observations, phase_cameras));
        }
        let Some((all, observations, phase_cameras)) = last else {
            return Err(StageError::Positions { head: self.head_name(head).to_owned(), found: 0 });
        };
        let circles = circles.len();
        Ok(HeadResult {
            head,
            positions,
            all,
            observations,
            circles,
            phase_cameras,
            misread: Vec::new(),
            findings: Vec::new(),
        })
    }

    fn starting_devices(&self, head: usize) -> Vec<DeviceModel> {
        let head = &self.nominal.heads[head];
        let model = |device: &Device| DeviceModel {
            lens: device.lens,
            device_from_frame: device.world_from_device.isometry().inverse(),
        };
        head.cameras.iter().map(|camera| model(&camera.device)).chain([model(&head.projector)]).collect()
    }

    /// Positions that a camera of the head saw, with the board's pose in the nominal world.
    fn starting_boards(
        &self,
        head: usize,
        excluded: &Excluded,
    ) -> Result<(Vec<usize>, Vec<Isometry3<f64>>), StageError> {
        let cameras = &self.nominal.heads[head].cameras;
        let (mut places, mut boards) = (Vec::new(), Vec::<Isometry3<f64>>::new());
        let (mut distinct, mut views) = (0, vec![0; cameras.len()]);
        for place in 0..self.positions.len() {
            // The camera that saw most of the board.
            let seen = cameras.iter().enumerate().filter(|(c, _)| !excluded.views.contains(&(*c, place)));
            let seen = seen.filter_map(|(c, camera)| Some((c, self.view(head, c, place)?, &camera.device)));
            let seen: Vec<_> = seen.collect();
            let Some((_, view, device)) = seen.iter().max_by_key(|(_, view, _)| view.sightings.len()) else {
                continue;
            };
            let Some(camera_from_board) = board_pose(self.board, &view.sightings, &device.lens) else {
                continue;
            };
            let board = device.world_from_device.isometry() * camera_from_board;
            distinct += usize::from(!boards.iter().any(|other| is_same_position(other, &board)));
            seen.iter().for_each(|(c, ..)| views[*c] += 1);
            places.push(place);
            boards.push(board);
        }
        self.check_positions(head, distinct)?;
        if let Some((camera, found)) = cameras.iter().zip(&views).find(|(_, found)| **found < LEAST_VIEWS) {
            return Err(StageError::Refused(format!(
                "camera {}: usable views in {found} of {} positions of the board, expected at least {LEAST_VIEWS}. See what was left out of it",
                camera.id,
                places.len()
            )));
        }
        let normals: Vec<Vector3<f64>> = boards.iter().map(|b| b.rotation * Vector3::z()).collect();
        let angles = normals.iter().flat_map(|a| normals.iter().map(move |b| a.angle(b)));
        let degrees = angles.fold(0.0, f64::max).to_degrees();
        if degrees < 25.0 {
            return Err(StageError::Refused(format!(
                "head {}: the positions of the board are tilted against each other by at most {} degrees, expected 25 or more. Tilt the board more",
                self.head_name(head),
                degrees as u32
            )));
        }
        Ok((places, boards))
    }

    fn check_phases(&self, head: usize, phases: &[Observation], positions: usize) -> Result<(), StageError> {
        let points = |board: usize| phases.iter().filter(|o| o.board == board).count();
        let found = (0..positions).filter(|board| points(*board) >= LEAST_PHASE_POINTS).count();
        if found < LEAST_PHASES {
            return Err(StageError::Refused(format!(
                "head {}: fringes give a phase in {found} positions of the board, expected at least {LEAST_PHASES}. After each white frame one with the rig's pattern is needed, the board at the same place",
                self.head_name(head)
            )));
        }
        Ok(())
    }

    /// Sightings of all circles, as measured.
    fn circles(&self, head: usize, positions: &[usize], excluded: &Excluded) -> Vec<(Observation, f64)> {
        let mut all = Vec::new();
        for (board, &position) in positions.iter().enumerate() {
            for device in 0..self.nominal.heads[head].cameras.len() {
                let view = self.view(head, device, position);
                let Some(view) = view.filter(|_| !excluded.views.contains(&(device, position))) else {
                    continue;
                };
                all.extend(view.sightings.iter().map(|sighting| {
                    let circle = self.board.circles()[sighting.circle];
                    let observation = Observation {
                        device,
                        board,
                        point: Point3::from(circle.centre_m),
                        measured: sighting.spot.ellipse.centre,
                        sigma_px: CIRCLE_SIGMA_PX,
                        columns_only: false,
                    };
                    (observation, circle.radius_m)
                }));
            }
        }
        all
    }

    /// The same with outline centres brought to the images of the circles' centres.
    fn corrected(&self, model: &Model, circles: &[(Observation, f64)]) -> Vec<Observation> {
        let correct = |(observation, radius): &(Observation, f64)| {
            let [du, dv] = centre_shift(model, observation, *radius).unwrap_or([0.0; 2]);
            let [u, v] = observation.measured;
            Observation { measured: [u - du, v - dv], ..*observation }
        };
        circles.iter().map(correct).collect()
    }

    /// A projector that sees columns only: fy and cy are in no column and k3 is held, k2 and the tangential terms are
    /// loosely known, and its place along its rows is known from the design alone.
    pub(super) fn priors(&self, head: usize) -> Vec<Prior> {
        let devices = self.starting_devices(head);
        let device = devices.len() - 1;
        let projector = &devices[device];
        let known = |parameter, mean, sigma| Prior { device, parameter, mean, sigma };
        let mut priors = vec![
            known(1, projector.lens.fy, 0.0),
            known(3, projector.lens.cy, 0.0),
            known(5, projector.lens.distortion[1], 0.05),
            known(6, projector.lens.distortion[2], 1e-3),
            known(7, projector.lens.distortion[3], 1e-3),
            known(8, 0.0, 0.0),
            known(13, projector.device_from_frame.translation.y, 0.02),
        ];
        // The cameras' k3 is held at 0: it explains nothing more (`docs/design/experiments.md`).
        priors.extend((0..device).map(|device| Prior { device, parameter: 8, mean: 0.0, sigma: 0.0 }));
        priors
    }
}

/// RMS of chosen residuals in units of their stated standard deviation; 1 where there are none.
fn spread(adjusted: &Adjusted, observations: &[Observation], is_chosen: impl Fn(usize) -> bool) -> f64 {
    let chosen = (0..observations.len()).filter(|&i| is_chosen(i) && !adjusted.outliers[i]);
    let (sum, n) = chosen.fold((0.0, 0.0), |(sum, n), i| {
        let ([u, v], o) = (adjusted.residuals[i], &observations[i]);
        let (square, count) = if o.columns_only { (u * u, 1.0) } else { (u * u + v * v, 2.0) };
        (sum + square / (o.sigma_px * o.sigma_px), n + count)
    });
    if n > 0.0 { f64::sqrt(sum / n).clamp(0.05, 50.0) } else { 1.0 }
}

/// Outline's centre minus image of the centre, px: perspective and distortion together.
fn centre_shift(model: &Model, observation: &Observation, radius_m: f64) -> Option<[f64; 2]> {
    let device = &model.devices[observation.device];
    let device_from_board = device.device_from_frame * model.boards[observation.board];
    let turned = |axis: Vector3<f64>| device_from_board.rotation * axis;
    let centre = device_from_board * observation.point;
    let columns = Matrix3::from_columns(&[turned(Vector3::x()), turned(Vector3::y()), centre.coords]);
    let ideal = image_of_circle(&columns, radius_m)?;
    let points: Vec<[f64; 2]> = (0..16)
        .map(|i| ideal.at(f64::from(i) * TAU / 16.0))
        .map(|[x, y]| device.lens.distort(x, y))
        .collect::<Option<_>>()?;
    let outline = Ellipse::fit(&points)?.centre;
    let image = device.lens.distort(centre.x / centre.z, centre.y / centre.z)?;
    Some([outline[0] - image[0], outline[1] - image[1]])
}
