// SPDX-License-Identifier: MIT OR Apache-2.0
//! A directory that `fourdbody reconstruct` wrote, as clouds: stored ones (`clouds/CAMERA_TRIGGER.ply`, `merged/TRIGGER.ply`, or the
//! same files in one directory), or those of its phase maps (`phases/CAMERA_TRIGGER.phase`), made with the calibration beside them.

use super::from_phase_maps::{self, PhaseDirectory};
use super::key::calibration_path;
use crate::data::{Calibration, Cloud};
use crate::export::merged_cloud;
use crate::formats::{CloudSource, Commented, ply};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where a cloud is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// In this file.
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
    /// Merged clouds by trigger.
    pub merged: BTreeMap<u64, Place>,
    maps: Option<PhaseDirectory>,
}

/// A cloud with its place.
pub type Placed<'a> = (&'a str, &'a Place);

impl Clouds {
    /// Lists the clouds under `directory`, or the phase maps where there are no clouds; an error when there is neither.
    pub fn open(directory: &Path) -> Result<Self, String> {
        let mut found = Self::default();
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
        Ok(found)
    }

    fn list(&mut self, folder: &Path) -> std::io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            let Some(stem) = path.file_name().and_then(|n| n.to_str()?.strip_suffix(".ply")) else {
                continue;
            };
            if let Ok(trigger) = stem.parse() {
                self.merged.entry(trigger).or_insert(Place::File(path));
            } else if let Some((camera, index)) = stem.rsplit_once('_')
                && let Ok(trigger) = index.parse()
            {
                self.directional.entry((trigger, camera.to_owned())).or_insert(Place::File(path));
            }
        }
        Ok(())
    }

    /// The cloud at a place, with the comments of its file. An error says which file is damaged.
    pub fn load(&self, place: &Place) -> Result<Commented, String> {
        let maps = || self.maps.as_ref().ok_or("no phase maps");
        match place {
            Place::File(path) => load_ply(path),
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
                Ok((comments, merged_cloud(&clouds, &cameras)))
            }
        }
    }

    /// Directional clouds by trigger and head. The calibration says which cameras make a head; without one, the
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
        format!("{e}. Results lie beside the calibration that they were made with: give the directory that `fourdbody reconstruct` wrote")
    })
}

/// The cloud of one file of a result, a cloud or a phase map, with its comments.
pub fn load_file(path: &Path) -> Result<Commented, String> {
    if path.extension().is_none_or(|end| end != "phase") {
        return load_ply(path);
    }
    // `DIR/phases/CAMERA_TRIGGER.phase`, also where DIR is not written.
    let path = std::path::absolute(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let directory = path.parent().and_then(Path::parent).unwrap_or(Path::new("/"));
    from_phase_maps::load_cloud(&path, &calibration_of(directory)?)
}

fn load_ply(path: &Path) -> Result<(Vec<String>, Cloud), String> {
    ply::load(path).map(|(header, cloud)| (header.comments, cloud)).map_err(|e| e.to_string())
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
        for said in [Clouds::open(dir.path()).err(), load_file(&path).err()] {
            let said = said.expect("no calibration");
            assert!(said.contains("calibration.json") && said.contains("reconstruct"), "{said}");
        }
    }
}
