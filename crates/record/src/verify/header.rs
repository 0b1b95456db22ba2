// SPDX-License-Identifier: MIT OR Apache-2.0
//! The header against the rig file that it repeats: which cameras are this node's.

use super::findings::{Notes, Severity};
use crate::reader::RecordingReader;
use crate::recover::is_of_damaged;
use crate::session::parse_rig;

/// Severity of a contradiction to the header: that of a copy of a damaged recording may have been damaged.
pub fn severity(recording: &RecordingReader) -> Severity {
    if is_of_damaged(recording) { Severity::Unconfirmed } else { Severity::Corrupt }
}

/// Each camera is one of the rig's, and of this node. A rig file that cannot be read is not used.
pub fn check(recording: &RecordingReader, notes: &mut Notes) {
    let header = &recording.header;
    let Ok(rig) = parse_rig(&header.rig_text) else { return };
    for camera in &header.cameras {
        let message = match rig.cameras().find(|(_, known)| known.id == camera.id) {
            Some((_, known)) if known.node == header.node => continue,
            Some((_, known)) => format!("is recorded here, but by the rig file it is node {}'s", known.node),
            None => "is recorded, but the rig file does not have it".to_owned(),
        };
        notes.add(severity(recording), None, Some(&camera.id), None, message);
    }
}
