// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session reconstructed to a directory: which frames, on which threads, what is written, and how it is resumed.
//!
//! [`run`] is the work; [`key`] states what a result depends on, so that only the same work is continued.

/// Whether the files of a result are of that result.
pub mod belonging;
/// Frames of fewer rows, and their calibration.
pub mod binned;
/// The shards of a session to one result.
pub mod collect_shards;
/// The maps of a frame as pictures, for people.
pub mod dump_maps;
/// Where the files of a result are, and what they state.
pub mod files;
/// Stored phase maps to clouds.
pub mod from_phase_maps;
/// Directories of images with other names.
pub mod image_names;
/// Directories of images, `DIR/CAMERA/INDEX.png`, and what in them is a frame.
pub mod image_tree;
/// What a result is made of.
pub mod key;
/// What a run is to do.
pub mod plan;
/// Frames that are read from PNG files.
pub mod png_source;
/// What a reconstruction wrote, as clouds.
pub mod result;
/// A session to clouds on disk.
pub mod run;
/// Frames that show another trigger are refused.
pub mod strangers;
/// What a reconstruction has come to.
pub mod summary;
/// What a run has taken.
pub mod timings;
mod unchecked;
/// What stands before and behind a run of a whole session.
pub mod whole;
/// Whether a frame shows its own trigger.
pub mod witness;
