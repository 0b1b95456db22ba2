// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whose calibration it is and where it is valid: what `calibration.json` states beside the geometry, and whether it
//! fits a recording.

use super::Calibration;
use crate::base::ids::{CameraId, HeadId};
use crate::data::frame_source::{SourceStatement, StatedCamera};
use crate::geometry::pattern::Pattern;
use serde::{Deserialize, Serialize};

/// The rig and the board that a calibration was made with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// SHA-256 of the rig file's cameras, projectors, nominal geometry and pattern.
    pub rig_sha256: String,
    pub board: String,
    /// SHA-256 of the board's circles.
    pub board_sha256: String,
    /// Vendor, model and serial number of each camera, as the recording states them; cameras that no recording
    /// names are missing.
    pub cameras: Vec<(CameraId, String)>,
    /// Name and version of the software that calibrated.
    pub software: String,
    /// Units and conventions, for readers without this software.
    pub conventions: String,
}

/// The device that `fourdbody import` states for a camera: none.
const IMPORTED: &str = "imported images";

/// Units and conventions of the numbers in the file, for readers without this software.
pub const CONVENTIONS: &str = "lengths in metres, angles in radians, lenses in pixels (integers at pixel centres, \
    u = column); distortion = [k1, k2, p1, p2, k3] (Brown-Conrady); world_from_device takes device \
    coordinates (x along \
    columns, y along rows, z forward) to the world; names ending in _mm are millimetres, in _px pixels";

/// Where the board was seen: the lenses are known there, and nowhere else.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValidVolume {
    /// By head, the box around all points that both circles and phase were measured at.
    pub heads: Vec<HeadVolume>,
    /// Where at least one head is valid.
    pub any: Extent,
    /// Where all heads are; `None` where their boxes have nothing in common.
    pub all: Option<Extent>,
}

/// Where one head is valid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadVolume {
    pub head: HeadId,
    pub extent: Extent,
}

/// An upright box in the world.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extent {
    /// The corner with the least coordinates, world, m.
    pub min_m: [f64; 3],
    /// The corner with the largest coordinates, world, m.
    pub max_m: [f64; 3],
}

impl Extent {
    /// The box around points; `None` without any.
    pub fn around(points: impl IntoIterator<Item = [f64; 3]>) -> Option<Self> {
        points.into_iter().fold(None, |found: Option<Self>, p| {
            let old = found.unwrap_or(Self { min_m: p, max_m: p });
            Some(old.hull(&Self { min_m: p, max_m: p }))
        })
    }

    fn hull(&self, other: &Self) -> Self {
        Self {
            min_m: std::array::from_fn(|i| self.min_m[i].min(other.min_m[i])),
            max_m: std::array::from_fn(|i| self.max_m[i].max(other.max_m[i])),
        }
    }

    fn common(&self, other: &Self) -> Option<Self> {
        let common = Self {
            min_m: std::array::from_fn(|i| self.min_m[i].max(other.min_m[i])),
            max_m: std::array::from_fn(|i| self.max_m[i].min(other.max_m[i])),
        };
        common.is_proper().then_some(common)
    }

    fn is_proper(&self) -> bool {
        self.min_m.iter().zip(&self.max_m).all(|(a, b)| a.is_finite() && b.is_finite() && a < b)
    }
}

impl ValidVolume {
    /// Of the heads' boxes; `None` without heads.
    pub fn of(heads: Vec<HeadVolume>) -> Option<Self> {
        let first = heads.first()?.extent;
        let any = heads.iter().fold(first, |any, head| any.hull(&head.extent));
        let all = heads.iter().try_fold(first, |all, head| all.common(&head.extent));
        Some(Self { heads, any, all })
    }

    pub(crate) fn check(&self) -> Result<(), String> {
        let all = self.heads.iter().map(|h| &h.extent).chain([&self.any]).chain(&self.all);
        match all.into_iter().find(|extent| !extent.is_proper()) {
            Some(extent) => {
                Err(format!("valid volume {extent:?}: expected each coordinate of max above that of min"))
            }
            None => Ok(()),
        }
    }
}

impl Calibration {
    /// Whether it can be used for these cameras of a recording: same ids, same image sizes, same devices as far as both
    /// are known, same pattern. All that does not fit comes at once.
    pub fn fits(&self, cameras: &[CameraId], stated: &SourceStatement) -> Result<(), String> {
        let mut problems = Vec::new();
        for id in cameras {
            let recorded = stated.cameras.iter().find(|camera| camera.id == *id);
            match (self.camera(id), recorded) {
                (Some((_, camera)), Some(recorded)) => {
                    let expected = (camera.device.width, camera.device.height);
                    if expected != (recorded.width, recorded.height) {
                        problems.push(format!(
                            "camera {id}: calibrated with images of {} x {}, recorded with {} x {}",
                            expected.0, expected.1, recorded.width, recorded.height
                        ));
                    }
                    problems.extend(self.other_device(recorded));
                }
                (Some(_), None) => {
                    let ids: Vec<&str> = stated.cameras.iter().map(|c| c.id.as_str()).collect();
                    problems.push(format!(
                        "camera {id} is calibrated, but not in the recording, which has {}",
                        ids.join(", ")
                    ));
                }
                (None, _) => problems.push(format!("camera {id} is not in the calibration")),
            }
        }
        if stated.pattern.as_ref().is_some_and(|pattern| !same_phases(pattern, &self.pattern)) {
            problems
                .push(format!("the pattern: calibrated {:?}, recorded {:?}", self.pattern, stated.pattern));
        }
        if problems.is_empty() {
            return Ok(());
        }
        Err(format!(
            "the calibration of rig {:?} does not fit the recording:\n  {}\nUse the calibration of this rig \
             and these cameras, or calibrate again",
            self.rig,
            problems.join("\n  ")
        ))
    }

    fn other_device(&self, recorded: &StatedCamera) -> Option<String> {
        let identity = self.identity.as_ref()?;
        let (id, calibrated) = identity.cameras.iter().find(|(id, _)| *id == recorded.id)?;
        let known = |text: &str| !text.trim().is_empty() && text != IMPORTED;
        let other = known(calibrated) && known(&recorded.device) && *calibrated != recorded.device;
        other.then(|| {
            format!("camera {id}: calibrated as {calibrated:?}, recorded with {:?}", recorded.device)
        })
    }
}

/// Whether two patterns give the same phase everywhere; gamma may be undone differently.
fn same_phases(a: &Pattern, b: &Pattern) -> bool {
    let numbers = |p: &Pattern| (p.period_px, p.marker_index, p.marker_every, p.marker, p.marker_period_px);
    numbers(a) == numbers(b)
}

#[cfg(test)]
mod tests {
    use super::{Extent, HeadVolume, Identity, ValidVolume};
    use crate::base::ids::{CameraId, HeadId};
    use crate::config::Rig;
    use crate::data::calibration::Calibration;
    use crate::data::frame_source::{SourceStatement, StatedCamera};
    use std::path::Path;

    fn calibration() -> Calibration {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        let mut calibration = Calibration::nominal(&Rig::load(&path).expect("the shipped rig"));
        let cameras = calibration.cameras().map(|(_, c)| (c.id.clone(), format!("Maker Model {}", c.id)));
        calibration.identity = Some(Identity {
            rig_sha256: String::new(),
            board: "b".to_owned(),
            board_sha256: String::new(),
            cameras: cameras.collect(),
            software: "s".to_owned(),
            conventions: "c".to_owned(),
        });
        calibration
    }

    fn stated(calibration: &Calibration) -> SourceStatement {
        let camera = |id: &CameraId| StatedCamera {
            id: id.clone(),
            width: 1920,
            height: 1200,
            device: format!("Maker Model {id}"),
        };
        SourceStatement {
            cameras: calibration.cameras().map(|(_, c)| camera(&c.id)).collect(),
            pattern: Some(calibration.pattern.clone()),
        }
    }

    #[test]
    fn a_recording_of_other_cameras_is_refused_with_all_reasons() {
        let calibration = calibration();
        let ids: Vec<CameraId> = calibration.cameras().map(|(_, c)| c.id.clone()).collect();
        let good = stated(&calibration);
        assert_eq!(calibration.fits(&ids, &good), Ok(()));
        let mut bad = stated(&calibration);
        bad.cameras[0].width = 960;
        bad.cameras[1].device = "Maker Model other".to_owned();
        bad.cameras[2].device = String::new();
        bad.cameras.remove(5);
        if let Some(pattern) = &mut bad.pattern {
            pattern.period_px = 12.0;
        }
        let text = calibration.fits(&ids, &bad).expect_err("four reasons");
        for part in
            ["h0_up: calibrated with images of 1920 x 1200, recorded with 960", "h0_low: calibrated as"]
        {
            assert!(text.contains(part), "{text}");
        }
        assert!(text.contains("h2_low is calibrated, but not in the recording") && text.contains("pattern"));
        assert!(!text.contains("h1_up:"), "an unknown device is no other device: {text}");
        // Without the missing camera and with another gamma only, nothing is wrong.
        let mut part = stated(&calibration);
        part.cameras.remove(5);
        part.pattern.as_mut().expect("stated").gamma = 2.2;
        assert_eq!(calibration.fits(&ids[..4], &part), Ok(()));
    }

    #[test]
    fn boxes_of_heads_are_joined_and_cut() {
        let head = |name: &str, min_m, max_m| HeadVolume {
            head: HeadId::from(name),
            extent: Extent { min_m, max_m },
        };
        let heads = vec![head("a", [0.0; 3], [2.0; 3]), head("b", [1.0; 3], [3.0; 3])];
        let volume = ValidVolume::of(heads).expect("two heads");
        assert_eq!((volume.any.min_m, volume.any.max_m), ([0.0; 3], [3.0; 3]));
        assert_eq!(volume.all, Some(Extent { min_m: [1.0; 3], max_m: [2.0; 3] }));
        let apart = vec![head("a", [0.0; 3], [1.0; 3]), head("b", [2.0; 3], [3.0; 3])];
        assert_eq!(ValidVolume::of(apart).expect("two heads").all, None);
    }
}
