//! Integration tests of the product: one binary, a module per subject.

mod analytic_scene;
mod architecture;
mod board_to_plane;
#[cfg(feature = "aravis")]
mod breaks;
#[cfg(feature = "aravis")]
mod chain;
#[cfg(feature = "aravis")]
mod doctor;
#[cfg(feature = "aravis")]
mod endurance;
#[cfg(feature = "aravis")]
mod faults;
mod fuzz_corpora;
mod hsu;
// Without live cameras only some of its parts are used.
#[cfg_attr(not(feature = "aravis"), allow(dead_code))]
mod lab;
mod recording;
mod recording_commands;
mod recording_damage;
mod recover;
#[cfg_attr(not(feature = "aravis"), allow(dead_code, unused_imports))]
mod refusals;
#[cfg(feature = "aravis")]
mod session_faults;
mod shared_calibration;
mod shared_scene;
mod third_party_camera;
mod third_party_loss;
mod third_party_mcap;
#[cfg(feature = "aravis")]
mod third_party_node;
#[cfg(feature = "aravis")]
mod third_party_session;
