// SPDX-License-Identifier: MIT OR Apache-2.0
//! What stands before and behind [`super::run::run`] for a whole session: whether session and calibration belong together,
//! and the files that are made of all triggers.

use super::files::summary_path;
use super::png_source::PngSource;
use super::run::{Plan, write_sequence};
use super::strangers;
use super::summary::Summary;
use crate::base::ids::CameraId;
use crate::base::{Exit, Fault};
use crate::data::{Calibration, FrameSource, LostPart, SessionIdentity};
use crate::record::{ReadError, SessionReader};
use std::path::Path;

/// The rate at which triggers without a time of their own are placed, Hz.
pub const RATE_HZ: f64 = 120.0;

/// Opens a session: a directory of recordings, which `open` reads, or of images.
pub fn open_source(
    path: &Path,
    cameras: &[CameraId],
    open: impl Fn(&Path) -> Result<SessionReader, ReadError>,
) -> Result<Box<dyn FrameSource>, Fault> {
    if cameras.iter().any(|camera| path.join(camera.as_str()).is_dir()) {
        return Ok(Box::new(PngSource::open(path, cameras).map_err(Fault::usage)?));
    }
    Ok(Box::new(open(path)?))
}

/// Refuses a session and a calibration that do not have the same cameras: half a rig must not pass for a whole one.
pub fn same_cameras(calibrated: &[CameraId], session: &SessionIdentity) -> Result<(), String> {
    let list = |ids: &[&CameraId]| ids.iter().map(|id| id.as_str()).collect::<Vec<_>>().join(", ");
    let lacking = |all: &'_ [CameraId], there: &[CameraId]| -> String {
        let lacking: Vec<&CameraId> = all.iter().filter(|id| !there.contains(id)).collect();
        list(&lacking)
    };
    let (of_session, of_calibration) =
        (lacking(&session.cameras, calibrated), lacking(calibrated, &session.cameras));
    let found = match (of_session.as_str(), of_calibration.as_str()) {
        ("", "") => return Ok(()),
        (more, "") => format!("the session has {more}, which the calibration has not"),
        ("", more) => format!("the calibration has {more}, which the session has not"),
        (a, b) => format!("the session has {a}, which the calibration has not, and the calibration {b}"),
    };
    Err(format!(
        "{found}; expected the same cameras in both. Give the calibration of the whole rig, or choose a \
         part of it: --cameras, or \
         --partial for those that both have"
    ))
}

/// Refuses a session whose cameras, as it states them, are not those of the calibration.
pub fn fits(calibration: &Calibration, cameras: &[CameraId], source: &dyn FrameSource) -> Result<(), String> {
    let Some(stated) = source.statement() else { return Ok(()) };
    let is_lost = |id: &CameraId| source.lost().iter().any(|part| part.cameras.contains(id));
    let readable: Vec<CameraId> = cameras.iter().filter(|id| !is_lost(id)).cloned().collect();
    calibration.fits(&readable, &stated)
}

/// Finishes a run, on the current rayon pool: refuses frames of other triggers, writes the sequence where clouds were
/// written, and the summary with the parts that cannot be read. Of a shard only the summary is made: what needs all
/// triggers is made when the shards are collected. `progress` gets triggers checked and their number.
pub fn finish<'a>(
    plan: &Plan,
    shard: Option<(u64, u64)>,
    calibration: &Calibration,
    summary: &mut Summary,
    lost: impl Iterator<Item = &'a LostPart>,
    rate_hz: f64,
    progress: impl Fn(usize, usize),
) -> Result<(), Fault> {
    let failed = |reason: String| Fault::new(Exit::Failure, reason);
    if shard.is_none() {
        strangers::refuse(plan, calibration, summary, progress).map_err(failed)?;
        if plan.merges() {
            write_sequence(plan, summary, rate_hz).map_err(failed)?;
        }
    }
    summary.unreadable = lost.map(LostPart::to_string).collect();
    summary.save(&summary_path(&plan.out, shard)).map_err(failed)
}
