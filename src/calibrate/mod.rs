//! Calibrations: the versioned file, and its computation from photographs of a board (paper, section 4.2).
//!
//! `board` describes the artefact, `spots` finds its circles in an image, `lattice` tells which is which.

mod board;
mod bundle;
mod ellipse;
mod file;
mod lattice;
mod spots;
pub mod stages;
mod start;
pub mod views;

pub use board::{Board, Circle};
pub use bundle::{AdjustError, Adjusted, DeviceModel, Model, Observation, Prior, adjust};
pub use ellipse::{Ellipse, image_of_circle};
pub use file::{CalibratedCamera, CalibratedHead, Calibration, CalibrationError};
pub use lattice::{NotIdentified, Sighting, identify};
pub use spots::{Spot, find_spots};
