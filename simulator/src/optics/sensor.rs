// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera with everything about it that does not change from frame to frame.

use super::lamp::Lamp;
use super::render::{Exposed, lamp_light};
use super::tiles::tile_number;
use crate::random::{NormalTable, hash, mix, text_number};
use crate::scenario::Optics;
use crate::scene::Sight;
use fourdbody::base::ids::CameraId;
use fourdbody::config::Channel;
use fourdbody::geometry::Device;
use nalgebra::{Point3, Rotation3, Vector3};
use rayon::prelude::{IndexedParallelIterator, ParallelIterator, ParallelSliceMut};

/// A camera in its place, with its table of rays and its pixels' sensitivities.
pub struct Sensor {
    /// Its name in the rig.
    pub id: CameraId,
    pub device: Device,
    /// Number of its head, which is also the number of its projector.
    pub head: usize,
    pub channel: Channel,
    /// Numbers of the projectors that its filter lets through; its own first.
    pub lamps: Vec<usize>,
    /// How much of each one's light it lets through.
    pub shares: Vec<f64>,
    /// Projection centre in the world's frame, m.
    pub centre: Point3<f64>,
    rotation: Rotation3<f64>,
    /// Normalized coordinates of each pixel; NaN where the distortion has no inverse.
    rays: Vec<[f64; 2]>,
    /// Vignetting times the pixel's own sensitivity.
    pub sensitivity: Vec<f32>,
}

/// A point of the room behind the subject.
#[derive(Debug, Clone, Copy)]
pub struct RoomPoint {
    /// The point in the world's frame, m.
    pub point: Point3<f64>,
    /// The unit normal that points towards the volume.
    pub normal: Vector3<f64>,
    /// The share of light that is reflected.
    pub albedo: f64,
}

impl Sensor {
    /// Tabulates a camera. `lamps` are all projectors, in the order of the heads.
    pub fn new(
        id: CameraId,
        device: Device,
        head: usize,
        lamps: &[Lamp],
        seed: u64,
        optics: &Optics,
        normal: &NormalTable,
    ) -> Self {
        let (width, height) = (device.width, device.height);
        let mut rays = vec![[f64::NAN; 2]; width * height];
        rays.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            for (u, ray) in row.iter_mut().enumerate() {
                *ray = device.lens.undistort(u as f64, v as f64).unwrap_or([f64::NAN; 2]);
            }
        });
        let key = hash(seed, &[text_number("prnu"), text_number(id.as_str())]);
        let half = [(width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0];
        let corner2 = half[0] * half[0] + half[1] * half[1];
        let mut sensitivity = vec![0f32; width * height];
        sensitivity.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
            for (u, value) in row.iter_mut().enumerate() {
                let (x, y) = (u as f64 - half[0], v as f64 - half[1]);
                let vignette = 1.0 - optics.vignetting * (x * x + y * y) / corner2;
                let bits = mix(key ^ (v * width + u) as u64);
                *value = (vignette * (1.0 + optics.prnu * f64::from(normal.pick(bits)))) as f32;
            }
        });
        let channel = lamps[head].channel;
        let share = |lamp: &usize| if lamps[*lamp].channel == channel { 1.0 } else { optics.cross_talk };
        let others = (0..lamps.len()).filter(|&lamp| lamp != head);
        let seen: Vec<usize> = std::iter::once(head).chain(others).filter(|lamp| share(lamp) > 0.0).collect();
        Self {
            shares: seen.iter().map(share).collect(),
            lamps: seen,
            centre: device.centre(),
            rotation: device.world_from_device.isometry().rotation.to_rotation_matrix(),
            id,
            device,
            head,
            channel,
            rays,
            sensitivity,
        }
    }

    fn sight_of(&self, [x, y]: [f64; 2]) -> Option<Sight> {
        let direction = (self.rotation * Vector3::new(x, y, 1.0)).normalize();
        direction.x.is_finite().then_some(Sight { origin: self.centre, direction })
    }

    /// The line of sight of pixel (u, v).
    pub fn sight(&self, u: usize, v: usize) -> Option<Sight> {
        self.sight_of(self.rays[v * self.device.width + u])
    }

    /// The line of sight of a place `offset` px beside pixel (u, v): linear between the pixels around.
    pub fn sight_beside(&self, u: usize, v: usize, offset: [f64; 2]) -> Option<Sight> {
        let at = |u: usize, v: usize| self.rays[v * self.device.width + u];
        let here = at(u, v);
        let beside = |to_right: bool| {
            let (from, to) = if to_right {
                let left = u.min(self.device.width.saturating_sub(2));
                (at(left, v), at((left + 1).min(self.device.width - 1), v))
            } else {
                let above = v.min(self.device.height.saturating_sub(2));
                (at(u, above), at(u, (above + 1).min(self.device.height - 1)))
            };
            [to[0] - from[0], to[1] - from[1]]
        };
        let (du, dv) = (beside(true), beside(false));
        let mixed = |axis: usize| here[axis] + du[axis] * offset[0] + dv[axis] * offset[1];
        self.sight_of([mixed(0), mixed(1)])
    }

    /// Camera z (m) of the point at `distance` along a line of sight.
    pub fn depth(&self, sight: &Sight, distance: f64) -> f64 {
        (self.rotation * Vector3::z()).dot(&sight.direction) * distance
    }

    /// What of the room a line of sight meets: the floor (z = 0) or the curtain around it.
    pub fn room_point(sight: &Sight, optics: &Optics) -> Option<RoomPoint> {
        let (o, d) = (sight.origin, sight.direction);
        let radius = optics.curtain_radius_m;
        if d.z < 0.0 {
            let point = sight.at(-o.z / d.z);
            if point.x.hypot(point.y) <= radius {
                return Some(RoomPoint { point, normal: Vector3::z(), albedo: optics.floor_albedo });
            }
        }
        let a = d.x * d.x + d.y * d.y;
        let half = o.x * d.x + o.y * d.y;
        let under = half * half - a * (o.x * o.x + o.y * o.y - radius * radius);
        let distance = (under.max(0.0).sqrt() - half) / a;
        let point = sight.at(distance);
        let normal = -Vector3::new(point.x, point.y, 0.0) / radius;
        let met = under >= 0.0 && distance > 0.0 && distance.is_finite();
        met.then_some(RoomPoint { point, normal, albedo: optics.curtain_albedo })
    }

    /// The empty room in one light: for each projector that this camera sees, what it adds to each pixel.
    pub fn room_light(&self, exposed: &Exposed<'_>) -> Vec<RoomLight> {
        self.lamps
            .iter()
            .zip(&self.shares)
            .map(|(&lamp, &share)| self.room_light_of(exposed, lamp, share))
            .collect()
    }

    fn room_light_of(&self, exposed: &Exposed<'_>, lamp: usize, share: f64) -> RoomLight {
        let (width, height) = (self.device.width, self.device.height);
        let mut light = RoomLight { dn: vec![0.0; width * height], panel_tile: vec![0; width * height] };
        let rows = light.dn.par_chunks_mut(width).zip(light.panel_tile.par_chunks_mut(width));
        rows.enumerate().for_each(|(v, (values, tiles))| {
            for (u, (value, tile)) in values.iter_mut().zip(tiles).enumerate() {
                let room = self.sight(u, v).and_then(|sight| Self::room_point(&sight, exposed.optics));
                let Some(room) = room else { continue };
                let full = lamp_light(exposed, lamp, &room.point, &room.normal);
                *value = (share * full * room.albedo / exposed.albedo_of(self.channel)) as f32;
                let projector = &exposed.lamps[lamp].device;
                *tile = projector.project(&room.point).map_or(0, |pixel| tile_number(projector, pixel));
            }
        });
        light
    }
}

/// What one projector adds to the picture of the empty room.
pub struct RoomLight {
    /// The grey value of each pixel, DN.
    pub dn: Vec<f32>,
    /// Per pixel, the tile of the projector's panel that lights it.
    pub panel_tile: Vec<u32>,
}
