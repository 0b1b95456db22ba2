// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of the board before one head of half the resolution, rendered once per test process, to be altered.

use fourdbody::base::ids::{CameraId, TriggerIndex};
use fourdbody::base::image::Plane;
use fourdbody::calibrate::observed::Looked;
use fourdbody::calibrate::positions::arrange;
use fourdbody::calibrate::run::{CalibrateError, Options, Outcome, solve};
use fourdbody::calibrate::views::{look_at_frame, pipelines};
use fourdbody::calibrate::{Board, Finding, Position};
use fourdbody::config::Rig;
use fourdbody::data::{Calibration, Frame};
use fourdbody::geometry::pattern::Marker;
use fourdbody_simulator::optics::{Exposure, Studio, blur, expose};
use fourdbody_simulator::random::NormalTable;
use fourdbody_simulator::scenario::{FlatPose, Light, Scenario, Subject};
use fourdbody_simulator::scene::subject::Stage;
use fourdbody_simulator::true_rig::{smaller_jitter, smaller_rig, true_calibration};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::OnceLock;

/// Distance, azimuth, tilt, roll of the good positions.
const POSES: [[f64; 4]; 8] = [
    [0.45, 0.0, 0.0, 0.0],
    [0.10, 20.0, 10.0, 0.0],
    [0.10, -20.0, -10.0, 0.0],
    [0.30, 12.0, -14.0, 4.0],
    [0.30, -12.0, 14.0, -4.0],
    [0.20, 24.0, 0.0, 90.0],
    [0.20, 0.0, 18.0, 180.0],
    [0.35, -22.0, -4.0, 0.0],
];

pub fn flat(distance_m: f64, azimuth_deg: f64, tilt_deg: f64, roll_deg: f64) -> FlatPose {
    FlatPose { centre_m: [distance_m, 0.0, 1.0], azimuth_deg, tilt_deg, roll_deg, rpm: None }
}

fn file(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// A simulated head, its studio, and what the product knows of it.
pub struct Scene {
    pub nominal: Calibration,
    pub truth: Calibration,
    pub board: Board,
    rig: Rig,
    scenario: Scenario,
    studio: Studio,
}

impl Scene {
    /// Head h0 at this divisor of the resolution.
    pub fn new(seed: u64, divisor: usize) -> Self {
        let mut scenario = Scenario::load(&file("config/scenarios/board.toml")).expect("valid");
        scenario.seed = seed;
        scenario.light = vec![Light::White, Light::Fringes];
        let mut rig = Rig::load(&file("config/rig.toml")).expect("valid");
        rig.heads.truncate(1);
        let rig = smaller_rig(&rig, divisor);
        let truth = true_calibration(&rig, &smaller_jitter(&scenario.geometry, divisor), seed);
        let studio = Studio::new(&scenario, &truth);
        let board = Board::load(&file("config/board.toml")).expect("valid");
        Self { nominal: Calibration::nominal(&rig), truth, board, rig, scenario, studio }
    }

    /// The same head with a pattern that has no marker.
    pub fn without_marker(mut self) -> Self {
        let mut truth = self.truth.clone();
        truth.pattern.marker = Marker::ZeroMean { amplitude: 0.0 };
        self.studio = Studio::new(&self.scenario, &truth);
        self
    }

    /// The rig at the size photographed, as its file says it.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    fn board_at(&self, pose: FlatPose) -> fourdbody_simulator::scene::Scene {
        let Subject::Flat { black, back, .. } = self.scenario.subject else {
            panic!("the scenario shows the board")
        };
        let subject = Subject::Flat { plate_m: None, poses: vec![pose], hold: 1, rpm: 0.0, black, back };
        Stage::new(&subject, &self.rig.board, 1.0).expect("no files").scene(0, 0.0).expect("flat")
    }

    /// What both cameras see of the board.
    pub fn photograph(&self, pose: FlatPose, light: Light, instant: u64) -> [Plane<u8>; 2] {
        let scene = [self.board_at(pose)];
        [0, 1].map(|camera| {
            let mut memory = self.studio.memory(camera);
            let (width, height) = (memory.light.width(), memory.light.height());
            let mut image = Plane::filled(width, height, 0);
            self.studio.photograph(camera, light, &scene, instant, &mut memory, image.as_mut_slice());
            image
        })
    }

    /// The light on both sensors, blurred, before any noise.
    fn lights(&self, pose: FlatPose, light: Light) -> [Plane<f32>; 2] {
        let scene = self.board_at(pose);
        [0, 1].map(|camera| {
            let mut memory = self.studio.memory(camera);
            self.studio.add_moment(camera, light, &scene, 1.0, &mut memory);
            let mut scratch = memory.light.clone();
            blur(&mut memory.light, &mut scratch, self.scenario.optics.camera_blur_px);
            memory.light
        })
    }
}

/// The light of all positions on both sensors, to be photographed with many seeds of noise.
pub struct Lights<'a> {
    scene: &'a Scene,
    /// Trigger, camera, light on the sensor.
    lights: Vec<(u64, usize, Plane<f32>)>,
}

impl<'a> Lights<'a> {
    pub fn new(scene: &'a Scene) -> Self {
        let mut lights = Vec::new();
        for (i, pose) in poses().iter().enumerate() {
            for (k, light) in [Light::White, Light::Fringes].into_iter().enumerate() {
                let trigger = (2 * i + k) as u64;
                let seen = scene.lights(*pose, light);
                lights.extend(seen.into_iter().enumerate().map(|(camera, l)| (trigger, camera, l)));
            }
        }
        Self { scene, lights }
    }

    pub fn photograph(&self, seed: u64) -> Photographs {
        let mut all = Photographs { images: BTreeMap::new(), looked: BTreeMap::new() };
        let normal = NormalTable::new();
        for (trigger, camera, light) in &self.lights {
            let mut image = Plane::filled(light.width(), light.height(), 0);
            let sensor = &self.scene.studio.sensors[*camera];
            let exposure = Exposure { seed, instant: *trigger };
            expose(light, sensor, &self.scene.scenario.optics, exposure, &normal, image.as_mut_slice());
            all.set_in(self.scene, *trigger, *camera, image);
        }
        all
    }
}

/// Frames by trigger and camera, with what the product sees in them; a change costs only the frames changed.
#[derive(Clone)]
pub struct Photographs {
    images: BTreeMap<(u64, usize), Plane<u8>>,
    looked: BTreeMap<(u64, usize), Looked>,
}

/// The scene of most tests.
pub fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| Scene::new(7, 2))
}

/// All positions, each in white light and with fringes.
pub fn good() -> Photographs {
    static GOOD: OnceLock<Photographs> = OnceLock::new();
    GOOD.get_or_init(|| Photographs::take(scene(), &poses())).clone()
}

/// Where the board stands in [`good`].
pub fn poses() -> [FlatPose; 8] {
    POSES.map(|[d, a, t, r]| flat(d, a, t, r))
}

impl Photographs {
    /// Trigger 2 i is position i in white light, trigger 2 i + 1 the same with fringes.
    pub fn take(scene: &Scene, poses: &[FlatPose]) -> Self {
        let mut all = Self { images: BTreeMap::new(), looked: BTreeMap::new() };
        for (i, pose) in poses.iter().enumerate() {
            for (k, light) in [Light::White, Light::Fringes].into_iter().enumerate() {
                let trigger = (2 * i + k) as u64;
                for (camera, image) in scene.photograph(*pose, light, trigger).into_iter().enumerate() {
                    all.set_in(scene, trigger, camera, image);
                }
            }
        }
        all
    }

    pub fn image(&self, trigger: u64, camera: usize) -> &Plane<u8> {
        &self.images[&(trigger, camera)]
    }

    pub fn set(&mut self, trigger: u64, camera: usize, image: Plane<u8>) {
        self.set_in(scene(), trigger, camera, image);
    }

    fn set_in(&mut self, scene: &Scene, trigger: u64, camera: usize, image: Plane<u8>) {
        let looked = look(scene, &scene.board, camera, &image);
        self.looked.insert((trigger, camera), looked);
        self.images.insert((trigger, camera), image);
    }

    /// Changes frames; `change` gets their pixels.
    pub fn change(&mut self, triggers: &[u64], cameras: &[usize], change: impl Fn(&Plane<u8>) -> Plane<u8>) {
        for (&trigger, &camera) in triggers.iter().flat_map(|t| cameras.iter().map(move |c| (t, c))) {
            let image = change(self.image(trigger, camera));
            self.set(trigger, camera, image);
        }
    }

    /// Exchanges all frames of the two cameras.
    pub fn swap_cameras(&mut self) {
        let swap = |(trigger, camera): (u64, usize)| (trigger, 1 - camera);
        self.images = std::mem::take(&mut self.images).into_iter().map(|(k, v)| (swap(k), v)).collect();
        for ((trigger, camera), image) in self.images.clone() {
            self.set(trigger, camera, image);
        }
    }

    /// Gives every frame another trigger.
    pub fn renumber(&mut self, number: impl Fn(u64) -> u64) {
        let new = |(trigger, camera): (u64, usize)| (number(trigger), camera);
        self.images = std::mem::take(&mut self.images).into_iter().map(|(k, v)| (new(k), v)).collect();
        self.looked = std::mem::take(&mut self.looked).into_iter().map(|(k, v)| (new(k), v)).collect();
    }

    /// Takes frames away, as gaps.
    pub fn miss(&mut self, triggers: &[u64], camera: usize) {
        for trigger in triggers {
            self.looked.insert((*trigger, camera), Looked::Missing("lost on the way".to_owned()));
        }
    }

    /// Keeps only the triggers for which this is true.
    pub fn keep(&mut self, keep: impl Fn(u64) -> bool) {
        self.images.retain(|(trigger, _), _| keep(*trigger));
        self.looked.retain(|(trigger, _), _| keep(*trigger));
    }

    /// Looks at the white frames with another board file in mind.
    pub fn with_board(mut self, board: &Board) -> Self {
        for ((trigger, camera), image) in &self.images {
            if trigger % 2 == 0 {
                self.looked.insert((*trigger, *camera), look(scene(), board, *camera, image));
            }
        }
        self
    }

    pub fn calibrate(&self) -> Result<Outcome, CalibrateError> {
        self.calibrate_in(scene(), &scene().board)
    }

    pub fn calibrate_in(&self, scene: &Scene, board: &Board) -> Result<Outcome, CalibrateError> {
        let (positions, findings) = self.arranged(scene, board);
        solve(positions, findings, &scene.nominal, board, &Options::default())
    }

    /// The positions before anything is calibrated.
    fn arranged(&self, scene: &Scene, board: &Board) -> (Vec<Position>, Vec<Finding>) {
        let frames = self.looked.iter().map(|((t, c), looked)| (TriggerIndex(*t), *c, looked.clone()));
        arrange(frames.collect(), &scene.nominal, board)
    }

    /// With markers that are read so many fringes from where they are: position, camera, fringes.
    pub fn calibrate_misread(&self, misread: &[(usize, usize, i32)]) -> Result<Outcome, CalibrateError> {
        let (scene, board) = (scene(), &scene().board);
        let (mut positions, findings) = self.arranged(scene, board);
        for &(position, camera, fringes) in misread {
            let view = positions[position].views[camera].as_mut().expect("a view");
            let phase = view.phase.as_mut().expect("a phase");
            assert!(phase.marker, "position {position}, camera {camera}: no marker to be misread");
            phase.plane.as_mut_slice().iter_mut().for_each(|x| *x += std::f32::consts::TAU * fringes as f32);
        }
        solve(positions, findings, &scene.nominal, board, &Options::default())
    }
}

fn look(scene: &Scene, board: &Board, camera: usize, image: &Plane<u8>) -> Looked {
    let ids: Vec<CameraId> = scene.nominal.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let pipelines = pipelines(&scene.nominal).expect("usable pairs");
    look_at_frame(&Frame::Owned(image.clone()), &ids[camera], &pipelines[camera], board).expect("of this rig")
}

/// How far a calibration is from the truth: worst focal length of a camera as a share, and the second camera's place
/// relative to the first, m.
pub fn errors(found: &Calibration, truth: &Calibration) -> (f64, f64) {
    let pairs = || found.heads[0].cameras.iter().zip(&truth.heads[0].cameras);
    let focal = pairs().map(|(f, t)| (f.device.lens.fx / t.device.lens.fx - 1.0).abs()).fold(0.0, f64::max);
    let relative = |c: &Calibration| {
        let [a, b] = [0, 1].map(|i| *c.heads[0].cameras[i].device.world_from_device.isometry());
        a.inverse() * b
    };
    let off = relative(truth).inverse() * relative(found);
    (focal, off.translation.vector.norm())
}
