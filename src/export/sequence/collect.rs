//! Clouds of any source into one sequence, in order of time.

use super::{Options, SequenceWriter};
use crate::export::job::{Summary, join};
use crate::export::source::CloudSource;
use crate::export::whole::write_whole;
use std::io;
use std::ops::Range;
use std::path::Path;

/// What goes into a sequence.
#[derive(Debug, Clone)]
pub struct Contents {
    /// Whether merged clouds do.
    pub merged: bool,
    /// Whether directional clouds do, each on a topic of its camera.
    pub directional: bool,
    /// Which triggers.
    pub triggers: Range<u64>,
    /// Which cameras: places in the source's list, in order.
    pub cameras: Vec<usize>,
}

/// Writes a sequence, which is never half there. `time_ns` says when a trigger was; times must not go back from trigger to
/// trigger. `progress` is told triggers done and their number. An error is one of writing; damaged clouds are in the summary.
pub fn collect(
    source: &dyn CloudSource,
    contents: &Contents,
    options: Options,
    path: &Path,
    time_ns: impl Fn(u64) -> u64,
    progress: impl Fn(u64, u64),
) -> io::Result<Summary> {
    let mut summary = Summary::default();
    write_whole(path, |file| {
        let out = io::BufWriter::with_capacity(1 << 20, file);
        let mut writer = SequenceWriter::with(out, options).map_err(io::Error::other)?;
        let total = source.triggers().range(contents.triggers.clone()).count() as u64;
        for (trigger, there) in source.triggers().range(contents.triggers.clone()) {
            let cameras: Vec<usize> =
                contents.cameras.iter().copied().filter(|camera| there.contains(camera)).collect();
            summary.triggers += 1;
            progress(summary.triggers as u64, total);
            let clouds = match source.clouds(*trigger, &cameras) {
                Ok(clouds) => clouds,
                Err(problem) => {
                    summary.problems.push(problem);
                    continue;
                }
            };
            let numbered: Vec<(u8, String)> =
                cameras.iter().map(|&camera| source.cameras()[camera].clone()).collect();
            let time = time_ns(*trigger);
            if contents.merged {
                let merged = join(&clouds, &numbered);
                summary.points += merged.len();
                writer.push(time, &merged).map_err(io::Error::other)?;
            }
            if contents.directional {
                for ((_, cloud), (_, name)) in clouds.iter().zip(&numbered) {
                    summary.points += cloud.len();
                    writer.push_of(time, Some(name), cloud).map_err(io::Error::other)?;
                }
            }
        }
        let buffer = writer.finish().map_err(io::Error::other)?;
        buffer.into_inner().map(|_| ()).map_err(io::IntoInnerError::into_error)
    })?;
    summary.written = 1;
    summary.bytes = path.metadata()?.len();
    Ok(summary)
}
