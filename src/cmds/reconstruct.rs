// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody reconstruct`: frames to clouds.

mod staged;

use super::failure::{Failure, tell_lost, tell_made_up_times};
use super::progress::Progress;
use crate::base::Exit;
use crate::base::ids::CameraId;
use crate::base::json;
use crate::batch::binned::{BinnedSource, MOST_ROWS};
use crate::batch::collect_shards::{self, Shards};
use crate::batch::image_tree::ImageTree;
use crate::batch::run::{self, Format, Plan};
use crate::batch::summary::Summary;
use crate::batch::timings::Timings;
use crate::batch::whole;
use crate::data::{Calibration, FrameSource, LostPart, SessionIdentity};
use crate::reconstruct::fringe_order::{self, MostDifference};
use crate::reconstruct::marker::epipolar_check::REMARKABLE_PX;
use crate::reconstruct::pipeline::Method;
use crate::reconstruct::triangulate::camera_projector::CameraProjector;
use crate::record::SessionReader;
use clap::ValueEnum;
use staged::Staged;
use std::io::IsTerminal;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};

/// Turn every frame of a session into a point cloud, stored as a phase map.
///
/// The directory has all that `view`, `export`, `validate` and `report` need, the calibration with it.
///
/// A merged cloud has the points of all cameras of a trigger, except those that one head sees at grazing incidence
/// where another head sees the surface well, within 2 mm. The clouds of single cameras have all points.
///
/// A frame that was taken at another trigger than the one it is stored under is refused: moving parts of the body lie
/// in it where the other cameras see them at that other trigger.
///
/// Finished frames of the same session, calibration, method and algorithm are kept, so that an interrupted run goes
/// on where it was; an --out with anything else is refused. All cameras of the session are reconstructed, unless
/// --cameras or --partial chooses. On several machines: `--shard I/N` on each with the same --out, then `--collect N`
/// once; `fourdbody cluster submit` does this under Slurm. Session and --out may be s3://BUCKET/PREFIX, staged in
/// --scratch.
///
/// Exit codes: 3 some frames are missing or were refused, and are listed in summary.json; 4 some frames are damaged,
/// or no frame was reconstructed at all.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody reconstruct sessions/walk-01 --calibration calibration.json --out clouds/walk-01"
)]
pub struct Args {
    #[command(flatten)]
    what: What,
    /// Number of threads [default: one per core].
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
    /// Only the triggers whose index leaves I when divided by N, for runs on several machines.
    #[arg(long, value_name = "I/N", value_parser = parse_shard)]
    shard: Option<(u64, u64)>,
    /// Make summary.json and sequence.mcap of N finished shards: the files that one run would have written. Refused,
    /// with what is missing, while a shard is not complete.
    #[arg(long, value_name = "N", conflicts_with_all = ["shard", "discard", "dump_maps", "timings"])]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    collect: Option<u64>,
    /// Write the time of each stage, and the memory that was needed, to this file, as JSON.
    #[arg(long, value_name = "FILE")]
    timings: Option<PathBuf>,
    /// Write every map of every frame as a PNG image to this directory.
    #[arg(long, value_name = "DIR")]
    dump_maps: Option<PathBuf>,
    /// Keep no cloud, only summary.json and the timings: for measurements.
    #[arg(long, conflicts_with = "dump_maps")]
    discard: bool,
    /// With s3:// locations: where frames and results are staged [default: the system's directory of temporary files].
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,
    /// Print the summary as JSON.
    #[arg(long)]
    json: bool,
}

/// The options that all shards of a session share: which frames are reconstructed, and how.
#[derive(Clone, clap::Args)]
pub(super) struct What {
    /// A session (directory of recordings, or s3://BUCKET/PREFIX of one), or a directory of CAMERA/INDEX.png images.
    pub(super) session: PathBuf,
    /// The calibration, as `fourdbody calibrate` writes it.
    #[arg(long, value_name = "FILE")]
    pub(super) calibration: PathBuf,
    /// Where phases/, calibration.json and summary.json go (clouds/, merged/ and sequence.mcap with --format ply): a
    /// directory, or s3://BUCKET/PREFIX.
    #[arg(long, value_name = "DIR")]
    pub(super) out: PathBuf,
    /// Only triggers A to B - 1, or one trigger by its index.
    #[arg(long, value_name = "A..B", value_parser = parse_range)]
    triggers: Option<Range<u64>>,
    /// Only these cameras, separated by commas.
    #[arg(long, value_name = "CAMERA,...", value_delimiter = ',')]
    cameras: Vec<String>,
    /// Only the cameras that both session and calibration have; without this and --cameras they must have the same
    /// ones.
    #[arg(long, conflicts_with = "cameras")]
    partial: bool,
    /// Triggers per second, for the times in sequence.mcap of images, which state none.
    #[arg(long, value_name = "HZ", default_value_t = 120.0, value_parser = parse_rate)]
    rate_hz: f64,
    /// How fringe orders are found: `joint`, from all cameras of a trigger together, refuses what is not certain;
    /// `paper` is section 4.1 of the paper to the letter.
    #[arg(long, value_enum, default_value = "joint")]
    method: MethodName,
    /// Refuse points whose fringe order leads the next one by less than T: a larger T refuses more points and leaves
    /// fewer wrong ones (docs/validation.md has the curve).
    #[arg(long, value_name = "T", default_value_t = fringe_order::MARGIN, value_parser = parse_margin)]
    margin: f32,
    /// Make one row of N, for a part of the time: 2 keeps the surface, 3 loses a part of it; with more rows the program
    /// would not notice that a device has turned (docs/design/reconstruction.md, Fewer rows).
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = parse_bin_rows)]
    bin_rows: usize,
    /// What to write, separated by commas: `phase` maps in phases/, which all other commands read; `ply` point clouds
    /// in clouds/ and merged/, with sequence.mcap, sixty times the bytes. `fourdbody export` makes the
    /// same clouds of phase maps.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "phase", value_name = "FORMAT,...")]
    format: Vec<FormatName>,
    /// Give every point its standard uncertainty along the line of sight, `sigma` (float, metres) in PLY files.
    #[arg(long)]
    uncertainty: bool,
    /// Whether the session is a staged copy, without the frames that this run does not read.
    #[arg(skip)]
    is_part: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum FormatName {
    Phase,
    Ply,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum MethodName {
    Joint,
    Paper,
}

/// Opens a session: a directory of recordings, or of images.
pub(super) fn open_source(path: &Path, cameras: &[CameraId]) -> Result<Box<dyn FrameSource>, Failure> {
    whole::open_source(path, cameras, SessionReader::open_frames)
}

/// Lets the allocator keep the memory of a frame for the next one. By default blocks of this size go back to the
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

/// A session that is opened with its calibration, and what is to be made of it.
pub(super) struct Opened {
    pub(super) session: SessionIdentity,
    pub(super) source: Box<dyn FrameSource>,
    pub(super) calibration: Calibration,
    pub(super) plan: Plan,
}

impl What {
    /// Opens session and calibration, and checks that they and the options fit each other. The plan is that of one run
    /// over all triggers.
    pub(super) fn open(&self) -> Result<Opened, Failure> {
        let usage = |e: &dyn std::fmt::Display| Failure::new(Exit::Usage, e);
        let calibration = Calibration::load(&self.calibration).map_err(|e| usage(&e))?;
        let mut cameras = self.chosen_cameras(&calibration)?;
        // Of a part of a session there is no more than the indexes have.
        let open = if self.is_part { SessionReader::open_frames } else { SessionReader::open_timed };
        let source = whole::open_source(&self.session, &cameras, open)?;
        if let Some(left_out) = ImageTree::remark(source.left_out()) {
            eprintln!("{left_out}");
        }
        tell_lost(source.lost());
        let session = source
            .identity()
            .map_err(|e| Failure::new(Exit::Corrupt, format!("{}: {e}", self.session.display())))?;
        if self.partial {
            cameras.retain(|camera| session.cameras.contains(camera));
        } else if self.cameras.is_empty() {
            // The cameras of an unreadable recording are not known: those are what is lacking.
            let exit = if source.lost().is_empty() { Exit::Usage } else { Exit::Corrupt };
            whole::same_cameras(&cameras, &session).map_err(|e| Failure::new(exit, e))?;
        }
        if let Some(none) = cameras.is_empty().then_some("the calibration has none of the session's cameras")
        {
            return Err(usage(&none));
        }
        whole::fits(&calibration, &cameras, source.as_ref()).map_err(|e| usage(&e))?;
        if let [only] = &cameras[..]
            && let Some((head, camera)) = calibration.camera(only)
            && CameraProjector::new(head, camera, &calibration).is_ok_and(|pair| pair.is_shallow)
        {
            eprintln!(
                "warning: fringe orders of {only} come from the volume, which is less than a fringe deep: that \
                 nothing else in view is lit is assumed"
            );
        }
        let triggers = super::export::chosen_triggers(self.triggers.as_ref(), source.triggers())?;
        if matches!(self.method, MethodName::Paper) && calibration.pattern.marker_every > 0 {
            let message = "--method paper: the paper's pattern has one marker, this calibration's has \
                 several; use the default method";
            return Err(usage(&message));
        }
        if matches!(self.method, MethodName::Paper) && self.uncertainty {
            let message =
                "--method paper: it has no uncertainties; leave out --uncertainty, or use the default method";
            return Err(usage(&message));
        }
        let source = BinnedSource::around(source, self.bin_rows);
        let calibration =
            if self.bin_rows > 1 { calibration.with_binned_rows(self.bin_rows) } else { calibration };
        let plan = Plan {
            out: self.out.clone(),
            triggers,
            cameras,
            method: match self.method {
                MethodName::Joint => Method::Joint,
                MethodName::Paper => Method::Paper,
            },
            margin: self.margin,
            most_difference: MostDifference::of_rows(self.bin_rows),
            bin_rows: self.bin_rows,
            formats: self.formats(),
            uncertainty: self.uncertainty,
            ..Plan::default()
        };
        Ok(Opened { session, source, calibration, plan })
    }

    /// Whether a part that cannot be read belongs to what the options choose.
    fn includes(&self, part: &LostPart) -> bool {
        let named = |name: &String| part.cameras.iter().any(|id| id.as_str() == name);
        self.cameras.is_empty() || self.cameras.iter().any(named)
    }

    fn chosen_cameras(&self, calibration: &Calibration) -> Result<Vec<CameraId>, Failure> {
        let known: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let wanted: Vec<CameraId> = self.cameras.iter().map(|name| CameraId::from(name.as_str())).collect();
        if let Some(unknown) = wanted.iter().find(|camera| !known.contains(camera)) {
            let names = known.iter().map(CameraId::as_str).collect::<Vec<_>>().join(", ");
            let message = format!("--cameras {unknown}: the calibration has {names}");
            return Err(Failure::new(Exit::Usage, message));
        }
        Ok(if wanted.is_empty() { known } else { wanted })
    }

    /// What is written, each once, in order.
    fn formats(&self) -> Vec<Format> {
        let format = |name: &FormatName| match name {
            FormatName::Phase => Format::Phase,
            FormatName::Ply => Format::Ply,
        };
        let mut formats: Vec<Format> = self.format.iter().map(format).collect();
        formats.sort_unstable();
        formats.dedup();
        formats
    }

    /// The options beside session, calibration and out, as the command line takes them, for these triggers.
    pub(super) fn options(&self, triggers: &Range<u64>) -> Vec<String> {
        let mut options = Vec::new();
        if self.partial {
            options.push("--partial".to_owned());
        }
        let mut option = |name: &str, value: String| options.extend([name.to_owned(), value]);
        option("--triggers", format!("{}..{}", triggers.start, triggers.end));
        if !self.cameras.is_empty() {
            option("--cameras", self.cameras.join(","));
        }
        option("--rate-hz", self.rate_hz.to_string());
        if let Some(value) = self.method.to_possible_value() {
            option("--method", value.get_name().to_owned());
        }
        option("--margin", self.margin.to_string());
        option("--bin-rows", self.bin_rows.to_string());
        option("--format", Format::names(&self.formats()));
        if self.uncertainty {
            options.push("--uncertainty".to_owned());
        }
        options
    }
}

/// Runs `fourdbody reconstruct` with these arguments.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    keep_freed_memory();
    match Staged::of(args)? {
        Some(staged) => staged.run(args),
        None => run_here(args, &args.what),
    }
}

/// Runs with paths on this machine.
fn run_here(args: &Args, what: &What) -> Result<Exit, Failure> {
    let Opened { session, source, calibration, mut plan } = what.open()?;
    plan.shard = args.shard.unwrap_or((0, 1));
    plan.maps.clone_from(&args.dump_maps);
    plan.discard = args.discard;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.jobs.unwrap_or(0))
        .thread_name(|i| format!("reconstruct-{i}"))
        .build()
        .map_err(|e| Failure::new(Exit::Failure, e))?;
    let mut summary = match args.collect {
        None => reconstruct(args, &pool, source.as_ref(), &calibration, &plan)?,
        Some(count) => {
            let shards = Shards::new(session, &plan, &calibration, count)
                .map_err(|e| Failure::new(Exit::Failure, e))?;
            collect_shards::remove_leftovers(&plan.out);
            pool.install(|| collect_shards::collect(&shards))?
        }
    };
    let progress = Progress::of("looking for frames of other triggers", "triggers");
    let at = |done: usize, of: usize| progress.at(done as u64, of as u64);
    let lost = source.lost().iter().filter(|part| what.includes(part));
    pool.install(|| whole::finish(&plan, args.shard, &calibration, &mut summary, lost, what.rate_hz, at))?;
    if plan.merges() && args.shard.is_none() && summary.time_base.is_none() {
        tell_made_up_times(what.rate_hz);
    }
    report(args, &summary);
    // Of few frame sets a shard may have none.
    if args.shard.is_some() && summary.frames == 0 {
        return Ok(Exit::Done);
    }
    if summary.clouds == 0 {
        eprintln!("error: {}", nothing(&summary));
    }
    Ok(exit_of(&summary))
}

/// The exit code that a summary means.
pub(super) fn exit_of(summary: &Summary) -> Exit {
    match summary {
        Summary { clouds: 0, .. } => Exit::Corrupt,
        Summary { unreadable, .. } if !unreadable.is_empty() => Exit::Corrupt,
        Summary { damaged: 0, gaps: 0, refused: 0, .. } => Exit::Done,
        Summary { damaged: 0, .. } => Exit::DataLoss,
        _ => Exit::Corrupt,
    }
}

/// The message that no frame was reconstructed, with the most frequent reason.
fn nothing(summary: &Summary) -> String {
    let Summary { frames, refused, gaps, damaged, .. } = summary;
    let most =
        summary.most_refused_for().map_or_else(String::new, |reason| format!("; most often: {reason}"));
    format!(
        "no frame was reconstructed: expected clouds of {frames} frames, but {refused} were refused, {gaps} \
         are missing and {damaged} \
         damaged{most}. Is it the calibration of this rig, and was there light?"
    )
}

fn reconstruct(
    args: &Args,
    pool: &rayon::ThreadPool,
    source: &dyn FrameSource,
    calibration: &Calibration,
    plan: &Plan,
) -> Result<Summary, Failure> {
    let count = plan.shard_triggers().count();
    let show = std::io::stderr().is_terminal();
    let progress = |done: usize| {
        if show {
            eprint!("\r{done} of {count} triggers{}", if done == count { "\n" } else { "" });
        }
        ControlFlow::Continue(())
    };
    let (summary, timings) = pool.install(|| run::run(source, calibration, plan, progress))?;
    if let Some(path) = &args.timings {
        write_json(path, &Cost { timings, peak_memory_bytes: peak_memory_bytes() })?;
    }
    Ok(summary)
}

/// The content of the file that `--timings` names.
#[derive(serde::Serialize)]
struct Cost {
    #[serde(flatten)]
    timings: Timings,
    /// The most memory that the process had at once, bytes.
    peak_memory_bytes: u64,
}

/// The most memory that this process has had at once.
fn peak_memory_bytes() -> u64 {
    let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: `usage` is a valid place for an rusage, of which all zeros are a value, too.
    let usage = unsafe {
        libc::getrusage(libc::RUSAGE_SELF, usage.as_mut_ptr());
        usage.assume_init()
    };
    // Linux counts KiB.
    u64::try_from(usage.ru_maxrss).unwrap_or(0).saturating_mul(1024)
}

pub(super) fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), Failure> {
    json::save(path, value).map_err(|e| Failure::new(Exit::Failure, e))
}

fn report(args: &Args, summary: &Summary) {
    if args.json {
        println!("{}", serde_json::json!(summary));
        return;
    }
    let merged = summary.merged_points.map_or(String::new(), |points| {
        format!("; {points} of them in {} merged clouds", summary.triggers.len())
    });
    println!(
        "{} frames: {} clouds, {} refused, {} missing, {} damaged; {} points{merged}",
        summary.frames,
        summary.clouds,
        summary.refused,
        summary.gaps,
        summary.damaged,
        summary.points(),
    );
    if !summary.left_out.is_empty() {
        let names: Vec<&str> = summary.left_out.iter().map(CameraId::as_str).collect();
        println!("  partial, as requested: without {}", names.join(", "));
    }
    for part in &summary.unreadable {
        println!("  NOT WHOLE: {part}");
    }
    for lack in &summary.unchecked {
        println!("  not checked: {lack}");
    }
    for suspect in &summary.suspects {
        println!("  suspect: {suspect}");
    }
    for trigger in &summary.triggers {
        for frame in &trigger.frames {
            if let Some(reason) = &frame.reason {
                println!("  {} {}: {}: {reason}", frame.camera, trigger.trigger, frame.outcome);
            }
        }
    }
    if let Some((camera, most)) = summary.differ_rad().into_iter().max_by(|a, b| a.1.total_cmp(&b.1)) {
        println!("  cameras differ by {most:.3} rad of phase at most where they see one surface: {camera}");
    }
    for (camera, offset) in summary.marker_offsets_px() {
        if offset.abs() > REMARKABLE_PX {
            println!(
                "  {camera}: the marker's dashes lie {offset:.2} px of the panel from where the calibration \
                 has them; has a device moved since?"
            );
        }
    }
}

pub(super) fn parse_rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate: &f64| (0.001..=1e6).contains(rate));
    rate.ok_or_else(|| format!("expected triggers per second, for instance 120, found {text:?}"))
}

fn parse_bin_rows(text: &str) -> Result<usize, String> {
    let rows = text.parse().ok().filter(|rows| (1..=MOST_ROWS).contains(rows));
    rows.ok_or_else(|| format!("expected a number of rows, 1 to {MOST_ROWS}, found {text:?}"))
}

fn parse_margin(text: &str) -> Result<f32, String> {
    let margin = text.parse().ok().filter(|margin: &f32| (0.01..=100.0).contains(margin));
    margin.ok_or_else(|| format!("expected a margin of 0.01 to 100, for instance 1.5, found {text:?}"))
}

/// Triggers: `A..B`, without B, or one index.
pub(super) fn parse_range(text: &str) -> Result<Range<u64>, String> {
    let parsed = match text.split_once("..") {
        Some((a, b)) => a.parse().ok().zip(b.parse().ok()),
        None => text.parse().ok().and_then(|one: u64| Some((one, one.checked_add(1)?))),
    };
    parsed.map(|(first, end)| first..end).filter(|range| range.start < range.end).ok_or_else(|| {
        format!(
            "expected A..B with A below B (0..120 are the triggers 0 to 119), or one index such as 12, found {text:?}"
        )
    })
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
        assert_eq!(parse_range("12"), Ok(12..13));
        assert_eq!(parse_shard("3/4"), Ok((3, 4)));
        for bad in ["", "-3", "7..3", "3..3", "a..b", "-1..2", "..", "3..", "18446744073709551615"] {
            assert!(parse_range(bad).is_err(), "{bad}");
        }
        for bad in ["", "4/4", "1", "0/0", "-1/2"] {
            assert!(parse_shard(bad).is_err(), "{bad}");
        }
    }
}
