//! Calibrations: the versioned file (and, later, its computation from images).

mod file;

pub use file::{CalibratedCamera, CalibratedHead, Calibration, CalibrationError};
