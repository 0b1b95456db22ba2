// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node file's keys for a camera, expressed in the camera's own features: a pure function of its description.
//!
//! Names follow rules (SFNC 2, SFNC 1, GigE Vision before SFNC), not tables of models: docs/design/camera-profiles.md.

mod action;
mod gain;
mod image;
mod must;
mod plan;
mod time;
mod trigger;

pub use action::PTP_SWITCHES;
pub use image::uneven_rows;
pub use must::{Must, Want, all as must_be};
pub use plan::{Amount, Link, Plan, Scale, Trouble, Wishes, Write};
pub use trigger::{FRAME_TRIGGERS, OFF, ON, frame_trigger, starts_a_frame, trigger_lines};

use crate::camera::description::{Description, Feature};

/// Translates the node file's keys into writes to a camera's features.
pub fn resolve(camera: &dyn Description, wishes: &Wishes) -> Plan {
    let mut plan = Plan::default();
    image::resolve(camera, wishes, &mut plan);
    time::exposure(camera, wishes, &mut plan);
    gain::resolve(camera, wishes, &mut plan);
    time::packet_delay(camera, wishes, &mut plan);
    // Last, because a trigger that is on may lock the features that are set before.
    trigger::resolve(camera, wishes, &mut plan);
    plan
}

/// The selection and the command that load a camera's factory settings, where it has them.
pub fn known_state(camera: &dyn Description) -> Option<(Write, &'static str)> {
    const LOAD: &str = "UserSetLoad";
    let selector = camera.feature("UserSetSelector")?;
    camera.feature(LOAD).filter(Feature::is_writable)?;
    let entry = selector.entry(&["Default", "Factory", "FactoryDefault", "UserSetDefault", "Standard"])?;
    Some((Write::entry("UserSetSelector", entry, "").optional(), LOAD))
}

#[cfg(test)]
pub(crate) mod tests;
