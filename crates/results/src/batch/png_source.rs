// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames from a directory of `CAMERA/INDEX.png` files (8-bit grey; index = trigger index).

use super::image_tree::ImageTree;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::read_png_grey;
use crate::data::{Frame, FrameSource, SessionIdentity};
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A directory of images. Files are found when it is opened, and read when a frame is requested.
#[derive(Debug)]
pub struct PngSource {
    cameras: Vec<CameraId>,
    tree: ImageTree,
    triggers: Range<u64>,
}

impl PngSource {
    /// Lists the images of `cameras` under `directory`; cameras without a directory have gaps everywhere.
    pub fn open(directory: &Path, cameras: &[CameraId]) -> Result<Self, String> {
        let tree = ImageTree::list(directory, cameras, &["png"]).map_err(|problems| problems.join("\n"))?;
        let wanted = tree.cameras.iter().filter(|(camera, _)| cameras.contains(camera));
        let indexes: Vec<u64> = wanted.flat_map(|(_, images)| images.keys().copied()).collect();
        let (Some(first), Some(last)) = (indexes.iter().min(), indexes.iter().max()) else {
            return Err(format!(
                "{}: expected images as CAMERA/INDEX.png for cameras {:?}, found none",
                directory.display(),
                cameras.iter().map(CameraId::as_str).collect::<Vec<_>>()
            ));
        };
        Ok(Self { cameras: cameras.to_vec(), triggers: *first..last + 1, tree })
    }

    fn path(&self, camera: &CameraId, trigger: TriggerIndex) -> Option<&PathBuf> {
        self.tree.cameras.get(camera)?.get(&trigger.0)
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
        match self.path(camera, trigger) {
            None => Ok(Frame::Gap("there is no such file".to_owned())),
            Some(path) => read_png_grey(path).map(Frame::Owned).map_err(|e| e.to_string()),
        }
    }

    /// By the names and sizes of all images: what is in them is looked at where it is used.
    fn identity(&self) -> Result<SessionIdentity, String> {
        let mut digest = Sha256::new();
        for (camera, images) in &self.tree.cameras {
            for (index, path) in images {
                let bytes = path.metadata().map_err(|e| format!("{}: {e}", path.display()))?.len();
                digest.update(format!("{camera}/{index}: {bytes}\n"));
            }
        }
        let id: String = digest.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect();
        let images = self.tree.cameras.iter().filter(|(_, images)| !images.is_empty());
        let cameras = images.map(|(camera, _)| camera.clone()).collect();
        Ok(SessionIdentity { id: format!("images {id}"), cameras, ..SessionIdentity::default() })
    }

    fn left_out(&self) -> &[PathBuf] {
        &self.tree.left_out
    }
}
