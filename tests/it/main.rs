//! Integration tests of the product: one binary, a module per subject.

mod analytic_scene;
mod architecture;
mod chain;
mod hsu;
mod lab;
mod recording;
mod recording_commands;
mod recording_damage;
mod refusals;
mod shared_scene;
mod third_party_camera;
mod third_party_mcap;
#[cfg(feature = "aravis")]
mod third_party_node;
