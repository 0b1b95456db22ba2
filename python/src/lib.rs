// SPDX-License-Identifier: MIT OR Apache-2.0
//! The native half of the Python package: `python/fourdbody` gives these classes their names, units and documentation.

mod arrays;
mod calibrate;
mod calibration;
mod error;
mod reconstruct;
mod result;
mod session;
mod work;

use pyo3::prelude::*;

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<calibration::Calibration>()?;
    module.add_class::<reconstruct::Reconstructor>()?;
    module.add_class::<result::Result>()?;
    module.add_class::<session::Session>()?;
    module.add_function(wrap_pyfunction!(calibrate::calibrate, module)?)?;
    module.add_function(wrap_pyfunction!(calibrate::calibration_check, module)?)?;
    module.add_function(wrap_pyfunction!(reconstruct::reconstruct, module)?)
}
