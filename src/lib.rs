// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody`: an open-source 4D human-body scanner.
//!
//! Eight cameras photograph fringes projected on a moving person; every photograph becomes a metric point
//! cloud. The flow of data, and the folder that owns each step:
//!
//! ```text
//! trigger -> camera -> [camera] Aravis buffer -> [acquire] receiver -> [matcher] trigger -> [record] writer -> MCAP
//! MCAP -> [record] reader (pread) -> [reconstruct] phase maps, clouds -> [batch] files -> [export] other formats
//! operator -> [cmds] CLI -> [api] HTTP -> [node] state machine -> [hsu] serial link + [camera]
//! ```
//!
//! `ARCHITECTURE.md` has the folders in their order, from the ground up: each names only those before it.

// First: what follows prints by its macros.
/// Identifiers, images, clocks, files written whole, and how a command ends.
#[macro_use]
pub mod base;
/// Frames from cameras to the writer: receivers, accounting, bounded hand-offs.
pub mod acquire;
/// The node's HTTP server.
pub mod api;
/// A session reconstructed to a directory of results.
pub mod batch;
/// Photographs of the board to a calibration (paper, section 4.2).
pub mod calibrate;
/// Cameras: settings, and streams through Aravis.
pub mod camera;
/// A capture over all nodes, from whichever of them it is run.
pub mod capture;
/// A reconstruction spread over a cluster.
pub mod cluster;
/// One file per command of the command line.
pub mod cmds;
/// Configuration files, read and validated with all problems at once.
pub mod config;
/// What both sides of the API speak: requests, status, tokens, and the client.
pub mod control;
/// What flows between the parts: frames, phase maps, clouds, calibrations.
pub mod data;
/// Is this host fit for its cameras' rate?
pub mod doctor;
/// Clouds, meshes, pictures and tables in the formats of other programs.
pub mod export;
/// File formats of clouds and phase maps.
pub mod formats;
/// Lenses, poses and the projected pattern.
pub mod geometry;
/// What is asked of Linux: real-time threads, locked memory, idle processes.
pub mod host;
/// The serial link to the hardware synchronization unit.
pub mod hsu;
/// The body of all cameras while they run.
pub mod live;
/// Which trigger a frame belongs to, by two witnesses.
pub mod matcher;
/// Directional clouds to merged clouds.
pub mod merge;
/// This host's network interfaces, and the cameras that answer on them.
pub mod network;
/// A new bench, step by step, to a node file.
pub mod new_bench;
/// One session on one node: the state machine and the threads that carry it out.
pub mod node;
/// A reconstructed session as frame sets for a player.
pub mod play;
/// Pictures of the cameras while they run, and quick looks at what was recorded.
pub mod preview;
/// One frame to one point cloud: the phase pipeline (paper, section 4.1).
pub mod reconstruct;
/// Recordings: layout, writer, reader, verification, recovery.
pub mod record;
/// A session on one page.
pub mod report;
/// Recordings and results in an object store.
pub mod s3;
/// What the service manager is told.
pub mod systemd;
/// What a running node counts: metrics, and thresholds that judge them.
pub mod telemetry;
/// Figures of merit: clouds against the truth (paper, section 5).
pub mod validate;
/// Reconstructs what was recorded, by itself, when nothing else is to be done.
pub mod worker;
