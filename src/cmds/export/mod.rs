// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody export`: what was recorded and reconstructed, for other programs.

mod clouds;
mod session;

use super::failure::{Failure, tell_amiss, tell_made_up_times};
use super::progress::Progress;
use crate::base::Exit;
use crate::batch::from_phase_maps;
use crate::batch::key::Key;
use crate::batch::plan::method_name;
use crate::batch::result::calibration_of;
use crate::data::Calibration;
use crate::export::frames::Picture;
use crate::formats::Format;
use crate::formats::sequence::STEPS_M;
use crate::reconstruct::pipeline::Method;
use std::ops::Range;
use std::path::PathBuf;

/// Write clouds, meshes, frames and times as files that other programs read.
///
/// Of a reconstruction: point clouds and triangle meshes in the formats of --to, one sequence (mcap), or images without
/// fringes (intensity-png, mp4). Of a session: its frames (png, tiff) and when each of them was (csv). Files that are
/// finished and not older than what they are made of are kept, so that an interrupted run goes on where it was.
/// docs/guide/exporting.md describes what each format holds and which programs open it.
///
/// Without --to, --clouds, --mesh, --triggers and --cameras, phase maps become the files that `reconstruct --format
/// ply` writes, byte for byte: clouds/, merged/ and sequence.mcap.
///
/// Each file of a reconstruction is checked against its name, its session and summary.json.
///
/// Exit codes: 0 done; 2 wrong usage; 3 done, but some frames are missing in the session, files are missing, or
/// clouds have no points (nothing is written of these); 4 some clouds or frames are damaged or belong to something
/// else, and are listed, or there is nothing to export; 1 could not write.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  fourdbody export walk-01 --to e57,pcd --out walk-01-scans
  fourdbody export walk-01 --to glb --mesh grid --triggers 0..120 --out walk-01-meshes
  fourdbody export walk-01 --to mcap --clouds directional --quantize 0.02 --out walk-01-small
  fourdbody export sessions/walk-01 --to png,csv --cameras h0_up,h0_low --out walk-01-frames
  fourdbody export walk-01 --out walk-01")]
pub struct Args {
    /// What `fourdbody reconstruct` wrote (clouds/, merged/ or phases/ in it); for png, tiff and csv a session.
    directory: PathBuf,
    /// The calibration that it was reconstructed with [default: that in DIRECTORY].
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// The directory that the files go to.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What to write, separated by commas.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ply", value_name = "FORMAT,...")]
    to: Vec<Target>,
    /// Only triggers A to B - 1, or one trigger by its index.
    #[arg(long, value_name = "A..B", value_parser = super::reconstruct::parse_range)]
    triggers: Option<Range<u64>>,
    /// Only these cameras, separated by commas.
    #[arg(long, value_name = "CAMERA,...", value_delimiter = ',')]
    cameras: Vec<String>,
    /// Which clouds: one file per trigger (`merged`, without points that another head sees better), one file per
    /// camera and trigger (`directional`), or both [default: merged].
    #[arg(long, value_enum, value_delimiter = ',', value_name = "KIND,...")]
    clouds: Vec<Clouds>,
    /// Triangles instead of points: `grid` joins the neighbouring pixels of each camera and keeps holes; `watertight`
    /// makes one closed surface through the merged cloud. For ply, ply-ascii, glb and obj.
    #[arg(long, value_enum, value_name = "KIND")]
    mesh: Option<MeshName>,
    /// With --mesh grid: the longest edge, in median spacings of a cloud's points.
    #[arg(long, value_name = "TIMES", default_value_t = 4.0, value_parser = parse_stretch)]
    stretch: f32,
    /// With --mesh watertight: side of the cells that the surface is found on, mm.
    #[arg(long, value_name = "MM", default_value_t = 5.0, value_parser = parse_cell)]
    cell: f64,
    /// With --to xyz: without the lines that begin with #, for readers that do not skip them.
    #[arg(long)]
    no_comments: bool,
    /// With --to xyz: only the first N columns, for readers that know no more: 3 places, 6 with normals, 7 with
    /// intensity.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(3..=11))]
    columns: Option<u8>,
    /// With --to mcap: round places to steps of at most this, mm (0.02 is far below the measurement's uncertainty),
    /// normals and intensities likewise, and compress: less than half of the bytes.
    #[arg(long, value_name = "MM", value_parser = parse_step)]
    quantize: Option<f64>,
    /// With --to mcap: level of compression (zstd), 0 for none [default: 0, or 1 with --quantize].
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(u8).range(0..=19))]
    compress: Option<u8>,
    /// With --to mcap, of results of older versions, which state no times: take them from this session.
    #[arg(long, value_name = "DIR")]
    session: Option<PathBuf>,
    /// Number of threads [default: one per core].
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Triggers per second, for the times in sequence.mcap where no file states them, as of images.
    #[arg(long, value_name = "HZ", default_value_t = 120.0, value_parser = super::reconstruct::parse_rate)]
    rate_hz: f64,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Target {
    /// Binary PLY, the layout that `reconstruct` writes.
    Ply,
    /// PLY as text, with the same columns.
    PlyAscii,
    /// PCD (Point Cloud Library), binary.
    Pcd,
    /// Columns of text: x y z nx ny nz intensity u v camera.
    Xyz,
    /// E57 (ASTM E2807), a scan a camera.
    E57,
    /// glTF 2.0, binary: points or triangles.
    Glb,
    /// Wavefront OBJ, text: points or triangles.
    Obj,
    /// A sequence of clouds, foxglove.PointCloud in MCAP.
    Mcap,
    /// Fringe-free images (`intensity` of the points at their pixels), 8-bit grey, a PNG file a frame.
    IntensityPng,
    /// Fringe-free images as a video a camera; needs ffmpeg.
    Mp4,
    /// Frames of a session, 8-bit grey, compressed.
    Png,
    /// Frames of a session, 8-bit grey, not compressed.
    Tiff,
    /// Times of a session's frames.
    Csv,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Clouds {
    Merged,
    Directional,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum MeshName {
    Grid,
    Watertight,
}

impl Target {
    fn format(self) -> Option<Format> {
        match self {
            Self::Ply => Some(Format::Ply),
            Self::PlyAscii => Some(Format::PlyAscii),
            Self::Pcd => Some(Format::Pcd),
            Self::Xyz => Some(Format::XYZ),
            Self::E57 => Some(Format::E57),
            Self::Glb => Some(Format::Glb),
            Self::Obj => Some(Format::Obj),
            Self::Mcap | Self::IntensityPng | Self::Mp4 | Self::Png | Self::Tiff | Self::Csv => None,
        }
    }

    fn picture(self) -> Option<Picture> {
        match self {
            Self::Png => Some(Picture::Png),
            Self::Tiff => Some(Picture::Tiff),
            _ => None,
        }
    }

    fn is_of_session(self) -> bool {
        self.picture().is_some() || self == Self::Csv
    }
}

/// Runs `fourdbody export` with these arguments.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    super::reconstruct::keep_freed_memory();
    if (args.no_comments || args.columns.is_some()) && !args.to.contains(&Target::Xyz) {
        return Err(Failure::usage("--no-comments and --columns: are for --to xyz"));
    }
    let of_session = args.to.iter().filter(|target| target.is_of_session()).count();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.jobs.unwrap_or(0))
        .build()
        .map_err(|e| Failure::new(Exit::Failure, e))?;
    if of_session == 0 {
        tell_no_sigma(args);
    }
    match of_session {
        0 if is_plain(args) => pool.install(|| everything(args)),
        0 => pool.install(|| clouds::run(args)),
        n if n == args.to.len() => pool.install(|| session::run(args)),
        _ => {
            let message = "--to: png, tiff and csv are made of a session, the others of a reconstruction: \
                 export them one after the other";
            Err(Failure::new(Exit::Usage, message))
        }
    }
}

/// Says that points lack their uncertainty, where a wanted format has a place for it.
fn tell_no_sigma(args: &Args) {
    let has_none = |key: &Key| !key.uncertainty && key.method == method_name(Method::Joint);
    let holds = |target: &Target| target.format().map_or(*target == Target::Mcap, Format::holds_sigma);
    // A key that cannot be read is reported where it is needed.
    if Key::load(&args.directory).ok().flatten().as_ref().is_some_and(has_none) && args.to.iter().any(holds) {
        eprintln!(
            "the points have no sigma (standard uncertainty): {} was reconstructed without --uncertainty",
            args.directory.display()
        );
    }
}

/// Whether stored phase maps are to become what `reconstruct` would have written.
fn is_plain(args: &Args) -> bool {
    let chosen = args.triggers.is_some() || !args.cameras.is_empty() || !args.clouds.is_empty();
    let plain = args.to == [Target::Ply] && args.mesh.is_none();
    plain && !chosen && args.directory.join("phases").is_dir()
}

/// Stored phase maps to clouds, merged clouds and the sequence.
fn everything(args: &Args) -> Result<Exit, Failure> {
    let calibration = calibration(args)?;
    let progress = Progress::of("exporting", "triggers");
    let at = |done, total| progress.at(done, total);
    let made = from_phase_maps::export(&args.directory, &calibration, &args.out, args.rate_hz, at)?;
    drop(progress);
    let is_amiss = tell_amiss(&made.amiss);
    if made.made_up_times {
        tell_made_up_times(args.rate_hz);
    }
    let is_whole = made.empty == 0 && !is_amiss;
    if args.json {
        println!("{}", serde_json::json!(made));
    } else {
        let from_phase_maps::Exported { clouds, merged_points, triggers, kept, empty, .. } = made;
        let merged = triggers - empty;
        println!(
            "{clouds} clouds; {merged_points} points in {merged} merged clouds; {kept} of {triggers} \
             triggers finished before, {empty} \
             without a point"
        );
    }
    Ok(if is_whole { Exit::Done } else { Exit::DataLoss })
}

fn calibration(args: &Args) -> Result<Calibration, Failure> {
    match &args.calibration {
        Some(path) => Calibration::load(path).map_err(|e| Failure::new(Exit::Usage, e)),
        None => calibration_of(&args.directory).map_err(|e| Failure::new(Exit::Usage, e)),
    }
}

/// The wanted triggers, all of which must be there.
pub(super) fn chosen_triggers(wanted: Option<&Range<u64>>, all: Range<u64>) -> Result<Range<u64>, Failure> {
    match wanted {
        None => Ok(all),
        Some(wanted) if wanted.start >= all.start && wanted.end <= all.end => Ok(wanted.clone()),
        Some(wanted) => {
            let message = if all.is_empty() {
                "expected a part of what is there, found no trigger there".to_owned()
            } else {
                format!("expected a part of {}..{} (the last trigger is {})", all.start, all.end, all.end - 1)
            };
            Err(Failure::new(Exit::Usage, format!("--triggers {}..{}: {message}", wanted.start, wanted.end)))
        }
    }
}

/// Places of the wanted cameras, in order; all of them where none is named.
fn chosen_cameras(wanted: &[String], known: &[&str]) -> Result<Vec<usize>, Failure> {
    let place = |name: &String| {
        known.iter().position(|known| known == name).ok_or_else(|| {
            Failure::new(Exit::Usage, format!("--cameras {name}: there are {}", known.join(", ")))
        })
    };
    let mut places: Vec<usize> = wanted.iter().map(place).collect::<Result<_, _>>()?;
    places.sort_unstable();
    places.dedup();
    Ok(if wanted.is_empty() { (0..known.len()).collect() } else { places })
}

fn parse_within(text: &str, range: std::ops::RangeInclusive<f64>, what: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| range.contains(number));
    number.ok_or_else(|| format!("expected {what}, {} to {}, found {text:?}", range.start(), range.end()))
}

fn parse_stretch(text: &str) -> Result<f32, String> {
    parse_within(text, 1.5..=1000.0, "a number of spacings").map(|x| x as f32)
}

fn parse_cell(text: &str) -> Result<f64, String> {
    parse_within(text, 0.5..=100.0, "millimetres")
}

fn parse_step(text: &str) -> Result<f64, String> {
    let (least, most) = (STEPS_M.start() * 1e3, STEPS_M.end() * 1e3);
    parse_within(text, least..=most, "millimetres")
}
