// SPDX-License-Identifier: MIT OR Apache-2.0
//! A session's frames to pictures: `OUT/CAMERA/INDEX.png` (or `.tiff`), 8-bit grey without loss, the names that
//! `fourdbody import` and `reconstruct` read.

use super::job::claim;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::{Mono8, encode_png_grey};
use crate::base::{Fault, write_whole};
use crate::data::FrameSource;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Map, json};
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// A format of pictures that frames are exported to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Picture {
    Png,
    #[cfg(feature = "tiff")]
    Tiff,
}

impl Picture {
    /// How files of it are called behind the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Png => "png",
            #[cfg(feature = "tiff")]
            Self::Tiff => "tiff",
        }
    }

    /// Writes a file, which is never half there.
    pub fn save(self, path: &Path, image: Mono8<'_>) -> io::Result<()> {
        write_whole(path, |file| self.write(file, image))
    }

    fn write(self, out: impl Write + Seek, image: Mono8<'_>) -> io::Result<()> {
        // A buffer that is dropped with bytes in it reports no error of writing them.
        let mut out = BufWriter::new(out);
        match self {
            Self::Png => encode_png_grey(&mut out, image)?,
            #[cfg(feature = "tiff")]
            Self::Tiff => {
                let side = |side: usize| u32::try_from(side).map_err(io::Error::other);
                let (width, height) = (side(image.width())?, side(image.height())?);
                let mut encoder = tiff::encoder::TiffEncoder::new(&mut out).map_err(io::Error::other)?;
                encoder
                    .write_image::<tiff::encoder::colortype::Gray8>(width, height, image.as_slice())
                    .map_err(io::Error::other)?;
            }
        }
        out.flush()
    }
}

/// Which frames of a session are written, where, and as what.
#[derive(Debug, Clone)]
pub struct FramePlan {
    /// The directory that the pictures go to.
    pub out: PathBuf,
    /// The session that the frames are of, in words that no other session has.
    pub origin: String,
    pub formats: Vec<Picture>,
    pub triggers: Vec<u64>,
    pub cameras: Vec<CameraId>,
}

/// The numbers of frames that were written, kept, missing and damaged.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct FrameSummary {
    /// Frames of the plan: its triggers times its cameras.
    pub frames: usize,
    pub written: usize,
    /// Pictures that were finished before this run.
    pub skipped: usize,
    /// Frames that are missing, each with a gap record.
    pub gaps: usize,
    /// Frames that could not be read, with the reason: at most [`MAX_PROBLEMS`] of them.
    pub problems: Vec<String>,
    /// The number of further such frames.
    pub more_problems: usize,
}

/// Unreadable frames that are listed at most: a damaged recording may claim millions of them.
pub const MAX_PROBLEMS: usize = 1000;

/// Writes the pictures that are not there yet, on the current rayon pool. `progress` gets the number of frames done
/// and of all. An error is one of writing.
pub fn run(
    source: &dyn FrameSource,
    plan: &FramePlan,
    progress: impl Fn(u64, u64) + Sync,
) -> Result<FrameSummary, Fault> {
    let make =
        |folder: &Path| std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()));
    make(&plan.out)?;
    let mut wanted = Map::new();
    for format in &plan.formats {
        wanted.insert(format!("CAMERA/INDEX.{}", format.extension()), json!({"origin": plan.origin}));
    }
    claim(&plan.out, wanted)?;
    for camera in &plan.cameras {
        make(&plan.out.join(camera.as_str()))?;
    }
    let frames: Vec<(u64, &CameraId)> = plan
        .triggers
        .iter()
        .flat_map(|&trigger| plan.cameras.iter().map(move |camera| (trigger, camera)))
        .collect();
    let (done, total) = (AtomicU64::new(0), frames.len() as u64);
    let summary = Mutex::new(FrameSummary { frames: frames.len(), ..FrameSummary::default() });
    frames.into_par_iter().with_max_len(1).try_for_each(|(trigger, camera)| {
        export(source, plan, trigger, camera, &summary)?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
        Ok::<(), Fault>(())
    })?;
    let mut summary = summary.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    summary.problems.sort();
    Ok(summary)
}

fn export(
    source: &dyn FrameSource,
    plan: &FramePlan,
    trigger: u64,
    camera: &CameraId,
    summary: &Mutex<FrameSummary>,
) -> Result<(), String> {
    let count = |change: &dyn Fn(&mut FrameSummary)| {
        change(&mut summary.lock().unwrap_or_else(std::sync::PoisonError::into_inner));
    };
    let path = |format: &Picture| {
        plan.out.join(camera.as_str()).join(format!("{trigger:06}.{}", format.extension()))
    };
    // A recording never changes.
    let missing: Vec<&Picture> = plan.formats.iter().filter(|format| !path(format).exists()).collect();
    count(&|summary| summary.skipped += plan.formats.len() - missing.len());
    if missing.is_empty() {
        return Ok(());
    }
    let frame = match source.frame(camera, TriggerIndex(trigger)) {
        Ok(frame) => frame,
        Err(problem) => {
            count(&|summary| match summary.problems.len() < MAX_PROBLEMS {
                true => summary.problems.push(problem.clone()),
                false => summary.more_problems += 1,
            });
            return Ok(());
        }
    };
    let Some(image) = frame.image() else {
        count(&|summary| summary.gaps += 1);
        return Ok(());
    };
    for format in missing {
        let path = path(format);
        format.save(&path, image).map_err(|e| format!("{}: {e}", path.display()))?;
        count(&|summary| summary.written += 1);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::Picture;
    use crate::base::image::Mono8;
    use std::io::{self, Cursor, Seek, SeekFrom, Write};

    /// A medium with room for a number of bytes.
    struct Medium {
        file: Cursor<Vec<u8>>,
        room: usize,
    }

    impl Write for Medium {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let end = self.file.position() as usize + bytes.len();
            if end > self.room { Err(io::ErrorKind::StorageFull.into()) } else { self.file.write(bytes) }
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Seek for Medium {
        fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
            self.file.seek(to)
        }
    }

    #[test]
    fn a_picture_that_does_not_fit_is_no_success() {
        let pixels: Vec<u8> = (0..60 * 40).map(|i| (i * 7 % 251) as u8).collect();
        let image = Mono8::new(60, 40, &pixels).expect("a picture");
        for format in [
            Picture::Png,
            #[cfg(feature = "tiff")]
            Picture::Tiff,
        ] {
            let write = |room| {
                let mut medium = Medium { file: Cursor::new(Vec::new()), room };
                format.write(&mut medium, image).map(|()| medium.file.into_inner().len())
            };
            let whole = write(usize::MAX).expect("room");
            (0..whole).step_by(13).chain([whole - 1]).for_each(|room| {
                assert!(write(room).is_err(), "{format:?}: {room} of {whole} bytes are no picture");
            });
            assert_eq!(write(whole).expect("room"), whole);
        }
    }
}
