// SPDX-License-Identifier: MIT OR Apache-2.0
//! A directory that `fourdbody reconstruct` wrote, as clouds: stored ones (`clouds/CAMERA_TRIGGER.ply`,
//! `merged/TRIGGER.ply`, or the same files in one directory), or those of its phase maps
//! (`phases/CAMERA_TRIGGER.phase`), made with the calibration beside them.

use super::belonging::{Expected, Held, Listed};
use super::files::named as list;
use super::from_phase_maps::{self, PhaseDirectory};
use super::key::calibration_path;
use crate::data::Calibration;
use crate::formats::{CloudSource, Commented, merged_cloud, named, ply};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Where a cloud of a result is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// In this file, as a PLY file.
    File(PathBuf),
    /// The phase map of a trigger and a camera, by its place among the cameras of the maps.
    Map(u64, usize),
    /// All phase maps of a trigger.
    Maps(u64),
}

/// The clouds of a result.
#[derive(Default)]
pub struct Clouds {
    /// Directional clouds by trigger and camera.
    pub directional: BTreeMap<(u64, String), Place>,
    pub merged: BTreeMap<u64, Place>,
    /// What they are held against.
    pub expected: Expected,
    there: Listed,
    maps: Option<PhaseDirectory>,
}

/// A cloud with its place.
pub type Placed<'a> = (&'a str, &'a Place);

impl Clouds {
    /// Lists the clouds under `directory`, or the phase maps where there are no clouds; an error when there is neither.
    pub fn open(directory: &Path) -> Result<Self, String> {
        let mut found = Self { expected: Expected::of(directory)?, ..Self::default() };
        for folder in [directory.join("clouds"), directory.join("merged"), directory.to_owned()] {
            if folder.is_dir() {
                found.list(&folder).map_err(|e| format!("{}: {e}", folder.display()))?;
            }
        }
        if found.directional.is_empty() && directory.join("phases").is_dir() {
            let maps = PhaseDirectory::open(directory, calibration_of(directory)?)?;
            for (&trigger, cameras) in maps.triggers() {
                for &camera in cameras {
                    let name = maps.cameras()[camera].1.clone();
                    found.directional.insert((trigger, name), Place::Map(trigger, camera));
                }
                found.merged.entry(trigger).or_insert(Place::Maps(trigger));
            }
            found.maps = Some(maps);
        }
        if found.directional.is_empty() && found.merged.is_empty() {
            return Err(format!(
                "{}: expected phases/, clouds/ or merged/ as `fourdbody reconstruct` writes them, found none",
                directory.display()
            ));
        }
        for (trigger, camera) in found.directional.keys() {
            found.there.entry(*trigger).or_default().insert(camera.clone());
        }
        if found.directional.is_empty() {
            let all = found.merged.keys().map(|trigger| (*trigger, found.expected.cameras_at(*trigger)));
            found.there = all.collect();
        }
        found.directional.retain(|(trigger, _), _| found.expected.speaks_of(*trigger));
        found.merged.retain(|trigger, _| found.expected.speaks_of(*trigger));
        Ok(found)
    }

    /// What is missing of the files of these triggers, and what is left out, a sentence each ([`Expected::amiss`]).
    pub fn amiss(&self, triggers: &Range<u64>) -> Vec<String> {
        let mut amiss = self.expected.amiss(&self.there, triggers, &|_| true);
        let with_points = self.expected.triggers_with_points().filter(|trigger| triggers.contains(trigger));
        let missing: Vec<u64> = with_points.filter(|trigger| self.lacks_merged(*trigger)).collect();
        if !missing.is_empty() {
            amiss.push(format!(
                "MISSING  the merged clouds of {}, which have points by summary.json",
                list(&missing)
            ));
        }
        amiss
    }

    /// Of a trigger that has points by the summary: whose files are missing that its merged cloud is, or is made of.
    pub fn missing_at(&self, trigger: u64) -> Option<String> {
        if self.merged.values().any(|place| matches!(place, Place::File(_))) {
            return self.lacks_merged(trigger).then(|| "the merged cloud".to_owned());
        }
        let cameras: Vec<&str> = self.expected.missing_at(trigger, &self.there).collect();
        (!cameras.is_empty()).then(|| format!("the files of {}", cameras.join(", ")))
    }

    /// Whether other triggers have merged clouds, and this one, which has points, has none.
    fn lacks_merged(&self, trigger: u64) -> bool {
        let some = self.merged.values().any(|place| matches!(place, Place::File(_)));
        some && !self.merged.contains_key(&trigger) && self.expected.has_points(trigger)
    }

    fn list(&mut self, folder: &Path) -> std::io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            let Some(stem) = path.file_name().and_then(|n| n.to_str()?.strip_suffix(".ply")) else {
                continue;
            };
            match named(stem) {
                Some((trigger, None)) => drop(self.merged.entry(trigger).or_insert(Place::File(path))),
                Some((trigger, Some(camera))) => {
                    let key = (trigger, camera.to_owned());
                    self.directional.entry(key).or_insert(Place::File(path));
                }
                None => {}
            }
        }
        Ok(())
    }

    /// The cloud at a place, with the comments of its file. An error states which file is damaged, or of something
    /// else.
    pub fn load(&self, place: &Place) -> Result<Commented, String> {
        let source = self.maps.as_ref().map(|maps| Held::new(maps, &self.expected));
        let maps = || source.as_ref().ok_or("no phase maps");
        match place {
            Place::File(path) => load_held(path, &self.expected),
            Place::Map(trigger, camera) => {
                let cloud = maps()?.clouds(*trigger, &[*camera])?.pop();
                cloud.ok_or_else(|| format!("trigger {trigger}: no phase map"))
            }
            Place::Maps(trigger) => {
                let maps = maps()?;
                let places = maps.triggers().get(trigger).map_or(&[][..], |cameras| cameras);
                let clouds = maps.clouds(*trigger, places)?;
                let cameras: Vec<_> = places.iter().map(|&place| maps.cameras()[place].clone()).collect();
                let comments = clouds.first().map_or_else(Vec::new, |(comments, _)| comments.clone());
                Ok((comments, merged_cloud(&clouds, &cameras).0))
            }
        }
    }

    /// Directional clouds by trigger and head. The calibration states which cameras make a head; without one, the
    /// part of the camera's name before its last `_` does.
    pub fn heads(&self, calibration: Option<&Calibration>) -> BTreeMap<(u64, String), Vec<Placed<'_>>> {
        let mut heads: BTreeMap<_, Vec<Placed<'_>>> = BTreeMap::new();
        for ((trigger, camera), place) in &self.directional {
            let known = calibration.and_then(|c| c.cameras().find(|(_, found)| found.id.as_str() == camera));
            let head = match known {
                Some((head, _)) => head.id.to_string(),
                None => camera.rsplit_once('_').map_or(camera.as_str(), |(head, _)| head).to_owned(),
            };
            heads.entry((*trigger, head)).or_default().push((camera, place));
        }
        heads
    }
}

/// The calibration of a result.
pub fn calibration_of(directory: &Path) -> Result<Calibration, String> {
    let path = calibration_path(directory);
    Calibration::load(&path).map_err(|e| {
        format!(
            "{e}. Results lie beside the calibration that they were made with: give the directory that \
             `fourdbody reconstruct` wrote"
        )
    })
}

/// The cloud of one file of a result, a cloud or a phase map, with its comments.
pub fn load_file(path: &Path) -> Result<Commented, String> {
    // `DIR/phases/CAMERA_TRIGGER.phase`, also where DIR is not written.
    let path = std::path::absolute(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let directory = path.parent().and_then(Path::parent).unwrap_or(Path::new("/"));
    let is_map = path.extension().is_some_and(|end| end == "phase");
    if !is_map
        && !path.parent().is_some_and(|folder| folder.ends_with("clouds") || folder.ends_with("merged"))
    {
        // Whatever it is called, and wherever it lies.
        return load_ply(&path);
    }
    let expected = Expected::of(directory)?;
    if !is_map {
        return load_held(&path, &expected);
    }
    let cloud = from_phase_maps::load_cloud(&path, &calibration_of(directory)?)?;
    held(&path, &expected, cloud)
}

fn load_ply(path: &Path) -> Result<Commented, String> {
    ply::load(path).map(|(header, cloud)| (header.comments, cloud)).map_err(|e| e.to_string())
}

fn load_held(path: &Path, expected: &Expected) -> Result<Commented, String> {
    held(path, expected, load_ply(path)?)
}

/// A cloud of the trigger and camera that its file's name states, and of this result.
fn held(path: &Path, expected: &Expected, (comments, cloud): Commented) -> Result<Commented, String> {
    let stem = path.file_stem().and_then(|stem| stem.to_str());
    if let Some((trigger, camera)) = stem.and_then(named) {
        let held = expected.hold(trigger, camera, Some(cloud.len()), &comments);
        held.map_err(|reason| format!("FOREIGN  {}: {reason}", path.display()))?;
    }
    Ok((comments, cloud))
}

#[cfg(test)]
mod tests {
    use super::{Clouds, load_file};

    #[test]
    fn clouds_are_found_by_name() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        std::fs::create_dir(dir.path().join("clouds")).expect("writable");
        std::fs::create_dir(dir.path().join("merged")).expect("writable");
        for name in ["clouds/h0_up_000003.ply", "clouds/h0_low_000003.ply", "merged/000003.ply", "notes.txt"]
        {
            std::fs::write(dir.path().join(name), "").expect("writable");
        }
        let set = Clouds::open(dir.path()).expect("clouds");
        let heads = set.heads(None);
        assert_eq!(heads.keys().collect::<Vec<_>>(), [&(3, "h0".to_owned())]);
        assert_eq!(heads.values().next().map(Vec::len), Some(2));
        assert_eq!(set.merged.keys().collect::<Vec<_>>(), [&3]);
        assert!(Clouds::open(&dir.path().join("nothing")).is_err());
    }

    #[test]
    fn phase_maps_without_their_calibration_are_not_read() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("phases/h0_up_000003.phase");
        std::fs::create_dir(dir.path().join("phases")).expect("writable");
        std::fs::write(&path, "").expect("writable");
        for error in [Clouds::open(dir.path()).err(), load_file(&path).err()] {
            let error = error.expect("no calibration");
            assert!(error.contains("calibration.json") && error.contains("reconstruct"), "{error}");
        }
    }
}
