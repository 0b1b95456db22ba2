// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rendered sequences on disk, and their replay at full rate.
//!
//! `DIR/frames/CAMERA.mono8` holds all images of one camera one after the other; `DIR/manifest.json` lists what
//! they are and is written last, so that a directory with a manifest is complete.

use crate::images::ImageSource;
use crate::scenario::AfterEnd;
use fourdbody::base::ids::CameraId;
use fourdbody::base::image::Mono8;
use memmap2::{Mmap, MmapOptions};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

/// What a cache directory holds.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    format: String,
    version: u32,
    /// SHA-256 of everything that the images depend on.
    pub inputs_sha256: String,
    pub scenario: String,
    /// Number of images per camera.
    pub instants: usize,
    /// What follows the last one.
    pub after_end: AfterEnd,
    /// The cameras, in the rig's order.
    pub cameras: Vec<CachedCamera>,
}

/// One camera of a cache.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CachedCamera {
    /// Its name in the rig.
    pub id: CameraId,
    pub width: usize,
    pub height: usize,
}

/// Why a cache could not be used.
#[derive(Debug, thiserror::Error)]
pub enum CacheError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: io::Error },
    /// The directory is not a cache, or not this one's.
    #[error("{path}: {reason}; render it again with `fourdbody-sim render`")]
    Invalid {
        path: PathBuf,
        /// What was found, what was expected.
        reason: String,
    },
}

const FORMAT: &str = "fourdbody-frames";
const VERSION: u32 = 1;

impl Manifest {
    /// A manifest of this version.
    pub fn new(
        inputs_sha256: String,
        scenario: String,
        instants: usize,
        after_end: AfterEnd,
        cameras: Vec<CachedCamera>,
    ) -> Self {
        Self {
            format: FORMAT.to_owned(),
            version: VERSION,
            inputs_sha256,
            scenario,
            instants,
            after_end,
            cameras,
        }
    }

    /// Where the manifest of a directory is.
    pub fn path(directory: &Path) -> PathBuf {
        directory.join("manifest.json")
    }

    /// Reads the manifest of a rendered sequence's directory.
    pub fn load(directory: &Path) -> Result<Self, CacheError> {
        let path = Self::path(directory);
        let bytes = std::fs::read(&path).map_err(|source| CacheError::Io { path: path.clone(), source })?;
        let invalid = |reason: String| CacheError::Invalid { path: path.clone(), reason };
        let manifest: Self =
            serde_json::from_slice(&bytes).map_err(|e| invalid(format!("not a manifest ({e})")))?;
        if manifest.format != FORMAT || manifest.version != VERSION {
            return Err(invalid(format!(
                "format {:?} version {}, expected {FORMAT:?} version {VERSION}",
                manifest.format, manifest.version
            )));
        }
        if manifest.instants == 0 {
            return Err(invalid("no instants".to_owned()));
        }
        Ok(manifest)
    }

    /// Writes the manifest: the directory is complete from now on.
    pub fn save(&self, directory: &Path) -> Result<(), CacheError> {
        let path = Self::path(directory);
        let partial = directory.join("manifest.json.partial");
        let write = || -> io::Result<()> {
            std::fs::write(&partial, serde_json::to_string_pretty(self)? + "\n")?;
            std::fs::rename(&partial, &path)
        };
        write().map_err(|source| CacheError::Io { path: path.clone(), source })
    }

    /// Where a camera's images are.
    pub fn frames_path(directory: &Path, camera: &CameraId) -> PathBuf {
        directory.join("frames").join(format!("{camera}.mono8"))
    }
}

/// One camera's images, mapped into memory.
pub struct CachedImages {
    map: Mmap,
    width: usize,
    height: usize,
    instants: usize,
    after_end: AfterEnd,
}

impl CachedImages {
    /// Maps a camera's images and reads them into memory, so that replay never waits for a disk. The file must
    /// not be changed while it is mapped.
    pub fn open(directory: &Path, manifest: &Manifest, camera: &CameraId) -> Result<Self, CacheError> {
        let path = Manifest::frames_path(directory, camera);
        let invalid = |reason: String| CacheError::Invalid { path: path.clone(), reason };
        let listed = manifest.cameras.iter().find(|c| c.id == *camera);
        let listed = listed.ok_or_else(|| invalid(format!("the manifest lists no camera {camera}")))?;
        let expected = listed.width.checked_mul(listed.height).and_then(|n| n.checked_mul(manifest.instants));
        let open = || -> io::Result<Mmap> {
            let file = File::open(&path)?;
            // SAFETY: the mapping is read-only and only read as bytes; a cache is never changed once its
            // manifest is there.
            unsafe { MmapOptions::new().populate().map(&file) }
        };
        let map = open().map_err(|source| CacheError::Io { path: path.clone(), source })?;
        if Some(map.len()) != expected {
            let (n, w, h) = (manifest.instants, listed.width, listed.height);
            return Err(invalid(format!("{} bytes, expected {n} images of {w} x {h}", map.len())));
        }
        Ok(Self {
            map,
            width: listed.width,
            height: listed.height,
            instants: manifest.instants,
            after_end: manifest.after_end,
        })
    }

    /// The image at an instant, within or beyond the sequence.
    pub fn image(&self, instant: i64) -> Option<Mono8<'_>> {
        Mono8::new(self.width, self.height, self.pixels(instant))
    }
}

/// Which image of a sequence is shown at an instant: before the first, the first; after the last, as
/// `after_end` defines.
pub fn image_number(instant: i64, instants: usize, after_end: AfterEnd) -> usize {
    let instant = usize::try_from(instant.max(0)).unwrap_or(0);
    match after_end {
        AfterEnd::Wrap => instant % instants,
        AfterEnd::PingPong => {
            let around = (2 * instants - 2).max(1);
            let within = instant % around;
            if within < instants { within } else { around - within }
        }
    }
}

impl ImageSource for CachedImages {
    fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn pixels(&self, instant: i64) -> &[u8] {
        let bytes = self.width * self.height;
        let number = image_number(instant, self.instants, self.after_end);
        &self.map[number * bytes..][..bytes]
    }
}

#[cfg(test)]
mod tests {
    use super::{CachedCamera, CachedImages, Manifest, image_number};
    use crate::images::ImageSource;
    use crate::scenario::AfterEnd;
    use fourdbody::base::ids::CameraId;

    #[test]
    fn sequences_go_on_as_the_scenario_says() {
        let shown = |after_end| -> Vec<usize> { (-2..9).map(|i| image_number(i, 4, after_end)).collect() };
        assert_eq!(shown(AfterEnd::Wrap), [0, 0, 0, 1, 2, 3, 0, 1, 2, 3, 0]);
        assert_eq!(shown(AfterEnd::PingPong), [0, 0, 0, 1, 2, 3, 2, 1, 0, 1, 2]);
        assert_eq!(image_number(5, 1, AfterEnd::PingPong), 0);
        assert_eq!(image_number(i64::MIN, 1, AfterEnd::Wrap), 0);
    }

    #[test]
    fn frames_replay_and_a_cut_file_is_refused() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let id = CameraId::from("h0_up");
        let cameras = vec![CachedCamera { id: id.clone(), width: 4, height: 2 }];
        let manifest = Manifest::new("0".to_owned(), "x".to_owned(), 3, AfterEnd::Wrap, cameras);
        manifest.save(dir.path()).expect("writable");
        assert_eq!(Manifest::load(dir.path()).expect("readable"), manifest);
        let path = Manifest::frames_path(dir.path(), &id);
        std::fs::create_dir_all(path.parent().expect("a parent")).expect("writable");
        let bytes: Vec<u8> = (0..24).collect();
        std::fs::write(&path, &bytes).expect("writable");
        let images = CachedImages::open(dir.path(), &manifest, &id).expect("complete");
        assert_eq!(images.size(), (4, 2));
        assert_eq!(images.pixels(-1), &bytes[..8]);
        assert_eq!(images.pixels(4), &bytes[8..16]);
        drop(images);
        std::fs::write(&path, &bytes[..23]).expect("writable");
        assert!(CachedImages::open(dir.path(), &manifest, &id).is_err());
        assert!(CachedImages::open(dir.path(), &manifest, &CameraId::from("h9")).is_err());
    }
}
