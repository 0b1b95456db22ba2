// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody export` of a session: frames and times.

use super::{Args, Target, chosen_cameras, chosen_triggers};
use crate::base::Exit;
use crate::base::ids::CameraId;
use crate::base::write_whole;
use crate::cmds::failure::{Failure, tell_lost};
use crate::cmds::progress::Progress;
use crate::data::FrameSource;
use crate::export::frames::{self, FramePlan, FrameSummary, Picture};
use crate::export::inputs;
use crate::export::ptp::PtpTime;
use crate::export::timing::{self, Rows};
use crate::record::SessionReader;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::ops::Range;
use std::path::Path;

/// Exports frames and times of a session.
pub(super) fn run(args: &Args) -> Result<Exit, Failure> {
    let usage = |e: &dyn std::fmt::Display| Failure::new(Exit::Usage, e);
    if args.mesh.is_some() || !args.clouds.is_empty() || args.quantize.is_some() {
        return Err(usage(&"--mesh, --clouds and --quantize are for clouds; a session has frames"));
    }
    let session = SessionReader::open(&args.directory)?;
    let lost = tell_lost(session.lost());
    let triggers = chosen_triggers(args.triggers.as_ref(), session.triggers())?;
    let names: Vec<&str> = session.cameras().iter().map(CameraId::as_str).collect();
    let places = chosen_cameras(&args.cameras, &names)?;
    let cameras: Vec<CameraId> = places.iter().map(|&place| session.cameras()[place].clone()).collect();
    check_extent(&session, &args.directory, &triggers, cameras.len())?;
    let formats: Vec<Picture> = args.to.iter().filter_map(|target| target.picture()).collect();
    let mut frames = None;
    if !formats.is_empty() {
        let ids = session.recordings().iter().map(|recording| recording.header.session_id.as_str());
        let origin = format!("session {}", ids.max().unwrap_or_default());
        let plan = FramePlan {
            out: args.out.clone(),
            origin,
            formats,
            triggers: triggers.clone().collect(),
            cameras: cameras.clone(),
        };
        let progress = Progress::of("exporting", "frames");
        frames = Some(frames::run(&session, &plan, |done, total| progress.at(done, total))?);
    }
    let csv = args.to.contains(&Target::Csv);
    let ptp = if csv { PtpTime::of(&session) } else { PtpTime::default() };
    let rows = csv.then(|| write_timing(args, &session, triggers, &cameras, &ptp)).transpose()?;
    let edges = match rows {
        Some(_) => write_inputs(args, &session)?,
        None => 0,
    };
    report(args, &session, frames.as_ref(), rows, edges, &ptp);
    // With --cameras, what cannot be read may be of others.
    let damaged = (lost && args.cameras.is_empty())
        || frames.as_ref().is_some_and(|frames| !frames.problems.is_empty())
        || rows.is_some_and(|rows| rows.damaged > 0);
    let missing =
        frames.as_ref().is_some_and(|frames| frames.gaps > 0) || rows.is_some_and(|rows| rows.gaps > 0);
    Ok(match (damaged, missing) {
        (true, _) => Exit::Corrupt,
        (false, true) => Exit::DataLoss,
        (false, false) => Exit::Done,
    })
}

/// Refuses more frames than the recordings have room for: a false number in a small file would otherwise make a large
/// one.
fn check_extent(
    session: &SessionReader,
    path: &Path,
    triggers: &Range<u64>,
    cameras: usize,
) -> Result<(), Failure> {
    // A gap record has more bytes than this.
    const BYTES_EACH: u64 = 8;
    // This number of frames is no burden, whatever is lost of a recording.
    const ALWAYS: u64 = 1 << 20;
    let segments = session.recordings().iter().flat_map(|recording| &recording.segments);
    let bytes: u64 = segments.map(|segment| segment.length() as u64).sum();
    let frames = (triggers.end - triggers.start).saturating_mul(cameras as u64);
    if frames <= ALWAYS.max(bytes / BYTES_EACH) {
        return Ok(());
    }
    let message = format!(
        "{}: expected a record of every frame, found {frames} frames of triggers {} to {} stated in {bytes} bytes; \
         `fourdbody verify` names what is wrong; --triggers A..B exports a part",
        path.display(),
        triggers.start,
        triggers.end.saturating_sub(1)
    );
    Err(Failure::new(Exit::Corrupt, message))
}

fn write_timing(
    args: &Args,
    session: &SessionReader,
    triggers: Range<u64>,
    cameras: &[CameraId],
    ptp: &PtpTime,
) -> Result<Rows, Failure> {
    let mut rows = Rows::default();
    write_table(args, "timing.csv", |out| {
        rows = timing::write(out, session, triggers, cameras, ptp)?;
        Ok(())
    })?;
    Ok(rows)
}

/// How many edges came on the HSU's inputs; their table, if there are any.
fn write_inputs(args: &Args, session: &SessionReader) -> Result<usize, Failure> {
    let edges = inputs::edges(session);
    if !edges.is_empty() {
        write_table(args, "inputs.csv", |out| inputs::write(out, session, &edges))?;
    }
    Ok(edges.len())
}

fn write_table(
    args: &Args,
    name: &str,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<(), Failure> {
    let path = args.out.join(name);
    let written = std::fs::create_dir_all(&args.out).and_then(|()| {
        write_whole(&path, |file| {
            let mut out = BufWriter::new(file);
            write(&mut out)?;
            out.flush()
        })
    });
    written.map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", path.display())))
}

fn report(
    args: &Args,
    session: &SessionReader,
    frames: Option<&FrameSummary>,
    rows: Option<Rows>,
    edges: usize,
    ptp: &PtpTime,
) {
    for problem in frames.iter().flat_map(|frames| &frames.problems) {
        eprintln!("{problem}");
    }
    if args.json {
        println!(
            "{}",
            serde_json::json!({
                "frames": frames, "timing": rows, "inputs": edges, "ptp": ptp, "unreadable": session.unreadable()
            })
        );
        return;
    }
    if let Some(frames) = frames {
        println!(
            "{} frames: {} pictures written, {} were finished, {} frames missing, {} damaged",
            frames.frames,
            frames.written,
            frames.skipped,
            frames.gaps,
            frames.problems.len() + frames.more_problems
        );
    }
    if let Some(rows) = rows {
        let Rows { frames, gaps, damaged } = rows;
        println!("timing.csv: {frames} frames, {gaps} gaps, {damaged} damaged");
        if let Some(witness) = ptp.witnesses.first() {
            println!(
                "PTP time by {}, {:.1} us before its stamps, to {:.1} us besides what PTP itself leaves \
                 open; {} cameras agree",
                witness.camera,
                witness.delay_ns as f64 / 1e3,
                witness.open_ns as f64 / 1e3,
                ptp.witnesses.len()
            );
            if let Some(scale) = ptp.scale {
                println!("the PTP clock counts {scale}");
            }
        } else if let Some(reason) = &ptp.none_because {
            println!("no PTP time: {reason}");
        }
        if edges > 0 {
            println!("inputs.csv: {edges} edges of the HSU's inputs");
        }
    }
}
