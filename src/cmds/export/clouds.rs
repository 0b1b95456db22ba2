// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody export` of a reconstruction.

use super::{Args, Clouds, MeshName, Target, calibration, chosen_cameras, chosen_triggers};
use crate::base::Exit;
use crate::base::ids::TriggerIndex;
use crate::batch::belonging::{self, Expected, Held};
use crate::batch::from_phase_maps::PhaseDirectory;
use crate::batch::key::Key;
use crate::batch::run::time_by_index_ns;
use crate::cmds::failure::{Failure, tell_amiss, tell_lost, tell_made_up_times, unusable_clouds};
use crate::cmds::progress::Progress;
use crate::data::FrameSource;
use crate::export::collect;
use crate::export::frames::{self, FramePlan, Picture};
use crate::export::intensity::{self, Intensity, VideoPlan};
use crate::export::job::{self, Plan, Summary};
use crate::export::mesh::{GridLimits, MeshKind};
use crate::formats::sequence::Options;
use crate::formats::{CloudSource, Format, PlyDirectory};
use crate::record::SessionReader;
use std::ops::Range;
use std::path::Path;

/// Clouds, meshes, and the sequence.
pub(super) fn run(args: &Args) -> Result<Exit, Failure> {
    let folder = |name: &str| args.directory.join(name).is_dir();
    if folder("phases") && !folder("clouds") && !folder("merged") {
        let calibration = calibration(args)?;
        let source = PhaseDirectory::open(&args.directory, calibration);
        return export(args, &source.map_err(|e| Failure::new(Exit::Corrupt, e))?);
    }
    let source = PlyDirectory::open(&args.directory).map_err(|e| unusable_clouds(&args.directory, e))?;
    export(args, &source)
}

fn export(args: &Args, source: &dyn CloudSource) -> Result<Exit, Failure> {
    let corrupt = |e: String| Failure::new(Exit::Corrupt, e);
    let expected = Expected::of(&args.directory).map_err(corrupt)?;
    let there = belonging::listed(source);
    let source: &dyn CloudSource = &Held::new(source, &expected);
    let plan = plan(args, source)?;
    if args.to.contains(&Target::Mp4) {
        intensity::find_encoder().map_err(|e| Failure::usage(format!("--to mp4: {e}")))?;
    }
    let wanted = |name: &str| plan.cameras.iter().any(|&camera| source.cameras()[camera].1 == name);
    let triggers = args.triggers.clone().unwrap_or(0..u64::MAX);
    let is_amiss = tell_amiss(&expected.amiss(&there, &triggers, &wanted));
    let progress = Progress::of("exporting", "triggers");
    let mut summary = Summary::default();
    if !plan.formats.is_empty() {
        summary = job::run(source, &plan, |done, total| progress.at(done, total))?;
    }
    if args.to.contains(&Target::Mcap) {
        let made = write_sequence(args, source, &plan, &progress)?;
        summary.triggers = summary.triggers.max(made.triggers);
        summary.written += made.written;
        summary.points += made.points;
        summary.bytes += made.bytes;
        summary.empty = summary.empty.max(made.empty);
        summary.problems.extend(made.problems);
    }
    if wants_images(args) {
        write_images(args, source, &plan, &progress, &mut summary)?;
    }
    drop(progress);
    report(args, &summary);
    if summary.problems.is_empty() && summary.written + summary.skipped == 0 {
        let message = format!(
            "{}: nothing was exported: expected clouds with points, found none in {} triggers (summary.json \
             states why frames were refused)",
            args.directory.display(),
            summary.triggers
        );
        return Err(Failure::new(Exit::Corrupt, message));
    }
    Ok(match (summary.problems.is_empty(), summary.empty > 0 || is_amiss) {
        (true, false) => Exit::Done,
        (true, true) => Exit::DataLoss,
        (false, _) => Exit::Corrupt,
    })
}

fn plan(args: &Args, source: &dyn CloudSource) -> Result<Plan, Failure> {
    let usage = |message: String| Failure::new(Exit::Usage, message);
    let known: Vec<&str> = source.cameras().iter().map(|(_, name)| name.as_str()).collect();
    let first = source.triggers().first_key_value().map_or(0, |(trigger, _)| *trigger);
    let last = source.triggers().last_key_value().map_or(0, |(trigger, _)| *trigger);
    let xyz =
        Format::Xyz { comments: !args.no_comments, columns: args.columns.map_or(usize::MAX, usize::from) };
    let chosen = |format| if format == Format::XYZ { xyz } else { format };
    let formats: Vec<Format> = args.to.iter().filter_map(|target| target.format()).map(chosen).collect();
    let grid = GridLimits { stretch: args.stretch, ..GridLimits::default() };
    let mesh = args.mesh.map(|mesh| match mesh {
        MeshName::Grid => MeshKind::Grid(grid),
        MeshName::Watertight => MeshKind::Watertight { cell_m: args.cell / 1e3 },
    });
    let merged = args.clouds.is_empty() || args.clouds.contains(&Clouds::Merged);
    let directional = args.clouds.contains(&Clouds::Directional);
    if mesh.is_some() {
        if let Some(format) = formats.iter().find(|format| !format.holds_triangles()) {
            return Err(usage(format!(
                "--mesh: {} holds points only; use ply, ply-ascii, glb or obj",
                format.extension()
            )));
        }
        if args.to.contains(&Target::Mcap) || wants_images(args) {
            return Err(usage("--mesh: sequences and images hold points only; leave them out".to_owned()));
        }
        if args.mesh == Some(MeshName::Watertight) && directional {
            return Err(usage("--mesh watertight: needs merged clouds; leave --clouds out".to_owned()));
        }
    }
    if args.quantize.is_some() && !args.to.contains(&Target::Mcap) {
        return Err(usage("--quantize: is for --to mcap".to_owned()));
    }
    let origin = std::fs::canonicalize(&args.directory).map_err(|e| usage(e.to_string()))?;
    if mesh.is_none() && formats.contains(&Format::Ply) {
        // The very files that are read must not be written.
        let out = std::fs::canonicalize(&args.out).unwrap_or_else(|_| args.out.clone());
        if out == origin {
            return Err(usage(format!(
                "--out {}: is where the clouds are; give another directory",
                args.out.display()
            )));
        }
    }
    // The same place may have other clouds today.
    let key = Key::load(&args.directory).map_err(|e| Failure::new(Exit::Corrupt, e))?;
    let made_of = key.map_or_else(String::new, |key| format!(": {}, {}", key.session, key.parameters()));
    Ok(Plan {
        out: args.out.clone(),
        origin: format!("{}{made_of}", origin.display()),
        formats,
        merged,
        directional,
        mesh,
        triggers: chosen_triggers(args.triggers.as_ref(), first..last.saturating_add(1))?,
        cameras: chosen_cameras(&args.cameras, &known)?,
    })
}

fn write_sequence(
    args: &Args,
    source: &dyn CloudSource,
    plan: &Plan,
    progress: &Progress,
) -> Result<Summary, Failure> {
    let session = args.session.as_ref().map(|path| same_session(args, path)).transpose()?;
    let known = |trigger: u64| {
        let of_session = || session.as_ref()?.trigger_time_ns(TriggerIndex(trigger));
        source.time_ns(trigger).or_else(of_session)
    };
    let unknown = |trigger: &u64| known(*trigger).is_none();
    if source.triggers().range(plan.triggers.clone()).any(|(trigger, _)| unknown(trigger)) {
        tell_made_up_times(args.rate_hz);
    }
    let time_ns = |trigger: u64| known(trigger).unwrap_or_else(|| time_by_index_ns(trigger, args.rate_hz));
    let options = Options {
        zstd_level: args.compress.map_or(u32::from(args.quantize.is_some()), u32::from),
        step_m: args.quantize.map(|mm| mm / 1e3),
    };
    let path = args.out.join("sequence.mcap");
    let fail = |e: std::io::Error| Failure::new(Exit::Failure, format!("{}: {e}", path.display()));
    std::fs::create_dir_all(&args.out).map_err(fail)?;
    collect(source, plan, options, &path, time_ns, |done, total| progress.at(done, total)).map_err(fail)
}

fn wants_images(args: &Args) -> bool {
    args.to.iter().any(|target| matches!(target, Target::IntensityPng | Target::Mp4))
}

/// The fringe-free images: pictures, videos, or both.
fn write_images(
    args: &Args,
    source: &dyn CloudSource,
    plan: &Plan,
    progress: &Progress,
    summary: &mut Summary,
) -> Result<(), Failure> {
    // Two hours and more; a wrong index would make years of black.
    const MOST_IN_A_VIDEO: u64 = 1 << 20;
    let images = Intensity::of(source, &calibration(args)?).map_err(Failure::usage)?;
    let out = args.out.join("intensity");
    let triggers: Vec<u64> =
        source.triggers().range(plan.triggers.clone()).map(|(trigger, _)| *trigger).collect();
    let at = |done, total| progress.at(done, total);
    summary.triggers = triggers.len();
    if args.to.contains(&Target::IntensityPng) {
        let cameras = plan.cameras.iter().map(|&place| images.cameras()[place].clone()).collect();
        let (out, origin, formats) = (out.clone(), plan.origin.clone(), vec![Picture::Png]);
        let made = frames::run(&images, &FramePlan { out, origin, formats, triggers, cameras }, at)?;
        summary.written += made.written;
        summary.skipped += made.skipped;
        summary.empty += made.gaps;
        summary.problems.extend(made.problems);
    }
    if args.to.contains(&Target::Mp4) {
        let Range { start, end } = plan.triggers;
        if end - start > MOST_IN_A_VIDEO {
            let found = format!("expected at most {MOST_IN_A_VIDEO} triggers, found {start}..{end}");
            return Err(Failure::usage(format!("--to mp4: {found}; choose with --triggers A..B")));
        }
        let rate_hz = rate_of(source).unwrap_or_else(|| {
            tell_made_up_times(args.rate_hz);
            args.rate_hz
        });
        let (cameras, triggers) = (plan.cameras.clone(), plan.triggers.clone());
        let plan = VideoPlan { out: &out, origin: &plan.origin, cameras, triggers, rate_hz };
        let made = intensity::write_videos(&images, &plan, at)?;
        if !args.json {
            let frames = end - start;
            println!(
                "{}/CAMERA.mp4: {frames} frames, {rate_hz} Hz; the first is trigger {start}",
                out.display()
            );
        }
        summary.written += made.written;
        summary.skipped += made.skipped;
        summary.empty += made.black;
        summary.problems.extend(made.problems);
    }
    Ok(())
}

/// Triggers per second by the median of the times between them, where these are known.
fn rate_of(source: &dyn CloudSource) -> Option<f64> {
    let timed = |trigger: &u64| Some((*trigger, source.time_ns(*trigger)?));
    let times: Vec<(u64, u64)> = source.triggers().keys().filter_map(timed).collect();
    let period =
        |pair: &[(u64, u64)]| pair[1].1.saturating_sub(pair[0].1) as f64 / (pair[1].0 - pair[0].0) as f64;
    let mut periods: Vec<f64> = times.windows(2).map(period).collect();
    periods.sort_unstable_by(f64::total_cmp);
    let period_ns = periods.get(periods.len() / 2).filter(|period| **period > 0.0)?;
    Some((1e12 / period_ns).round() / 1e3)
}

/// The session that the result is of.
fn same_session(args: &Args, path: &Path) -> Result<SessionReader, Failure> {
    let session = SessionReader::open_timed(path)?;
    // Times are there as long as one node's recording is.
    tell_lost(session.lost());
    let corrupt = |e: String| Failure::new(Exit::Corrupt, e);
    let (found, key) = (session.identity().map_err(corrupt)?, Key::load(&args.directory).map_err(corrupt)?);
    if let Some(key) = key.filter(|key| key.session.id != found.id) {
        return Err(corrupt(format!(
            "--session {}: is {found}, expected the session that {} was made of, {}",
            path.display(),
            args.directory.display(),
            key.session
        )));
    }
    Ok(session)
}

fn report(args: &Args, summary: &Summary) {
    for problem in &summary.problems {
        eprintln!("{problem}");
    }
    if args.json {
        println!("{}", serde_json::json!(summary));
    } else {
        println!(
            "{} triggers: {} files written ({:.1} MB, {} points, {} triangles), {} were finished, {} \
             without points, {} problems",
            summary.triggers,
            summary.written,
            summary.bytes as f64 / 1e6,
            summary.points,
            summary.triangles,
            summary.skipped,
            summary.empty,
            summary.problems.len()
        );
    }
}
