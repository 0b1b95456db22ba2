// SPDX-License-Identifier: MIT OR Apache-2.0
//! A calibration: where the devices are, and what their pixels see.

use crate::arrays;
use crate::error::{OrRaise, raise};
use fourdbody_calibrate::foreign::import;
use fourdbody_core::base::{Exit, Fault};
use fourdbody_core::config::Rig;
use fourdbody_core::data;
use fourdbody_core::geometry::Device;
use nalgebra::Point3;
use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::prelude::*;
use std::path::PathBuf;

#[pyclass(frozen)]
pub struct Calibration {
    pub content: data::Calibration,
}

#[pymethods]
impl Calibration {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        Ok(Self { content: data::Calibration::load(&path).or_raise(py, Exit::Usage)? })
    }

    /// The calibration of a content that was changed: what its file states as checksum is left out.
    #[staticmethod]
    fn of_text(py: Python<'_>, text: &str) -> PyResult<Self> {
        let stated = || {
            let mut value: serde_json::Value = serde_json::from_str(text).map_err(|e| e.to_string())?;
            value.as_object_mut().ok_or("expected an object")?.remove("sha256");
            let content: data::Calibration = serde_json::from_value(value).map_err(|e| e.to_string())?;
            data::Calibration::parse(content.text().map_err(|e| e.to_string())?.as_bytes())
        };
        let expected = "expected the content of a calibration";
        let content = stated().map_err(|found: String| format!("{expected}; found: {found}"));
        Ok(Self { content: content.or_raise(py, Exit::Usage)? })
    }

    /// The calibration of another program's files; volume, pattern and the place of the first device are those of the rig
    /// file, or of a calibration.
    #[staticmethod]
    fn of_files(
        py: Python<'_>,
        files: Vec<PathBuf>,
        rig: Option<PathBuf>,
        base: Option<&Self>,
        devices: Vec<String>,
        unit_mm: Option<f64>,
    ) -> PyResult<Self> {
        let base = match (rig, base) {
            (Some(rig), None) => {
                data::Calibration::nominal(&Rig::load(&rig).map_err(|e| raise(py, &Fault::from(e)))?)
            }
            (None, Some(base)) => base.content.clone(),
            _ => return Err("expected rig or base, found both or none").or_raise(py, Exit::Usage),
        };
        let (content, ..) = import(&files, base, &devices, unit_mm).or_raise(py, Exit::Usage)?;
        Ok(Self { content })
    }

    /// Writes the file, with its checksum.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        py.detach(|| self.content.save(&path)).or_raise(py, Exit::Failure)
    }

    /// The content of the file, JSON.
    fn text(&self, py: Python<'_>) -> PyResult<String> {
        self.content.text().or_raise(py, Exit::Failure)
    }

    /// The names of the cameras, in the order of camera numbers in merged clouds.
    fn cameras(&self) -> Vec<String> {
        self.content.cameras().map(|(_, camera)| camera.id.to_string()).collect()
    }

    /// Columns and rows of a device, and its centre in the world, m.
    fn device(&self, py: Python<'_>, name: &str) -> PyResult<((usize, usize), [f64; 3])> {
        let device = self.named(py, name)?;
        Ok(((device.width, device.height), device.centre().into()))
    }

    /// Unit directions in the world in which a device's pixels look, N x 3; NaN where a lens has none.
    fn directions<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        uv: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let device = self.named(py, name)?;
        let rows = rows::<2>(py, &uv)?;
        let ray = |[u, v]: &[f64; 2]| device.ray(*u, *v).map_or([f64::NAN; 3], |ray| (*ray.direction).into());
        arrays::table(py, rows.iter().map(ray).collect())
    }

    /// The pixels of a device that see these points of the world, N x 2; NaN where it cannot see them.
    fn project<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        xyz_m: PyReadonlyArray2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let device = self.named(py, name)?;
        let rows = rows::<3>(py, &xyz_m)?;
        let pixel = |point: &[f64; 3]| device.project(&Point3::from(*point)).unwrap_or([f64::NAN; 2]);
        arrays::table(py, rows.iter().map(pixel).collect())
    }
}

impl Calibration {
    fn named(&self, py: Python<'_>, name: &str) -> PyResult<&Device> {
        let cameras = self.content.cameras().map(|(_, camera)| (camera.id.to_string(), &camera.device));
        let projectors =
            self.content.heads.iter().map(|head| (format!("projector {}", head.id), &head.projector));
        let devices: Vec<_> = cameras.chain(projectors).collect();
        let found = devices.iter().find(|(known, _)| known == name).map(|(_, device)| *device);
        found
            .ok_or_else(|| {
                let known: Vec<&str> = devices.iter().map(|(known, _)| known.as_str()).collect();
                format!("expected a device of the calibration ({}), found {name:?}", known.join(", "))
            })
            .or_raise(py, Exit::Usage)
    }
}

/// The rows of an array with N columns.
fn rows<const N: usize>(py: Python<'_>, array: &PyReadonlyArray2<'_, f64>) -> PyResult<Vec<[f64; N]>> {
    let view = array.as_array();
    if view.ncols() != N {
        return Err(format!("expected {N} columns, found {}", view.ncols())).or_raise(py, Exit::Usage);
    }
    Ok(view.rows().into_iter().map(|row| std::array::from_fn(|i| row[i])).collect())
}
