// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rigid transforms as they stand in files: a rotation matrix (rows) and a translation in metres.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// A rigid transform `a_from_b`. In files: `{"rotation": [[3], [3], [3]], "translation_m": [3]}`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "PoseFile", into = "PoseFile")]
pub struct Pose {
    isometry: Isometry3<f64>,
    /// The rotation as the file has it, so that what is read and written again is the same to the last digit: results
    /// are tied to the digest of their calibration.
    rows: [[f64; 3]; 3],
}

#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseFile {
    rotation: [[f64; 3]; 3],
    translation_m: [f64; 3],
}

impl Pose {
    /// The pose of an isometry, whose rotation matrix goes to files.
    pub fn new(isometry: Isometry3<f64>) -> Self {
        let matrix = isometry.rotation.to_rotation_matrix();
        let row = |r: usize| [matrix[(r, 0)], matrix[(r, 1)], matrix[(r, 2)]];
        Self { isometry, rows: [row(0), row(1), row(2)] }
    }

    /// From the rows of a rotation matrix and a translation; an error when the matrix is not a rotation
    /// (orthonormal to 1e-6, determinant +1) or anything is not finite.
    pub fn from_rows(rotation: [[f64; 3]; 3], translation_m: [f64; 3]) -> Result<Self, String> {
        let matrix = Matrix3::from_fn(|row, column| rotation[row][column]);
        let finite = matrix.iter().chain(&translation_m).all(|x| x.is_finite());
        let orthonormal = (matrix * matrix.transpose() - Matrix3::identity()).abs().max() < 1e-6;
        if !finite || !orthonormal || matrix.determinant() < 0.0 {
            return Err(format!(
                "expected a rotation matrix (rows orthonormal, determinant +1) and a finite translation, \
                 found {rotation:?}, {translation_m:?}"
            ));
        }
        let turned = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
        let isometry = Isometry3::from_parts(Translation3::from(Vector3::from(translation_m)), turned);
        Ok(Self { isometry, rows: rotation })
    }

    /// The transform, to be applied to points.
    pub fn isometry(&self) -> &Isometry3<f64> {
        &self.isometry
    }
}

impl TryFrom<PoseFile> for Pose {
    type Error = String;

    fn try_from(file: PoseFile) -> Result<Self, String> {
        Self::from_rows(file.rotation, file.translation_m)
    }
}

impl From<Pose> for PoseFile {
    fn from(pose: Pose) -> Self {
        Self { rotation: pose.rows, translation_m: pose.isometry.translation.vector.into() }
    }
}

/// The pose of a device at `position_m` aimed at `target_m`. With `roll_deg` 0 columns run to the viewer's
/// right and rows down; 90 turns the device to portrait with columns running down. `None` when the aim is
/// vertical or the two points coincide.
pub fn look_at(position_m: [f64; 3], target_m: [f64; 3], roll_deg: f64) -> Option<Pose> {
    let position = Vector3::from(position_m);
    let forward = (Vector3::from(target_m) - position).try_normalize(1e-9)?;
    let right = forward.cross(&Vector3::z()).try_normalize(1e-6)?;
    let down = forward.cross(&right);
    let (sin, cos) = roll_deg.to_radians().sin_cos();
    let u = right * cos + down * sin;
    let v = down * cos - right * sin;
    let rotation = Rotation3::from_basis_unchecked(&[u, v, forward]);
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Pose::new(Isometry3::from_parts(Translation3::from(position), rotation)))
}

#[cfg(test)]
mod tests {
    use super::Pose;

    #[test]
    fn files_with_something_else_than_a_rotation_are_refused() {
        let identity = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        assert!(Pose::from_rows(identity, [0.0; 3]).is_ok());
        let mut mirrored = identity;
        mirrored[2][2] = -1.0;
        let mut scaled = identity;
        scaled[0][0] = 1.001;
        assert!(Pose::from_rows(mirrored, [0.0; 3]).is_err());
        assert!(Pose::from_rows(scaled, [0.0; 3]).is_err());
        assert!(Pose::from_rows(identity, [f64::NAN, 0.0, 0.0]).is_err());
    }

    #[test]
    fn a_pose_survives_its_file_form() {
        let pose = super::look_at([2.4, 0.1, 1.8], [0.0, 0.0, 1.0], 90.0).expect("valid");
        let text = serde_json::to_string(&pose).expect("serializes");
        let back: Pose = serde_json::from_str(&text).expect("parses");
        assert_eq!(serde_json::to_string(&back).expect("serializes"), text);
        assert!((pose.isometry().to_matrix() - back.isometry().to_matrix()).abs().max() < 1e-14);
    }
}
