// SPDX-License-Identifier: MIT OR Apache-2.0
//! The outcome of setting a bench up: its cameras, and what an operator should know of them.

use super::delays::Delays;
use super::found::Found;
use super::lines::BenchCamera;
use super::roles::{Known, Role};
use crate::base::ids::CameraId;
use serde::Serialize;
use std::path::PathBuf;

/// A camera as it was set up.
#[derive(Debug, Clone, Serialize)]
pub struct NamedCamera {
    pub id: CameraId,
    pub device: Found,
    /// How it is known which camera of the rig it is.
    pub named: Known,
    /// The line that the HSU is wired to; `None` where raw settings name it, or it was not found.
    pub trigger_line: Option<String>,
    /// The number of the head whose pulse it answers.
    pub head: Option<usize>,
    /// From the edge of the pulse to the frame's timestamp, us.
    pub stamp_us: Option<f64>,
    /// From the edge of the pulse to the first packet, us.
    pub arrival_us: Option<f64>,
    /// The largest packet that arrives, bytes.
    pub largest_packet_bytes: Option<u32>,
    /// Frames at the rig's rate, and the number of triggers that they are of.
    pub frames_at_rate: Option<(usize, u32)>,
    /// The file with a picture of it.
    pub picture: Option<PathBuf>,
}

impl NamedCamera {
    /// A camera without its picture; without a `bench` it was not measured.
    pub fn of(role: &Role, device: Found, bench: Option<&BenchCamera>) -> Self {
        let wired = bench.and_then(|bench| bench.wired.as_ref());
        Self {
            id: role.id.clone(),
            device,
            named: role.known,
            trigger_line: wired.and_then(|wired| wired.line.clone()),
            head: wired.map(|wired| wired.delays.head),
            stamp_us: wired.and_then(|wired| wired.delays.stamp_us),
            arrival_us: wired.map(|wired| wired.delays.arrival_us),
            largest_packet_bytes: bench.and_then(|bench| bench.largest),
            frames_at_rate: bench.and_then(|bench| bench.frames_at_rate),
            picture: None,
        }
    }
}

/// The outcome of [`set_up`](super::set_up): cameras, problems and remarks.
#[derive(Debug, Clone, Serialize)]
pub struct Outcome {
    /// The node file, which is written even where there are problems.
    pub file: PathBuf,
    /// The cameras, in the rig's order.
    pub cameras: Vec<NamedCamera>,
    /// What keeps the bench from being used.
    pub problems: Vec<String>,
    /// Remarks that the operator should read.
    #[serde(rename = "told")]
    pub notes: Vec<String>,
}

/// The comment above a camera's entry in the node file.
pub fn comment(found: &Found, known: Known, delays: Option<Delays>) -> String {
    let who = format!("{} {} {}", found.vendor, found.model, found.serial);
    let named = if known == Known::InOrder { ", named in the order of serial numbers" } else { "" };
    let Some(Delays { stamp_us, arrival_us, .. }) = delays else {
        return format!("{who}{named}: no frame yet");
    };
    let stamp = stamp_us.map_or("no stamp".to_owned(), |us| format!("stamp {:.1} ms", us / 1000.0));
    format!("{who}{named}: {stamp} and first packet {:.1} ms after the edge", arrival_us / 1000.0)
}
