//! `fourdbody validate`: figures of merit of clouds.

use super::{Exit, Failure};
use crate::calibrate::Calibration;
use crate::export::{Cloud, ply};
use crate::ids::CameraId;
use crate::image::write_png_rgb;
use crate::validate::truth::{Reference, Score, Tally, Truth};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Measure clouds against something known.
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    Truth(TruthArgs),
}

/// Score clouds against rendered ground truth, per camera, all directional clouds together, and merged.
///
/// The distance of a point is the Euclidean one to the true surface around its pixel. A point has the wrong
/// fringe order when the projector sees it more than pi from the true phase at its pixel; points whose pixel
/// sees no surface count as wrong, too.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  fourdbody validate truth --clouds out --truth scene/truth --calibration calibration.json"
)]
struct TruthArgs {
    /// What `fourdbody reconstruct` wrote (with clouds/ and merged/ in it).
    #[arg(long, value_name = "DIR")]
    clouds: PathBuf,
    /// Directory of CAMERA_INDEX.npz files.
    #[arg(long, value_name = "DIR")]
    truth: PathBuf,
    /// The calibration that the scene was rendered with.
    #[arg(long, value_name = "FILE")]
    calibration: PathBuf,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
    /// Draw where each directional cloud is right (grey), wrong (red, magenta) or missing (blue).
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    match &args.what {
        What::Truth(args) => truth(args),
    }
}

/// A truth file: its camera's number in the calibration, and its trigger.
type Key = (u64, usize);

fn truth(args: &TruthArgs) -> Result<Exit, Failure> {
    let calibration = Calibration::load(&args.calibration).map_err(|e| Failure::new(Exit::Usage, e))?;
    let cameras: Vec<_> = calibration.cameras().collect();
    let files = truth_files(&args.truth, &calibration)?;
    let mut per_camera: BTreeMap<usize, Tally> = BTreeMap::new();
    let (mut merged, mut merged_clouds) = (Tally::default(), 0);
    let mut loaded: Option<(u64, Option<Cloud>)> = None;
    for (&(trigger, number), path) in &files {
        let (head, camera) = cameras[number];
        let truth = Truth::load(path, &camera.device).map_err(|e| Failure::new(Exit::Corrupt, e))?;
        let reference =
            Reference { camera: &camera.device, projector: &head.projector, pattern: &calibration.pattern };
        let cloud = directional(&args.clouds, &camera.id, trigger)?;
        let cloud = cloud.unwrap_or_default();
        per_camera.entry(number).or_default().add(&cloud, |_| true, &truth, reference);
        if let Some(folder) = &args.pictures {
            let (width, height, rgb) = truth.picture(&cloud, reference);
            let path = folder.join(format!("{}_{trigger:06}.png", camera.id));
            std::fs::create_dir_all(folder)
                .and_then(|()| write_png_rgb(&path, width, height, &rgb))
                .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", path.display())))?;
        }
        if loaded.as_ref().is_none_or(|(index, _)| *index != trigger) {
            let cloud =
                load(&[args.clouds.join("merged"), args.clouds.clone()], &format!("{trigger:06}.ply"))?;
            merged_clouds += usize::from(cloud.is_some());
            loaded = Some((trigger, cloud));
        }
        if let Some((_, Some(cloud))) = &loaded {
            let number = u8::try_from(number).unwrap_or(u8::MAX);
            merged.add(cloud, |i| cloud.camera.get(i) == Some(&number), &truth, reference);
        }
    }
    let mut all = Tally::default();
    per_camera.values().for_each(|tally| all.join(tally));
    let rows = per_camera.iter().map(|(&number, tally)| (cameras[number].1.id.to_string(), tally.score()));
    let rows: Vec<(String, Score)> = rows.collect();
    let merged = (merged_clouds > 0).then(|| merged.score());
    print(args.json, &rows, &all.score(), merged.as_ref());
    Ok(Exit::Done)
}

/// All truth files, by trigger and camera.
fn truth_files(directory: &Path, calibration: &Calibration) -> Result<BTreeMap<Key, PathBuf>, Failure> {
    let fail = |e: &dyn std::fmt::Display| Failure::new(Exit::Usage, format!("{}: {e}", directory.display()));
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(directory).map_err(|e| fail(&e))? {
        let path = entry.map_err(|e| fail(&e))?.path();
        let Some(stem) = path.file_name().and_then(|n| n.to_str()?.strip_suffix(".npz")) else { continue };
        let Some((camera, index)) = stem.rsplit_once('_') else { continue };
        let Ok(trigger) = index.parse::<u64>() else { continue };
        if let Some(number) = calibration.cameras().position(|(_, c)| c.id.as_str() == camera) {
            files.insert((trigger, number), path);
        }
    }
    if files.is_empty() {
        return Err(fail(&"expected files CAMERA_INDEX.npz of the calibration's cameras, found none"));
    }
    Ok(files)
}

fn directional(clouds: &Path, camera: &CameraId, trigger: u64) -> Result<Option<Cloud>, Failure> {
    load(&[clouds.join("clouds"), clouds.to_owned()], &format!("{camera}_{trigger:06}.ply"))
}

/// The cloud `name` in the first of the directories that has it.
fn load(directories: &[PathBuf], name: &str) -> Result<Option<Cloud>, Failure> {
    let Some(path) = directories.iter().map(|d| d.join(name)).find(|p| p.exists()) else { return Ok(None) };
    let (_, cloud) = ply::load(&path).map_err(|e| Failure::new(Exit::Corrupt, e))?;
    Ok(Some(cloud))
}

fn print(json: bool, rows: &[(String, Score)], all: &Score, merged: Option<&Score>) {
    if json {
        let cameras: serde_json::Map<_, _> =
            rows.iter().map(|(name, score)| (name.clone(), serde_json::json!(score))).collect();
        println!("{}", serde_json::json!({"cameras": cameras, "directional": all, "merged": merged}));
        return;
    }
    println!(
        "{:<12} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}",
        "", "points", "rms mm", "right mm", "p95 mm", "robust mm", "wrong %", "(off %)", "of lit %"
    );
    let named = rows.iter().map(|(name, score)| (name.as_str(), score));
    for (name, score) in named.chain([("directional", all)]).chain(merged.map(|score| ("merged", score))) {
        println!(
            "{name:<12} {:>9} {:>9.3} {:>9.3} {:>9.3} {:>9.3} {:>9.3} {:>9.3} {:>9.2}",
            score.points,
            score.rms_mm,
            score.rms_right_order_mm,
            score.p95_mm,
            score.robust_mm,
            100.0 * score.wrong_order_share,
            100.0 * score.off_surface_share,
            100.0 * score.completeness_of_lit,
        );
    }
}
