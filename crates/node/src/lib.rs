// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node: its session, its HTTP server, its console's pictures, its worker, and a capture over all nodes.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

use fourdbody_calibrate as calibrate;
use fourdbody_core::{base, config, data};
use fourdbody_devices::{acquire, camera, hsu};
use fourdbody_reconstruct as reconstruct;
use fourdbody_record::{self as record, host, matcher};
use fourdbody_results::batch;

/// The node's HTTP server, with its console.
pub mod api;
/// A capture over all nodes, from whichever of them it is run.
pub mod capture;
/// What both sides of the API speak: requests, status, tokens, and the client.
pub mod control;
/// The body of all cameras while they run.
pub mod live;
/// One session on one node: the state machine and the threads that carry it out.
pub mod node;
/// A reconstructed session as frame sets for a player.
pub mod play;
/// Pictures of the cameras while they run, and quick looks at what was recorded.
pub mod preview;
/// A session on one page.
pub mod report;
/// Recordings and results in an object store.
pub mod s3;
/// Readiness, status and watchdog of the service manager.
pub mod systemd;
/// A process of this program that may be ended at any moment.
mod task;
/// What a running node counts: metrics, and thresholds that judge them.
pub mod telemetry;
/// Reconstructs what was recorded, by itself, when nothing else is to be done.
pub mod worker;
