// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fringe-free images of a reconstruction: the light over one fringe, which clouds have as `intensity`, at the
//! pixels of the photograph; black where there is no point.
//!
//! ```text
//! OUT/CAMERA/INDEX.png    as the photographs of `fourdbody export --to png`
//! OUT/CAMERA.mp4          frame k is trigger A + k of --triggers A..B, a trigger without points a black one
//! OUT/export.json         what each of these was made of, with A..B
//! ```

use super::job::claim;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::Plane;
use crate::base::{Fault, write_whole};
use crate::data::{Calibration, Frame, FrameSource};
use crate::formats::CloudSource;
use serde_json::{Map, json};
use std::io::{self, Write};
use std::ops::Range;
use std::path::Path;
use std::process::{Command, Stdio};

/// The program that makes videos.
const FFMPEG: &str = "ffmpeg";

/// The fringe-free images of a source of clouds, as frames.
pub struct Intensity<'a> {
    source: &'a dyn CloudSource,
    cameras: Vec<CameraId>,
    /// Columns and rows of each camera's photographs.
    sizes: Vec<[usize; 2]>,
}

impl<'a> Intensity<'a> {
    /// An error where the calibration lacks a camera of the clouds.
    pub fn of(source: &'a dyn CloudSource, calibration: &Calibration) -> Result<Self, String> {
        let mut sizes = Vec::new();
        for (_, name) in source.cameras() {
            let found = calibration.cameras().find(|(_, camera)| camera.id.as_str() == name);
            let (_, camera) = found.ok_or_else(|| format!("the calibration has no camera {name}"))?;
            sizes.push([camera.device.width, camera.device.height]);
        }
        let cameras = source.cameras().iter().map(|(_, name)| CameraId::from(name.as_str())).collect();
        Ok(Self { source, cameras, sizes })
    }
}

impl FrameSource for Intensity<'_> {
    fn cameras(&self) -> &[CameraId] {
        &self.cameras
    }

    fn triggers(&self) -> Range<u64> {
        let all = self.source.triggers();
        let ends = all.first_key_value().zip(all.last_key_value());
        ends.map_or(0..0, |((first, _), (last, _))| *first..last.saturating_add(1))
    }

    fn frame(&self, camera: &CameraId, TriggerIndex(trigger): TriggerIndex) -> Result<Frame<'_>, String> {
        let there = self.source.triggers().get(&trigger).into_iter().flatten();
        let Some(&place) = there.into_iter().find(|&&place| self.cameras[place] == *camera) else {
            return Ok(Frame::Gap("no cloud".to_owned()));
        };
        let [width, height] = self.sizes[place];
        let mut image = Plane::filled(width, height, 0u8);
        let clouds = self.source.clouds(trigger, &[place])?;
        for (_, cloud) in &clouds {
            for (&[u, v], &intensity) in cloud.pixel.iter().zip(&cloud.intensity) {
                let (u, v) = (usize::from(u), usize::from(v));
                if u >= width || v >= height {
                    return Err(format!(
                        "{camera}, trigger {trigger}: expected pixels of {width} x {height}, as the calibration \
                         states, found ({u}, {v}); give the calibration that it was reconstructed with"
                    ));
                }
                image.set(u, v, (255.0 * intensity).round() as u8);
            }
        }
        let is_empty = clouds.iter().all(|(_, cloud)| cloud.is_empty());
        Ok(if is_empty { Frame::Gap("no points".to_owned()) } else { Frame::Owned(image) })
    }
}

/// Which videos are written, where, and of which triggers.
#[derive(Debug)]
pub struct VideoPlan<'a> {
    pub out: &'a Path,
    /// What the images are of, in words that nothing else has.
    pub origin: &'a str,
    pub cameras: Vec<usize>,
    pub triggers: Range<u64>,
    pub rate_hz: f64,
}

/// The numbers of videos that were written and kept, of black frames in the new ones, and what could not be read.
#[derive(Debug, Default)]
pub struct Videos {
    pub written: usize,
    pub skipped: usize,
    pub black: usize,
    pub problems: Vec<String>,
}

/// An error, with what to install, where there is no program that makes videos.
pub fn find_encoder() -> Result<(), String> {
    let found = Command::new(FFMPEG).arg("-version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    let advice =
        "install ffmpeg (Debian: apt install ffmpeg), or leave mp4 out: --to intensity-png needs no program";
    match found {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("expected `{FFMPEG} -version` to run, found {status}; {advice}")),
        Err(error) => Err(format!("expected the program {FFMPEG}, found none ({error}); {advice}")),
    }
}

/// Writes the videos that are not there yet, one after the other: the encoder has threads of its own.
pub fn write_videos(
    images: &Intensity<'_>,
    plan: &VideoPlan<'_>,
    progress: impl Fn(u64, u64),
) -> Result<Videos, Fault> {
    std::fs::create_dir_all(plan.out).map_err(|e| format!("{}: {e}", plan.out.display()))?;
    let mut wanted = Map::new();
    let Range { start, end } = plan.triggers;
    let about =
        json!({"origin": plan.origin, "triggers": format!("{start}..{end}"), "rate_hz": plan.rate_hz});
    for &camera in &plan.cameras {
        wanted.insert(format!("{}.mp4", images.cameras[camera]), about.clone());
    }
    claim(plan.out, wanted)?;
    let mut videos = Videos::default();
    for (done, &camera) in (1..).zip(&plan.cameras) {
        let path = plan.out.join(format!("{}.mp4", images.cameras[camera]));
        if path.exists() {
            videos.skipped += 1;
            continue;
        }
        let mut problem = None;
        let written = write_whole(&path, |file| {
            let black = encode(images, camera, plan, Stdio::from(file.try_clone()?), &mut problem)?;
            videos.black += black;
            Ok(())
        });
        match (written, problem) {
            (Ok(()), _) => videos.written += 1,
            (Err(_), Some(problem)) => videos.problems.push(problem),
            (Err(error), None) => return Err(format!("{}: {error}", path.display()).into()),
        }
        progress(done, plan.cameras.len() as u64);
    }
    Ok(videos)
}

/// Encodes the images of a camera; the number of black ones. `problem`: what could not be read.
fn encode(
    images: &Intensity<'_>,
    camera: usize,
    plan: &VideoPlan<'_>,
    file: Stdio,
    problem: &mut Option<String>,
) -> io::Result<usize> {
    let ([width, height], name, first) = (images.sizes[camera], &images.cameras[camera], plan.triggers.start);
    let mut encoder = Command::new(FFMPEG)
        .args(["-v", "error", "-f", "rawvideo", "-pixel_format", "gray"])
        .args([
            "-video_size",
            &format!("{width}x{height}"),
            "-framerate",
            &plan.rate_hz.to_string(),
            "-i",
            "-",
        ])
        // What players know has sides of even length.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"])
        .args(["-metadata", &format!("title={name}")])
        .args(["-metadata", &format!("comment=first frame: trigger {first}; {}", plan.origin)])
        // By its name the file can be written at any place, unlike a pipe.
        .args(["-f", "mp4", "-y", "/dev/stdout"])
        .stdin(Stdio::piped())
        .stdout(file)
        .stderr(Stdio::piped())
        .spawn()?;
    let mut input = encoder.stdin.take().ok_or_else(|| io::Error::other("no pipe to the encoder"))?;
    let nothing = Plane::filled(width, height, 0u8);
    let mut black = 0;
    for trigger in plan.triggers.clone() {
        let frame = images.frame(name, TriggerIndex(trigger));
        let frame = match frame {
            Ok(frame) => frame,
            Err(reason) => {
                *problem = Some(reason);
                break;
            }
        };
        let image = frame.image();
        black += usize::from(image.is_none());
        let pixels = image.map_or(nothing.as_slice(), |image| image.as_slice());
        if input.write_all(pixels).is_err() {
            // It has ended, and states why.
            break;
        }
    }
    if black as u64 == plan.triggers.end - first {
        *problem = Some(format!("{name}: expected a cloud with points, found none in {:?}", plan.triggers));
    }
    drop(input);
    let ended = encoder.wait_with_output()?;
    if !ended.status.success() {
        let said = String::from_utf8_lossy(&ended.stderr);
        return Err(io::Error::other(format!("{FFMPEG}: {}: {}", ended.status, said.trim())));
    }
    if problem.is_some() { Err(io::Error::other("an image cannot be read")) } else { Ok(black) }
}
