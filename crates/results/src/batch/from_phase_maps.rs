// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stored phase maps to cloud files: the very bytes that `reconstruct` would have written itself.
//!
//! ```text
//! IN/phases/CAMERA_INDEX.phase   one phase map, as `fourdbody reconstruct` writes it
//! ```

use super::belonging::{Expected, listed};
use super::files::{cloud_path, merged_path, phase_path, remove_leftovers, summary_path, time_by_index_ns};
use super::key::Key;
use super::summary::{Summary, load_summary};
use crate::base::{Exit, Fault, write_whole};
use crate::data::{CalibratedCamera, Calibration, Cloud};
use crate::formats::phase_file::{self, Statement};
use crate::formats::sequence::SequenceWriter;
use crate::formats::{CloudSource, Commented, named, ply, save_merged};
use crate::merge::{self, Viewpoint};
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use crate::reconstruct::triangulate::points;
use crate::reconstruct::triangulate::ray_table::RayTable;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

/// What a map states of its calibration: the hash of its geometry, and the corners of its volume, m.
pub type Geometry = (String, [[f64; 3]; 2]);

/// What maps that were made with a calibration state of it.
pub fn statement_of(calibration: &Calibration) -> Geometry {
    (calibration.geometry_sha256(), [calibration.volume_min_m, calibration.volume_max_m])
}

/// The numbers of clouds that an export has written, kept and found missing.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Exported {
    pub clouds: usize,
    /// Points of all merged clouds.
    pub merged_points: usize,
    pub triggers: usize,
    /// Triggers whose clouds were there already.
    pub kept: usize,
    /// Triggers without a single point: they have no merged cloud.
    pub empty: usize,
    /// Maps that are missing, and those left out, a sentence each ([`Expected::amiss`]).
    pub amiss: Vec<String>,
    /// Whether the sequence's times are made up, because no file states when the triggers were.
    pub made_up_times: bool,
}

/// A trigger whose clouds are there.
struct Made {
    trigger: u64,
    time_ns: Option<u64>,
    /// The number of points of its merged cloud.
    points: usize,
    kept: bool,
}

/// The maps of one trigger: for each, the place of its camera in the calibration, and its file.
type Maps = Vec<(usize, PathBuf)>;

/// Makes the clouds of all phase maps in `from`, on the current rayon pool: directional ones, merged ones, and the
/// sequence, where triggers without a time of their own are placed by index at `rate_hz`. What is there and states
/// the same as the maps is kept, but for the sequence. `progress` gets triggers done and their number.
pub fn export(
    from: &Path,
    calibration: &Calibration,
    out: &Path,
    rate_hz: f64,
    progress: impl Fn(u64, u64) + Sync,
) -> Result<Exported, Fault> {
    let corrupt = |reason: String| Fault::new(Exit::Corrupt, reason);
    let source = PhaseDirectory::open(from, calibration.clone()).map_err(corrupt)?;
    let expected = Expected::of(from).map_err(corrupt)?;
    let amiss = expected.amiss(&listed(&source), &(0..u64::MAX), &|_| true);
    if let Some(key) = Key::load(from).map_err(corrupt)? {
        // Maps and the clouds of them may lie in one directory, which the maps have taken.
        let clouds = Key { format: "ply".to_owned(), ..key.clone() };
        clouds.claim(out).or_else(|refused| key.check(out).map_err(|_| refused))?;
    }
    for folder in ["clouds", "merged"] {
        let path = out.join(folder);
        std::fs::create_dir_all(&path).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    remove_leftovers(out);
    let triggers: Vec<u64> = source.files.keys().copied().filter(|t| expected.speaks_of(*t)).collect();
    let (done, total) = (AtomicU64::new(0), triggers.len() as u64);
    let made = triggers.par_iter().map(|&trigger| {
        let statements = source.statements(trigger, &expected).map_err(corrupt)?;
        let made = match source.finished(trigger, &statements, out) {
            Some(made) => made,
            None => {
                let clouds = source.clouds(trigger, &source.triggers[&trigger]).map_err(corrupt)?;
                source.export_trigger(trigger, &statements, &clouds, out)?
            }
        };
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
        Ok(made)
    });
    let made = made.collect::<Result<Vec<Made>, Fault>>()?;
    let with_points = || made.iter().filter(|made| made.points > 0);
    if with_points().next().is_none() {
        return Err(corrupt(format!(
            "{}: no frame was reconstructed, so that there is nothing to export; summary.json states why",
            from.display()
        )));
    }
    write_sequence(out, with_points().map(|made| (made.trigger, made.time_ns)), rate_hz)?;
    if out != from && summary_path(from, None).exists() {
        write_summary(from, out, &made)?;
    }
    Ok(Exported {
        amiss,
        made_up_times: with_points().any(|made| made.time_ns.is_none()),
        clouds: triggers.iter().map(|trigger| source.files[trigger].len()).sum(),
        merged_points: made.iter().map(|made| made.points).sum(),
        triggers: made.len(),
        kept: made.iter().filter(|made| made.kept).count(),
        empty: made.iter().filter(|made| made.points == 0).count(),
    })
}

/// The summary of the maps as that of the clouds.
fn write_summary(from: &Path, out: &Path, made: &[Made]) -> Result<(), String> {
    let mut summary: Summary = load_summary(from)?;
    let points: BTreeMap<u64, usize> = made.iter().map(|made| (made.trigger, made.points)).collect();
    for trigger in &mut summary.triggers {
        trigger.merged_points = Some(points.get(&trigger.trigger).copied().unwrap_or(0));
    }
    summary.merged_points = Some(points.values().sum());
    summary.save(&summary_path(out, None))
}

/// Stored phase maps as a source of clouds.
pub struct PhaseDirectory {
    calibration: Calibration,
    geometry: Geometry,
    /// Of each camera, in the calibration's order.
    tables: Vec<RayTable>,
    cameras: Vec<(u8, String)>,
    /// Places of the cameras in the calibration.
    triggers: BTreeMap<u64, Vec<usize>>,
    files: BTreeMap<u64, Maps>,
}

impl PhaseDirectory {
    /// Lists the phase maps in `from`, which were made with this calibration.
    pub fn open(from: &Path, calibration: Calibration) -> Result<Self, String> {
        let files = list(from, &calibration)?;
        let names = calibration.cameras().map(|(_, camera)| camera.id.to_string());
        let number = |(number, name)| u8::try_from(number).map(|number: u8| (number, name));
        let cameras: Result<Vec<(u8, String)>, _> = names.enumerate().map(number).collect();
        let cameras = cameras.map_err(|_| "more than 255 cameras".to_owned())?;
        let places = |maps: &Maps| maps.iter().map(|(place, _)| *place).collect();
        let triggers = files.iter().map(|(trigger, maps)| (*trigger, places(maps))).collect();
        let heads_and_cameras: Vec<_> = calibration.cameras().collect();
        let tables = heads_and_cameras.par_iter().map(|(head, camera)| {
            CameraProjector::new(head, camera, &calibration).map(|pair| RayTable::new(&pair))
        });
        let tables = tables.collect::<Result<Vec<_>, String>>()?;
        Ok(Self { geometry: statement_of(&calibration), tables, calibration, cameras, triggers, files })
    }

    fn paths(&self, trigger: u64, cameras: &[usize]) -> impl Iterator<Item = &(usize, PathBuf)> {
        let maps = self.files.get(&trigger).into_iter().flatten();
        maps.filter(move |(place, _)| cameras.contains(place))
    }

    /// What a trigger's maps state, held against their names, their session and the summary.
    fn statements(&self, trigger: u64, expected: &Expected) -> Result<Vec<Statement>, String> {
        let of_map = |(place, path): &(usize, PathBuf)| {
            let statement = phase_file::load_statement(path).map_err(|e| e.to_string())?;
            let camera = Some(self.cameras[*place].1.as_str());
            let held = expected.hold(trigger, camera, Some(statement.points), &statement.comments);
            held.map_err(|reason| format!("FOREIGN  {}: {reason}", path.display()))?;
            Ok(statement)
        };
        self.files[&trigger].iter().map(of_map).collect()
    }

    /// A trigger whose clouds are all there, of which only headers are read.
    fn finished(&self, trigger: u64, statements: &[Statement], out: &Path) -> Option<Made> {
        let has_cloud = |statement: &Statement| {
            let found = ply::load_whole_header(&cloud_path(out, &statement.camera, trigger));
            (&statement.geometry_sha256, &statement.volume_m) == (&self.geometry.0, &self.geometry.1)
                && found.is_ok_and(|found| {
                    found.points == statement.points && found.comments == statement.comments
                })
        };
        statements.iter().all(has_cloud).then_some(())?;
        let time_ns = statements.iter().find_map(|statement| statement.time_ns);
        let points = statements.iter().map(|statement| statement.points).sum();
        if points == 0 {
            return Some(Made { trigger, time_ns, points: 0, kept: true });
        }
        let merged = ply::load_whole_header(&merged_path(out, trigger)).ok()?;
        let decided = statements.iter().any(|statement| Viewpoint::of(&statement.comments).is_some());
        let there = merge::is_finished(&merged, &statements.first()?.merged_comments, points, decided);
        there.then_some(Made { trigger, time_ns, points: merged.points, kept: true })
    }

    /// Writes the clouds of a trigger, and the merged one unless it has no points.
    fn export_trigger(
        &self,
        trigger: u64,
        statements: &[Statement],
        clouds: &[Commented],
        out: &Path,
    ) -> Result<Made, String> {
        statements.par_iter().zip(clouds).with_max_len(1).try_for_each(
            |(statement, (comments, cloud))| {
                let path = cloud_path(out, &statement.camera, trigger);
                ply::save(&path, cloud, comments).map_err(|e| format!("{}: {e}", path.display()))
            },
        )?;
        let time_ns = statements.iter().find_map(|statement| statement.time_ns);
        let mut points = 0;
        if clouds.iter().any(|(_, cloud)| !cloud.is_empty()) {
            let numbers = self.triggers[&trigger].iter().map(|&place| self.cameras[place].0);
            let comments = statements.first().map_or_else(Vec::new, |first| first.merged_comments.clone());
            let path = merged_path(out, trigger);
            points = save_merged(&path, clouds, numbers, comments)
                .map_err(|e| format!("{}: {e}", path.display()))?;
        }
        Ok(Made { trigger, time_ns, points, kept: false })
    }
}

impl CloudSource for PhaseDirectory {
    fn cameras(&self) -> &[(u8, String)] {
        &self.cameras
    }

    fn triggers(&self) -> &BTreeMap<u64, Vec<usize>> {
        &self.triggers
    }

    fn clouds(&self, trigger: u64, cameras: &[usize]) -> Result<Vec<Commented>, String> {
        let read = |(place, path): &(usize, PathBuf)| {
            let (statement, cloud) =
                read_cloud(path, &self.calibration, &self.geometry, *place, &self.tables[*place])?;
            Ok((statement.comments, cloud))
        };
        let paths: Vec<_> = self.paths(trigger, cameras).collect();
        paths.into_par_iter().with_max_len(1).map(read).collect()
    }

    fn modified(&self, trigger: u64, cameras: &[usize]) -> Option<SystemTime> {
        self.paths(trigger, cameras).map(|(_, path)| path.metadata().ok()?.modified().ok()).max()?
    }

    fn time_ns(&self, trigger: u64) -> Option<u64> {
        self.files.get(&trigger)?.iter().find_map(|(_, path)| phase_file::load_statement(path).ok()?.time_ns)
    }
}

/// Packs the merged clouds of triggers into OUT/sequence.mcap, each with its time, ns, or by index at `rate_hz` where it has
/// none; without clouds there is no file.
pub fn write_sequence(
    out: &Path,
    triggers: impl Iterator<Item = (u64, Option<u64>)>,
    rate_hz: f64,
) -> Result<(), String> {
    let path = out.join("sequence.mcap");
    let mut triggers = triggers.peekable();
    if triggers.peek().is_none() {
        return Ok(());
    }
    let packed = write_whole(&path, |file| {
        let mut writer = SequenceWriter::new(std::io::BufWriter::new(file)).map_err(io::Error::other)?;
        for (trigger, time_ns) in triggers {
            let (_, cloud) = ply::load(&merged_path(out, trigger)).map_err(io::Error::other)?;
            let time_ns = time_ns.unwrap_or_else(|| time_by_index_ns(trigger, rate_hz));
            writer.push(time_ns, &cloud).map_err(io::Error::other)?;
        }
        let buffer = writer.finish().map_err(io::Error::other)?;
        buffer.into_inner().map_err(|e| e.into_error()).map(drop)
    });
    packed.map_err(|e| format!("{}: {e}", path.display()))
}

/// The maps by trigger, in the calibration's order.
fn list(from: &Path, calibration: &Calibration) -> Result<BTreeMap<u64, Maps>, String> {
    let folder = from.join("phases");
    let fail = |e: std::io::Error| {
        format!("{}: {e}; expected phases/ as `fourdbody reconstruct` writes it", folder.display())
    };
    let mut triggers: BTreeMap<u64, Maps> = BTreeMap::new();
    for entry in std::fs::read_dir(&folder).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        let Some(stem) = path.file_name().and_then(|n| n.to_str()?.strip_suffix(".phase")) else { continue };
        let Some((trigger, Some(camera))) = named(stem) else { continue };
        let number = calibration.cameras().position(|(_, known)| known.id.as_str() == camera);
        let number =
            number.ok_or_else(|| format!("{}: the calibration has no such camera", path.display()))?;
        // With other names a camera could have two maps of one trigger.
        let name = phase_path(from, camera, trigger);
        if name != path {
            return Err(format!("FOREIGN  {}: expected the name {}", path.display(), name.display()));
        }
        triggers.entry(trigger).or_default().push((number, path));
    }
    triggers.values_mut().for_each(|maps| maps.sort());
    if triggers.is_empty() {
        return Err(format!("{}: expected CAMERA_INDEX.phase files, found none", folder.display()));
    }
    Ok(triggers)
}

/// The cloud of the stored map at `path`, with the comments of its file.
pub fn load_cloud(path: &Path, calibration: &Calibration) -> Result<Commented, String> {
    let statement = phase_file::load_statement(path).map_err(|e| e.to_string())?;
    let is_it = |(_, camera): &(&_, &CalibratedCamera)| camera.id.as_str() == statement.camera;
    let (number, (head, camera)) =
        calibration.cameras().enumerate().find(|(_, found)| is_it(found)).ok_or_else(|| {
            format!("{}: the calibration has no camera {}", path.display(), statement.camera)
        })?;
    let table = RayTable::new(&CameraProjector::new(head, camera, calibration)?);
    read_cloud(path, calibration, &statement_of(calibration), number, &table)
        .map(|(statement, cloud)| (statement.comments, cloud))
}

/// The cloud of a stored map; `number`: the place of its camera in the calibration.
fn read_cloud(
    path: &Path,
    calibration: &Calibration,
    (geometry, volume): &Geometry,
    number: usize,
    table: &RayTable,
) -> Result<(Statement, Cloud), String> {
    let fail = |reason: String| format!("{}: {reason}", path.display());
    let camera = calibration.cameras().nth(number).map(|(_, camera)| camera);
    let camera = camera.ok_or_else(|| fail("the calibration has no such camera".to_owned()))?;
    let frame = [camera.device.width, camera.device.height];
    let (statement, map) = phase_file::load_of_frame(path, frame).map_err(|e| e.to_string())?;
    if (&statement.geometry_sha256, &statement.volume_m) != (geometry, volume) {
        return Err(fail(format!(
            "made with the calibration {}, not with {geometry}; give the calibration that it was reconstructed with",
            statement.geometry_sha256
        )));
    }
    if camera.id.as_str() != statement.camera {
        return Err(fail(format!(
            "a map of camera {}, which the file's name does not state",
            statement.camera
        )));
    }
    let cloud = points::make(table, &map);
    if cloud.len() != statement.points {
        let (found, stated) = (cloud.len(), statement.points);
        return Err(fail(format!("gives {found} points, {stated} are stated: made by another version")));
    }
    Ok((statement, cloud))
}
