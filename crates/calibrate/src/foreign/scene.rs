// SPDX-License-Identifier: MIT OR Apache-2.0
//! The rig of a renderer as JSON: every camera and projector with its lens, and `x_device = R x_world + t`, metres.

use super::{Foreign, ForeignDevice, Place};
use crate::base::json;
use crate::config::Channel;
use crate::geometry::{Device, Lens, Pose};
use serde::Deserialize;
use serde_json::{Map, Value};

/// The heads of a scene.
#[derive(Debug, Deserialize)]
pub struct SceneRig {
    pub heads: Vec<SceneHead>,
}

/// A projector and its cameras.
#[derive(Debug, Deserialize)]
pub struct SceneHead {
    pub id: u64,
    pub channel: Channel,
    pub projector: SceneDevice,
    pub cameras: Vec<SceneCamera>,
}

/// A camera with its name.
#[derive(Debug, Deserialize)]
pub struct SceneCamera {
    pub name: String,
    #[serde(flatten)]
    pub device: SceneDevice,
}

/// A lens and a place.
#[derive(Debug, Deserialize)]
pub struct SceneDevice {
    width: usize,
    height: usize,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    dist: [f64; 5],
    #[serde(rename = "R")]
    rotation: [[f64; 3]; 3],
    #[serde(rename = "t")]
    translation: [f64; 3],
}

impl SceneHead {
    /// The name of its head in a rig.
    pub fn name(&self) -> String {
        format!("h{}", self.id)
    }
}

impl SceneDevice {
    /// The same as a device.
    ///
    /// # Errors
    /// What is no rotation.
    pub fn device(&self) -> Result<Device, String> {
        let device_from_world = Pose::from_rows(self.rotation, self.translation)?;
        Ok(Device {
            width: self.width,
            height: self.height,
            lens: Lens { fx: self.fx, fy: self.fy, cx: self.cx, cy: self.cy, distortion: self.dist },
            world_from_device: Pose::new(device_from_world.isometry().inverse()),
        })
    }
}

pub(super) fn devices(all: Map<String, Value>) -> Result<Foreign, String> {
    let scene: SceneRig =
        json::from_value(Value::Object(all)).map_err(|e| format!("no rig of a scene: {e}"))?;
    let foreign = |name: String, device: &SceneDevice, is_projector: bool| {
        let Device { width, height, lens, world_from_device } = device.device()?;
        let (size, place) = (Some([width, height]), Place::World(world_from_device));
        Ok(ForeignDevice { name, lens, size, place, is_projector })
    };
    let of = |head: &SceneHead| {
        let cameras = head.cameras.iter().map(|camera| foreign(camera.name.clone(), &camera.device, false));
        let projector = foreign(head.name(), &head.projector, true);
        [projector].into_iter().chain(cameras).collect::<Vec<Result<ForeignDevice, String>>>()
    };
    let devices: Result<Vec<ForeignDevice>, String> = scene.heads.iter().flat_map(of).collect();
    Ok(Foreign { program: "a scene", devices: devices?, unit_mm: Some(1000.0) })
}
