// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the projector's panel to pixel values: `docs/design/simulated-light.md` has the equations.

mod expose;
mod lamp;
#[cfg(test)]
mod physics_tests;
pub mod render;
mod sensor;
mod tiles;

pub use expose::{Exposure, blur, expose};
pub use lamp::{Lamp, PanelLight};
pub use render::{Irradiance, Studio};
pub use sensor::{RoomLight, Sensor};
