//! The three stages of section 4.2: cameras of a head, phase of each camera-projector pair, heads together.
//!
//! 1. *Cameras*: circles seen by both cameras of a head, any number of positions of the board. Measured centres are
//!    those of the outlines; the centre of a circle's image is not the image of its centre, so the difference under the
//!    current estimate is taken off, and the adjustment repeated.
//! 2. *Phase*: the absolute phase at points of the white field between the circles is the panel column that lights them:
//!    the projector is adjusted like a camera that sees columns only, together with the cameras.
//! 3. *Global*: positions that several heads saw tie the heads together; at the end everything is adjusted once more in
//!    one problem, so that errors of a loop are spread as the observations ask.

use super::board::Board;
use super::bundle::{AdjustError, Adjusted, DeviceModel, Model, Observation, Prior, adjust};
use super::ellipse::image_of_circle;
use super::start::board_pose;
use super::views::{Position, column_at, phase_observation};
use super::{Calibration, Ellipse};
use crate::geometry::{Device, Pose};
use crate::reconstruct::pair::Pair;
use nalgebra::{Isometry3, Matrix3, Point3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// Standard deviation of a circle's centre, px, before the residuals say better.
const CIRCLE_SIGMA_PX: f64 = 0.02;
/// Fewest positions for a head: fewer leave lens and distance entangled.
const LEAST_POSITIONS: usize = 6;
/// How often centres are corrected and phases sampled anew.
const ROUNDS: usize = 3;
/// Two heads saw the same position of the board when their poses agree to this, m and rad, under the nominal rig.
const SAME_POSITION: (f64, f64) = (0.25, 0.35);

/// Why a calibration came to nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StageError {
    /// Too few usable positions.
    #[error("head {head}: {found} usable positions of the board, expected at least {LEAST_POSITIONS}")]
    Positions {
        /// The head.
        head: String,
        /// How many.
        found: usize,
    },
    /// All positions are nearly parallel.
    #[error(
        "head {head}: the positions of the board are tilted against each other by at most {degrees} degrees, expected 25 or more; tilt the board more"
    )]
    Parallel {
        /// The head.
        head: String,
        /// Largest angle between two positions.
        degrees: u32,
    },
    /// A head shares no position with any other.
    #[error(
        "head {head} saw no position of the board together with another head; show the board between two heads"
    )]
    Alone {
        /// The head.
        head: String,
    },
    /// The equations have no solution.
    #[error("head {head}: {error}")]
    Adjust {
        /// The head, or "all heads".
        head: String,
        /// Why.
        error: AdjustError,
    },
}

/// What the stages know of the devices: place in the calibration's order.
pub struct Rigging<'a> {
    /// The rig's nominal geometry.
    pub nominal: &'a Calibration,
    /// The board.
    pub board: &'a Board,
    /// The positions.
    pub positions: &'a [Position],
}

/// A head after stages 1 and 2. Devices: cameras in the rig's order, then the projector. The frame is the nominal world.
#[derive(Debug, Clone)]
pub struct HeadResult {
    /// Place of the head in the rig.
    pub head: usize,
    /// Positions used, as places in the list of positions.
    pub positions: Vec<usize>,
    /// After stage 1, the cameras alone.
    pub cameras: Adjusted,
    /// After stage 2.
    pub all: Adjusted,
    /// Circle observations, then phase observations, as in `all`.
    pub observations: Vec<Observation>,
    /// How many of them are circles.
    pub circles: usize,
}

impl Rigging<'_> {
    /// Place of a head's first camera among all cameras.
    fn first_camera(&self, head: usize) -> usize {
        self.nominal.heads[..head].iter().map(|h| h.cameras.len()).sum()
    }

    fn head_name(&self, head: usize) -> String {
        self.nominal.heads[head].id.to_string()
    }

    /// Stages 1 and 2 of one head.
    pub fn calibrate_head(&self, head: usize) -> Result<HeadResult, StageError> {
        let adjust_error = |error| StageError::Adjust { head: self.head_name(head), error };
        let (positions, boards) = self.starting_boards(head)?;
        let mut model = Model { devices: self.starting_devices(head), boards };
        let circles = self.circles(head, &positions);
        let priors = self.priors(head);
        let (projector, cameras) = (model.devices.len() - 1, self.nominal.heads[head].cameras.len());
        let mut stage1 = None;
        for _ in 0..ROUNDS {
            let observations = self.corrected(&model, &circles);
            // The projector waits; nothing observes it yet.
            let adjusted = adjust(model.clone(), &observations, &[], 0).map_err(adjust_error)?;
            model = adjusted.model.clone();
            stage1 = Some(adjusted);
        }
        let mut last = None;
        for _ in 0..ROUNDS {
            let mut observations = self.corrected(&model, &circles);
            for camera in 0..cameras {
                observations.extend(self.phases(head, camera, projector, &positions, &model));
            }
            let adjusted = adjust(model.clone(), &observations, &priors, 0).map_err(adjust_error)?;
            model = adjusted.model.clone();
            last = Some((adjusted, observations));
        }
        let (Some(cameras), Some((all, observations))) = (stage1, last) else {
            return Err(StageError::Positions { head: self.head_name(head), found: 0 });
        };
        let circles = circles.len();
        Ok(HeadResult { head, positions, cameras, all, observations, circles })
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
    fn starting_boards(&self, head: usize) -> Result<(Vec<usize>, Vec<Isometry3<f64>>), StageError> {
        let first = self.first_camera(head);
        let cameras = &self.nominal.heads[head].cameras;
        let (mut places, mut boards) = (Vec::new(), Vec::new());
        for (place, position) in self.positions.iter().enumerate() {
            // The camera that saw most of the board.
            let views = cameras.iter().enumerate().filter_map(|(c, camera)| {
                let view = position.views[first + c].as_ref()?;
                Some((view, &camera.device))
            });
            let Some((view, device)) = views.max_by_key(|(view, _)| view.sightings.len()) else { continue };
            let Some(camera_from_board) = board_pose(self.board, &view.sightings, &device.lens) else {
                continue;
            };
            places.push(place);
            boards.push(device.world_from_device.isometry() * camera_from_board);
        }
        if places.len() < LEAST_POSITIONS {
            return Err(StageError::Positions { head: self.head_name(head), found: places.len() });
        }
        let normals: Vec<Vector3<f64>> = boards.iter().map(|b| b.rotation * Vector3::z()).collect();
        let angles = normals.iter().flat_map(|a| normals.iter().map(move |b| a.angle(b)));
        let degrees = angles.fold(0.0, f64::max).to_degrees();
        if degrees < 25.0 {
            return Err(StageError::Parallel { head: self.head_name(head), degrees: degrees as u32 });
        }
        Ok((places, boards))
    }

    /// Sightings of all circles, as measured.
    fn circles(&self, head: usize, positions: &[usize]) -> Vec<(Observation, f64)> {
        let first = self.first_camera(head);
        let mut all = Vec::new();
        for (board, &position) in positions.iter().enumerate() {
            for device in 0..self.nominal.heads[head].cameras.len() {
                let Some(view) = &self.positions[position].views[first + device] else { continue };
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

    /// What the projector "saw" of the white field, through the phase in one camera's frames.
    fn phases(
        &self,
        head: usize,
        camera: usize,
        projector: usize,
        positions: &[usize],
        model: &Model,
    ) -> Vec<Observation> {
        let nominal = &self.nominal.heads[head];
        let Ok(pair) = Pair::new(nominal, &nominal.cameras[camera], self.nominal) else { return Vec::new() };
        let place = self.first_camera(head) + camera;
        let points = field_points(self.board);
        let mut all = Vec::new();
        for (board, &position) in positions.iter().enumerate() {
            let phase = self.positions[position].views[place].as_ref().and_then(|view| view.phase.as_ref());
            let Some(phase) = phase else { continue };
            for point in &points {
                let Some(pixel) = project(&model.devices[camera], &model.boards[board], point) else {
                    continue;
                };
                let Some((column, sigma)) = column_at(phase, pixel, &pair) else { continue };
                all.push(phase_observation(projector, board, *point, column, sigma));
            }
        }
        all
    }

    /// A projector that sees columns only: fy, cy and k3 are held, k2 and the tangential terms are only loosely
    /// known, and nothing but the design says where it is along its rows.
    fn priors(&self, head: usize) -> Vec<Prior> {
        let devices = self.starting_devices(head);
        let device = devices.len() - 1;
        let projector = &devices[device];
        let held = |parameter, mean, sigma| Prior { device, parameter, mean, sigma };
        let mut priors = vec![
            held(1, projector.lens.fy, 0.0),
            held(3, projector.lens.cy, 0.0),
            held(5, projector.lens.distortion[1], 0.05),
            held(6, projector.lens.distortion[2], 1e-3),
            held(7, projector.lens.distortion[3], 1e-3),
            held(8, 0.0, 0.0),
            held(13, projector.device_from_frame.translation.y, 0.02),
        ];
        // The third radial term is not observable in cameras of this field either.
        priors.extend((0..device).map(|camera| Prior {
            device: camera,
            parameter: 8,
            mean: 0.0,
            sigma: 0.0,
        }));
        priors
    }
}

/// Pixel of a board point.
fn project(device: &DeviceModel, frame_from_board: &Isometry3<f64>, point: &Point3<f64>) -> Option<[f64; 2]> {
    let p = device.device_from_frame * (frame_from_board * point);
    (p.z > 1e-6).then(|| device.lens.distort(p.x / p.z, p.y / p.z)).flatten()
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

/// Points of the white field, as far from the circles as can be: between two and between four of them.
fn field_points(board: &Board) -> Vec<Point3<f64>> {
    let mean = |places: &[(usize, usize)]| {
        let centres = places.iter().filter_map(|&(column, row)| board.circle(column, row));
        let (sum, n) =
            centres.fold((Vector3::zeros(), 0.0), |(sum, n), c| (sum + Vector3::from(c.centre_m), n + 1.0));
        Point3::from(sum / n)
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

/// The relation between two heads' frames, and how well their common positions agree on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Places of the heads in the rig.
    pub heads: [usize; 2],
    /// Takes the second head's frame to the first's.
    pub first_from_second: Isometry3<f64>,
    /// Common positions.
    pub positions: usize,
    /// RMS distance of the board's corners between both heads' views, after the relation, m.
    pub rms_m: f64,
}

/// Relations of all pairs of heads that saw a position together.
pub fn links(rigging: &Rigging<'_>, heads: &[HeadResult]) -> Vec<Link> {
    let mut links = Vec::new();
    for (i, a) in heads.iter().enumerate() {
        for b in &heads[i + 1..] {
            let pairs: Vec<(Isometry3<f64>, Isometry3<f64>)> = common(a, b);
            let Some(relation) = mean_pose(pairs.iter().map(|(in_a, in_b)| in_a * in_b.inverse())) else {
                continue;
            };
            let corners = corner_points(rigging.board);
            let squares = pairs.iter().flat_map(|(in_a, in_b)| {
                corners.iter().map(move |c| (in_a * c - relation * (in_b * c)).norm_squared())
            });
            let rms_m = (squares.sum::<f64>() / (pairs.len() * corners.len()) as f64).sqrt();
            links.push(Link {
                heads: [a.head, b.head],
                first_from_second: relation,
                positions: pairs.len(),
                rms_m,
            });
        }
    }
    links
}

/// Board poses of the positions that both heads saw at the same place.
fn common(a: &HeadResult, b: &HeadResult) -> Vec<(Isometry3<f64>, Isometry3<f64>)> {
    let pairs = a.positions.iter().enumerate().filter_map(|(i, position)| {
        let k = b.positions.iter().position(|other| other == position)?;
        let (in_a, in_b) = (a.all.model.boards[i], b.all.model.boards[k]);
        let shift = (in_a.translation.vector - in_b.translation.vector).norm();
        let turn = in_a.rotation.angle_to(&in_b.rotation);
        (shift < SAME_POSITION.0 && turn < SAME_POSITION.1).then_some((in_a, in_b))
    });
    pairs.collect()
}

fn corner_points(board: &Board) -> [Point3<f64>; 4] {
    let [x, y] = board.size_m.map(|s| s / 2.0);
    [[-x, -y], [x, -y], [x, y], [-x, y]].map(|[x, y]| Point3::new(x, y, 0.0))
}

fn mean_pose(poses: impl Iterator<Item = Isometry3<f64>> + Clone) -> Option<Isometry3<f64>> {
    let first = poses.clone().next()?;
    let n = poses.clone().count() as f64;
    let shift = poses.clone().map(|p| p.translation.vector).sum::<Vector3<f64>>() / n;
    let turn = poses.map(|p| (p.rotation * first.rotation.inverse()).scaled_axis()).sum::<Vector3<f64>>() / n;
    Some(Isometry3::from_parts(shift.into(), UnitQuaternion::from_scaled_axis(turn) * first.rotation))
}

/// Everything in one frame.
#[derive(Debug, Clone)]
pub struct Together {
    /// Stage 3, pairs of heads.
    pub links: Vec<Link>,
    /// Largest corner displacement around a closed loop of heads, m; `None` without a loop.
    pub loop_error_m: Option<f64>,
    /// One adjustment of everything: per head its cameras, then its projector.
    pub all: Adjusted,
    /// The observations of that adjustment.
    pub observations: Vec<Observation>,
}

/// Stage 3: brings the heads into one frame, and adjusts everything once more.
pub fn bring_together(rigging: &Rigging<'_>, heads: &[HeadResult]) -> Result<Together, StageError> {
    let links = links(rigging, heads);
    let frames = frames(rigging, heads, &links)?;
    let loop_error_m = loop_error(rigging.board, heads, &links);
    let (model, mut observations, priors) = merged(rigging, heads, &frames);
    let adjusted = adjust(model, &observations, &priors, 0)
        .map_err(|error| StageError::Adjust { head: "all heads".to_owned(), error })?;
    observations.shrink_to_fit();
    Ok(Together { links, loop_error_m, all: adjusted, observations })
}

/// For each head, what takes its frame to the first's: along the links with the best agreement.
fn frames(
    rigging: &Rigging<'_>,
    heads: &[HeadResult],
    links: &[Link],
) -> Result<Vec<Isometry3<f64>>, StageError> {
    let mut found: Vec<Option<Isometry3<f64>>> = vec![None; heads.len()];
    if let Some(first) = found.first_mut() {
        *first = Some(Isometry3::identity());
    }
    let place = |head: usize| heads.iter().position(|h| h.head == head);
    let mut sorted: Vec<&Link> = links.iter().collect();
    sorted.sort_by(|a, b| a.rms_m.total_cmp(&b.rms_m));
    for _ in heads {
        for link in &sorted {
            let (Some(a), Some(b)) = (place(link.heads[0]), place(link.heads[1])) else { continue };
            match (found[a], found[b]) {
                (Some(frame), None) => found[b] = Some(frame * link.first_from_second),
                (None, Some(frame)) => found[a] = Some(frame * link.first_from_second.inverse()),
                _ => {}
            }
        }
    }
    let named = heads.iter().zip(found);
    named
        .map(|(h, frame)| frame.ok_or_else(|| StageError::Alone { head: rigging.head_name(h.head) }))
        .collect()
}

/// Around h0 -> h1 -> ... -> h0, where every neighbour has a link.
fn loop_error(board: &Board, heads: &[HeadResult], links: &[Link]) -> Option<f64> {
    if heads.len() < 3 {
        return None;
    }
    let mut round = Isometry3::identity();
    for i in 0..heads.len() {
        let (a, b) = (heads[i].head, heads[(i + 1) % heads.len()].head);
        let forward = links.iter().find(|l| l.heads == [a, b]).map(|l| l.first_from_second);
        let back = || links.iter().find(|l| l.heads == [b, a]).map(|l| l.first_from_second.inverse());
        round *= forward.or_else(back)?;
    }
    let corners = corner_points(board).map(|c| c + Vector3::new(0.0, 0.0, 1.0));
    Some(corners.iter().map(|c| (round * c - c).norm()).fold(0.0, f64::max))
}

/// One problem of all heads' problems; positions that are the same become one.
fn merged(
    rigging: &Rigging<'_>,
    heads: &[HeadResult],
    frames: &[Isometry3<f64>],
) -> (Model, Vec<Observation>, Vec<Prior>) {
    let (mut devices, mut boards) = (Vec::new(), Vec::<(usize, Isometry3<f64>)>::new());
    let (mut observations, mut priors) = (Vec::new(), Vec::new());
    for (head, frame) in heads.iter().zip(frames) {
        let offset = devices.len();
        devices.extend(head.all.model.devices.iter().map(|device| DeviceModel {
            device_from_frame: device.device_from_frame * frame.inverse(),
            ..*device
        }));
        let places: Vec<usize> = head
            .positions
            .iter()
            .zip(&head.all.model.boards)
            .map(|(&position, board)| {
                let board = frame * board;
                let same = |(p, other): &(usize, Isometry3<f64>)| {
                    *p == position
                        && (other.translation.vector - board.translation.vector).norm()
                            < SAME_POSITION.0 / 5.0
                        && other.rotation.angle_to(&board.rotation) < SAME_POSITION.1 / 5.0
                };
                boards.iter().position(same).unwrap_or_else(|| {
                    boards.push((position, board));
                    boards.len() - 1
                })
            })
            .collect();
        observations.extend(head.observations.iter().map(|o| Observation {
            device: o.device + offset,
            board: places[o.board],
            ..*o
        }));
        let moved = devices.len() - 1;
        priors.extend(rigging.priors(head.head).into_iter().map(|prior| Prior {
            device: prior.device + offset,
            // The shift along the rows is wherever the head's own adjustment put it.
            mean: if prior.parameter == 13 {
                devices[moved].device_from_frame.translation.y
            } else {
                prior.mean
            },
            ..prior
        }));
    }
    let boards = boards.into_iter().map(|(_, board)| board).collect();
    (Model { devices, boards }, observations, priors)
}

/// The result as a calibration file has it.
pub fn calibration(nominal: &Calibration, origin: String, model: &Model) -> Calibration {
    let mut devices = model.devices.iter();
    let mut take = |device: &mut Device| {
        if let Some(found) = devices.next() {
            device.lens = found.lens;
            device.world_from_device = Pose::new(found.device_from_frame.inverse());
        }
    };
    let mut result = nominal.clone();
    result.origin = origin;
    for head in &mut result.heads {
        head.cameras.iter_mut().for_each(|camera| take(&mut camera.device));
        take(&mut head.projector);
    }
    result
}
