// SPDX-License-Identifier: MIT OR Apache-2.0
//! What everything stands on: identifiers and files, lenses and patterns, configuration, what flows between parts,
//! formats.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

/// Identifiers, images, clocks, files written whole, and how a command ends.
pub mod base;
/// Configuration files, read and validated with all problems at once.
pub mod config;
/// What flows between the parts: frames, phase maps, clouds, calibrations.
pub mod data;
/// File formats of clouds and phase maps.
pub mod formats;
/// Lenses, poses and the projected pattern.
pub mod geometry;
