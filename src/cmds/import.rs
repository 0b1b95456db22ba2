// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody import`: image sequences of other recorders become a session.
//!
//! `DIR/CAMERA/INDEX.png`, index = trigger index, or as a pattern has it. Everything is checked before anything is
//! written, and the session appears under its name only when it is whole.

use super::failure::{Failure, number_in, print};
use super::progress::Progress;
use crate::base::ids::{BlockId, CameraId, NodeId, SessionName, TriggerIndex};
use crate::base::image::Plane;
use crate::base::photograph::{self, Conversion, ENDINGS, Photograph};
use crate::base::{Exit, Scratch, regular};
use crate::batch::image_names::NamePattern;
use crate::batch::image_tree::{INDEX_END, ImageTree, Images};
use crate::config::{Rig, RigCamera};
use crate::record::envelope::pixels_crc;
use crate::record::{
    CameraHeader, ENVELOPE_CAPACITY, FrameMeta, GapCause, MAX_TRIGGERS, Recording, RecordingHeader,
    SessionEnd, Verdict, WriterOptions, node_dir, write_envelope,
};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Turn image sequences of another recorder into a session.
#[derive(clap::Args)]
#[command(after_help = "\
DIR holds a directory per camera of the rig, with grey images of the camera's size (PNG, TIFF, BMP, PGM, JPEG),
named by trigger index: DIR/h0_up/0.png, DIR/h0_up/1.png, ... (leading zeros are fine). An index that some camera has
and another has not becomes a gap record (not_recorded). Other files, and folders without images, are left out and
named; two files of one index, and images of a camera that the rig has not, are refused.

Examples:
  fourdbody import --rig config/rig.toml --images shots --out sessions/walk-01
  fourdbody import --rig bench.toml --images shots --pattern '{camera}_{index}' --renumber --scale 4095 --out hand")]
pub struct Args {
    /// The rig that the images were taken with.
    #[arg(long)]
    rig: PathBuf,
    /// The directory of image sequences, DIR above.
    #[arg(long)]
    images: PathBuf,
    /// How the images are named below DIR, without the ending: '{camera}_{index}', '{camera}/frame{index}'. With one
    /// camera, {camera} may be absent. [default: {camera}/{index}]
    #[arg(long)]
    pattern: Option<NamePattern>,
    /// Number each camera's images from 0, in the order of their numbers; all cameras must have as many.
    #[arg(long)]
    renumber: bool,
    /// The value in the images that becomes 255, where they have more or less than 8 bits: 4095 for 12 bits.
    #[arg(long, value_name = "VALUE")]
    #[arg(value_parser = number_in(1e-6..=1e12, "a value above 0"))]
    scale: Option<f64>,
    /// Take this channel of colour images. Where a colour filter lies over the sensor, it was interpolated.
    #[arg(long)]
    channel: Option<Colour>,
    /// The session's directory; must not exist.
    #[arg(long)]
    out: PathBuf,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

/// The channels of a colour image, in their order.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Colour {
    Red,
    Green,
    Blue,
}

// What is listed can be recorded.
const _: () = assert!(INDEX_END == MAX_TRIGGERS);

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let rig = Rig::load(&args.rig)?;
    let rig_text = regular::read_text(&args.rig, regular::TEXT_BYTES)
        .map_err(|e| Failure::usage(format!("{}: {e}", args.rig.display())))?;
    let name = session_name(&args.out)?;
    if args.out.exists() {
        let message =
            format!("{} exists; a session is never overwritten: choose another name", args.out.display());
        return Err(Failure::usage(message));
    }
    let tree = args.find_images(&rig).map_err(|problems| all_problems(&args.images, &problems))?;
    if let Some(left_out) = ImageTree::remark(&tree.left_out) {
        eprintln!("{left_out}");
    }
    if let Some(remark) = &tree.remark {
        eprintln!("warning: {remark}");
    }
    let conversion =
        Conversion { scale: args.scale.map(|x| x as f32), channel: args.channel.map(|x| x as usize) };
    let sequences = tree.cameras;
    let triggers = sequences.values().filter_map(|s| s.last_key_value()).map(|(last, _)| last + 1).max();
    let triggers = triggers.unwrap_or(0);
    let lossy = check_images(&rig, &sequences, &conversion)
        .map_err(|problems| all_problems(&args.images, &problems))?;
    if lossy > 0 {
        eprintln!("warning: {lossy} images are JPEG, whose compression changes phases: record without it");
    }
    let session =
        Import { rig: &rig, rig_text: &rig_text, name: &name, sequences: &sequences, conversion, triggers };
    // Removed unless it gets its name.
    let partial = Scratch(partial_path(&args.out));
    let verdicts = session.write(&partial.0)?;
    std::fs::rename(&partial.0, &args.out).map_err(|e| Failure::at(&args.out, e))?;
    let value = serde_json::json!({
        "session": args.out, "triggers": triggers, "nodes": verdicts, "left_out": tree.left_out,
        "lossy": lossy,
    });
    print(args.json, &value, || {
        verdicts.iter().for_each(|(node, verdict)| println!("node {node}: {verdict}"));
        println!("{}: imported", args.out.display());
    });
    let lossless = verdicts.values().all(|verdict| verdict.gaps() == 0);
    Ok(if lossless { Exit::Done } else { Exit::DataLoss })
}

fn session_name(out: &Path) -> Result<SessionName, Failure> {
    let name = out.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    SessionName::parse(name).map_err(|e| Failure::usage(format!("--out {}: {e}", out.display())))
}

/// A hidden neighbour on the same file system.
fn partial_path(out: &Path) -> PathBuf {
    let name = out.file_name().unwrap_or_default().to_string_lossy();
    out.with_file_name(format!(".{name}.partial-{}", std::process::id()))
}

fn all_problems(images: &Path, problems: &[String]) -> Failure {
    let count = problems.len();
    let plural = if count == 1 { "" } else { "s" };
    let list = problems.join("\n  ");
    Failure::usage(format!("{}: {count} problem{plural}\n  {list}", images.display()))
}

impl Args {
    /// The images of every camera of the rig, and what lies beside them; or everything that is wrong with their names.
    fn find_images(&self, rig: &Rig) -> Result<ImageTree, Vec<String>> {
        if let Some(kind) = self.images.is_file().then(|| photograph::kind(&self.images)).flatten() {
            return Err(vec![format!("expected a directory of images, found {kind}")]);
        }
        let known: Vec<CameraId> = rig.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let names = known.iter().map(CameraId::as_str).collect::<Vec<_>>().join(", ");
        let mut tree = if self.pattern.is_some() || self.renumber {
            let usual = || "{camera}/{index}".parse().map_err(|e| vec![e]);
            let pattern = self.pattern.clone().map_or_else(usual, Ok)?;
            pattern.list(&self.images, &known, &ENDINGS, self.renumber)?
        } else {
            let tree = ImageTree::list(&self.images, &known, &ENDINGS)?;
            let unknown = tree.cameras.keys().filter(|camera| !known.contains(camera));
            let problem = |camera: &CameraId| {
                let path = self.images.join(camera.as_str());
                format!("{}: has images, but is no camera of the rig; expected {names}", path.display())
            };
            let problems: Vec<String> = unknown.map(problem).collect();
            if !problems.is_empty() {
                return Err(problems);
            }
            tree
        };
        if tree.cameras.values().all(Images::is_empty) {
            let mut problems = vec![format!(
                "expected images as CAMERA/INDEX.png of the cameras {names}, found none; where they have other names, \
                 describe them: --pattern '{{camera}}_{{index}}'"
            )];
            let others = tree.left_out.iter().filter_map(|path| Some((path, photograph::kind(path)?)));
            problems.extend(others.take(3).map(|(path, kind)| format!("{} is {kind}", path.display())));
            return Err(problems);
        }
        // A camera without a directory recorded nothing.
        for camera in known {
            tree.cameras.entry(camera).or_default();
        }
        Ok(tree)
    }
}

/// Decodes every image once to be sure of it: an import of an hour must not fail at its end. Returned is how many have
/// lost something to compression.
fn check_images(
    rig: &Rig,
    sequences: &BTreeMap<CameraId, Images>,
    conversion: &Conversion,
) -> Result<u64, Vec<String>> {
    let progress = Progress::of("checking", "images");
    let total: u64 = sequences.values().map(|s| s.len() as u64).sum();
    let (done, lossy) = (AtomicU64::new(0), AtomicU64::new(0));
    let mut problems = Vec::new();
    for (_, camera) in rig.cameras() {
        let Some(sequence) = sequences.get(&camera.id) else { continue };
        let wrong: Vec<String> = sequence
            .par_iter()
            .filter_map(|(_, path)| {
                progress.at(done.fetch_add(1, Ordering::Relaxed) + 1, total);
                let image = read_image(camera, path, conversion);
                lossy.fetch_add(image.as_ref().is_ok_and(|image| image.lossy).into(), Ordering::Relaxed);
                image.err()
            })
            .collect();
        problems.extend(wrong);
    }
    if problems.is_empty() { Ok(lossy.into_inner()) } else { Err(problems) }
}

fn read_image(camera: &RigCamera, path: &Path, conversion: &Conversion) -> Result<Photograph, String> {
    let image = photograph::read(path, conversion).map_err(|e| e.to_string())?;
    let (width, height) = (camera.device.width, camera.device.height);
    if (image.grey.width(), image.grey.height()) != (width, height) {
        return Err(format!(
            "{}: expected {width} x {height} pixels (camera {} of the rig), found {} x {}",
            path.display(),
            camera.id,
            image.grey.width(),
            image.grey.height()
        ));
    }
    Ok(image)
}

/// Everything that the session will be.
struct Import<'a> {
    rig: &'a Rig,
    rig_text: &'a str,
    name: &'a SessionName,
    sequences: &'a BTreeMap<CameraId, Images>,
    conversion: Conversion,
    triggers: u64,
}

impl Import<'_> {
    fn write(&self, dir: &Path) -> Result<BTreeMap<String, Verdict>, Failure> {
        let progress = Progress::of("importing", "triggers");
        let nodes = self.rig.nodes();
        let created_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
        let total = self.triggers * nodes.len() as u64;
        let mut verdicts = BTreeMap::new();
        for (n, node) in nodes.iter().enumerate() {
            let before = n as u64 * self.triggers;
            let advance = |trigger: u64| progress.at(before + trigger, total);
            verdicts.insert(node.to_string(), self.write_node(dir, node, created_ns, &advance)?);
        }
        Ok(verdicts)
    }

    fn write_node(
        &self,
        dir: &Path,
        node: &NodeId,
        created_ns: u64,
        advance: &dyn Fn(u64),
    ) -> Result<Verdict, Failure> {
        let cameras: Vec<&RigCamera> = self.rig.cameras_of(node).map(|(_, camera)| camera).collect();
        let header = self.header(node, &cameras, created_ns);
        let mut recording = Recording::create(&node_dir(dir, node), header, WriterOptions::default())
            .map_err(Failure::failed)?;
        let period_ns = 1e9 / self.rig.trigger_rate_hz;
        for trigger in 0..self.triggers {
            let camera_time_ns = (trigger as f64 * period_ns).round() as u64;
            let frames: Result<Vec<Option<ImportedFrame>>, String> = cameras
                .par_iter()
                .map(|camera| {
                    let path = self.sequences.get(&camera.id).and_then(|images| images.get(&trigger));
                    let image = path.map(|path| read_image(camera, path, &self.conversion));
                    let frame = image
                        .map(|image| frame_of(camera, &image?.grey, trigger, camera_time_ns, created_ns));
                    frame.transpose()
                })
                .collect();
            let frames = frames.map_err(Failure::usage)?;
            for (place, frame) in frames.iter().enumerate() {
                if let Some((meta, message)) = frame {
                    recording.frame(place, meta, message).map_err(Failure::failed)?;
                }
            }
            for (place, _) in frames.iter().enumerate().filter(|(_, frame)| frame.is_none()) {
                recording
                    .gap(place, TriggerIndex(trigger), GapCause::NotRecorded)
                    .map_err(Failure::failed)?;
            }
            advance(trigger + 1);
        }
        let end = SessionEnd {
            triggers_emitted: Some(self.triggers),
            aborted: None,
            absent: GapCause::NotRecorded,
            host_time_ns: created_ns,
        };
        recording.finish(end).map_err(Failure::failed)
    }

    fn header(&self, node: &NodeId, cameras: &[&RigCamera], created_ns: u64) -> RecordingHeader {
        let digest = Sha256::digest(format!("{} {created_ns} {}", self.name, std::process::id()));
        let cameras = cameras.iter().map(|camera| CameraHeader {
            id: camera.id.clone(),
            width: camera.device.width as u32,
            height: camera.device.height as u32,
            device: "imported images".to_owned(),
            pixel_format: String::new(),
            settings: Vec::new(),
            state: std::collections::BTreeMap::new(),
        });
        RecordingHeader {
            session: self.name.clone(),
            session_id: digest.iter().take(16).map(|byte| format!("{byte:02x}")).collect(),
            node: node.clone(),
            rig_text: self.rig_text.to_owned(),
            cameras: cameras.collect(),
            hsu: None,
            expected_triggers: Some(self.triggers),
            trigger_rate_hz: self.rig.trigger_rate_hz,
            host_clock: "trigger index times nominal period, from the import on".to_owned(),
            created_ns,
            software: concat!("fourdbody ", env!("CARGO_PKG_VERSION"), " import").to_owned(),
            subject: None,
            note: None,
        }
    }
}

/// A frame's metadata, and its message with the envelope in front of the pixels.
type ImportedFrame = (FrameMeta, Vec<u8>);

/// An image of a camera as a frame of this trigger.
fn frame_of(
    camera: &RigCamera,
    image: &Plane<u8>,
    trigger: u64,
    camera_time_ns: u64,
    created_ns: u64,
) -> Result<ImportedFrame, String> {
    let pixels = image.as_slice();
    let meta = FrameMeta {
        trigger: TriggerIndex(trigger),
        block: BlockId(trigger),
        camera_time_ns,
        host_time_ns: created_ns.saturating_add(camera_time_ns),
        width: camera.device.width as u32,
        height: camera.device.height as u32,
        pixels_crc: pixels_crc(pixels),
    };
    let mut message = vec![0; ENVELOPE_CAPACITY];
    let length = write_envelope(&mut message, &camera.id, &meta).map_err(|e| e.to_string())?;
    message.drain(..ENVELOPE_CAPACITY - length);
    message.extend_from_slice(pixels);
    Ok((meta, message))
}
