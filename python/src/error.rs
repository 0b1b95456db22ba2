// SPDX-License-Identifier: MIT OR Apache-2.0
//! Faults as the Python exception `fourdbody.Error`, with the exit code that the command line would have.

use fourdbody_core::base::{Exit, Fault};
use pyo3::prelude::*;
use pyo3::types::PyType;

/// The exception of a fault.
pub fn raise(py: Python<'_>, fault: &Fault) -> PyErr {
    let class =
        || py.import("fourdbody.errors")?.getattr("Error")?.cast_into::<PyType>().map_err(PyErr::from);
    match class() {
        Ok(class) => PyErr::from_type(class, (fault.message.clone(), fault.exit)),
        Err(error) => error,
    }
}

/// Errors of the library crates as exceptions.
pub trait OrRaise<T> {
    /// As an exception of this exit code.
    fn or_raise(self, py: Python<'_>, exit: Exit) -> PyResult<T>;
}

impl<T, E: ToString> OrRaise<T> for std::result::Result<T, E> {
    fn or_raise(self, py: Python<'_>, exit: Exit) -> PyResult<T> {
        self.map_err(|error| raise(py, &Fault::new(exit, error)))
    }
}
