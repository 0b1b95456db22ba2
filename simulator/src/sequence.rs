// SPDX-License-Identifier: MIT OR Apache-2.0
//! A whole scenario to a cache directory: frames, true geometry, ground truth.

use crate::cache::{CacheError, CachedCamera, Manifest};
use crate::optics::{Irradiance, Studio};
use crate::rig_file;
use crate::scenario::{Scenario, Subject};
use crate::scene::subject::Stage;
use crate::scene::{Scene, mesh_file};
use crate::true_rig::{drifted, smaller_jitter, smaller_rig, true_calibration};
use crate::truth;
use fourdbody::config::{ConfigError, Rig};
use fourdbody::data::Calibration;
use fourdbody::geometry::pattern::Marker;
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// What may be changed about a scenario without editing it.
#[derive(Debug, Clone, Default)]
pub struct Changes {
    /// A mesh file or directory in place of the scenario's subject.
    pub mesh: Option<PathBuf>,
    /// Replaces the scenario's number of instants.
    pub instants: Option<usize>,
    /// Another marker than the rig's. The exposure is changed with it, so that the other fringes stay as bright as they
    /// are.
    pub marker: Option<Marker>,
    /// Divide the resolution of cameras and panels by this (0 and 1: do not).
    pub size_divisor: usize,
}

/// Why a scenario could not be rendered.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The scenario or the rig.
    #[error("{0}")]
    Config(ConfigError),
    #[error("{0}")]
    Mesh(#[from] mesh_file::MeshError),
    #[error("{0}")]
    Cache(#[from] CacheError),
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: io::Error },
    /// The values are valid, but do not fit together.
    #[error("{0}")]
    Unfit(String),
}

impl From<ConfigError> for RenderError {
    fn from(error: ConfigError) -> Self {
        Self::Config(error)
    }
}

/// A scenario, ready to be rendered.
pub struct Run {
    pub scenario: Scenario,
    /// The rig, at the resolution rendered.
    pub rig: Rig,
    pub calibration: Calibration,
    /// The calibration of the rig: the same, unless devices have turned since.
    stated: Calibration,
    stage: Stage,
    inputs_sha256: String,
}

/// The sources of everything that decides a pixel: an edited renderer makes old caches stale.
const SOURCES: [&str; 21] = [
    include_str!("optics/expose.rs"),
    include_str!("optics/lamp.rs"),
    include_str!("optics/render.rs"),
    include_str!("optics/sensor.rs"),
    include_str!("optics/tiles.rs"),
    include_str!("random.rs"),
    include_str!("scenario.rs"),
    include_str!("scene/bvh.rs"),
    include_str!("scene/implicit.rs"),
    include_str!("scene/mannequin.rs"),
    include_str!("scene/mesh.rs"),
    include_str!("scene/mesh_file.rs"),
    include_str!("scene/mod.rs"),
    include_str!("scene/motion.rs"),
    include_str!("scene/paint.rs"),
    include_str!("scene/polygonize.rs"),
    include_str!("scene/skeleton.rs"),
    include_str!("scene/solids.rs"),
    include_str!("scene/subject.rs"),
    include_str!("scene/torso.rs"),
    include_str!("true_rig.rs"),
];

/// Light on the ridges of all fringes but the marker, as a share of full light.
fn ridge_light(marker: Marker) -> f64 {
    match marker {
        Marker::Darkened { .. } => 1.0,
        Marker::ZeroMean { amplitude } => 1.0 / (1.0 + amplitude),
    }
}

impl Run {
    /// Reads a scenario and what it names.
    pub fn load(scenario: &Path, changes: &Changes) -> Result<Self, RenderError> {
        let scenario = Scenario::load(scenario)?;
        let rig = Rig::load(&scenario.rig)?;
        Self::new(scenario, &rig, changes)
    }

    /// Prepares a scenario on a rig.
    pub fn new(mut scenario: Scenario, rig: &Rig, changes: &Changes) -> Result<Self, RenderError> {
        if let Some(path) = &changes.mesh {
            scenario.subject = Subject::Mesh { path: path.clone(), hold: 1 };
        }
        if let Some(instants) = changes.instants {
            scenario.instants = instants.max(1);
        }
        let mut rig = rig.clone();
        if let Some(marker) = changes.marker {
            scenario.optics.exposure_dn *= ridge_light(rig.pattern.marker) / ridge_light(marker);
            rig.pattern.marker = marker;
        }
        let divisor = changes.size_divisor.max(1);
        let smallest = rig.cameras().flat_map(|(head, camera)| [&camera.device, &head.projector]);
        let smallest = smallest.map(|device| device.width.min(device.height)).min().unwrap_or(0);
        if smallest / divisor < 16 {
            return Err(RenderError::Unfit(format!(
                "a size divisor of {divisor} leaves {} pixels on the shortest side of the rig's devices, expected at least 16",
                smallest / divisor
            )));
        }
        let jitter = smaller_jitter(&scenario.geometry, divisor);
        let rig = smaller_rig(&rig, divisor);
        let stated = true_calibration(&rig, &jitter, scenario.seed);
        let calibration = drifted(&stated, jitter.drift_deg, scenario.seed);
        let rate_hz = scenario.rate_hz.unwrap_or(rig.trigger_rate_hz);
        let io_error = |path: &Path, source| RenderError::Io { path: path.to_owned(), source };
        let stage =
            Stage::new(&scenario.subject, &rig.board, rate_hz).map_err(|e| match &scenario.subject {
                Subject::Mesh { path, .. } => io_error(path, e),
                _ => io_error(&scenario.rig, e),
            })?;
        let mut inputs = Sha256::new();
        SOURCES.iter().for_each(|source| inputs.update(source));
        inputs.update(env!("CARGO_PKG_VERSION"));
        // Where the rig and the meshes lie on disk does not matter, what they hold does.
        let mut placeless = scenario.clone();
        placeless.rig = PathBuf::new();
        if let Subject::Mesh { path, .. } = &mut placeless.subject {
            *path = PathBuf::new();
        }
        for value in [serde_json::to_value(&placeless), serde_json::to_value(&rig)] {
            let value = value.map_err(|e| RenderError::Unfit(format!("a number is not finite ({e})")))?;
            inputs.update(value.to_string());
        }
        for file in stage.files() {
            inputs.update(std::fs::read(file).map_err(|e| io_error(file, e))?);
        }
        let inputs_sha256 = inputs.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { scenario, rig, calibration, stated, stage, inputs_sha256 })
    }

    /// Whether the directory already holds exactly this run.
    pub fn is_cached(&self, directory: &Path) -> bool {
        let manifest = Manifest::load(directory).ok().filter(|m| m.inputs_sha256 == self.inputs_sha256);
        let complete = |manifest: &Manifest| {
            manifest.cameras.iter().all(|camera| {
                let size = camera.width * camera.height * manifest.instants;
                let path = Manifest::frames_path(directory, &camera.id);
                std::fs::metadata(path).is_ok_and(|file| file.len() == size as u64)
            })
        };
        manifest.is_some_and(|manifest| complete(&manifest))
    }

    /// Renders everything into the directory, unless it is there already; returns whether it rendered. `progress`
    /// hears of every finished frame: done, total.
    pub fn render(
        &self,
        directory: &Path,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<bool, RenderError> {
        if self.is_cached(directory) {
            return Ok(false);
        }
        let (frames, truth) = (directory.join("frames"), directory.join("truth"));
        for path in [&frames, &truth] {
            std::fs::create_dir_all(path).map_err(|source| RenderError::Io { path: path.clone(), source })?;
        }
        // From here on the directory is not a cache until the new manifest is there.
        let old = Manifest::path(directory);
        match std::fs::remove_file(&old) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                return Err(RenderError::Io { path: old, source });
            }
            _ => {}
        }
        self.write_geometry(directory)?;
        let studio = Studio::new(&self.scenario, &self.calibration);
        self.render_frames(&studio, directory, &mut progress)?;
        let cameras = studio.sensors.iter().map(|sensor| CachedCamera {
            id: sensor.id.clone(),
            width: sensor.device.width,
            height: sensor.device.height,
        });
        let (hash, name) = (self.inputs_sha256.clone(), self.scenario.name.clone());
        let after_end = self.scenario.after_end;
        Manifest::new(hash, name, self.scenario.instants, after_end, cameras.collect()).save(directory)?;
        Ok(true)
    }

    /// The rig as rendered, its true geometry, and the true poses of a flat subject.
    fn write_geometry(&self, directory: &Path) -> Result<(), RenderError> {
        let write = |name: &str, text: String| {
            let path = directory.join(name);
            std::fs::write(&path, text).map_err(|source| RenderError::Io { path, source })
        };
        write("rig.toml", rig_file::to_toml(&self.rig))?;
        let mut calibrations = vec![("calibration.json", &self.calibration)];
        if self.stated != self.calibration {
            calibrations.push(("calibration-before-drift.json", &self.stated));
        }
        for (name, calibration) in calibrations {
            let path = directory.join(name);
            calibration
                .save(&path)
                .map_err(|e| RenderError::Io { path: path.clone(), source: io::Error::other(e) })?;
        }
        let poses: Vec<_> = (0..self.scenario.instants)
            .filter_map(|instant| {
                let pose = fourdbody::geometry::Pose::new(self.stage.flat_pose(instant, 0.0)?);
                let light = self.scenario.light_at(instant);
                Some(serde_json::json!({"instant": instant, "light": light, "world_from_board": pose}))
            })
            .collect();
        let subject = serde_json::json!({"subject": self.scenario.subject, "poses": poses});
        write("truth/subject.json", format!("{subject:#}\n"))?;
        let girths = self.stage.girths();
        if girths.is_empty() {
            return Ok(());
        }
        write("truth/girths.json", format!("{:#}\n", serde_json::json!(girths)))
    }

    fn render_frames(
        &self,
        studio: &Studio,
        directory: &Path,
        progress: &mut impl FnMut(usize, usize),
    ) -> Result<(), RenderError> {
        let mut files = Vec::new();
        let mut memories: Vec<Irradiance> = Vec::new();
        for (s, sensor) in studio.sensors.iter().enumerate() {
            let path = Manifest::frames_path(directory, &sensor.id);
            let file = File::create(&path);
            files.push((file.map_err(|source| RenderError::Io { path: path.clone(), source })?, path));
            // Cameras of one size share their memory.
            if s == 0 {
                memories.push(studio.memory(s));
            }
        }
        let mut memory_of = |s: usize| -> usize {
            let device = &studio.sensors[s].device;
            let fits = |m: &Irradiance| (m.light.width(), m.light.height()) == (device.width, device.height);
            memories.iter().position(fits).unwrap_or_else(|| {
                memories.push(studio.memory(s));
                memories.len() - 1
            })
        };
        let slots: Vec<usize> = (0..studio.sensors.len()).map(&mut memory_of).collect();
        let total = self.scenario.instants * studio.sensors.len();
        let mut done = 0;
        let mut still: Option<Scene> = None;
        for instant in 0..self.scenario.instants {
            let light = self.scenario.light_at(instant);
            let mut now = match still.take() {
                Some(scene) => scene,
                None => self.stage.scene(instant, 0.0)?,
            };
            if self.scenario.has_truth(instant) {
                self.write_truth(studio, directory, instant, &now)?;
            }
            for (s, sensor) in studio.sensors.iter().enumerate() {
                let device = &sensor.device;
                let mut pixels = vec![0u8; device.width * device.height];
                let moments = self.moments(instant, sensor.head, now)?;
                let memory = &mut memories[slots[s]];
                studio.photograph(s, light, &moments, instant as u64, memory, &mut pixels);
                now = self.first_of(moments, instant)?;
                let (file, path) = &mut files[s];
                file.write_all(&pixels).map_err(|source| RenderError::Io { path: path.clone(), source })?;
                done += 1;
                progress(done, total);
            }
            still = self.stage.is_still().then_some(now);
        }
        Ok(())
    }

    /// The moments of one exposure of a head's cameras; `now` is the instant itself.
    fn moments(&self, instant: usize, head: usize, now: Scene) -> Result<Vec<Scene>, RenderError> {
        let n = self.scenario.optics.exposure_samples;
        if n == 1 || self.stage.is_still_at(instant) {
            return Ok(vec![now]);
        }
        let exposure_s = self.rig.heads[head].exposure_ns as f64 * 1e-9;
        let offset = |k: usize| ((k as f64 + 0.5) / n as f64 - 0.5) * exposure_s;
        (0..n).map(|k| Ok(self.stage.scene(instant, offset(k))?)).collect()
    }

    /// Gives the instant's own scene back after an exposure.
    fn first_of(&self, mut moments: Vec<Scene>, instant: usize) -> Result<Scene, RenderError> {
        match moments.len() {
            1 => Ok(moments.swap_remove(0)),
            _ => Ok(self.stage.scene(instant, 0.0)?),
        }
    }

    fn write_truth(
        &self,
        studio: &Studio,
        directory: &Path,
        instant: usize,
        scene: &Scene,
    ) -> Result<(), RenderError> {
        let folder = directory.join("truth");
        for (s, sensor) in studio.sensors.iter().enumerate() {
            let path = folder.join(format!("{}_{instant:06}.npz", sensor.id));
            let truth = studio.truth(s, scene, &self.calibration.pattern);
            truth::write_npz(&path, &truth).map_err(|source| RenderError::Io { path, source })?;
        }
        for solid in &scene.solids {
            let path = folder.join(format!("surface_{instant:06}.ply"));
            mesh_file::write_ply(&path, &solid.mesh()).map_err(|source| RenderError::Io { path, source })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Changes, Run};
    use crate::cache::{CachedImages, Manifest};
    use crate::images::ImageSource;
    use crate::scenario::Scenario;
    use fourdbody::config::Rig;
    use fourdbody::data::Calibration;
    use std::path::Path;

    #[test]
    fn a_directory_is_rendered_once_and_again_when_anything_changes() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/scenarios/sphere.toml");
        let scenario = Scenario::load(&path).expect("valid");
        let rig = Rig::load(&scenario.rig).expect("valid");
        let dir = tempfile::tempdir().expect("a temporary directory");
        let render = |seed: u64, divisor: usize| {
            let scenario = Scenario { seed, ..scenario.clone() };
            let changes = Changes { size_divisor: divisor, ..Changes::default() };
            let run = Run::new(scenario, &rig, &changes).expect("fits");
            run.render(dir.path(), |_, _| {}).expect("rendered")
        };
        assert!(render(1, 16) && !render(1, 16) && render(2, 16) && render(2, 12) && !render(2, 12));
        let manifest = Manifest::load(dir.path()).expect("complete");
        let camera = &manifest.cameras[5];
        let images = CachedImages::open(dir.path(), &manifest, &camera.id).expect("complete");
        assert_eq!(images.size(), (160, 100));
        assert!(images.pixels(3).iter().any(|&value| value > 60), "the ball is in the picture");
        assert!(dir.path().join(format!("truth/{}_000000.npz", camera.id)).exists());
        let written = Rig::load(&dir.path().join("rig.toml")).expect("a valid rig");
        let calibration = Calibration::load(&dir.path().join("calibration.json")).expect("a calibration");
        assert_eq!(written.pattern, calibration.pattern);
        std::fs::remove_file(Manifest::frames_path(dir.path(), &camera.id)).expect("there");
        assert!(render(2, 12), "a missing file is noticed");
        let tiny = Changes { size_divisor: 400, ..Changes::default() };
        assert!(Run::new(scenario.clone(), &rig, &tiny).is_err());
    }
}
