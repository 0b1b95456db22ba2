// SPDX-License-Identifier: MIT OR Apache-2.0
//! `calibration.json`: everything that turns a pixel and its absolute phase into a world point.
//!
//! Versioned and self-describing; `sha256` covers the compact JSON of the same object without that field,
//! so a file that was edited or cut is refused. `docs/reference/calibration.md` specifies the file.

mod found;
mod identity;
mod projector;
mod rows;
mod world;

pub use identity::{CONVENTIONS, Extent, HeadVolume, Identity, ValidVolume};
pub use projector::{PanelRows, Response};
pub use world::World;

use crate::base::ids::{CameraId, HeadId};
use crate::base::{FileError, json, regular, write_whole};
use crate::config::{Channel, Rig};
use crate::geometry::Device;
use crate::geometry::pattern::Pattern;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt;
use std::io::{self, Write};
use std::ops::Range;
use std::path::Path;

/// One camera with its calibrated lens and pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    pub device: Device,
}

/// One calibrated head: the projector is the second device of each triangulation pair (paper, 4.2).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedHead {
    /// Its name in the rig.
    pub id: HeadId,
    pub channel: Channel,
    /// The projector as an inverse camera.
    pub projector: Device,
    /// Which rows of the panel the rows of this geometry are; `None`: not known. Fringes do not depend on them, and
    /// only the marker's place along itself needs them ([`crate::reconstruct::marker::epipolar_check`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rows: Option<PanelRows>,
    pub cameras: Vec<CalibratedCamera>,
}

/// A whole calibration, as `calibration.json` holds it. `fourdbody calibrate` makes it from photographs of the board,
/// or [`Self::nominal`] from a rig file; every reconstruction reads it, and a copy stays beside the results for as
/// long as these exist. It is checked as a whole when it is read: what exists of it can be used.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    format: String,
    version: u32,
    /// Name of the rig that it belongs to.
    pub rig: String,
    /// How it came to be, in words.
    pub origin: String,
    /// The pattern that the phases refer to.
    pub pattern: Pattern,
    /// Lower corner of the volume that it is valid in, world, m.
    pub volume_min_m: [f64; 3],
    /// Upper corner of that volume, world, m.
    pub volume_max_m: [f64; 3],
    /// The heads, in the rig's order.
    pub heads: Vec<CalibratedHead>,
    /// How well it agrees with the photographs it was made from; `None` for one that was not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<Quality>,
    /// The rig and the board that it was made with; `None` for one that was not made from photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identity: Option<Identity>,
    /// Where the board was seen; `None` for one that was not made from photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub valid: Option<ValidVolume>,
}

/// Residuals and uncertainties of a calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quality {
    pub board: String,
    pub cameras: Vec<CameraResiduals>,
    /// Per head: RMS distance between the panel column that the phase names and the one that the geometry names, px.
    pub projector_rms_px: Vec<(HeadId, f64)>,
    /// Pairs of heads that saw the board together.
    pub links: Vec<HeadLink>,
    /// Around a closed loop of heads, mm.
    pub loop_error_mm: Option<f64>,
    /// Standard deviations of the estimates.
    pub uncertainties: Vec<DeviceUncertainty>,
    /// Per head, what its projector makes of panel values; heads with too little light for it are missing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub responses: Vec<(HeadId, Response)>,
    /// How its world was chosen; `None` in files of earlier versions, whose world is the rig file's pose of the first
    /// camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub world: Option<World>,
}

/// How well one camera's circles are explained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraResiduals {
    pub camera: CameraId,
    /// Positions of the board that it saw.
    pub positions: usize,
    /// Circles in all of these positions together.
    pub circles: usize,
    /// RMS distance along one axis, px.
    pub circles_rms_px: f64,
}

/// How well two heads agree on the positions that both saw.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HeadLink {
    /// Their places in the rig.
    pub heads: [usize; 2],
    /// Positions of the board that both heads saw.
    pub positions: usize,
    /// RMS distance of the board's corners, mm.
    pub rms_mm: f64,
}

/// Standard deviations of one device's parameters: pixels for the lens, radians and metres for the pose; 0 where
/// a parameter was held.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceUncertainty {
    /// The camera, or the projector of a head.
    pub device: String,
    /// By name of the parameter.
    pub sigma: std::collections::BTreeMap<String, f64>,
}

/// The most pixels along a side of a camera or a panel, as in the rig file.
const SIDE_MAX: usize = 16_384;
/// The most cameras that a merged cloud can name by a byte.
const CAMERAS_MAX: usize = 255;
/// The most pixels of all cameras together: tables take at least a byte for each.
const PIXELS_MAX: usize = 1 << 30;

/// The value of `format` in every calibration file.
const FORMAT: &str = "fourdbody-calibration";
/// The version that is written: 3 has the rows of the panel.
const VERSION: u32 = 3;
/// The oldest version that is read: 1 has no identity, no valid volume and no responses, 2 no rows.
const OLDEST: u32 = 1;

impl Calibration {
    /// A calibration with the geometry given; the rest comes from the rig.
    pub fn new(rig: &Rig, origin: String, heads: Vec<CalibratedHead>) -> Self {
        Self {
            format: FORMAT.to_owned(),
            version: VERSION,
            rig: rig.name.clone(),
            origin,
            pattern: rig.pattern.clone(),
            volume_min_m: rig.volume_min_m,
            volume_max_m: rig.volume_max_m,
            heads,
            quality: None,
            identity: None,
            valid: None,
        }
    }

    /// The rig's nominal geometry as a calibration.
    pub fn nominal(rig: &Rig) -> Self {
        let heads = rig.heads.iter().map(|head| CalibratedHead {
            id: head.id.clone(),
            channel: head.channel,
            projector: head.projector.clone(),
            rows: None,
            cameras: head
                .cameras
                .iter()
                .map(|c| CalibratedCamera { id: c.id.clone(), device: c.device.clone() })
                .collect(),
        });
        Self::new(rig, "nominal geometry of the rig file".to_owned(), heads.collect())
    }

    /// All cameras with their heads, in the rig's order. A camera's place here is its number in merged clouds.
    pub fn cameras(&self) -> impl Iterator<Item = (&CalibratedHead, &CalibratedCamera)> {
        self.heads.iter().flat_map(|head| head.cameras.iter().map(move |camera| (head, camera)))
    }

    /// Places of a head's cameras among all cameras.
    pub fn cameras_of(&self, head: usize) -> Range<usize> {
        let first = self.heads[..head].iter().map(|h| h.cameras.len()).sum();
        first..first + self.heads[head].cameras.len()
    }

    /// One camera with its head.
    pub fn camera(&self, id: &CameraId) -> Option<(&CalibratedHead, &CalibratedCamera)> {
        self.cameras().find(|(_, camera)| camera.id == *id)
    }

    /// Reads and checks a calibration file.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        let told = |found: &dyn fmt::Display| {
            FileError::of(path)(format!(
                "expected a calibration.json as `fourdbody calibrate` writes it; found: {found}; a copy of the one \
                 in use lies beside each result"
            ))
        };
        let bytes = regular::read(path, regular::STATEMENT_BYTES).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => told(&"no file of this name"),
            _ => FileError::of(path)(error),
        })?;
        Self::parse(&bytes).map_err(|reason| told(&reason))
    }

    /// Checks the bytes of a calibration file. The error is what was found instead of one.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mut value: serde_json::Value = json::from_slice(bytes).map_err(|e| found::not_json(bytes, &e))?;
        let object = value.as_object_mut().ok_or("JSON that is not an object in braces")?;
        if object.get("format").is_none_or(|format| format != FORMAT) {
            return Err(found::another_object(object));
        }
        let stated = object.remove("sha256").ok_or("a calibration without its checksum (sha256)")?;
        let found = sha256(&value);
        // A later version may have other fields: that is reported before missing fields are.
        if let Some(version) = value["version"].as_u64().filter(|version| *version > u64::from(VERSION)) {
            return Err(format!(
                "version {version}, expected at most {VERSION}: written by a newer fourdbody"
            ));
        }
        let calibration: Self = json::from_value(value).map_err(|e| found::misfit(&e))?;
        if calibration.format != FORMAT || !(OLDEST..=VERSION).contains(&calibration.version) {
            return Err(format!(
                "format {:?} version {}, expected {FORMAT:?} version {OLDEST} to {VERSION}",
                calibration.format, calibration.version
            ));
        }
        if stated.as_str() != Some(&found) {
            return Err(format!("sha256 is {found}, but the file states {stated}: it was edited or damaged"));
        }
        calibration.check()?;
        Ok(calibration)
    }

    /// Writes the file through a temporary neighbour, so that it is never half there.
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        let text = self.text().map_err(FileError::of(path))?;
        write_whole(path, |file| file.write_all(text.as_bytes())).map_err(FileError::of(path))
    }

    /// The text of the calibration's file, with its checksum.
    pub fn text(&self) -> Result<String, serde_json::Error> {
        let mut value = serde_json::to_value(self)?;
        value["sha256"] = sha256(&value).into();
        Ok(serde_json::to_string_pretty(&value)? + "\n")
    }

    /// Refuses values that would make every later step meaningless.
    fn check(&self) -> Result<(), String> {
        let mut ids = std::collections::BTreeSet::new();
        for (head, camera) in self.cameras() {
            if !ids.insert(&camera.id) {
                return Err(format!("camera {} is listed twice", camera.id));
            }
            for (what, device) in [("camera", &camera.device), ("projector", &head.projector)] {
                let lens = &device.lens;
                let numbers = [lens.fx, lens.fy, lens.cx, lens.cy];
                // No rig has more, and tables of a false size would fill the memory.
                let sized = [device.width, device.height].iter().all(|side| (1..=SIDE_MAX).contains(side));
                let finite = numbers.iter().chain(&lens.distortion).all(|x| x.is_finite());
                if !sized {
                    let size = [device.width, device.height];
                    return Err(format!(
                        "{what} of {}: found {size:?} pixels, expected 1 to {SIDE_MAX} each way",
                        camera.id
                    ));
                }
                if !finite || lens.fx <= 0.0 || lens.fy <= 0.0 {
                    return Err(format!("{what} of {}: not a usable lens: {lens:?}", camera.id));
                }
            }
        }
        if let Some(head) = self.heads.iter().find(|head| head.rows.is_some_and(|rows| !rows.is_finite())) {
            return Err(format!("head {}: not usable rows: {:?}", head.id, head.rows));
        }
        if ids.is_empty() {
            return Err("no cameras".to_owned());
        }
        let pixels = self.cameras().map(|(_, camera)| camera.device.width * camera.device.height);
        let pixels: usize = pixels.sum();
        if ids.len() > CAMERAS_MAX || pixels > PIXELS_MAX {
            return Err(format!(
                "found {} cameras with {pixels} pixels, expected at most {CAMERAS_MAX} with {PIXELS_MAX}",
                ids.len()
            ));
        }
        let sides = self.volume_min_m.iter().zip(&self.volume_max_m);
        if !sides.into_iter().all(|(a, b)| a.is_finite() && b.is_finite() && a < b) {
            let (min, max) = (self.volume_min_m, self.volume_max_m);
            return Err(format!("working volume from {min:?} to {max:?}: expected each coordinate to grow"));
        }
        self.valid.as_ref().map_or(Ok(()), ValidVolume::check)
    }

    /// SHA-256 of cameras, projectors and pattern.
    pub fn geometry_sha256(&self) -> String {
        sha256(&serde_json::json!({ "heads": self.heads, "pattern": self.pattern }))
    }
}

/// Keys of a JSON object are sorted and floats print as the shortest text that reads back the same, so the
/// compact text is canonical.
fn sha256(value: &serde_json::Value) -> String {
    Sha256::digest(value.to_string()).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::Calibration;
    use crate::config::Rig;
    use std::path::Path;

    fn calibration() -> Calibration {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/rig.toml");
        Calibration::nominal(&Rig::load(&path).expect("the shipped rig"))
    }

    #[test]
    fn it_survives_its_file() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("calibration.json");
        let calibration = calibration();
        calibration.save(&path).expect("writable");
        let back = Calibration::load(&path).expect("readable");
        assert_eq!(back.cameras().count(), 8);
        assert_eq!(back.pattern, calibration.pattern);
        // Results lie beside a copy of it, and are tied to its digest.
        assert_eq!(back.text().expect("text"), calibration.text().expect("text"));
        assert_eq!(back.geometry_sha256(), calibration.geometry_sha256());
    }

    #[test]
    fn the_first_version_still_loads_and_a_later_one_is_named() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("calibration.json");
        let with_version = |version: u32| {
            let mut calibration = calibration();
            calibration.version = version;
            calibration.save(&path).expect("writable");
            Calibration::load(&path)
        };
        assert_eq!(with_version(1).expect("readable").cameras().count(), 8);
        let error = with_version(4).expect_err("must be refused").to_string();
        assert!(error.contains("version 4") && error.contains("newer"), "{error}");
    }

    #[test]
    fn values_without_sense_are_refused() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("calibration.json");
        let mut bad = calibration();
        bad.volume_max_m[1] = bad.volume_min_m[1];
        bad.save(&path).expect("writable");
        let error = Calibration::load(&path).expect_err("must be refused").to_string();
        assert!(error.contains("working volume"), "{error}");
        let mut bad = calibration();
        bad.heads[1].projector.lens.fx = -1.0;
        bad.save(&path).expect("writable");
        assert!(Calibration::load(&path).is_err());
    }

    #[test]
    fn a_changed_digit_is_found() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("calibration.json");
        calibration().save(&path).expect("writable");
        let text = std::fs::read_to_string(&path).expect("readable").replacen("2048.0", "2049.0", 1);
        let reason = Calibration::parse(text.as_bytes()).expect_err("must be refused");
        assert!(reason.contains("sha256"), "{reason}");
    }
}
