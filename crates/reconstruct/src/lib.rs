// SPDX-License-Identifier: MIT OR Apache-2.0
//! Photographs of projected fringes to points: one photograph of each camera, taken at one instant, becomes a cloud of
//! points in metres with intensity and normal (4DBODY paper, section 4.1).
//!
//! # Where to start
//!
//! [`Reconstructor`] is all that most programs need:
//!
//! ```no_run
//! use fourdbody_core::base::image::{Mono8, Plane};
//! use fourdbody_core::data::Calibration;
//! use fourdbody_reconstruct::Reconstructor;
//! use std::{collections::BTreeMap, path::Path};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let photographs: BTreeMap<String, Plane<u8>> = BTreeMap::new();
//! let calibration = Calibration::load(Path::new("calibration.json"))?;
//! let reconstructor = Reconstructor::new(&calibration)?;
//! let results = reconstructor.reconstruct(|camera| photographs.get(camera.as_str()).map(Mono8::from));
//! let body = reconstructor.merge(&results);
//! println!("{} points", body.len());
//! # Ok(())
//! # }
//! ```
//!
//! `examples/points.rs` is this as a program: a calibration and PNG files in, a PLY file out. A calibration comes from
//! `fourdbody calibrate`; `docs/design/calibration.md` describes it.
//!
//! # What it promises
//!
//! - **A point has the right fringe order, or it is left out.** The orders of all cameras are found together
//!   ([`fringe_order`]); what is not certain is refused.
//! - **The same photographs and calibration give the same bytes**, on any number of threads and with any vector
//!   instructions of the processor.
//! - **It knows of nothing else**: no recordings, cameras, networks or asynchronous code.
//!
//! # The parts
//!
//! The folders follow Figure 5 of the paper, from the object mask to the points. [`pipeline`] runs the stages of one
//! frame, [`frame_set`] those of all frames of a trigger, [`merge`] makes one cloud of the cameras' clouds, and
//! [`paper`] is the paper's own method in plain loops, to compare with. `docs/design/reconstruction.md` describes the
//! stages.
//!
//! Lengths are metres, angles and phases radians. A pixel is (u, v): u is the column, integers are pixel centres.

#[cfg(test)]
mod constants_tests;
#[cfg(test)]
use fourdbody_core::config;
use fourdbody_core::{base, data, formats, geometry};

pub mod counts;
pub mod frame_set;
pub mod fringe_order;
pub(crate) mod kernels;
pub mod marker;
pub(crate) mod mask;
pub mod merge;
pub mod outcome;
pub mod paper;
pub(crate) mod phase;
pub mod pipeline;
pub mod reconstructor;
pub(crate) mod refine;
pub mod triangulate;
pub(crate) mod wrapped_phase;

pub use reconstructor::Reconstructor;
