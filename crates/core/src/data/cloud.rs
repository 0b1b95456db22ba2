// SPDX-License-Identifier: MIT OR Apache-2.0
//! A point cloud as a structure of arrays.

/// The camera number of a directional cloud's points before merging.
pub const NO_CAMERA: u8 = u8::MAX;

/// Points in the world frame. All arrays have the same length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cloud {
    pub position_m: Vec<[f32; 3]>,
    /// Unit normals towards the camera.
    pub normal: Vec<[f32; 3]>,
    /// 0 to 1: light averaged over one fringe period.
    pub intensity: Vec<f32>,
    pub pixel: Vec<[u16; 2]>,
    /// Source camera: its place in the calibration. Empty in a directional cloud.
    pub camera: Vec<u8>,
    /// Standard uncertainty of the place along the line of sight, metres. Empty without `--uncertainty`.
    pub sigma_m: Vec<f32>,
}

impl Cloud {
    /// The number of points in the cloud.
    pub fn len(&self) -> usize {
        self.position_m.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.position_m.is_empty()
    }

    /// Whether the points carry their camera.
    pub fn is_merged(&self) -> bool {
        !self.camera.is_empty()
    }

    /// Appends a directional cloud as the points of camera number `camera`.
    pub fn merge(&mut self, directional: &Cloud, camera: u8) {
        self.position_m.extend_from_slice(&directional.position_m);
        self.normal.extend_from_slice(&directional.normal);
        self.intensity.extend_from_slice(&directional.intensity);
        self.pixel.extend_from_slice(&directional.pixel);
        self.sigma_m.extend_from_slice(&directional.sigma_m);
        self.camera.resize(self.position_m.len(), camera);
    }

    /// The points of camera number `camera` in a merged cloud, as a directional cloud.
    pub fn of_camera(&self, camera: u8) -> Cloud {
        let of = |i: &usize| self.camera.get(*i) == Some(&camera);
        let places: Vec<usize> = (0..self.len()).filter(of).collect();
        Cloud { camera: Vec::new(), ..self.pick(&places) }
    }

    /// The points at these places, in this order. Places beyond the end are an error of the caller.
    pub fn pick(&self, places: &[usize]) -> Cloud {
        fn of<T: Copy>(all: &[T], places: &[usize]) -> Vec<T> {
            // Properties that the cloud does not have stay absent.
            if all.is_empty() { Vec::new() } else { places.iter().map(|&i| all[i]).collect() }
        }
        Cloud {
            position_m: of(&self.position_m, places),
            normal: of(&self.normal, places),
            intensity: of(&self.intensity, places),
            pixel: of(&self.pixel, places),
            camera: of(&self.camera, places),
            sigma_m: of(&self.sigma_m, places),
        }
    }
}
