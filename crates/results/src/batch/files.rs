// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where the files of a result are, and what they state: the same for all that write and read them.

use super::plan::Format;
use crate::base::ids::CameraId;
use crate::base::{STALE, remove_stale};
use crate::formats::{phase_file, ply};
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Numbers of triggers that a message names.
const NAMED: usize = 8;
/// Where a phase map is.
pub fn phase_path(out: &Path, camera: impl Display, trigger: u64) -> PathBuf {
    out.join("phases").join(format!("{camera}_{trigger:06}.phase"))
}

/// Where a directional cloud is.
pub fn cloud_path(out: &Path, camera: impl Display, trigger: u64) -> PathBuf {
    out.join("clouds").join(format!("{camera}_{trigger:06}.ply"))
}

/// Where a merged cloud is.
pub fn merged_path(out: &Path, trigger: u64) -> PathBuf {
    out.join("merged").join(format!("{trigger:06}.ply"))
}

/// Where a frame's cloud or map is.
pub(super) fn frame_path(out: &Path, format: Format, camera: &CameraId, trigger: u64) -> PathBuf {
    match format {
        Format::Ply => cloud_path(out, camera, trigger),
        Format::Phase => phase_path(out, camera, trigger),
    }
}

/// What the whole file of a frame states: its points and comments. `None` where there is no such file, or a damaged
/// one.
pub(super) fn stated(out: &Path, format: Format, camera: &CameraId, trigger: u64) -> Option<ply::Header> {
    let path = frame_path(out, format, camera, trigger);
    match format {
        Format::Ply => ply::load_whole_header(&path).ok(),
        Format::Phase => phase_file::load_statement(&path).ok().map(|stored| ply::Header {
            points: stored.points,
            merged: false,
            sigma: false,
            comments: stored.comments,
        }),
    }
}

/// The time of a trigger where none is known: by index at this rate, from 0 on, ns.
pub fn time_by_index_ns(trigger: u64, rate_hz: f64) -> u64 {
    (trigger as f64 * 1e9 / rate_hz).round() as u64
}

/// The comment that names the cameras that a directional cloud depends on.
pub(crate) fn cameras_comment<'a>(cameras: impl Iterator<Item = &'a CameraId>) -> String {
    format!("together {}", cameras.map(CameraId::as_str).collect::<Vec<_>>().join(" "))
}

/// Where the summary of a run, or of one of its shards, is: `summary.json`, or `summary-0-of-4.json`.
pub fn summary_path(out: &Path, shard: Option<(u64, u64)>) -> PathBuf {
    match shard {
        None => out.join("summary.json"),
        Some((i, n)) => out.join(format!("summary-{i}-of-{n}.json")),
    }
}

/// Removes temporary files that killed processes have left in a result's directories, as far as that goes.
pub fn remove_leftovers(out: &Path) {
    for folder in [".", "clouds", "merged", "phases"] {
        // A directory that is not there has none.
        let _ = remove_stale(&out.join(folder), STALE);
    }
}

/// Triggers as a message names them.
pub fn named(list: &[u64]) -> String {
    let some: Vec<String> = list.iter().take(NAMED).map(u64::to_string).collect();
    match (list.len(), list.len().saturating_sub(NAMED)) {
        (0, _) => "none".to_owned(),
        (1, _) => format!("trigger {}", some.join("")),
        (_, 0) => format!("triggers {}", some.join(", ")),
        (_, more) => format!("triggers {} and {more} more", some.join(", ")),
    }
}
