// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where clouds come from when they are exported: directories of PLY files here, stored phase maps in
//! `batch::from_phase_maps`.

use super::ply;
use crate::data::Cloud;
use crate::merge::{self, LeftOut, Rule, View, Viewpoint};
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// A cloud with the comments of its file.
pub type Commented = (Vec<String>, Cloud);

/// Directional clouds by trigger and camera.
pub trait CloudSource: Sync {
    /// Number in merged clouds and name of every camera, by number.
    fn cameras(&self) -> &[(u8, String)];

    /// The triggers that there are, with the places in [`Self::cameras`] of the cameras that have a cloud.
    fn triggers(&self) -> &BTreeMap<u64, Vec<usize>>;

    /// The clouds of these cameras (places in [`Self::cameras`]) at a trigger. An error states which file is damaged,
    /// or missing.
    fn clouds(&self, trigger: u64, cameras: &[usize]) -> Result<Vec<Commented>, String>;

    /// When the latest of these files was written.
    fn modified(&self, trigger: u64, cameras: &[usize]) -> Option<SystemTime>;

    /// When the trigger was, ns, where that is known.
    fn time_ns(&self, _trigger: u64) -> Option<u64> {
        None
    }
}

/// Calls `then` with the views of directional clouds for [`merge`] and what their merged cloud lacks; `numbers`:
/// those of their cameras in merged clouds.
fn with_views<T>(
    clouds: &[Commented],
    numbers: impl Iterator<Item = u8>,
    then: impl FnOnce(&[View<'_>], LeftOut) -> T,
) -> T {
    let from: Vec<Option<Viewpoint>> = clouds.iter().map(|(comments, _)| Viewpoint::of(comments)).collect();
    let views = clouds.iter().zip(&from).zip(numbers);
    let views = views.map(|(((_, cloud), from), camera)| View { camera, cloud, from: from.as_ref() });
    let views: Vec<View<'_>> = views.collect();
    let left_out = merge::left_out(&views, Rule::default());
    then(&views, left_out)
}

/// The merged cloud of directional ones, by the rule of [`merge`], and what it lacks; number and name of each camera.
pub fn merged_cloud(clouds: &[Commented], cameras: &[(u8, String)]) -> (Cloud, LeftOut) {
    let numbers = cameras.iter().map(|(number, _)| *number);
    with_views(clouds, numbers, |views, left_out| (merge::merged(views, &left_out), left_out))
}

/// Writes the merged cloud of directional ones with these comments and what it lacks; the number of its points.
pub fn save_merged(
    path: &Path,
    clouds: &[Commented],
    numbers: impl Iterator<Item = u8>,
    comments: Vec<String>,
) -> io::Result<usize> {
    with_views(clouds, numbers, |views, left_out| merge::save(path, views, &left_out, comments))
}

/// What `reconstruct` wrote: `clouds/CAMERA_INDEX.ply`, or only `merged/INDEX.ply`.
pub struct PlyDirectory {
    cameras: Vec<(u8, String)>,
    triggers: BTreeMap<u64, Vec<usize>>,
    directory: PathBuf,
    /// Whether there are directional clouds; else they are picked out of the merged ones.
    directional: bool,
}

impl PlyDirectory {
    /// Lists the clouds. An error where there are none.
    pub fn open(directory: &Path) -> Result<Self, String> {
        let mut found: BTreeMap<u64, BTreeSet<String>> = BTreeMap::new();
        let mut names: BTreeSet<String> = BTreeSet::new();
        for stem in stems(&directory.join("clouds")) {
            let Some((trigger, Some(camera))) = named(&stem) else { continue };
            names.insert(camera.to_owned());
            found.entry(trigger).or_default().insert(camera.to_owned());
        }
        let directional = !found.is_empty();
        let merged: Vec<u64> =
            stems(&directory.join("merged")).iter().filter_map(|stem| stem.parse().ok()).collect();
        let stated = merged.first().map(|trigger| merged_path(directory, *trigger));
        let mut cameras = match stated {
            Some(path) => stated_cameras(&path)?,
            None => Vec::new(),
        };
        // Without a merged cloud they have no numbers yet.
        for name in names {
            if !cameras.iter().any(|(_, known)| *known == name) {
                let free =
                    (0..crate::data::NO_CAMERA).find(|n| cameras.iter().all(|(number, _)| number != n));
                cameras.push((free.ok_or("more than 255 cameras")?, name));
            }
        }
        cameras.sort();
        let all: Vec<usize> = (0..cameras.len()).collect();
        let triggers: BTreeMap<u64, Vec<usize>> = if directional {
            let place = |name: &String| cameras.iter().position(|(_, known)| known == name);
            found
                .iter()
                .map(|(trigger, names)| {
                    let mut places: Vec<usize> = names.iter().filter_map(place).collect();
                    places.sort_unstable();
                    (*trigger, places)
                })
                .collect()
        } else {
            merged.into_iter().map(|trigger| (trigger, all.clone())).collect()
        };
        if triggers.is_empty() {
            return Err(format!(
                "{}: expected clouds/CAMERA_INDEX.ply or merged/INDEX.ply as `fourdbody reconstruct` writes \
                 them, found none",
                directory.display()
            ));
        }
        Ok(Self { cameras, triggers, directory: directory.to_owned(), directional })
    }

    fn paths(&self, trigger: u64, cameras: &[usize]) -> Vec<PathBuf> {
        if !self.directional {
            return vec![merged_path(&self.directory, trigger)];
        }
        let name = |&place: &usize| {
            let camera = &self.cameras[place].1;
            self.directory.join("clouds").join(format!("{camera}_{trigger:06}.ply"))
        };
        cameras.iter().map(name).collect()
    }
}

/// Names without `.ply`, sorted; none where there is no such directory.
fn stems(directory: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(directory) else { return Vec::new() };
    let stem = |entry: std::fs::DirEntry| Some(entry.file_name().to_str()?.strip_suffix(".ply")?.to_owned());
    let mut stems: Vec<String> = entries.flatten().filter_map(stem).collect();
    stems.sort();
    stems
}

/// Trigger and camera by a file's name: `CAMERA_TRIGGER`, or `TRIGGER` of a merged cloud.
pub(crate) fn named(stem: &str) -> Option<(u64, Option<&str>)> {
    if let Ok(trigger) = stem.parse() {
        return Some((trigger, None));
    }
    let (camera, index) = stem.rsplit_once('_')?;
    Some((index.parse().ok()?, Some(camera)))
}

fn merged_path(directory: &Path, trigger: u64) -> PathBuf {
    directory.join("merged").join(format!("{trigger:06}.ply"))
}

/// Numbers and names that a merged cloud states: `cameras 0=h0_up 1=h0_low`.
fn stated_cameras(path: &Path) -> Result<Vec<(u8, String)>, String> {
    let header = ply::load_header(path).map_err(|e| e.to_string())?;
    let pairs = header.comment("cameras").unwrap_or_default().split_whitespace();
    let pair = |text: &str| {
        let (number, name) = text.split_once('=')?;
        // The name becomes a part of file names.
        let plain = !name.is_empty() && !name.contains(['/', '\\']) && name != "..";
        plain.then_some((number.parse().ok()?, name.to_owned()))
    };
    let cameras: Option<Vec<(u8, String)>> = pairs.map(pair).collect();
    cameras.ok_or_else(|| {
        format!("{}: expected a comment like `cameras 0=h0_up 1=h0_low`: reconstruct again", path.display())
    })
}

impl CloudSource for PlyDirectory {
    fn cameras(&self) -> &[(u8, String)] {
        &self.cameras
    }

    fn triggers(&self) -> &BTreeMap<u64, Vec<usize>> {
        &self.triggers
    }

    fn clouds(&self, trigger: u64, cameras: &[usize]) -> Result<Vec<Commented>, String> {
        let paths = self.paths(trigger, cameras);
        let loaded: Result<Vec<Commented>, String> = paths
            .iter()
            .map(|path| {
                ply::load(path).map(|(header, cloud)| (header.comments, cloud)).map_err(|e| e.to_string())
            })
            .collect();
        match (loaded?, self.directional) {
            (clouds, true) => Ok(clouds),
            (merged, false) => {
                let pick = |&place: &usize| {
                    let (comments, cloud) = merged.first().ok_or("no merged cloud")?;
                    Ok((comments.clone(), cloud.of_camera(self.cameras[place].0)))
                };
                cameras.iter().map(pick).collect()
            }
        }
    }

    fn time_ns(&self, trigger: u64) -> Option<u64> {
        let path = self.paths(trigger, self.triggers.get(&trigger)?).into_iter().next()?;
        ply::load_header(&path).ok()?.comment("time_ns")?.parse().ok()
    }

    fn modified(&self, trigger: u64, cameras: &[usize]) -> Option<SystemTime> {
        self.paths(trigger, cameras).iter().map(|path| path.metadata().ok()?.modified().ok()).max()?
    }
}
