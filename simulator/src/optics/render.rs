// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rays from every pixel to the scene and on to the projectors.

use super::expose::{Exposure, blur, blur_by_depth, expose};
use super::lamp::{Lamp, PanelLight};
use super::sensor::{RoomLight, Sensor};
use super::tiles::Tiles;
use crate::random::NormalTable;
use crate::scenario::{Light, Optics, Scenario};
use crate::scene::paint::Paint;
use crate::scene::{Hit, Scene, Sight};
use fourdbody::base::image::Plane;
use fourdbody::config::Channel;
use fourdbody::data::Calibration;
use nalgebra::{Point3, Vector3};
use rayon::prelude::{IndexedParallelIterator, IntoParallelRefIterator, ParallelIterator, ParallelSliceMut};

/// The projectors in one light, and how that becomes pixel values.
pub struct Exposed<'a> {
    /// All projectors, in the order of the heads.
    pub lamps: &'a [Lamp],
    /// What each of them shows.
    pub panels: &'a [PanelLight],
    pub optics: &'a Optics,
}

fn channel_number(channel: Channel) -> usize {
    match channel {
        Channel::R => 0,
        Channel::G => 1,
        Channel::B => 2,
    }
}

impl Exposed<'_> {
    /// The subject's albedo in a channel; exposure is set for it.
    pub fn albedo_of(&self, channel: Channel) -> f64 {
        self.optics.albedo[channel_number(channel)]
    }
}

/// DN that the subject's albedo gives at a point in the light of one projector, shadows aside:
/// `exposure (d0 / d)^2 cos(angle) panel(projected point)`; 0 where the surface faces away.
pub fn lamp_light(exposed: &Exposed<'_>, lamp: usize, point: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
    let projector = &exposed.lamps[lamp];
    let way = projector.centre - point;
    let distance2 = way.norm_squared();
    let cosine = way.dot(normal) / distance2.sqrt();
    if !(cosine > 0.0) {
        return 0.0;
    }
    let Some([u, v]) = projector.device.project(point) else { return 0.0 };
    let optics = exposed.optics;
    let blur_px = optics.projector_blur_at(distance2.sqrt(), projector.device.lens.fx);
    let panel = f64::from(exposed.panels[lamp].blurred_at(u, v, blur_px));
    let full = optics.exposure_dn * optics.exposure_factor[channel_number(projector.channel)];
    full * optics.exposure_distance_m.powi(2) / distance2 * cosine * panel
}

/// One pixel's first look at the scene.
#[derive(Debug, Clone, Copy)]
struct Seen {
    /// Distance, m; infinite where there is only the room.
    distance: f32,
    albedo: f32,
    /// The direct light that arrives, DN.
    value: f32,
}

const NOTHING: Seen = Seen { distance: f32::INFINITY, albedo: 0.0, value: 0.0 };

/// Light on one sensor, DN per pixel before vignetting, noise and offset.
pub struct Irradiance {
    seen: Vec<Seen>,
    /// The sum over the moments of an exposure.
    pub light: Plane<f32>,
    scratch: Plane<f32>,
}

/// All cameras and projectors of a scenario, ready to photograph.
pub struct Studio {
    /// The rig's cameras, in its order.
    pub sensors: Vec<Sensor>,
    /// The rig's projectors, in the order of the heads.
    pub lamps: Vec<Lamp>,
    panels: Vec<(Light, Vec<PanelLight>)>,
    /// For each sensor and light, the room in the light of each of the sensor's lamps.
    rooms: Vec<Vec<(Light, Vec<RoomLight>)>>,
    optics: Optics,
    paint: Paint,
    seed: u64,
    normal: NormalTable,
}

impl Studio {
    /// Tabulates everything that stays the same over the scenario. `truth` is the true geometry.
    pub fn new(scenario: &Scenario, truth: &Calibration) -> Self {
        let optics = scenario.optics.clone();
        let lamps: Vec<Lamp> =
            truth.heads.iter().map(|head| Lamp::new(head.projector.clone(), head.channel)).collect();
        let mut lights: Vec<Light> = Vec::new();
        for light in &scenario.light {
            if !lights.contains(light) {
                lights.push(*light);
            }
        }
        let panel = |light: Light, lamp: &Lamp| {
            PanelLight::of(light, &truth.pattern, &optics, lamp.device.width, lamp.device.height)
        };
        let panels: Vec<(Light, Vec<PanelLight>)> = lights
            .iter()
            .map(|&light| (light, lamps.iter().map(|lamp| panel(light, lamp)).collect()))
            .collect();
        let normal = NormalTable::new();
        let cameras =
            truth.heads.iter().enumerate().flat_map(|(h, head)| head.cameras.iter().map(move |c| (h, c)));
        let sensors: Vec<Sensor> = cameras
            .map(|(head, camera)| {
                let (id, device) = (camera.id.clone(), camera.device.clone());
                Sensor::new(id, device, head, &lamps, scenario.seed, &optics, &normal)
            })
            .collect();
        let room = |sensor: &Sensor, panels: &[PanelLight]| {
            sensor.room_light(&Exposed { lamps: &lamps, panels, optics: &optics })
        };
        let rooms = sensors
            .iter()
            .map(|sensor| panels.iter().map(|(light, panels)| (*light, room(sensor, panels))).collect())
            .collect();
        Self { sensors, lamps, panels, rooms, optics, paint: scenario.paint, seed: scenario.seed, normal }
    }

    /// Memory for the frames of one sensor size; reuse it.
    pub fn memory(&self, sensor: usize) -> Irradiance {
        let device = &self.sensors[sensor].device;
        let (width, height) = (device.width, device.height);
        Irradiance {
            seen: vec![NOTHING; width * height],
            light: Plane::filled(width, height, 0.0),
            scratch: Plane::filled(width, height, 0.0),
        }
    }

    /// Photographs the scenes, which are moments of one exposure, into `pixels` (row-major).
    pub fn photograph(
        &self,
        sensor: usize,
        light: Light,
        moments: &[Scene],
        instant: u64,
        memory: &mut Irradiance,
        pixels: &mut [u8],
    ) {
        memory.light.as_mut_slice().fill(0.0);
        for scene in moments {
            self.add_moment(sensor, light, scene, 1.0 / moments.len() as f32, memory);
        }
        let exposure = Exposure { seed: self.seed, instant };
        if self.optics.camera_defocus > 0.0 {
            let distances = memory.seen.iter().map(|seen| seen.distance);
            blur_by_depth(&mut memory.light, distances, &self.optics);
        } else {
            blur(&mut memory.light, &mut memory.scratch, self.optics.camera_blur_px);
        }
        expose(&memory.light, &self.sensors[sensor], &self.optics, exposure, &self.normal, pixels);
    }

    /// Adds `share` of the light of one scene to the sensor.
    pub fn add_moment(
        &self,
        sensor: usize,
        light: Light,
        scene: &Scene,
        share: f32,
        memory: &mut Irradiance,
    ) {
        let number = sensor;
        let sensor = &self.sensors[number];
        let (width, height) = (sensor.device.width, sensor.device.height);
        let Some((_, panels)) = self.panels.iter().find(|(of, _)| *of == light) else { return };
        let Some((_, room)) = self.rooms[number].iter().find(|(of, _)| *of == light) else { return };
        let exposed = Exposed { lamps: &self.lamps, panels, optics: &self.optics };
        let tiles = Tiles::new(scene, &sensor.device);
        let panel_tiles = sensor.lamps.iter().map(|&l| Tiles::new(scene, &self.lamps[l].device)).collect();
        let view = View { sensor, scene, paint: &self.paint, exposed, room, tiles, panel_tiles };
        memory.seen.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            for (u, seen) in row.iter_mut().enumerate() {
                *seen = view.first_look(u, v);
            }
        });
        let seen = &memory.seen;
        memory.light.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            for (u, light) in row.iter_mut().enumerate() {
                let here = seen[v * width + u];
                let refine = self.optics.edge_samples > 1 && at_edge(seen, width, height, u, v);
                *light += share * if refine { view.refined(u, v) } else { here.value };
            }
        });
    }
}

/// Whether depth, albedo or light jump around a pixel.
fn at_edge(seen: &[Seen], width: usize, height: usize, u: usize, v: usize) -> bool {
    let here = &seen[v * width + u];
    let differs = |u: usize, v: usize| {
        let other = &seen[v * width + u];
        let gap = (here.distance - other.distance).abs();
        // infinity - infinity is NaN: both see the room.
        gap > 0.02 || (here.albedo - other.albedo).abs() > 0.1
    };
    (u > 0 && differs(u - 1, v))
        || (u + 1 < width && differs(u + 1, v))
        || (v > 0 && differs(u, v - 1))
        || (v + 1 < height && differs(u, v + 1))
}

/// One sensor looking at one scene in one light.
struct View<'a> {
    sensor: &'a Sensor,
    scene: &'a Scene,
    paint: &'a Paint,
    exposed: Exposed<'a>,
    room: &'a [RoomLight],
    /// Where the camera may see the scene.
    tiles: Tiles,
    /// Where the sensor's projectors may.
    panel_tiles: Vec<Tiles>,
}

impl View<'_> {
    /// What the line of sight through a pixel's centre brings.
    fn first_look(&self, u: usize, v: usize) -> Seen {
        let pixel = v * self.sensor.device.width + u;
        if !self.tiles.holds(u, v) {
            return Seen { value: self.room_light(|| self.sensor.sight(u, v), pixel), ..NOTHING };
        }
        self.sensor.sight(u, v).map_or(NOTHING, |sight| self.look(&sight, pixel))
    }

    /// What a line of sight through pixel number `pixel` brings.
    fn look(&self, sight: &Sight, pixel: usize) -> Seen {
        match self.scene.intersect(sight) {
            Some(hit) => self.seen(sight, hit),
            None => Seen { value: self.room_light(|| Some(*sight), pixel), ..NOTHING },
        }
    }

    /// What the subject shows at a hit.
    fn seen(&self, sight: &Sight, mut hit: Hit) -> Seen {
        hit.albedo *= self.paint.factor(&sight.at(hit.distance));
        Seen {
            distance: hit.distance as f32,
            albedo: hit.albedo as f32,
            value: self.subject_light(sight, &hit),
        }
    }

    fn subject_light(&self, sight: &Sight, hit: &Hit) -> f32 {
        let point = sight.at(hit.distance);
        let direct = self.sensor.lamps.iter().zip(&self.sensor.shares).map(|(&lamp, share)| {
            let light = share * lamp_light(&self.exposed, lamp, &point, &hit.normal);
            let source = &self.exposed.lamps[lamp].centre;
            if light > 1e-6 && !self.scene.shadowed(&point, &hit.normal, source) { light } else { 0.0 }
        });
        let optics = self.exposed.optics;
        (hit.albedo * (direct.sum::<f64>() + optics.ambient * optics.exposure_dn)) as f32
    }

    fn room_light(&self, sight: impl Fn() -> Option<Sight>, pixel: usize) -> f32 {
        // Less than this many DN of light cannot be distinguished from the noise: not worth a shadow.
        const FAINT_DN: f32 = 0.02;
        let mut sum = 0.0;
        for (n, (light, &lamp)) in self.room.iter().zip(&self.sensor.lamps).enumerate() {
            let value = light.dn[pixel];
            if value > FAINT_DN && self.panel_tiles[n].holds_tile(light.panel_tile[pixel]) {
                let room = sight().and_then(|sight| Sensor::room_point(&sight, self.exposed.optics));
                let source = &self.exposed.lamps[lamp].centre;
                if room.is_some_and(|room| self.scene.shadowed(&room.point, &room.normal, source)) {
                    continue;
                }
            }
            sum += value;
        }
        sum
    }

    /// The mean over a grid of lines of sight through one pixel.
    fn refined(&self, u: usize, v: usize) -> f32 {
        let n = self.exposed.optics.edge_samples;
        let offset = |i: usize| (i as f64 + 0.5) / n as f64 - 0.5;
        let pixel = v * self.sensor.device.width + u;
        let samples = (0..n * n).map(|k| {
            let sight = self.sensor.sight_beside(u, v, [offset(k % n), offset(k / n)]);
            sight.map_or(0.0, |sight| self.look(&sight, pixel).value)
        });
        samples.sum::<f32>() / (n * n) as f32
    }
}

/// Ground truth of one camera at one moment, for all pixels.
pub struct SensorTruth {
    /// Camera z, m; NaN where the subject is not.
    pub depth: Plane<f32>,
    /// Absolute projector phase, rad; NaN where the subject is not.
    pub phase: Plane<f32>,
    /// In the panel of the camera's own projector, not shadowed, facing it.
    pub lit: Plane<bool>,
}

impl Studio {
    /// What is true at the pixels' centres.
    pub fn truth(
        &self,
        sensor: usize,
        scene: &Scene,
        pattern: &fourdbody::geometry::pattern::Pattern,
    ) -> SensorTruth {
        let sensor = &self.sensors[sensor];
        let lamp = &self.lamps[sensor.head];
        let (width, height) = (sensor.device.width, sensor.device.height);
        let tiles = Tiles::new(scene, &sensor.device);
        let at = |u: usize, v: usize| -> Option<(f32, f32, bool)> {
            if !tiles.holds(u, v) {
                return None;
            }
            let sight = sensor.sight(u, v)?;
            let hit = scene.intersect(&sight)?;
            let point = sight.at(hit.distance);
            let depth = sensor.depth(&sight, hit.distance) as f32;
            let Some(pixel) = lamp.device.project(&point) else { return Some((depth, f32::NAN, false)) };
            let faces = (lamp.centre - point).dot(&hit.normal) > 0.0;
            let inside = lamp.device.contains(pixel);
            let lit = faces && inside && !scene.shadowed(&point, &hit.normal, &lamp.centre);
            Some((depth, pattern.phase(pixel[0]) as f32, lit))
        };
        let numbers: Vec<usize> = (0..height).collect();
        let rows: Vec<Vec<(f32, f32, bool)>> = numbers
            .par_iter()
            .map(|&v| (0..width).map(|u| at(u, v).unwrap_or((f32::NAN, f32::NAN, false))).collect())
            .collect();
        let mut truth = SensorTruth {
            depth: Plane::filled(width, height, f32::NAN),
            phase: Plane::filled(width, height, f32::NAN),
            lit: Plane::filled(width, height, false),
        };
        for (v, row) in rows.into_iter().enumerate() {
            for (u, (depth, phase, lit)) in row.into_iter().enumerate() {
                truth.depth.set(u, v, depth);
                truth.phase.set(u, v, phase);
                truth.lit.set(u, v, lit);
            }
        }
        truth
    }
}
