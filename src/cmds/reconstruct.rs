//! `fourdbody reconstruct`: frames to clouds.

use super::{Exit, Failure};
use crate::calibrate::Calibration;
use crate::ids::CameraId;
use crate::reconstruct::FrameSource;
use crate::reconstruct::batch::{self, Format, Plan, Summary};
use crate::reconstruct::pipeline::Method;
use crate::reconstruct::png_source::PngSource;
use crate::record::SessionReader;
use std::io::IsTerminal;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Turn every frame of a session into a point cloud.
///
/// Finished clouds that were made with the same calibration and method are kept, so that an interrupted run
/// goes on where it was. Exit code 3: some frames are missing, and are listed in summary.json.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody reconstruct sessions/walk-01 --calibration calibration.json --out clouds/walk-01"
)]
pub struct Args {
    /// A session (directory of recordings), or a directory of CAMERA/INDEX.png images.
    session: PathBuf,
    /// The calibration, as `fourdbody calibrate` writes it.
    #[arg(long, value_name = "FILE")]
    calibration: PathBuf,
    /// Where clouds/, merged/, sequence.mcap and summary.json go.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Only triggers A to B - 1.
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    triggers: Option<Range<u64>>,
    /// Only these cameras, separated by commas.
    #[arg(long, value_name = "CAMERA,...", value_delimiter = ',')]
    cameras: Vec<String>,
    /// Number of threads [default: one per core].
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Only the triggers whose index leaves I when divided by N, for runs on several machines.
    #[arg(long, value_name = "I/N", value_parser = parse_shard)]
    shard: Option<(u64, u64)>,
    /// Triggers per second, for the times in sequence.mcap where the session does not tell them.
    #[arg(long, value_name = "HZ", default_value_t = 120.0, value_parser = parse_rate)]
    rate_hz: f64,
    /// Write the time of each stage to this file, as JSON.
    #[arg(long, value_name = "FILE")]
    timings: Option<PathBuf>,
    /// How the absolute phase is found: `anchored` refuses what no marker anchors, `paper` is section 4.1 of
    /// the paper to the letter.
    #[arg(long, value_enum, default_value = "anchored")]
    method: MethodName,
    /// What to write: `ply` point clouds, or `phase` maps in phases/, a twentieth of the bytes, of which
    /// `fourdbody export` makes the very same clouds.
    #[arg(long, value_enum, default_value = "ply")]
    format: FormatName,
    /// Give every point its standard uncertainty along the line of sight, `sigma` (float, metres) in PLY files.
    #[arg(long)]
    uncertainty: bool,
    /// Write every map of every frame as a PNG image to this directory.
    #[arg(long, value_name = "DIR")]
    dump_maps: Option<PathBuf>,
    /// Keep no cloud, only summary.json and the timings: for measurements.
    #[arg(long, conflicts_with = "dump_maps")]
    discard: bool,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum FormatName {
    Ply,
    Phase,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum MethodName {
    Anchored,
    Paper,
}

/// Opens a session: a directory of recordings, or of images.
pub(super) fn open_source(path: &Path, cameras: &[CameraId]) -> Result<Box<dyn FrameSource>, String> {
    if cameras.iter().any(|camera| path.join(camera.as_str()).is_dir()) {
        return Ok(Box::new(PngSource::open(path, cameras)?));
    }
    Ok(Box::new(SessionReader::open(path).map_err(|e| e.to_string())?))
}

/// Lets the allocator keep what a frame gives back for the next one. By default blocks of this size go back to the
/// system each time, and every page of them is cleared and mapped anew: a quarter of the time.
pub(super) fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: mallopt may be called at any time; it only sets parameters of the allocator.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 1 << 30);
        libc::mallopt(libc::M_TRIM_THRESHOLD, i32::MAX);
        // Only the first arena keeps blocks of any size.
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    keep_freed_memory();
    let calibration = Calibration::load(&args.calibration).map_err(|e| Failure::new(Exit::Usage, e))?;
    let cameras = chosen_cameras(args, &calibration)?;
    let source = open_source(&args.session, &cameras).map_err(|e| Failure::new(Exit::Usage, e))?;
    if let Some(stated) = source.statement() {
        calibration.fits(&cameras, &stated).map_err(|e| Failure::new(Exit::Usage, e))?;
    }
    let all = source.triggers();
    let triggers = match &args.triggers {
        None => all,
        Some(wanted) if wanted.start >= all.start && wanted.end <= all.end => wanted.clone(),
        Some(wanted) => {
            let message = format!("--triggers {wanted:?}: the session has triggers {all:?}");
            return Err(Failure::new(Exit::Usage, message));
        }
    };
    if matches!(args.method, MethodName::Paper) && calibration.pattern.marker_every > 0 {
        let message = "--method paper: the paper's pattern has one marker, this calibration's has several; use the default method";
        return Err(Failure::new(Exit::Usage, message));
    }
    let plan = Plan {
        out: args.out.clone(),
        triggers,
        cameras,
        shard: args.shard.unwrap_or((0, 1)),
        method: match args.method {
            MethodName::Anchored => Method::Anchored,
            MethodName::Paper => Method::Paper,
        },
        format: match args.format {
            FormatName::Ply => Format::Ply,
            FormatName::Phase => Format::Phase,
        },
        uncertainty: args.uncertainty,
        maps: args.dump_maps.clone(),
        discard: args.discard,
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.jobs.unwrap_or(0))
        .thread_name(|i| format!("reconstruct-{i}"))
        .build()
        .map_err(|e| Failure::new(Exit::Failure, e))?;
    let count = plan.shard_triggers().count();
    let show = std::io::stderr().is_terminal();
    let progress = |done: usize| {
        if show {
            eprint!("\r{done} of {count} triggers{}", if done == count { "\n" } else { "" });
        }
    };
    let run = pool.install(|| batch::run(source.as_ref(), &calibration, &plan, progress));
    let (summary, timings) = run.map_err(|e| Failure::new(Exit::Failure, e))?;
    if plan.format == Format::Ply && !plan.discard {
        let sequence = args.out.join(shard_name("sequence", "mcap", args.shard));
        batch::write_sequence(source.as_ref(), &plan, args.rate_hz, &sequence)
            .map_err(|e| Failure::new(Exit::Failure, e))?;
    }
    write_json(&args.out.join(shard_name("summary", "json", args.shard)), &summary)?;
    if let Some(path) = &args.timings {
        write_json(path, &timings)?;
    }
    report(args, &summary);
    Ok(match (summary.damaged, summary.gaps) {
        (0, 0) => Exit::Done,
        (0, _) => Exit::DataLoss,
        _ => Exit::Corrupt,
    })
}

/// `summary.json`, or `summary-0-of-4.json` for a shard.
fn shard_name(stem: &str, extension: &str, shard: Option<(u64, u64)>) -> String {
    match shard {
        None => format!("{stem}.{extension}"),
        Some((i, n)) => format!("{stem}-{i}-of-{n}.{extension}"),
    }
}

fn chosen_cameras(args: &Args, calibration: &Calibration) -> Result<Vec<CameraId>, Failure> {
    let known: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let wanted: Vec<CameraId> = args.cameras.iter().map(|name| CameraId::from(name.as_str())).collect();
    if let Some(unknown) = wanted.iter().find(|camera| !known.contains(camera)) {
        let names = known.iter().map(CameraId::as_str).collect::<Vec<_>>().join(", ");
        let message = format!("--cameras {unknown}: the calibration has {names}");
        return Err(Failure::new(Exit::Usage, message));
    }
    Ok(if wanted.is_empty() { known } else { wanted })
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), Failure> {
    let fail = |e: &dyn std::fmt::Display| Failure::new(Exit::Failure, format!("{}: {e}", path.display()));
    let text = serde_json::to_string_pretty(value).map_err(|e| fail(&e))?;
    let partial = path.with_extension("json.partial");
    std::fs::write(&partial, text + "\n").map_err(|e| fail(&e))?;
    std::fs::rename(&partial, path).map_err(|e| fail(&e))
}

fn report(args: &Args, summary: &Summary) {
    if args.json {
        println!("{}", serde_json::json!(summary));
        return;
    }
    println!(
        "{} frames: {} clouds, {} refused, {} missing, {} damaged; {} points in {} merged clouds",
        summary.frames,
        summary.clouds,
        summary.refused,
        summary.gaps,
        summary.damaged,
        summary.merged_points,
        summary.triggers.len(),
    );
    for trigger in &summary.triggers {
        for frame in &trigger.frames {
            if let Some(reason) = &frame.reason {
                println!("  {} {}: {}: {reason}", frame.camera, trigger.trigger, frame.outcome);
            }
        }
    }
}

pub(super) fn parse_rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate: &f64| (0.001..=1e6).contains(rate));
    rate.ok_or_else(|| format!("expected triggers per second, for instance 120, found {text:?}"))
}

pub(super) fn parse_range(text: &str) -> Result<Range<u64>, String> {
    let parsed = text.split_once("..").and_then(|(a, b)| Some(a.parse().ok()?..b.parse().ok()?));
    parsed
        .filter(|range: &Range<u64>| range.start < range.end)
        .ok_or_else(|| format!("expected A..B with A below B, for instance 0..120, found {text:?}"))
}

fn parse_shard(text: &str) -> Result<(u64, u64), String> {
    let parsed = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    parsed
        .filter(|(i, n): &(u64, u64)| i < n)
        .ok_or_else(|| format!("expected I/N with I from 0 to N - 1, for instance 0/4, found {text:?}"))
}

#[cfg(test)]
mod tests {
    use super::{parse_range, parse_shard};

    #[test]
    fn ranges_and_shards_are_checked() {
        assert_eq!(parse_range("3..7"), Ok(3..7));
        assert_eq!(parse_shard("3/4"), Ok((3, 4)));
        for bad in ["", "3", "7..3", "3..3", "a..b", "-1..2"] {
            assert!(parse_range(bad).is_err(), "{bad}");
        }
        for bad in ["", "4/4", "1", "0/0", "-1/2"] {
            assert!(parse_shard(bad).is_err(), "{bad}");
        }
    }
}
