// SPDX-License-Identifier: MIT OR Apache-2.0
//! The header that is used, and one that is rebuilt where none is readable.
//!
//! A segment's header has a checksum of its own (`crc32`), those of older recordings only the data section's, which
//! only a closed segment has. Frames do not depend on it: their envelopes name the camera.

use super::salvage::{SegmentScan, SmallRecord};
use crate::base::ids::{CameraId, NodeId, SessionName};
use crate::layout::{CameraHeader, HsuIdentity, KEY_RIG, MAX_CAMERAS, RecordingHeader};
use crate::metadata::{StatedHeader, of_most};
use crate::session::parse_rig;
use std::collections::BTreeSet;
use std::path::Path;

/// The recording's header and whether a checksum proves it: of the segments that belong together, the one that is
/// proven, else the one that most have.
pub fn readable(scans: &[SegmentScan]) -> Option<(RecordingHeader, bool)> {
    let stated: Vec<&StatedHeader> = scans.iter().filter_map(|scan| scan.header.as_ref()).collect();
    let most = of_most(&stated)?;
    let own: Vec<&StatedHeader> = stated.into_iter().filter(|one| !one.is_foreign(&most)).collect();
    if let Some(proven) = own.iter().find(|one| one.proven) {
        return Some((proven.header.clone(), true));
    }
    let count = |one: &StatedHeader| own.iter().filter(|other| other.header == one.header).count();
    // `max_by_key` takes the last one of equals.
    let chosen = own.iter().rev().max_by_key(|one| count(one))?;
    Some((corrected(chosen.header.clone(), scans), false))
}

/// Name and size of all cameras that frames are of, in the order in which they appear.
fn cameras_of(scans: &[SegmentScan]) -> Vec<&(String, u32, u32)> {
    let mut known = BTreeSet::new();
    scans.iter().flat_map(|scan| &scan.cameras).filter(|camera| known.insert(*camera)).collect()
}

/// A header without proof, corrected by what the frames' envelopes prove (names and sizes), and by records that only an
/// HSU makes.
fn corrected(mut header: RecordingHeader, scans: &[SegmentScan]) -> RecordingHeader {
    let seen = cameras_of(scans);
    let mut unknown: Vec<_> =
        seen.iter().filter(|seen| !header.cameras.iter().any(|c| c.id.as_str() == seen.0)).collect();
    for camera in &mut header.cameras {
        let mut own = seen.iter().filter(|seen| seen.0 == camera.id.as_str());
        match (own.next(), own.next()) {
            (Some((_, width, height)), None) => (camera.width, camera.height) = (*width, *height),
            (None, None) if unknown.len() == 1 => {
                if let Some((name, width, height)) = unknown.pop() {
                    (camera.id, camera.width, camera.height) = (CameraId(name.clone()), *width, *height);
                }
            }
            _ => {}
        }
    }
    if header.hsu.is_none() && has_hsu(scans) {
        header.hsu = Some(HsuIdentity::default());
    }
    header
}

/// Whether an HSU counted the triggers: images that were imported have neither a trigger table nor readings of clocks.
fn has_hsu(scans: &[SegmentScan]) -> bool {
    let of_hsu = |record: &SmallRecord| matches!(record, SmallRecord::Trigger(_) | SmallRecord::Clock(_));
    scans.iter().flat_map(|scan| &scan.records).any(|one| of_hsu(&one.record))
}

/// A header from what is left: entries of the damaged one, the frames, the trigger table, the directory's name.
/// `None` without a single frame. What cannot be known stays empty.
pub fn rebuilt(path: &Path, scans: &[SegmentScan]) -> Option<RecordingHeader> {
    let entry = |key: &str| scans.iter().find_map(|scan| scan.header_entries.get(key).cloned());
    let name = |path: Option<&Path>| path?.file_name()?.to_str().map(str::to_owned);
    let node = entry("node").or_else(|| name(Some(path))?.strip_prefix("node-").map(str::to_owned));
    let session = entry("session").or_else(|| name(path.parent()));
    let safe = |text: Option<String>| text.filter(|text| SessionName::parse(text).is_ok());
    let node = NodeId(safe(node).unwrap_or_else(|| "unknown".to_owned()));
    let rig_text = entry(KEY_RIG).unwrap_or_default();
    let cameras = cameras_from_frames(&rig_text, scans)?;
    let header = RecordingHeader {
        session: SessionName(safe(session).unwrap_or_else(|| "unknown".to_owned())),
        session_id: entry("session_id").unwrap_or_default(),
        node,
        cameras,
        hsu: has_hsu(scans).then(HsuIdentity::default),
        expected_triggers: None,
        trigger_rate_hz: rate(&rig_text, scans),
        host_clock: "unknown".to_owned(),
        created_ns: scans
            .iter()
            .flat_map(SegmentScan::triggers)
            .map(|row| row.host_time_ns)
            .min()
            .unwrap_or(0),
        software: "unknown".to_owned(),
        subject: None,
        note: None,
        rig_text,
    };
    header.check().is_ok().then_some(header)
}

/// The cameras that frames are of, in the rig's order where there is a rig.
fn cameras_from_frames(rig_text: &str, scans: &[SegmentScan]) -> Option<Vec<CameraHeader>> {
    let seen = cameras_of(scans);
    let camera = |(name, width, height): &(String, u32, u32)| CameraHeader {
        id: CameraId(name.clone()),
        width: *width,
        height: *height,
        device: String::new(),
        pixel_format: String::new(),
        settings: Vec::new(),
        state: std::collections::BTreeMap::new(),
    };
    let mut cameras: Vec<CameraHeader> = seen.into_iter().map(camera).take(MAX_CAMERAS).collect();
    let mut ids = BTreeSet::new();
    cameras.retain(|camera| ids.insert(camera.id.clone()));
    if let Ok(rig) = parse_rig(rig_text) {
        let order: Vec<CameraId> = rig.cameras().map(|(_, camera)| camera.id.clone()).collect();
        cameras.sort_by_key(|camera| order.iter().position(|id| *id == camera.id).unwrap_or(usize::MAX));
    }
    (!cameras.is_empty()).then_some(cameras)
}

/// Triggers per second, by the rig or by the trigger table; 0 if neither is left.
fn rate(rig_text: &str, scans: &[SegmentScan]) -> f64 {
    if let Ok(rig) = parse_rig(rig_text) {
        return rig.trigger_rate_hz;
    }
    let rows = || scans.iter().flat_map(SegmentScan::triggers);
    let (Some(first), Some(last)) = (rows().min_by_key(|row| row.index), rows().max_by_key(|row| row.index))
    else {
        return 0.0;
    };
    let periods = last.index.0.saturating_sub(first.index.0);
    let ns = last.hsu_time_ns.saturating_sub(first.hsu_time_ns);
    if periods == 0 || ns == 0 { 0.0 } else { periods as f64 * 1e9 / ns as f64 }
}

/// Takes over from another node's recording of the session what a rebuilt header does not have, and one that is not
/// proven may have wrong. Either the id or the name of the session has to agree.
pub fn adopt(rebuilt: &mut RecordingHeader, other: &RecordingHeader) {
    let known = !rebuilt.session_id.is_empty();
    if known && rebuilt.session_id != other.session_id && rebuilt.session != other.session {
        return;
    }
    rebuilt.session_id.clone_from(&other.session_id);
    rebuilt.session.clone_from(&other.session);
    rebuilt.rig_text.clone_from(&other.rig_text);
    rebuilt.trigger_rate_hz = other.trigger_rate_hz;
    rebuilt.expected_triggers = other.expected_triggers;
}
