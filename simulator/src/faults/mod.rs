// SPDX-License-Identifier: MIT OR Apache-2.0
//! Faults on purpose: what is injected, where, and what a recording must state about it afterwards.
//!
//! ```text
//! [plan] seed, camera, trigger -> fault -> gige: sends it so -> [truth] one JSON line per fault
//! crate::disk: slow, full, failing disks ------------------------^  ([disk])
//!                                       recordings + truth   -> [check] counts per kind, mismatches
//! ```
//!
//! `docs/design/faults.md` has the table of faults and the reasons for what is expected.

pub mod check;
mod check_links;
mod check_rows;
pub mod disk;
pub mod hsu_plan;
mod pixels;
pub mod plan;
pub mod truth;

pub use check::{Accounting, Shown, Tally, check, check_with_disks};
pub use disk::{DiskEvent, DiskFault};
pub use hsu_plan::{HsuFault, HsuKind, HsuPlan};
pub use plan::{CameraPlan, Fault, FaultPlan, Kind, NamedFault, Part, PlanError, Resend};
pub use truth::{Injected, TruthLog, read_disk_truth, read_truth};

use std::sync::Arc;

/// What one camera needs to inject faults.
#[derive(Debug, Clone)]
pub struct CameraFaults {
    /// What to inject; the same for all cameras.
    pub plan: Arc<FaultPlan>,
    /// The camera's name in the rig: seeds its faults, and names it in the truth.
    pub camera: String,
    /// Where what was injected is written down.
    pub truth: Arc<TruthLog>,
}

/// What the HSU needs to inject faults.
#[derive(Debug, Clone)]
pub struct HsuFaults {
    pub plan: Arc<FaultPlan>,
    /// The node at the other end of each line.
    pub nodes: Vec<String>,
    /// Where what was injected is written down.
    pub truth: Arc<TruthLog>,
}
