// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads the fringes at points of the board: the panel column that lights each of them.
//!
//! A phase is known modulo whole turns. Within a window the slope that the board's pose gives brings all pixels to one
//! turn; over the whole view the projector's model does ([`super::orders`]).

use super::board::Board;
use super::bundle::{Model, Observation, project};
use super::estimate::least_squares;
use super::observed::Phase;
use super::rigging::{Excluded, Rigging};
use crate::geometry::pattern::Pattern;
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use nalgebra::{Isometry3, Matrix2, Point3, SVector, Vector2, Vector3};
use std::f64::consts::TAU;

/// Fewest positions of a head with a phase.
pub(super) const LEAST_PHASES: usize = 4;
/// Points with a phase below which a position, or a view, has none.
pub(super) const LEAST_PHASE_POINTS: usize = 30;
/// Half the window in which the phase around a board point is fitted, px.
const WINDOW: i64 = 8;
/// Share of the window that must have a phase.
const FILLED: f64 = 0.7;
/// Periods around the marker that are left out: its modulation pulls the phase.
const MARKER_PERIODS: f64 = 1.5;
/// How far a point's neighbours are from it, for slopes, m.
const STEP_M: f64 = 1e-3;

/// A point of the board in one view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reading {
    /// The point in the board's frame, m.
    pub(super) point: Point3<f64>,
    /// The panel column that lights it by the projector's model, px.
    pub(super) expected: f64,
    /// The panel column of its phase, px; whole fringes may be missing.
    pub(super) column: f64,
    /// Standard deviation of that, px.
    pub(super) sigma_px: f64,
    /// Whether the marker of its frame gives the whole fringes.
    pub(super) by_marker: bool,
}

impl Reading {
    /// How much larger the column of its phase is than expected, px.
    pub(super) fn excess(&self) -> f64 {
        self.column - self.expected
    }
}

/// Which view: a camera, as its place in its head, and a position of the board, as its place among all and in the
/// model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Which {
    pub(super) camera: usize,
    pub(super) position: usize,
    pub(super) board: usize,
}

impl Rigging<'_> {
    /// The views of a head whose phases count.
    pub(super) fn views_with_phase(
        &self,
        head: usize,
        positions: &[usize],
        excluded: &Excluded,
    ) -> Vec<Which> {
        let cameras = 0..self.nominal.heads[head].cameras.len();
        let all = cameras.flat_map(|camera| {
            positions.iter().enumerate().map(move |(board, &position)| Which { camera, position, board })
        });
        all.filter(|&Which { camera, position, .. }| {
            self.view(head, camera, position).is_some_and(|view| view.phase.is_some())
                && !excluded.views.contains(&(camera, position))
                && !excluded.phases.contains(&(camera, position))
        })
        .collect()
    }

    /// Reads the phase of a view at points between circles that were seen in both frames, so that nothing stands in
    /// front of the point.
    pub(super) fn readings(&self, head: usize, which: Which, model: &Model) -> Vec<Reading> {
        let nominal = &self.nominal.heads[head];
        let Ok(pair) = CameraProjector::new(nominal, &nominal.cameras[which.camera], self.nominal) else {
            return Vec::new();
        };
        let view = self.view(head, which.camera, which.position);
        let Some((view, phase)) = view.and_then(|view| Some((view, view.phase.as_ref()?))) else {
            return Vec::new();
        };
        let (camera, projector) = (&model.devices[which.camera], &model.devices[model.devices.len() - 1]);
        let pose: &Isometry3<f64> = &model.boards[which.board];
        let is_seen = |circle: &usize| view.confirmed.get(*circle).is_some_and(|is| *is);
        let read = |point: &Point3<f64>| {
            let pixel = project(camera, pose, point)?;
            let [expected, _] = project(projector, pose, point)?;
            // How pixel and column move along both axes of the board.
            let along = |axis: Vector3<f64>| {
                let (a, b) = (point - axis * STEP_M, point + axis * STEP_M);
                let ([u0, v0], [u1, v1]) = (project(camera, pose, &a)?, project(camera, pose, &b)?);
                let column = project(projector, pose, &b)?[0] - project(projector, pose, &a)?[0];
                Some((Vector2::new(u1 - u0, v1 - v0), column))
            };
            let ((x, column_x), (y, column_y)) = (along(Vector3::x())?, along(Vector3::y())?);
            let pixels = Matrix2::from_columns(&[x, y]).try_inverse()?;
            let slope = pixels.transpose() * Vector2::new(column_x, column_y);
            let (column, sigma_px, by_marker) = column_at(phase, pixel, slope.into(), &pair)?;
            Some(Reading { point: *point, expected, column, sigma_px, by_marker })
        };
        let points = field_points(self.board);
        let seen = points.iter().filter(|(_, circles)| circles.iter().all(is_seen));
        seen.filter_map(|(point, _)| read(point)).collect()
    }

    /// The projector's observations between the circles, from the phase in one camera's frames, with the fringe orders
    /// that the board gives each view.
    pub(super) fn phases(
        &self,
        head: usize,
        camera: usize,
        positions: &[usize],
        model: &Model,
        excluded: &Excluded,
    ) -> Vec<Observation> {
        let projector = model.devices.len() - 1;
        let views = self.views_with_phase(head, positions, excluded).into_iter();
        let of_view = |which: Which| {
            let readings = self.readings(head, which, model);
            in_order(readings, &self.nominal.pattern).into_iter().map(move |reading| Observation {
                device: projector,
                board: which.board,
                point: reading.point,
                measured: [reading.column, 0.0],
                sigma_px: reading.sigma_px,
                columns_only: true,
            })
        };
        views.filter(|which| which.camera == camera).flat_map(of_view).collect()
    }
}

/// Brings the readings of one view to the fringes that the projector's model has there, all together: what is left is
/// the same for neighbours, and at most half a fringe on the mean. Leaves out those near the marker.
fn in_order(readings: Vec<Reading>, pattern: &Pattern) -> Vec<Reading> {
    let period = pattern.period_px;
    let left = modulo_mean(readings.iter().map(Reading::excess), period);
    let brought = readings.into_iter().map(|reading| {
        let orders = ((left - reading.excess()) / period).round();
        Reading { column: reading.column + period * orders, ..reading }
    });
    let is_clear = |r: &Reading| pattern.from_marker(pattern.phase(r.column)).abs() >= TAU * MARKER_PERIODS;
    brought.filter(is_clear).collect()
}

/// The mean of values that are known modulo `period`, from minus half of it to half of it.
fn modulo_mean(values: impl Iterator<Item = f64>, period: f64) -> f64 {
    let sum = values.fold([0.0; 2], |[c, s], x| {
        let (sin, cos) = (TAU * x / period).sin_cos();
        [c + cos, s + sin]
    });
    sum[1].atan2(sum[0]) * period / TAU
}

/// The panel column that lights the board at pixel (u, v), its standard deviation, px, and whether the marker gives its
/// whole fringes. `slope`: how the column changes along u and v there. Which fringe of several is that of most of the
/// window.
fn column_at(
    Phase { plane: phase, by_marker, .. }: &Phase,
    [u, v]: [f64; 2],
    slope: [f64; 2],
    pair: &CameraProjector,
) -> Option<(f64, f64, bool)> {
    let (column, row) = (u.round() as i64, v.round() as i64);
    let inside = |at: i64, size: usize| at >= WINDOW && at + WINDOW < size as i64;
    if !(inside(column, phase.width()) && inside(row, phase.height())) {
        return None;
    }
    let slope = slope.map(|columns| columns * TAU / pair.pattern.period_px);
    let room = ((2 * WINDOW + 1) * (2 * WINDOW + 1)) as usize;
    let (mut rows, mut marks) = (Vec::with_capacity(room), Vec::with_capacity(room));
    for y in row - WINDOW..=row + WINDOW {
        for x in column - WINDOW..=column + WINDOW {
            let value = f64::from(phase.at(x as usize, y as usize));
            if !value.is_nan() {
                rows.push((Vector3::new(1.0, x as f64 - u, y as f64 - v), value));
                marks.push(by_marker.at(x as usize, y as usize));
            }
        }
    }
    let side = (2 * WINDOW + 1) as f64;
    if (rows.len() as f64) < FILLED * side * side {
        return None;
    }
    let level = |(at, value): &(Vector3<f64>, f64)| value - slope[0] * at[1] - slope[1] * at[2];
    let mean = modulo_mean(rows.iter().map(level), TAU);
    let mut turns: Vec<f64> = rows.iter().map(|row| ((level(row) - mean) / TAU).round()).collect();
    let each = turns.clone();
    let middle = turns.len() / 2;
    let most = *turns.select_nth_unstable_by(middle, f64::total_cmp).1;
    let marked = each.iter().zip(&marks).filter(|(own, marked)| **marked && **own == most).count();
    rows.iter_mut().zip(each).for_each(|((_, value), own)| *value -= TAU * (own - most));
    let fit: SVector<f64, 3> = least_squares(rows.iter().copied())?;
    let sum: f64 = rows.iter().map(|(row, value)| (row.dot(&fit) - value).powi(2)).sum();
    let rms = (sum / rows.len() as f64).sqrt();
    // An edge lies in the window.
    if rms > 0.3 {
        return None;
    }
    // Phases within a period share most of their pixels: one pixel per period counts as independent.
    let independent = rows.len() as f64 / pair.period_px.max(1.0) as f64;
    let sigma = rms.max(0.005) / independent.sqrt() * pair.pattern.period_px / TAU;
    Some((pair.pattern.column(fit[0]), sigma, 2 * marked > rows.len()))
}

/// Points of the white field, as far from the circles as can be: between two and between four of them; with the numbers
/// of those circles.
fn field_points(board: &Board) -> Vec<(Point3<f64>, Vec<usize>)> {
    let mean = |places: &[(usize, usize)]| {
        let circles: Vec<usize> = places.iter().map(|&(column, row)| board.number(column, row)).collect();
        let sum: Vector3<f64> = circles.iter().map(|c| Vector3::from(board.circles()[*c].centre_m)).sum();
        (Point3::from(sum / circles.len() as f64), circles)
    };
    let mut points = Vec::new();
    for row in 0..board.rows - 1 {
        for column in 0..board.columns - 1 {
            let (right, below, both) = ((column + 1, row), (column, row + 1), (column + 1, row + 1));
            points.push(mean(&[(column, row), right, below, both]));
            points.push(mean(&[(column, row), right]));
            points.push(mean(&[(column, row), below]));
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::modulo_mean;

    #[test]
    fn a_mean_modulo_a_period_forgets_whole_periods() {
        for k in [-124.0, -89.0, -1.0, 0.0, 2.0, 81.0] {
            let values = [0.9, 1.1, 1.0].map(|x| x + 8.0 * k);
            assert!((modulo_mean(values.into_iter(), 8.0) - 1.0).abs() < 1e-9, "{k}");
        }
        let across = modulo_mean([3.9, -3.9].into_iter(), 8.0);
        assert!((across.abs() - 4.0).abs() < 1e-9, "{across}");
    }
}
