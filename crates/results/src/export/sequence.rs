// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clouds of any source into one sequence, in order of time.

use super::job::{Plan, Summary};
use crate::base::write_whole;
use crate::data::Cloud;
use crate::formats::sequence::{Options, SequenceWriter};
use crate::formats::{CloudSource, merged_cloud};
use rayon::prelude::*;
use std::io;
use std::path::Path;

/// A message that is ready to be written: the camera whose topic it belongs to, its points, and its bytes.
type Ready = (Option<String>, usize, Vec<u8>);

/// Writes the clouds of a plan as a sequence, which is never half there; messages are made on the current rayon pool.
/// `time_ns` gives the time of a trigger; times must not go back from trigger to trigger. Clouds without points are
/// left out; without any points there is no file. `progress` gets the number of triggers done and of all. An error is
/// one of writing; damaged clouds are in the summary.
pub fn collect(
    source: &dyn CloudSource,
    plan: &Plan,
    options: Options,
    path: &Path,
    time_ns: impl Fn(u64) -> u64 + Sync,
    progress: impl Fn(u64, u64),
) -> io::Result<Summary> {
    let triggers: Vec<(&u64, &Vec<usize>)> = source.triggers().range(plan.triggers.clone()).collect();
    let mut summary = Summary { triggers: triggers.len(), written: 1, ..Summary::default() };
    let mut is_nothing = false;
    let written = write_whole(path, |file| {
        let out = io::BufWriter::with_capacity(1 << 20, file);
        let mut writer = SequenceWriter::with(out, options).map_err(io::Error::other)?;
        let mut done = 0;
        // So many triggers at a time as there are threads: what they hold is the memory that this takes.
        for part in triggers.chunks(rayon::current_num_threads()) {
            let made: Vec<(u64, Result<Vec<Ready>, String>)> = part
                .par_iter()
                .map(|(trigger, there)| {
                    let time = time_ns(**trigger);
                    (time, messages(source, plan, options, **trigger, there, time))
                })
                .collect();
            for (time, ready) in made {
                match ready {
                    Ok(ready) => {
                        for (camera, points, message) in ready {
                            if points == 0 {
                                summary.empty += 1;
                                continue;
                            }
                            summary.points += points;
                            writer.write(time, camera.as_deref(), &message).map_err(io::Error::other)?;
                        }
                    }
                    Err(problem) => summary.problems.push(problem),
                }
            }
            done += part.len() as u64;
            progress(done, triggers.len() as u64);
        }
        is_nothing = summary.points == 0;
        if is_nothing {
            return Err(io::Error::other("there are no points"));
        }
        let buffer = writer.finish().map_err(io::Error::other)?;
        buffer.into_inner().map(|_| ()).map_err(io::IntoInnerError::into_error)
    });
    if is_nothing {
        summary.written = 0;
        return Ok(summary);
    }
    written?;
    summary.bytes = path.metadata()?.len();
    Ok(summary)
}

/// The messages of a trigger.
fn messages(
    source: &dyn CloudSource,
    plan: &Plan,
    options: Options,
    trigger: u64,
    there: &[usize],
    time_ns: u64,
) -> Result<Vec<Ready>, String> {
    let cameras: Vec<usize> = plan.cameras.iter().copied().filter(|camera| there.contains(camera)).collect();
    let clouds = source.clouds(trigger, &cameras)?;
    let numbered: Vec<(u8, String)> =
        cameras.iter().map(|&camera| source.cameras()[camera].clone()).collect();
    let ready = |camera: Option<String>, cloud: &Cloud| {
        let mut message = Vec::new();
        options.encode(&mut message, time_ns, cloud);
        (camera, cloud.len(), message)
    };
    let mut made = Vec::new();
    if plan.merged {
        made.push(ready(None, &merged_cloud(&clouds, &numbered).0));
    }
    if plan.directional {
        made.extend(clouds.iter().zip(numbered).map(|((_, cloud), (_, name))| ready(Some(name), cloud)));
    }
    Ok(made)
}
