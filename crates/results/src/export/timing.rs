// SPDX-License-Identifier: MIT OR Apache-2.0
//! When every frame of a session was, as a table of comma-separated values (RFC 4180): a row a trigger and camera.
//!
//! | column | is |
//! |---|---|
//! | `trigger` | trigger index |
//! | `camera`, `node` | names in the rig; no node where its recording cannot be read |
//! | `outcome` | `frame`, the cause of a gap, or `damaged` |
//! | `block_id` | as the camera sent it |
//! | `camera_time_ns` | begin of the exposure, the camera's clock; with PTP of the scale `ptp_scale`, else since it was switched on |
//! | `host_time_ns` | arrival of the frame, the node's clock: UTC |
//! | `hsu_time_ns` | the trigger, the HSU's clock: since it was switched on |
//! | `hsu_host_time_ns` | arrival of the HSU's report, the node's clock: UTC |
//! | `ptp_time_ns`, `ptp_open_ns`, `ptp_camera` | the trigger on the cameras' PTP clock, what is open to either side, and by whom |
//! | `ptp_scale` | what that clock counts: `TAI` (PTP's own scale), `UTC`, or `own` for neither |
//! | `time_code` | of the trigger, `HH:MM:SS:FF.fff`; with drop frame `HH:MM:SS;FF.fff` |
//!
//! TAI and UTC are nanoseconds since 1970-01-01 00:00:00 of the scale; UTC without leap seconds. What is not known is
//! empty.

use super::ptp::{PtpInstant, PtpTime};
use crate::base::ids::{CameraId, TriggerIndex};
use crate::record::{FrameMeta, SessionReader, TimeCodeLine};
use std::io::{self, Write};
use std::ops::Range;

/// The first line of the table: the names of its columns.
pub const HEADER: &str = "trigger,camera,node,outcome,block_id,camera_time_ns,host_time_ns,hsu_time_ns,hsu_host_time_ns,time_code,\
     ptp_time_ns,ptp_open_ns,ptp_camera,ptp_scale";

/// The numbers of rows by outcome.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Rows {
    pub frames: usize,
    pub gaps: usize,
    /// With neither, or with a damaged one.
    pub damaged: usize,
}

/// Writes the table of these triggers and cameras.
pub fn write(
    mut out: impl Write,
    session: &SessionReader,
    triggers: Range<u64>,
    cameras: &[CameraId],
    ptp: &PtpTime,
) -> io::Result<Rows> {
    let mut rows = Rows::default();
    // All nodes have the reports of the same HSU, and one may have a trigger that another lacks.
    let recordings = session.recordings();
    let lines: Vec<TimeCodeLine> = recordings.iter().map(|one| TimeCodeLine::of(&one.events)).collect();
    writeln!(out, "{HEADER}")?;
    let scale = ptp.scale.map_or_else(String::new, |found| found.scale.to_string());
    for trigger in triggers.map(TriggerIndex) {
        let row = recordings.iter().find_map(|recording| recording.triggers.get(&trigger));
        let time_code = row.and_then(|row| lines.iter().find_map(|line| line.at(row.hsu_time_ns)));
        let time_code = time_code.map_or_else(String::new, |at| at.to_string());
        let ptp = ptp.at(session, trigger).map_or_else(
            || ",,,".to_owned(),
            |PtpInstant { time_ns, open_ns, camera }| format!("{time_ns},{open_ns},{camera},{scale}"),
        );
        for camera in cameras {
            let found = recordings.iter().find_map(|recording| {
                let place = recording.header.cameras.iter().position(|known| known.id == *camera)?;
                Some((recording, recording.frame_meta(place, trigger)))
            });
            // Of a recording that cannot be read nothing is known.
            let Some((recording, outcome)) = found else {
                rows.damaged += 1;
                writeln!(out, "{trigger},{camera},,damaged,,,,,,{time_code},{ptp}")?;
                continue;
            };
            let (word, count, meta) = match outcome {
                Ok(Ok(meta)) => ("frame".to_owned(), &mut rows.frames, Some(meta)),
                Ok(Err(cause)) => (cause.to_string(), &mut rows.gaps, None),
                Err(_) => ("damaged".to_owned(), &mut rows.damaged, None),
            };
            *count += 1;
            let frame = |number: fn(&FrameMeta) -> u64| field(meta.as_ref().map(number));
            let hsu = recording.triggers.get(&trigger);
            writeln!(
                out,
                "{trigger},{camera},{},{word},{},{},{},{},{},{time_code},{ptp}",
                recording.header.node,
                frame(|meta| meta.block.0),
                frame(|meta| meta.camera_time_ns),
                frame(|meta| meta.host_time_ns),
                field(hsu.map(|row| row.hsu_time_ns)),
                field(hsu.map(|row| row.host_time_ns)),
            )?;
        }
    }
    Ok(rows)
}

fn field(number: Option<u64>) -> String {
    number.map_or_else(String::new, |number| number.to_string())
}
