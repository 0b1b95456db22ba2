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

/// Keeps the memory of a frame for the next one, as the program has its allocator do, and leaves Python's own as it is.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// How long it keeps freed memory before the system gets it back, ms.
const KEPT_MS: std::ffi::c_long = 10_000;
/// `mi_option_purge_delay`, which the binding has no name for.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    // SAFETY: it sets a number of this module's own allocator, before other threads of the module have begun.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, KEPT_MS) };
    module.add_class::<calibration::Calibration>()?;
    module.add_class::<reconstruct::Reconstructor>()?;
    module.add_class::<result::Result>()?;
    module.add_class::<session::Session>()?;
    module.add_function(wrap_pyfunction!(calibrate::calibrate, module)?)?;
    module.add_function(wrap_pyfunction!(calibrate::calibration_check, module)?)?;
    module.add_function(wrap_pyfunction!(reconstruct::reconstruct, module)?)
}
