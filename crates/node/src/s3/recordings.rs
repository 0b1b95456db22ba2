// SPDX-License-Identifier: MIT OR Apache-2.0
//! The part of a session's recordings that a run reads, from the store to a scratch directory.

use super::remote::{Object, Remote};
use crate::base::ids::CameraId;
use crate::record::{copy_frames, is_segment};
use std::path::Path;

/// Copies the indexes of all segments, and the frames that are wanted, into the directory `to`, which appears when all
/// are there and which `SessionReader::open_frames` reads. Returns the bytes fetched. Recordings never change: what is
/// there already is kept.
pub fn stage(
    remote: &Remote,
    to: &Path,
    wanted: &(dyn Fn(&CameraId, u64) -> bool + Sync),
) -> Result<u64, String> {
    if to.exists() {
        return Ok(0);
    }
    let segments = segments(remote)?;
    if segments.is_empty() {
        return Err(format!("{}: no recording is there, expected node-*/segment-*.mcap", remote.location()));
    }
    let partial = to.with_extension("partial");
    let failed = |path: &Path, e: std::io::Error| format!("{}: {e}", path.display());
    if partial.exists() {
        std::fs::remove_dir_all(&partial).map_err(|e| failed(&partial, e))?;
    }
    let mut bytes = 0;
    for Object { name, size } in &segments {
        let path = partial.join(name);
        let folder = path.parent().unwrap_or(&partial);
        std::fs::create_dir_all(folder).map_err(|e| failed(folder, e))?;
        let read = |range| remote.read(name, range);
        bytes += super::with_many_requests(|| copy_frames(*size, &read, &path, wanted))?;
    }
    std::fs::rename(&partial, to).map_err(|e| failed(to, e))?;
    Ok(bytes)
}

/// The segments of all nodes, or of the one recording that the location is.
fn segments(remote: &Remote) -> Result<Vec<Object>, String> {
    let (mut found, folders) = remote.list("")?;
    for folder in folders.iter().filter(|name| name.starts_with("node-")) {
        found.extend(remote.list(folder)?.0);
    }
    let file = |object: &Object| object.name.rsplit('/').next().is_some_and(is_segment);
    found.retain(file);
    Ok(found)
}
