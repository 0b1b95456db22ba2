// SPDX-License-Identifier: MIT OR Apache-2.0
//! Computes a calibration from photographs of the board (paper, section 4.2). Its file is [`crate::data::Calibration`].
//!
//! Photographs: `board` describes the board, `spots` finds its circles in an image, `lattice` identifies them, `views`
//! judges each photograph, `positions` pairs the photographs of a position, and `observed` has what comes out.
//!
//! Geometry: `placement` and `consistency` refuse what contradicts itself. `bundle` adjusts lenses and poses, `phases`
//! reads the fringes at points of the board, `orders` finds the fringe orders, and `rows` finds the panel's rows, which
//! fringes alone do not determine. `stages` and `global` are the paper's three stages on what `rigging` has, and
//! `world` places the result above the floor. `run` does all of it; `drift` measures later how devices have moved.
//!
//! `docs/design/calibration.md` has the steps and the definitions.
#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

use fourdbody_core::{base, config, data, formats, geometry};
use fourdbody_reconstruct as reconstruct;

pub mod advice;
pub mod artwork;
mod board;
mod bundle;
mod consistency;
pub mod drift;
mod ellipse;
mod estimate;
mod findings;
/// Calibrations of other programs, put into ours.
pub mod foreign;
mod gamma;
pub mod global;
pub mod guide;
pub mod joined;
mod lattice;
mod marker_check;
pub mod observed;
mod orders;
mod phases;
mod placement;
pub mod positions;
pub mod report;
pub mod rigging;
mod rows;
pub mod run;
mod spots;
mod stages;
mod start;
/// Figures of merit: clouds against the truth (paper, section 5).
pub mod validate;
pub mod views;
mod world;

pub use board::{Board, Circle};
pub use bundle::{Adjusted, DeviceModel};
pub use ellipse::{Ellipse, image_of_circle};
pub use findings::{Finding, Kind, Refusal};
pub use lattice::{Sighting, identify};
pub use observed::Position;
pub use spots::{Spot, find_spots};
pub use world::Vertical;
