//! Calibrations: the versioned file, and its computation from photographs of a board (paper, section 4.2).
//!
//! `board` describes the artefact, `spots` finds its circles in an image, `lattice` tells which is which, `views` sorts
//! the photographs, `bundle` adjusts lenses and poses, `stages` are the paper's three, `run` is all of it.

pub mod artwork;
mod board;
mod bundle;
mod ellipse;
mod file;
mod lattice;
pub mod run;
mod spots;
pub mod stages;
mod start;
pub mod views;

pub use board::{Board, Circle};
pub use bundle::{AdjustError, Adjusted, DeviceModel, Model, Observation, Prior, adjust};
pub use ellipse::{Ellipse, image_of_circle};
pub use file::{
    CalibratedCamera, CalibratedHead, Calibration, CalibrationError, CameraResiduals, DeviceUncertainty,
    HeadLink, Quality,
};
pub use lattice::{NotIdentified, Sighting, identify};
pub use spots::{Spot, find_spots};
