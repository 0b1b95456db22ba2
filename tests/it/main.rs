// SPDX-License-Identifier: MIT OR Apache-2.0
//! Integration tests of the product: one binary, a module per subject.

#[cfg(feature = "aravis")]
mod action_triggers;
mod analytic_scene;
#[cfg(feature = "aravis")]
mod any_camera;
#[cfg(feature = "aravis")]
mod api_description;
#[cfg(feature = "aravis")]
mod api_node;
#[cfg(feature = "aravis")]
mod api_open;
#[cfg(feature = "aravis")]
mod api_security;
#[cfg(feature = "aravis")]
mod api_session;
mod architecture;
mod back_end;
mod bad_frames;
mod bad_photographs;
#[cfg(feature = "aravis")]
mod before_record;
#[cfg(feature = "aravis")]
mod before_the_start;
mod board_photographs;
mod board_to_plane;
#[cfg(feature = "aravis")]
mod breaks;
#[cfg(feature = "aravis")]
mod browser;
mod calibrate_command;
#[cfg(feature = "aravis")]
mod calibrate_live;
mod calibration_check;
#[cfg(feature = "aravis")]
mod calibration_light;
mod calibration_uncertainty;
mod calibrations_of_others;
#[cfg(feature = "aravis")]
mod camera_profiles;
#[cfg(feature = "aravis")]
mod chain;
mod cluster;
#[cfg(feature = "aravis")]
mod console;
#[cfg(feature = "aravis")]
mod console_truth;
mod crafted_files;
mod crash;
mod crossing_limbs;
#[cfg(feature = "aravis")]
mod deeper_grey;
#[cfg(feature = "aravis")]
mod disk_faults;
#[cfg(feature = "aravis")]
mod doctor;
mod documents;
#[cfg(feature = "aravis")]
mod endurance;
mod export;
#[cfg(feature = "aravis")]
mod exposure;
#[cfg(feature = "aravis")]
mod faults;
mod foreign_files;
mod foreign_records;
mod forged_recordings;
#[cfg(feature = "aravis")]
mod frame_contract;
mod frame_set;
mod fuzz_corpora;
mod hsu;
mod hsu_clock;
#[cfg(feature = "aravis")]
mod identity;
mod images_of_others;
#[cfg(feature = "aravis")]
mod input_lines;
#[cfg(feature = "aravis")]
mod json_output;
#[cfg(feature = "aravis")]
mod kills;
// Without live cameras only some of its parts are used.
#[cfg_attr(not(feature = "aravis"), allow(dead_code))]
mod lab;
mod lab_command;
mod live_preview;
#[cfg(feature = "aravis")]
mod matrix;
mod merging;
mod messages;
#[cfg_attr(not(feature = "aravis"), allow(dead_code))]
mod monitoring;
#[cfg(feature = "aravis")]
mod new_bench;
#[cfg(feature = "aravis")]
mod nonsense;
mod object_store;
#[cfg(feature = "aravis")]
mod plan_faults;
#[cfg(feature = "aravis")]
mod player;
#[cfg(feature = "aravis")]
mod playing;
#[cfg(feature = "aravis")]
mod process_limits;
mod profiles;
#[cfg(feature = "aravis")]
mod ptp_time;
mod recording;
mod recording_commands;
mod recording_damage;
mod recording_info;
mod recording_pairs;
mod recording_regions;
mod recover;
mod reference;
#[cfg_attr(not(feature = "aravis"), allow(dead_code, unused_imports))]
mod refusals;
mod release;
#[cfg(feature = "aravis")]
mod report;
mod result_files;
mod reused;
#[cfg(feature = "aravis")]
mod service;
#[cfg(feature = "aravis")]
mod session_faults;
mod shared_calibration;
mod shared_exposure;
mod shared_scene;
mod simd_paths;
mod slurm;
#[cfg(feature = "aravis")]
mod stray_frames;
#[cfg(feature = "aravis")]
mod sub_path;
#[cfg(feature = "aravis")]
mod telemetry;
mod third_party_camera;
mod third_party_loss;
mod third_party_mcap;
#[cfg(feature = "aravis")]
mod third_party_node;
#[cfg(feature = "aravis")]
mod third_party_session;
#[cfg(feature = "aravis")]
mod time_code;
#[cfg(feature = "aravis")]
mod two_nodes;
mod unread_output;
mod unreadable_disk;
mod unreadable_sessions;
#[cfg(feature = "aravis")]
mod upgrade;
mod validate_commands;
#[cfg(feature = "aravis")]
mod warm_up;
mod witness;
mod worker;
