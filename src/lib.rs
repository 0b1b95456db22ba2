//! `fourdbody`: an open-source 4D human-body scanner.
//!
//! Eight cameras photograph fringes projected on a moving person; every photograph becomes a metric point
//! cloud. The flow of data, and the module that owns each step:
//!
//! ```text
//! trigger -> camera -> [camera] Aravis buffer -> [acquire] matcher -> ring -> [record] writer -> MCAP
//! MCAP -> [record] reader (pread) -> [reconstruct] phase pipeline -> clouds -> [export] PLY, MCAP, PNG
//! operator -> [cmds] CLI -> [api] HTTP -> [session] state machine -> [hsu] serial link + [camera]
//! ```
//!
//! `ARCHITECTURE.md` is the code map, with what each part may not know.

// First: what follows prints by its macros.
#[macro_use]
mod print;

/// Frames from cameras to the writer: buffer pool, trigger matching, bounded hand-offs.
pub mod acquire;
/// The node's HTTP control API: data transfer objects, server, client.
pub mod api;
/// Work that nothing waits for, in processes of its own.
pub mod background;
/// Calibrations: the versioned file, and (later) its computation from images.
pub mod calibrate;
/// Cameras: settings, and streams through Aravis.
pub mod camera;
/// A reconstruction spread over a cluster.
pub mod cluster;
/// One file per command of the command line.
pub mod cmds;
/// Configuration files, read and validated with all problems at once.
pub mod config;
/// Is this host fit for its cameras' rate?
pub mod doctor;
/// Point clouds and pictures on their way out: PLY, MCAP, PNG.
pub mod export;
/// Lens models, rigid transforms and the triangulating devices.
pub mod geometry;
/// Histograms of durations.
pub mod histogram;
/// The serial link to the hardware synchronization unit.
pub mod hsu;
/// Identifiers that must not be mixed up.
pub mod ids;
/// Row-major image planes and grey PNG files.
pub mod image;
/// The projected pattern: sine fringes and the marker.
pub mod pattern;
/// Pictures of the cameras while they run, and quick looks at what was recorded.
pub mod preview;
/// One frame to one point cloud: the phase pipeline.
pub mod reconstruct;
/// Recordings: layout, writer, reader, verification.
pub mod record;
/// A session on one page.
pub mod report;
/// Recordings and results in an object store.
pub mod s3;
/// What the service manager is told.
pub mod service;
/// One capture on one node: the state machine and its driver.
pub mod session;
/// What a running node counts: metrics, and thresholds that judge them.
pub mod telemetry;
/// The host's clocks.
pub mod time;
/// Figures of merit: clouds against the truth.
pub mod validate;
/// Reconstructs what was recorded, by itself, when nothing else is to be done.
pub mod worker;
