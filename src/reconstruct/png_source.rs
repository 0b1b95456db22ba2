//! Frames from a directory of `CAMERA/INDEX.png` files (8-bit grey; index = trigger index).

use super::source::{Frame, FrameSource};
use crate::ids::{CameraId, TriggerIndex};
use crate::image::read_png_grey;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A directory of images. Files are found when it is opened and read when they are asked for.
#[derive(Debug)]
pub struct PngSource {
    cameras: Vec<CameraId>,
    files: BTreeMap<(CameraId, u64), PathBuf>,
    triggers: Range<u64>,
}

impl PngSource {
    /// Lists the images of `cameras` under `directory`; cameras without a directory have gaps everywhere.
    pub fn open(directory: &Path, cameras: &[CameraId]) -> Result<Self, String> {
        let mut files = BTreeMap::new();
        for camera in cameras {
            let folder = directory.join(camera.as_str());
            let Ok(entries) = std::fs::read_dir(&folder) else { continue };
            for entry in entries {
                let path = entry.map_err(|e| format!("{}: {e}", folder.display()))?.path();
                if path.extension().is_none_or(|x| x != "png") {
                    continue;
                }
                let index = path.file_stem().and_then(|s| s.to_str()).and_then(|s| s.parse::<u64>().ok());
                let index = index.ok_or_else(|| {
                    format!("{}: expected a name like 000000.png, its trigger index", path.display())
                })?;
                files.insert((camera.clone(), index), path);
            }
        }
        let indices = || files.keys().map(|(_, index)| *index);
        let (Some(first), Some(last)) = (indices().min(), indices().max()) else {
            return Err(format!(
                "{}: expected images as CAMERA/INDEX.png for cameras {:?}, found none",
                directory.display(),
                cameras.iter().map(CameraId::as_str).collect::<Vec<_>>()
            ));
        };
        Ok(Self { cameras: cameras.to_vec(), files, triggers: first..last.saturating_add(1) })
    }
}

impl FrameSource for PngSource {
    fn cameras(&self) -> &[CameraId] {
        &self.cameras
    }

    fn triggers(&self) -> Range<u64> {
        self.triggers.clone()
    }

    fn frame(&self, camera: &CameraId, trigger: TriggerIndex) -> Result<Frame<'_>, String> {
        match self.files.get(&(camera.clone(), trigger.0)) {
            None => Ok(Frame::Gap("there is no such file".to_owned())),
            Some(path) => read_png_grey(path).map(Frame::Owned).map_err(|e| e.to_string()),
        }
    }
}
