// SPDX-License-Identifier: MIT OR Apache-2.0
//! The matrices of `cv2.calibrateCamera` and `cv2.stereoCalibrate`, by the names under which people keep them.
//!
//! Points of the first device become those of the second by `R x + T`. Names are compared without capitals and
//! separators: `camera_matrix_1` is `cameraMatrix1`.

use super::{Foreign, ForeignDevice, Place, lens};
use nalgebra::{Matrix3, Vector3};
use serde_json::{Map, Value};

/// A device by its names for camera matrix, distortion, and rotation and translation from the first.
struct Names {
    what: &'static str,
    matrix: &'static str,
    distortion: &'static str,
    rotation: &'static str,
    translation: &'static str,
}

const FIRST: Names = Names {
    what: "the first camera",
    matrix: "k1 m1 cm1 mtx1 cameramatrix1 intrinsicmatrix1 leftk kleft leftcameramatrix cameramatrixleft mtxl kl \
             camk kcam camint cammatrix cammtx kc cameramatrix cameraintrinsics intrinsicmatrix mtx k",
    distortion: "d1 dist1 distcoeffs1 distortioncoefficients1 distortion1 leftd dleft distleft distcoeffsleft \
                 leftdistcoeffs distl dl camkc camd camdist dc distortioncoefficients distcoeffs cameradistortion \
                 distortion dist d",
    rotation: "",
    translation: "",
};

const SECOND: Names = Names {
    what: "the second camera",
    matrix: "k2 m2 cm2 mtx2 cameramatrix2 intrinsicmatrix2 rightk kright rightcameramatrix cameramatrixright mtxr kr",
    distortion: "d2 dist2 distcoeffs2 distortioncoefficients2 distortion2 rightd dright distright distcoeffsright \
                 rightdistcoeffs distr dr",
    rotation: "r rlr r12 rotation rotationmatrix rot",
    translation: "t tlr t12 translation translationvector trans",
};

const PROJECTOR: Names = Names {
    what: "the projector",
    matrix: "m4 projk kproj projint projmatrix projmtx projectormatrix projectorcameramatrix projectorintrinsics \
             projectork kp",
    distortion: "d4 projkc projd dproj projdist projectordistortion projectordistcoeffs projectord dp",
    rotation: "rlp rcp r rotation rotationmatrix rot roration",
    translation: "tlp tcp t translation translationvector trans",
};

/// Words by which the lens models are named that [`crate::geometry::Lens`] has not.
const OTHER_MODELS: [&str; 6] = ["equi", "fish", "rational", "omni", "thin", "kannala"];

/// The devices of OpenCV's matrices.
pub fn devices(all: &Map<String, Value>) -> Result<Foreign, String> {
    let plain =
        |name: &str| name.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_lowercase();
    let values: Vec<(String, &String, &Value)> = all.iter().map(|(name, x)| (plain(name), name, x)).collect();
    let find = |names: &str| {
        let named = |name: &str| values.iter().find(|value| value.0 == name);
        names.split_whitespace().find_map(named).map(|(_, name, value)| (name.as_str(), *value))
    };
    let model = find("distortionmodel cameramodel model fisheyemodel fisheye");
    if let Some((name, model)) = model {
        let text = model.as_str().map_or_else(|| model.to_string(), str::to_lowercase);
        let is_on =
            name.to_lowercase().contains("fisheye") && !["0", "0.0", "false"].contains(&text.as_str());
        if is_on || OTHER_MODELS.iter().any(|other| text.contains(other)) {
            return Err(format!(
                "expected distortion k1, k2, p1, p2, k3 (plumb_bob), found {name}: {text}; calibrate again with it"
            ));
        }
    }
    let size = match (find("imagewidth width"), find("imageheight height")) {
        (Some(width), Some(height)) => Some([number(width.1), number(height.1)]),
        _ => find("imagesize imgsize s size").and_then(|(_, size)| {
            let size = numbers(size);
            (size.len() == 2).then(|| [Some(size[0]), Some(size[1])])
        }),
    };
    let size = size.and_then(|[width, height]| Some([width? as usize, height? as usize]));
    let mut devices = Vec::new();
    for names in [&FIRST, &SECOND, &PROJECTOR] {
        let Some((matrix_name, matrix)) = find(names.matrix) else { continue };
        let required = |what: &str, expected: &str| {
            let missing = || format!("expected {what} of {} ({expected}), found none", names.what);
            find(expected).ok_or_else(missing)
        };
        let (distortion_name, distortion) =
            required("distortion, zeros where there is none,", names.distortion)?;
        let name = format!("{matrix_name}, {distortion_name}");
        let of_device = |e: String| format!("{name}: {e}");
        let place = if devices.is_empty() {
            Place::First
        } else {
            // Where there are two cameras, R and T are theirs.
            let (rotation, shift) = match devices.len() {
                2 => ("rlp rcp", "tlp tcp"),
                _ => (names.rotation, names.translation),
            };
            let (rotation, shift) = (required("R", rotation)?, required("T", shift)?);
            let turn = square(rotation.1).map_err(of_device)?;
            Place::FromFirst(turn, vector(shift.0, Some(shift.1)).map_err(of_device)?)
        };
        let lens = lens(&square(matrix).map_err(of_device)?, &numbers(distortion)).map_err(of_device)?;
        let is_projector = names.what == PROJECTOR.what;
        // The one size is the first camera's: the second device may be a projector.
        let size = size.filter(|_| devices.is_empty());
        devices.push(ForeignDevice { name, lens, size, place, is_projector });
    }
    if devices.is_empty() {
        let found: Vec<&str> = all.keys().map(String::as_str).take(12).collect();
        return Err(format!(
            "expected the matrices of OpenCV's calibration under their usual names (K1, D1, K2, D2, R, T; M1; \
             cameraMatrix1, distCoeffs1; camera_matrix; cam_K, proj_K), found {}; rename them",
            if found.is_empty() { "nothing".to_owned() } else { found.join(", ") }
        ));
    }
    Ok(Foreign { program: "OpenCV", devices, unit_mm: None })
}

/// All numbers of a matrix or list, row by row.
pub fn numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Object(matrix) => matrix.get("data").map(numbers).unwrap_or_default(),
        Value::Array(list) => list.iter().flat_map(numbers).collect(),
        value => value.as_f64().into_iter().collect(),
    }
}

fn number(value: &Value) -> Option<f64> {
    numbers(value).first().copied()
}

/// The three numbers of a value with this name.
pub fn vector(name: &str, value: Option<&Value>) -> Result<Vector3<f64>, String> {
    match value.map(numbers).unwrap_or_default()[..] {
        [x, y, z] => Ok(Vector3::new(x, y, z)),
        ref other => Err(format!("expected three numbers as {name}, found {}", other.len())),
    }
}

/// A matrix of three rows and columns.
pub fn square(value: &Value) -> Result<Matrix3<f64>, String> {
    let all = numbers(value);
    match all.len() {
        9 => Ok(Matrix3::from_row_slice(&all)),
        count => Err(format!("expected a matrix of 3 x 3, found {count} numbers")),
    }
}
