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

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

pub use fourdbody_calibrate::{self as calibrate, validate};
pub use fourdbody_core::{base, config, data, geometry};
pub use fourdbody_devices::{acquire, camera, hsu, network};
pub use fourdbody_node::{
    api, capture, control, live, node, play, preview, report, s3, systemd, telemetry, worker,
};
pub use fourdbody_reconstruct::{self as reconstruct, merge};
pub use fourdbody_record::{self as record, host, matcher};
pub use fourdbody_results::{batch, calibrating, cluster, export, formats};

// First: what follows prints by its macros.
#[macro_use]
mod print;

/// One file per command of the command line.
pub mod cmds;
/// Is this host fit for its cameras' rate?
pub mod doctor;
/// A new bench, step by step, to a node file.
pub mod new_bench;
