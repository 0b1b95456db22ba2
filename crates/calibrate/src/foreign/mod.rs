// SPDX-License-Identifier: MIT OR Apache-2.0
//! Calibrations of other programs: lenses and poses of two or three devices that see one place, put into a calibration.
//!
//! ```text
//! tree     YAML, XML, JSON, TOML and NPZ files as one tree of values
//! opencv   the matrices that OpenCV's users keep, by their usual names
//! matlab   what MATLAB's `toStruct` states, as `jsonencode` writes it
//! anipose  cameras around a room, as Anipose, FreeMoCap and Caliscope keep them
//! scene    the rig of a renderer, every device in the world
//! ```
//!
//! These programs know two devices relative to each other, no world, no volume and no pattern. The calibration that is
//! changed has all of these: the first device stays where it has it.

mod anipose;
mod matlab;
mod opencv;
pub mod scene;
mod tree;

use crate::data::Calibration;
use crate::geometry::{Device, Lens, Pose};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::path::Path;

/// A camera or projector of another program.
#[derive(Debug, Clone)]
pub struct ForeignDevice {
    /// What the file calls it, for people; of a scene its name in the rig.
    pub name: String,
    pub lens: Lens,
    /// Columns and rows, where the file states them.
    pub size: Option<[usize; 2]>,
    pub place: Place,
    /// Whether the file says that it is a projector.
    pub is_projector: bool,
}

/// Where a device is, and in what.
#[derive(Debug, Clone)]
pub enum Place {
    /// The first: where the calibration has it.
    First,
    /// Takes coordinates of the first device to those of this one, in the file's unit of length.
    FromFirst(Matrix3<f64>, Vector3<f64>),
    /// In the world of the calibration.
    World(Pose),
}

/// What the files of a program state.
#[derive(Debug, Clone)]
pub struct Foreign {
    /// The program whose conventions they follow.
    pub program: &'static str,
    pub devices: Vec<ForeignDevice>,
    /// The unit of length, mm, where the files state it.
    pub unit_mm: Option<f64>,
}

impl Foreign {
    /// Reads files that complement each other, such as OpenCV's `intrinsics.yml` and `extrinsics.yml`.
    ///
    /// # Errors
    /// A file cannot be read, or what is missing in all of them together, or a model that [`Lens`] has not.
    fn read<P: AsRef<Path>>(files: &[P]) -> Result<Self, String> {
        let mut all = serde_json::Map::new();
        for file in files {
            let path = file.as_ref();
            let tree = tree::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
            all.extend(tree);
        }
        let read = match () {
            () if all.contains_key("heads") => scene::devices(all),
            () if anipose::is_it(&all) => anipose::devices(&all),
            () if matlab::is_it(&all) => matlab::devices(&all),
            () => opencv::devices(&all),
        };
        let names: Vec<String> = files.iter().map(|file| file.as_ref().display().to_string()).collect();
        read.map_err(|e| format!("{}: {e}", names.join(", ")))
    }

    /// Which cameras and heads (their projectors) of a calibration the devices are, where nobody says: what the file calls
    /// a projector is one; the others are the cameras in their order, and the projector where there are too few.
    ///
    /// # Errors
    /// There are fewer devices in the calibration, or several heads.
    fn usual_names(&self, calibration: &Calibration) -> Result<Vec<String>, String> {
        if self.devices.iter().all(|device| matches!(device.place, Place::World(_))) {
            return Ok(self.devices.iter().map(|device| device.name.clone()).collect());
        }
        let [head] = &calibration.heads[..] else {
            let count = calibration.heads.len();
            return Err(format!(
                "the rig has {count} heads: say with --devices which devices the file's are"
            ));
        };
        let mut left: Vec<String> = head.cameras.iter().map(|camera| camera.id.to_string()).collect();
        left.reverse();
        let mut projector = Some(head.id.to_string());
        let name = |device: &ForeignDevice| match device.is_projector {
            true => projector.take(),
            false => left.pop().or_else(|| projector.take()),
        };
        let names: Option<Vec<String>> = self.devices.iter().map(name).collect();
        names.ok_or_else(|| {
            format!("expected at most {} devices, found {}", head.cameras.len() + 1, self.devices.len())
        })
    }

    /// Puts the devices into a calibration as those of these names: cameras, or heads for their projectors. What was known
    /// of the quality of the calibration is dropped.
    ///
    /// # Errors
    /// A name is not in it, a size differs, or the unit of length is not known.
    fn put(
        &self,
        calibration: &mut Calibration,
        names: &[String],
        unit_mm: Option<f64>,
        origin: String,
    ) -> Result<(), String> {
        if names.len() != self.devices.len() {
            let found: Vec<&str> = self.devices.iter().map(|device| device.name.as_str()).collect();
            return Err(format!(
                "expected a name for each of the {} devices in the file ({}), found {}",
                found.len(),
                found.join("; "),
                names.len()
            ));
        }
        let mut first: Option<Pose> = None;
        for (foreign, name) in self.devices.iter().zip(names) {
            let known: Vec<String> = names_of(calibration);
            let device = device_mut(calibration, name).ok_or_else(|| {
                format!("expected a camera or a head of the rig ({}), found {name}", known.join(", "))
            })?;
            if let Some(size) = foreign.size.filter(|size| *size != [device.width, device.height]) {
                return Err(format!(
                    "{name}: expected {} x {} pixels as in the rig, found {} x {} for {}",
                    device.width, device.height, size[0], size[1], foreign.name
                ));
            }
            device.lens = foreign.lens;
            let start = *first.get_or_insert(device.world_from_device);
            device.world_from_device = match &foreign.place {
                Place::First => device.world_from_device,
                Place::World(pose) => *pose,
                Place::FromFirst(rotation, translation) => {
                    let unit_mm = unit_mm.or(self.unit_mm).ok_or(
                        "expected the unit of the translation: --unit-mm 1 for millimetres, 1000 for metres, 25 for \
                         squares of 25 mm",
                    )?;
                    let turn = nearest_rotation(rotation).map_err(|e| format!("{}: {e}", foreign.name))?;
                    let shift = Translation3::from(translation * (unit_mm / 1e3));
                    Pose::new(start.isometry() * Isometry3::from_parts(shift, turn).inverse())
                }
            };
        }
        calibration.origin = origin;
        (calibration.quality, calibration.identity, calibration.valid) = (None, None, None);
        // Rows of a panel that were measured belong to the geometry that is replaced.
        calibration.heads.iter_mut().for_each(|head| head.rows = None);
        Ok(())
    }
}

/// A calibration with the devices of other programs' files in it, what the files state, and the names of its devices in
/// the calibration. `names`: these names, or none for usual ones; `unit_mm`: the files' unit of
/// length, where they do not state it.
///
/// # Errors
/// A file is no calibration, or does not fit this one, or the calibration that comes out could not be read again.
pub fn import<P: AsRef<Path>>(
    files: &[P],
    mut calibration: Calibration,
    names: &[String],
    unit_mm: Option<f64>,
) -> Result<(Calibration, Foreign, Vec<String>), String> {
    let foreign = Foreign::read(files)?;
    let names = match names {
        [] => foreign.usual_names(&calibration)?,
        names => names.to_vec(),
    };
    let file_name = |path: &P| Some(path.as_ref().file_name()?.to_string_lossy().into_owned());
    let files = files.iter().filter_map(file_name).collect::<Vec<String>>().join(", ");
    let origin = format!("{files} of {}", foreign.program);
    foreign.put(&mut calibration, &names, unit_mm, origin).map_err(|e| format!("{files}: {e}"))?;
    // What is written can be read: it is checked as every calibration is.
    let text = calibration.text().map_err(|e| format!("found {e}"))?;
    let calibration = Calibration::parse(text.as_bytes()).map_err(|e| format!("found {e}"))?;
    Ok((calibration, foreign, names))
}

/// The names of all devices: cameras, and heads for their projectors.
fn names_of(calibration: &Calibration) -> Vec<String> {
    let of = |head: &crate::data::CalibratedHead| {
        let cameras = head.cameras.iter().map(|camera| camera.id.to_string());
        cameras.chain([head.id.to_string()]).collect::<Vec<String>>()
    };
    calibration.heads.iter().flat_map(of).collect()
}

/// A camera, or the projector of a head.
pub fn device_mut<'a>(calibration: &'a mut Calibration, name: &str) -> Option<&'a mut Device> {
    calibration.heads.iter_mut().find_map(|head| match head.id.to_string() == name {
        true => Some(&mut head.projector),
        false => {
            let camera = head.cameras.iter_mut().find(|camera| camera.id.as_str() == name);
            camera.map(|camera| &mut camera.device)
        }
    })
}

/// The rotation of a matrix that was printed with a few digits.
fn nearest_rotation(matrix: &Matrix3<f64>) -> Result<UnitQuaternion<f64>, String> {
    let off = (matrix * matrix.transpose() - Matrix3::identity()).abs().max();
    if !(off < 1e-3) || !(matrix.determinant() > 0.0) {
        return Err(format!("expected a rotation (rows orthonormal, determinant +1), found {matrix:.4}"));
    }
    let near = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*matrix));
    Ok(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_eps(matrix, 1e-15, 100, near.into())))
}

/// A lens of a camera matrix and distortion coefficients in OpenCV's order.
///
/// # Errors
/// A skew, or a model with more coefficients, by its name.
fn lens(matrix: &Matrix3<f64>, distortion: &[f64]) -> Result<Lens, String> {
    let (skew, last) = (matrix[(0, 1)], matrix.row(2) - nalgebra::RowVector3::new(0.0, 0.0, 1.0));
    if skew != 0.0 || matrix[(1, 0)] != 0.0 || last.amax() > 1e-9 {
        return Err(format!(
            "expected a camera matrix without skew, [fx 0 cx; 0 fy cy; 0 0 1], found {matrix:.4}"
        ));
    }
    let (known, more) = distortion.split_at(distortion.len().min(5));
    let model = match distortion.len() {
        4 | 5 => "",
        8 => "the rational model (k4, k5, k6)",
        12 => "the thin prism model (s1 to s4)",
        14 => "the tilted sensor model (tau)",
        count => return Err(format!("expected distortion k1, k2, p1, p2, k3, found {count} coefficients")),
    };
    if more.iter().any(|x| *x != 0.0) {
        return Err(format!(
            "expected distortion k1, k2, p1, p2, k3, found {model}: calibrate again without it"
        ));
    }
    let mut all = [0.0; 5];
    all[..known.len()].copy_from_slice(known);
    let [fx, fy, cx, cy] = [(0, 0), (1, 1), (0, 2), (1, 2)].map(|at| matrix[at]);
    if ![fx, fy, cx, cy].iter().chain(&all).all(|x| x.is_finite()) || fx <= 0.0 || fy <= 0.0 {
        return Err(format!("expected focal lengths above 0 and finite numbers, found {matrix:.4}, {all:?}"));
    }
    Ok(Lens { fx, fy, cx, cy, distortion: all })
}
