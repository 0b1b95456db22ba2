// SPDX-License-Identifier: MIT OR Apache-2.0
//! A reconstruction's clouds to files of other formats: in parallel, and resumable.
//!
//! ```text
//! OUT/clouds/CAMERA_INDEX.EXT      directional clouds
//! OUT/merged/INDEX.EXT             all cameras of one trigger
//! OUT/meshes/CAMERA_INDEX.EXT, OUT/meshes/INDEX.EXT    triangles on the cameras' pixel grids
//! OUT/watertight/INDEX.EXT         closed meshes of merged clouds
//! OUT/export.json                  what each of these folders was made of, and how
//! ```
//!
//! A file that is there and not older than the clouds that it is made of is not made again. So that this is right, a
//! folder takes files of one origin and one kind only: another one is refused. Of a cloud without points nothing is
//! written.

use super::mesh::{self, Mesh, MeshKind};
use crate::base::{Exit, Fault, json, regular};
use crate::formats::{CloudSource, Commented, Format, Shape, merged_cloud};
use crate::merge;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Comments of directional clouds that are true of a merged one, too.
const COMMON: [&str; 7] =
    ["fourdbody ", "parameters ", "calibration ", "session ", "trigger ", "time_ns ", "frames "];

/// Which clouds are written, where, and as what.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The directory that the files go to.
    pub out: PathBuf,
    /// Where the clouds come from, in words that no other origin has.
    pub origin: String,
    pub formats: Vec<Format>,
    /// Whether a file a trigger is written.
    pub merged: bool,
    /// Whether a file a camera and trigger is written.
    pub directional: bool,
    /// Which meshes are written instead of points.
    pub mesh: Option<MeshKind>,
    pub triggers: Range<u64>,
    /// Which cameras: places in the source's list.
    pub cameras: Vec<usize>,
}

/// The numbers of files that were written, kept, empty and damaged.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Summary {
    pub triggers: usize,
    pub written: usize,
    /// Files that were finished before this run.
    pub skipped: usize,
    /// Clouds without a point, of which nothing is written.
    pub empty: usize,
    /// Points in the files written.
    pub points: usize,
    /// Triangles in the files written.
    pub triangles: usize,
    /// Bytes of the files written.
    pub bytes: u64,
    /// What could not be read, with the reason: nothing was written of it.
    pub problems: Vec<String>,
}

/// One file that is not finished yet.
struct Output {
    path: PathBuf,
    format: Format,
}

/// Writes what the plan asks for, on the current rayon pool. `progress` gets the number of triggers done and of all.
/// An error is one of writing, or of a folder that holds other things; damaged clouds are in the summary.
pub fn run(
    source: &dyn CloudSource,
    plan: &Plan,
    progress: impl Fn(u64, u64) + Sync,
) -> Result<Summary, Fault> {
    state_origin(source, plan)?;
    let triggers: Vec<(&u64, &Vec<usize>)> = source.triggers().range(plan.triggers.clone()).collect();
    let (done, total) = (AtomicU64::new(0), triggers.len() as u64);
    let summary = Mutex::new(Summary { triggers: triggers.len(), ..Summary::default() });
    let job = Job { source, plan, summary };
    triggers.into_par_iter().with_max_len(1).try_for_each(|(trigger, there)| {
        let cameras: Vec<usize> =
            plan.cameras.iter().copied().filter(|camera| there.contains(camera)).collect();
        job.trigger(*trigger, &cameras)?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
        Ok::<(), Fault>(())
    })?;
    let mut summary = job.summary.into_inner().unwrap_or_else(PoisonError::into_inner);
    summary.problems.sort();
    Ok(summary)
}

/// The folder of what the plan writes a file a trigger of, and that of a file a camera.
fn folders(plan: &Plan) -> (&'static str, &'static str) {
    match plan.mesh {
        None => ("merged", "clouds"),
        Some(MeshKind::Grid(_)) => ("meshes", "meshes"),
        Some(MeshKind::Watertight { .. }) => ("watertight", "watertight"),
    }
}

struct Job<'a> {
    source: &'a dyn CloudSource,
    plan: &'a Plan,
    summary: Mutex<Summary>,
}

impl Job<'_> {
    fn count(&self, change: impl FnOnce(&mut Summary)) {
        change(&mut self.summary.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// The files made of these cameras' clouds that are not finished.
    fn outputs(&self, folder: &str, stem: &str, trigger: u64, cameras: &[usize]) -> Vec<Output> {
        let made = self.source.modified(trigger, cameras);
        let output = |format: &Format| {
            let path = self.plan.out.join(folder).join(format!("{stem}.{}", format.extension()));
            let there = path.metadata().and_then(|there| there.modified()).ok();
            let finished = there.zip(made).is_some_and(|(there, made)| there >= made);
            (!finished).then_some(Output { path, format: *format })
        };
        let outputs: Vec<Output> = self.plan.formats.iter().filter_map(output).collect();
        self.count(|summary| summary.skipped += self.plan.formats.len() - outputs.len());
        outputs
    }

    /// All files of a trigger; `cameras`: those that have a cloud.
    fn trigger(&self, trigger: u64, cameras: &[usize]) -> Result<(), String> {
        let (of_trigger, of_camera) = folders(self.plan);
        let name = |camera: &usize| &self.source.cameras()[*camera].1;
        let single = cameras.iter().filter(|_| self.plan.directional).map(|camera| {
            self.outputs(of_camera, &format!("{}_{trigger:06}", name(camera)), trigger, &[*camera])
        });
        let single: Vec<Vec<Output>> = single.collect();
        let merged = match self.plan.merged {
            true => self.outputs(of_trigger, &format!("{trigger:06}"), trigger, cameras),
            false => Vec::new(),
        };
        if merged.is_empty() && single.iter().all(Vec::is_empty) {
            return Ok(());
        }
        // A merged file is made of all clouds; where it is there, those are read whose own file is missing.
        let missing = |place: usize| single.get(place).is_some_and(|outputs| !outputs.is_empty());
        let needed = (0..cameras.len()).filter(|&place| !merged.is_empty() || missing(place));
        let (needed, single): (Vec<usize>, Vec<&[Output]>) =
            needed.map(|place| (cameras[place], single.get(place).map_or(&[][..], Vec::as_slice))).unzip();
        let clouds = match self.source.clouds(trigger, &needed) {
            Ok(clouds) => clouds,
            Err(problem) => {
                self.count(|summary| summary.problems.push(problem));
                return Ok(());
            }
        };
        let numbered = needed.iter().map(|&camera| self.source.cameras()[camera].clone());
        let numbered: Vec<(u8, String)> = numbered.collect();
        for ((outputs, commented), camera) in single.iter().zip(&clouds).zip(numbered.chunks(1)) {
            if !outputs.is_empty() {
                self.save_single(outputs, commented, camera)?;
            }
        }
        if merged.is_empty() { Ok(()) } else { self.save_merged(trigger, &merged, &clouds, &numbered) }
    }

    fn save_single(
        &self,
        outputs: &[Output],
        (comments, cloud): &Commented,
        cameras: &[(u8, String)],
    ) -> Result<(), String> {
        let Some(MeshKind::Grid(limits)) = self.plan.mesh else {
            return self.save(outputs, &Shape { cloud, triangles: &[], comments, cameras });
        };
        let mesh = mesh::on_grid(cloud, limits);
        let shape = Shape { cloud: &mesh.vertices, triangles: &mesh.triangles, comments, cameras };
        self.save(outputs, &shape)
    }

    fn save_merged(
        &self,
        trigger: u64,
        outputs: &[Output],
        clouds: &[Commented],
        cameras: &[(u8, String)],
    ) -> Result<(), String> {
        let mut comments = merged_comments(clouds, cameras);
        let joined = |comments: &mut Vec<String>| {
            let (cloud, left_out) = merged_cloud(clouds, cameras);
            let stated = || stated_removed(clouds, comments).map(merge::removed_comment);
            let lacks = left_out.comment().or_else(stated);
            comments.extend(lacks);
            cloud
        };
        let mesh = match self.plan.mesh {
            None => Ok(Mesh { vertices: joined(&mut comments), triangles: Vec::new() }),
            Some(MeshKind::Grid(limits)) => {
                let mut all = Mesh::default();
                for ((_, cloud), (number, _)) in clouds.iter().zip(cameras) {
                    all.append(&mesh::on_grid(cloud, limits), *number);
                }
                Ok(all)
            }
            Some(MeshKind::Watertight { cell_m }) => mesh::watertight(&joined(&mut comments), cell_m),
        };
        match mesh {
            Ok(mesh) => {
                let (cloud, comments) = (&mesh.vertices, &comments);
                self.save(outputs, &Shape { cloud, triangles: &mesh.triangles, comments, cameras })
            }
            Err(reason) => {
                self.count(|summary| summary.problems.push(format!("trigger {trigger}: {reason}")));
                Ok(())
            }
        }
    }

    fn save(&self, outputs: &[Output], shape: &Shape<'_>) -> Result<(), String> {
        for Output { path, format } in outputs {
            let fail = |e: std::io::Error| format!("{}: {e}", path.display());
            if shape.cloud.is_empty() {
                match std::fs::remove_file(path) {
                    Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(fail(error)),
                    _ => self.count(|summary| summary.empty += 1),
                }
                continue;
            }
            format.save(path, shape).map_err(fail)?;
            let bytes = path.metadata().map_err(fail)?.len();
            self.count(|summary| {
                summary.written += 1;
                summary.points += shape.cloud.len();
                summary.triangles += shape.triangles.len();
                summary.bytes += bytes;
            });
        }
        Ok(())
    }
}

fn merged_comments(clouds: &[Commented], cameras: &[(u8, String)]) -> Vec<String> {
    let first = clouds.first().map_or(&[][..], |(comments, _)| comments);
    let common = first.iter().filter(|comment| COMMON.iter().any(|key| comment.starts_with(key)));
    let mut comments: Vec<String> = common.cloned().collect();
    let names: Vec<String> = cameras.iter().map(|(number, name)| format!("{number}={name}")).collect();
    comments.push(format!("cameras {}", names.join(" ")));
    comments
}

/// How many points the merged cloud lacks that these clouds were picked out of, as its file states, if all of its
/// cameras are there.
fn stated_removed(clouds: &[Commented], merged: &[String]) -> Option<usize> {
    let (stated, removed) = merge::split_removed(&clouds.first()?.0)?;
    (stated.last() == merged.last()).then_some(removed)
}

/// Makes the folders, and writes down what they are for; an error where they are for something else.
fn state_origin(source: &dyn CloudSource, plan: &Plan) -> Result<(), Fault> {
    let names: Vec<&str> = plan.cameras.iter().map(|&camera| source.cameras()[camera].1.as_str()).collect();
    let (of_trigger, of_camera) = folders(plan);
    let mut wanted = Map::new();
    for format in &plan.formats {
        let mut state = |key: String, cameras: Value| {
            let mesh = plan.mesh.as_ref().map(ToString::to_string);
            let mut about = json!({"origin": plan.origin, "cameras": cameras, "mesh": mesh});
            if let Format::Xyz { comments, columns } = *format
                && *format != Format::XYZ
            {
                about["xyz"] = json!({"comments": comments, "columns": columns});
            }
            wanted.insert(key, about);
        };
        if plan.merged {
            state(format!("{of_trigger}/INDEX.{}", format.extension()), json!(names));
        }
        if plan.directional {
            state(format!("{of_camera}/CAMERA_INDEX.{}", format.extension()), Value::Null);
        }
    }
    for (needed, folder) in [(plan.merged, of_trigger), (plan.directional, of_camera)] {
        let path = plan.out.join(folder);
        if needed {
            std::fs::create_dir_all(&path).map_err(|e| format!("{}: {e}", path.display()))?;
        }
    }
    claim(&plan.out, wanted)
}

/// Writes statements to OUT/export.json; an error where one of them is there and differs.
pub fn claim(out: &Path, wanted: Map<String, Value>) -> Result<(), Fault> {
    let path = out.join("export.json");
    let fail = |e: &dyn std::fmt::Display| format!("{}: {e}", path.display());
    let mut stated: Map<String, Value> = match regular::read(&path, regular::STATEMENT_BYTES) {
        Ok(bytes) => json::from_slice(&bytes).map_err(|e| fail(&e))?,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Map::new(),
        Err(e) => return Err(fail(&e).into()),
    };
    for (key, value) in wanted {
        match stated.get(&key) {
            Some(there) if *there != value => {
                let message = format!(
                    "{}: its {key} were made of {there}, wanted is {value}; give another directory with \
                     --out, or delete \
                     them and their entry in {}",
                    out.display(),
                    path.display()
                );
                return Err(Fault::new(Exit::Usage, message));
            }
            _ => drop(stated.insert(key, value)),
        }
    }
    Ok(json::save(&path, &stated)?)
}
