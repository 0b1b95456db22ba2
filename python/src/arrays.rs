// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds and columns as NumPy arrays, which take over the memory of the vectors.

use fourdbody_core::data::Cloud;
use numpy::{Element, IntoPyArray, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// N x M values, row by row.
pub fn table<T: Element, const M: usize>(
    py: Python<'_>,
    rows: Vec<[T; M]>,
) -> PyResult<Bound<'_, PyArray2<T>>> {
    let count = rows.len();
    rows.into_flattened().into_pyarray(py).reshape([count, M])
}

/// The arrays of a cloud by their names; `None` for what it does not have.
pub fn cloud(py: Python<'_>, cloud: Cloud) -> PyResult<Bound<'_, PyDict>> {
    let arrays = PyDict::new(py);
    arrays.set_item("xyz_m", table(py, cloud.position_m)?)?;
    arrays.set_item("normal", table(py, cloud.normal)?)?;
    arrays.set_item("intensity", cloud.intensity.into_pyarray(py))?;
    arrays.set_item("uv", table(py, cloud.pixel)?)?;
    let given = |values: Vec<f32>| (!values.is_empty()).then(|| values.into_pyarray(py));
    arrays.set_item("sigma_m", given(cloud.sigma_m))?;
    arrays.set_item("camera", (!cloud.camera.is_empty()).then(|| cloud.camera.into_pyarray(py)))?;
    Ok(arrays)
}
