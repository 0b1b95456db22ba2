// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames of a finished run that show another trigger ([`super::witness`]) are refused: their files become those of
//! refused frames, and the merged clouds of their triggers are made without them.
//!
//! This is done when all triggers of a run are there, at its end or when its shards are collected, so that one run
//! and many shards give the same result.

use super::files::{frame_path, merged_path, stated};
use super::from_phase_maps::PhaseDirectory;
use super::plan::{Format, Plan};
use super::summary::{FrameSummary, Summary, TriggerSummary};
use super::witness::{self, Evidence, REACH, Sketch, Sketches};
use crate::base::ids::CameraId;
use crate::data::{Calibration, Cloud, PhaseMap};
use crate::formats::{CloudSource, PlyDirectory, phase_file, ply, save_merged};
use crate::merge;
use crate::reconstruct::pipeline::Method;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::io;
use std::path::Path;

/// Triggers whose clouds are read at a time.
const AT_ONCE: usize = 4;

/// The beginning of the reasons that this file gives: by it, frames are recognized that were refused here before.
const SHOWN: &str = "it shows trigger ";

fn reason(shown: u64, own: u64) -> String {
    format!(
        "{SHOWN}{shown}, not {own}: what moves lies where the other cameras have it then; see what happened \
         to this camera about this trigger (`fourdbody verify`)"
    )
}

/// Refuses the frames of a run that show another trigger, in its files and in `summary`, on the current rayon pool.
/// `progress` gets the number of triggers checked and of all.
///
/// # Errors
/// A file cannot be read or written.
pub fn refuse(
    plan: &Plan,
    calibration: &Calibration,
    summary: &mut Summary,
    progress: impl Fn(usize, usize),
) -> Result<(), String> {
    if plan.discard || plan.method != Method::Joint || summary.clouds == 0 {
        return Ok(());
    }
    let names: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let mut evidence = evidence_on(plan, calibration, summary, &names, progress)?;
    let strangers = witness::strangers(calibration, &mut evidence);
    for (&(trigger, camera), &shown) in &strangers {
        refuse_files(plan, &names[camera], trigger, &reason(shown, trigger))?;
    }
    for one in &mut summary.triggers {
        let is_stranger = |camera: &CameraId| {
            let place = names.iter().position(|name| name == camera)?;
            strangers.get(&(one.trigger, place)).copied()
        };
        let mut any = false;
        for frame in &mut one.frames {
            if let Some(shown) = is_stranger(&frame.camera) {
                set_refused(frame, reason(shown, one.trigger));
                any = true;
            }
        }
        if any && plan.merges() {
            one.merged_points = Some(merge_again(&plan.out, one)?);
        }
    }
    summary.count();
    summary.suspects = witness::suspects(calibration, &evidence)
        .into_iter()
        .map(|((trigger, camera), shown)| {
            format!(
                "{} {trigger}: the other camera of its head shows the same at trigger {shown}; one of \
                 the two is of another trigger",
                names[camera]
            )
        })
        .collect();
    Ok(())
}

fn set_refused(frame: &mut FrameSummary, reason: String) {
    (frame.outcome, frame.reason, frame.points) = ("refused".into(), Some(reason), 0);
}

/// The evidence on the frames that any camera votes against.
fn evidence_on(
    plan: &Plan,
    calibration: &Calibration,
    summary: &Summary,
    names: &[CameraId],
    progress: impl Fn(usize, usize),
) -> Result<BTreeMap<(u64, usize), Evidence>, String> {
    let source: Box<dyn CloudSource> = if plan.formats.contains(&Format::Phase) {
        Box::new(PhaseDirectory::open(&plan.out, calibration.clone())?)
    } else {
        Box::new(PlyDirectory::open(&plan.out)?)
    };
    let lit: Vec<&TriggerSummary> = summary
        .triggers
        .iter()
        .filter(|one| one.frames.iter().any(|frame| frame.outcome == "cloud"))
        .collect();
    let mut sketches: BTreeMap<u64, Sketches> = BTreeMap::new();
    let (mut evidence, mut loaded) = (BTreeMap::new(), 0);
    for (done, one) in lit.iter().enumerate() {
        while let Some(next) =
            lit.get(loaded).filter(|next| next.trigger <= one.trigger.saturating_add(REACH))
        {
            debug_assert!(!sketches.contains_key(&next.trigger));
            let chunk = &lit[loaded..lit.len().min(loaded + AT_ONCE)];
            let made =
                chunk.par_iter().map(|one| Ok((one.trigger, sketch(&*source, calibration, one, names)?)));
            sketches.extend(made.collect::<Result<Vec<_>, String>>()?);
            loaded += chunk.len();
        }
        let frames = (0..names.len()).into_par_iter();
        let found = frames.filter_map(|camera| {
            Some(((one.trigger, camera), witness::evidence_on(calibration, &sketches, one.trigger, camera)?))
        });
        evidence.extend(found.collect::<Vec<_>>());
        sketches = sketches.split_off(&one.trigger.saturating_sub(REACH));
        progress(done + 1, lit.len());
    }
    Ok(evidence)
}

/// The sketches of a trigger's clouds.
fn sketch(
    source: &dyn CloudSource,
    calibration: &Calibration,
    one: &TriggerSummary,
    names: &[CameraId],
) -> Result<Sketches, String> {
    let cameras: Vec<_> = calibration.cameras().map(|(_, camera)| camera).collect();
    let of = |(place, name): (usize, &CameraId)| {
        if !one.frames.iter().any(|frame| frame.camera == *name && frame.outcome == "cloud") {
            return Ok(None);
        }
        let known = source.cameras().iter().position(|(_, known)| known.as_str() == name.as_str());
        let cloud =
            known.map(|known| source.clouds(one.trigger, &[known])).transpose()?.and_then(|mut x| x.pop());
        Ok(cloud.map(|(_, cloud)| Sketch::new(&cloud, &cameras[place].device)))
    };
    names.par_iter().enumerate().map(of).collect()
}

/// Makes the files of a frame those of a refused one.
fn refuse_files(plan: &Plan, camera: &CameraId, trigger: u64, reason: &str) -> Result<(), String> {
    let refused = format!("refused {reason}");
    for &format in &plan.formats {
        let path = frame_path(&plan.out, format, camera, trigger);
        let saved = match format {
            Format::Phase => {
                let (mut statement, map) = phase_file::load(&path).map_err(|e| e.to_string())?;
                statement.points = 0;
                statement.comments.push(refused.clone());
                phase_file::save(&path, &statement, &PhaseMap { frame: map.frame, ..PhaseMap::default() })
            }
            Format::Ply => {
                let mut comments = ply::load_header(&path).map_err(|e| e.to_string())?.comments;
                comments.push(refused.clone());
                ply::save(&path, &Cloud::default(), &comments)
            }
        };
        saved.map_err(|e| format!("{}: {e}", path.display()))?;
    }
    Ok(())
}

/// Makes the merged cloud of a trigger of the directional clouds that there are; the number of its points.
fn merge_again(out: &Path, one: &TriggerSummary) -> Result<usize, String> {
    let path = merged_path(out, one.trigger);
    let stated = ply::load_header(&path).map_err(|e| e.to_string())?;
    let comments =
        merge::split_removed(&stated.comments).map_or(&stated.comments[..], |(own, _)| own).to_vec();
    let source = PlyDirectory::open(out)?;
    let with_points =
        |name: &str| one.frames.iter().any(|frame| frame.camera.as_str() == name && frame.points > 0);
    let places: Vec<usize> =
        (0..source.cameras().len()).filter(|place| with_points(&source.cameras()[*place].1)).collect();
    let failed = |e: io::Error| format!("{}: {e}", path.display());
    if places.is_empty() {
        return std::fs::remove_file(&path).map(|()| 0).map_err(failed);
    }
    let clouds = source.clouds(one.trigger, &places)?;
    let numbers = places.iter().map(|place| source.cameras()[*place].0);
    save_merged(&path, &clouds, numbers, comments).map_err(failed)
}

/// What a shard's summary has of a trigger, with the frames refused that an earlier collection has found to be of
/// another trigger. Whether there are any.
pub fn adopt(out: &Path, formats: &[Format], one: &mut TriggerSummary) -> bool {
    let mut any = false;
    for frame in &mut one.frames {
        let format = formats.first().copied().unwrap_or(Format::Ply);
        let comments =
            stated(out, format, &frame.camera, one.trigger).map_or_else(Vec::new, |found| found.comments);
        let reason = comments.iter().find_map(|comment| comment.strip_prefix("refused "));
        if let Some(reason) = reason.filter(|reason| reason.starts_with(SHOWN)) {
            set_refused(frame, reason.to_owned());
            any = true;
        }
    }
    if any && one.merged_points.is_some() {
        let merged = ply::load_whole_header(&merged_path(out, one.trigger));
        one.merged_points = Some(merged.map_or(0, |header| header.points));
    }
    any
}
