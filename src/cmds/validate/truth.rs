// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody validate truth`: clouds against rendered ground truth, a sphere or a mesh.

use super::{bin_rows, load_calibration, load_cloud, of_something, open_clouds, open_photographs, points};
use crate::base::Exit;
use crate::base::ids::{CameraId, TriggerIndex};
use crate::base::image::{Mono8, write_png_rgb};
use crate::cmds::failure::Failure;
use crate::data::{Calibration, Cloud, Frame, FrameSource};
use crate::validate::deviations::Deviations;
use crate::validate::light::{Light, USABLE_DN};
use crate::validate::solid::{Mesh, SolidScore, Sphere, score_mesh, score_sphere};
use crate::validate::truth::{Reference, Score, Tally, Truth};
use crate::validate::uncertainty::{Class, Points};
use nalgebra::Point3;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Score clouds against rendered ground truth, per camera, all directional clouds together, and merged.
///
/// The distance of a point is the Euclidean one to the true surface around its pixel. A point has the wrong fringe
/// order when the projector sees it more than pi from the true phase at its pixel; points whose pixel sees no surface
/// count as wrong, too. Normals of points of right order are compared with those of the true surface, three pixels
/// to each side.
///
/// Against a sphere or a mesh the distance is signed (positive outside) and to the nearest point of the solid; points
/// more than 10 mm away are counted (gross) and do not enter the other figures.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  fourdbody validate truth --clouds out --truth scene/truth\n  fourdbody validate truth --clouds out --sphere 0,0,1,0.15"
)]
pub struct Args {
    /// What `fourdbody reconstruct` wrote (with clouds/ and merged/ in it).
    #[arg(long, value_name = "DIR")]
    clouds: PathBuf,
    /// Directory of truth files, CAMERA_INDEX.npz each.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["sphere", "mesh"])]
    truth: Option<PathBuf>,
    /// The calibration that the scene was rendered with [default: that beside the clouds].
    #[arg(long, value_name = "FILE", requires = "truth")]
    calibration: Option<PathBuf>,
    /// Score against a sphere instead: centre and radius, world, m.
    #[arg(long, value_name = "X,Y,Z,R", value_parser = parse_sphere, conflicts_with = "mesh", allow_hyphen_values = true)]
    sphere: Option<Sphere>,
    /// Score against a mesh instead: a closed surface as Wavefront OBJ, world axes, m.
    #[arg(long, value_name = "FILE")]
    mesh: Option<PathBuf>,
    /// The photographs (a session, or a directory of CAMERA/INDEX.png): completeness and uncertainties are counted by
    /// modulation, too.
    #[arg(long, value_name = "SESSION", requires = "truth")]
    images: Option<PathBuf>,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
    /// Draw where each directional cloud is right (grey), wrong (red, magenta) or missing (blue).
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// Compare the predicted uncertainties (`fourdbody reconstruct --uncertainty`) with the errors, by classes.
    #[arg(long, requires = "truth")]
    uncertainty: bool,
}

/// A truth file: its camera's number in the calibration, and its trigger.
type Key = (u64, usize);

/// Runs `validate truth` and prints its tables.
pub fn run(args: &Args) -> Result<Exit, Failure> {
    match (&args.truth, &args.calibration, args.sphere, &args.mesh) {
        (None, _, Some(sphere), None) => solid(args, |points| score_sphere(points, &sphere)),
        (None, _, None, Some(mesh)) => {
            let mesh = Mesh::load(mesh).map_err(|e| Failure::new(Exit::Usage, e))?;
            solid(args, |points| score_mesh(points, &mesh))
        }
        (Some(directory), given, None, None) => rendered(args, directory, given.as_deref()),
        _ => Err(Failure::new(Exit::Usage, "expected one of: --truth DIR; --sphere X,Y,Z,R; --mesh FILE")),
    }
}

/// All triggers together: per camera, and merged.
fn solid(args: &Args, score: impl Fn(&[Point3<f64>]) -> SolidScore) -> Result<Exit, Failure> {
    let set = open_clouds(&args.clouds)?;
    let mut sets: BTreeMap<String, Vec<Point3<f64>>> = BTreeMap::new();
    for ((_, camera), place) in &set.directional {
        sets.entry(camera.clone()).or_default().extend(points(&load_cloud(&set, place)?));
    }
    let mut merged = Vec::new();
    for place in set.merged.values() {
        merged.extend(points(&load_cloud(&set, place)?));
    }
    let count = merged.len() + sets.values().map(Vec::len).sum::<usize>();
    of_something(count, &args.clouds, "clouds with points")?;
    let cameras: BTreeMap<&String, SolidScore> =
        sets.iter().map(|(name, points)| (name, score(points))).collect();
    let merged = score(&merged);
    if args.json {
        println!("{}", serde_json::json!({"cameras": cameras, "merged": merged}));
        return Ok(Exit::Done);
    }
    println!(
        "                points   mean mm    rms mm robust mm    p95 mm  gross %  fitted: radius error, centre error (mm)"
    );
    let rows = cameras.iter().map(|(name, score)| (name.as_str(), score)).chain([("merged", &merged)]);
    for (name, score) in rows {
        let Deviations { points, mean_mm, rms_mm, robust_mm, p95_mm, .. } = score.deviations;
        let gross = 100.0 * score.gross_share;
        let fitted = score.fitted.map_or(String::new(), |f| {
            let [x, y, z] = f.centre_error_mm;
            format!("{:+.3}, {x:+.3} {y:+.3} {z:+.3}", f.radius_error_mm)
        });
        println!(
            "{name:<12} {points:>9} {mean_mm:>+9.3} {rms_mm:>9.3} {robust_mm:>9.3} {p95_mm:>9.3} {gross:>8.3}  {fitted}"
        );
    }
    Ok(Exit::Done)
}

fn parse_sphere(text: &str) -> Result<Sphere, String> {
    let numbers: Vec<f64> = text.split(',').map_while(|n| n.trim().parse().ok()).collect();
    match numbers.as_slice() {
        &[x, y, z, radius_m] if radius_m > 0.0 && numbers.iter().all(|n| n.is_finite()) => {
            Ok(Sphere { centre: Point3::new(x, y, z), radius_m })
        }
        _ => Err(format!("expected x,y,z,radius in metres, for instance 0,0,1,0.15, found {text:?}")),
    }
}

/// Scores clouds against rendered truth, camera by camera.
fn rendered(args: &Args, directory: &Path, calibration: Option<&Path>) -> Result<Exit, Failure> {
    let calibration = load_calibration(calibration, &args.clouds)?;
    let rows = bin_rows(&args.clouds)?;
    let cameras: Vec<_> = calibration.cameras().collect();
    let files = truth_files(directory, &calibration)?;
    let set = open_clouds(&args.clouds)?;
    let ids: Vec<CameraId> = cameras.iter().map(|(_, camera)| camera.id.clone()).collect();
    let images = args.images.as_deref().map(|path| open_photographs(path, &ids, &args.clouds)).transpose()?;
    let mut per_camera: BTreeMap<usize, Tally> = BTreeMap::new();
    let (mut merged, mut merged_clouds, mut directional_clouds) = (Tally::default(), 0, 0);
    let mut predicted = Points::default();
    let mut loaded: Option<(u64, Option<Cloud>)> = None;
    for (&(trigger, number), path) in &files {
        let (head, camera) = cameras[number];
        let truth = Truth::load(path, &camera.device, rows).map_err(|e| Failure::new(Exit::Corrupt, e))?;
        let truth = truth.within([calibration.volume_min_m, calibration.volume_max_m], &camera.device);
        let reference =
            Reference { camera: &camera.device, projector: &head.projector, pattern: &calibration.pattern };
        let place = set.directional.get(&(trigger, camera.id.to_string()));
        directional_clouds += usize::from(place.is_some());
        let cloud = place.map(|place| load_cloud(&set, place)).transpose()?.unwrap_or_default();
        let light = images.as_deref().map(|images| light_of(images, &camera.id, trigger, &truth, reference));
        let light = light.transpose()?;
        let tally = per_camera.entry(number).or_default();
        tally.add(&cloud, |_| true, &truth, reference, light.as_ref());
        if args.uncertainty {
            predicted.add(&cloud, &truth, reference, light.as_ref());
        }
        if let Some(folder) = &args.pictures {
            let (width, height, rgb) = truth.picture(&cloud, reference);
            let path = folder.join(format!("{}_{trigger:06}.png", camera.id));
            std::fs::create_dir_all(folder)
                .and_then(|()| write_png_rgb(&path, width, height, &rgb))
                .map_err(|e| Failure::new(Exit::Failure, format!("{}: {e}", path.display())))?;
        }
        if loaded.as_ref().is_none_or(|(index, _)| *index != trigger) {
            let cloud = set.merged.get(&trigger).map(|place| load_cloud(&set, place)).transpose()?;
            merged_clouds += usize::from(cloud.is_some());
            loaded = Some((trigger, cloud));
        }
        if let Some((_, Some(cloud))) = &loaded {
            let number = u8::try_from(number).unwrap_or(u8::MAX);
            merged.add(cloud, |i| cloud.camera.get(i) == Some(&number), &truth, reference, None);
        }
    }
    of_something(
        directional_clouds + merged_clouds,
        &args.clouds,
        "clouds of the truth's triggers and cameras",
    )?;
    let mut all = Tally::default();
    per_camera.values().for_each(|tally| all.join(tally));
    let rows = per_camera.iter().map(|(&number, tally)| (cameras[number].1.id.to_string(), tally.score()));
    let rows: Vec<(String, Score)> = rows.collect();
    let merged = (merged_clouds > 0).then(|| merged.score());
    if args.uncertainty && predicted.is_empty() {
        let message = "no cloud has uncertainties: reconstruct with --uncertainty first";
        return Err(Failure::new(Exit::Usage, message));
    }
    let classes = if args.uncertainty { predicted.classes() } else { Vec::new() };
    print(args.json, &rows, &all.score(), merged.as_ref(), &classes);
    Ok(Exit::Done)
}

/// The fringes in a photograph.
fn light_of(
    images: &dyn FrameSource,
    camera: &CameraId,
    trigger: u64,
    truth: &Truth,
    reference: Reference<'_>,
) -> Result<Light, Failure> {
    let fail = |why: String| Failure::new(Exit::Usage, format!("photograph {trigger} of {camera}: {why}"));
    let damaged = |why: String| Failure::corrupt(fail(why).message);
    let light = match images.frame(camera, TriggerIndex(trigger)).map_err(damaged)? {
        Frame::Image(image) => Light::measure(truth, image, reference),
        Frame::Owned(image) => Light::measure(truth, Mono8::from(&image), reference),
        Frame::Gap(cause) => Err(format!("there is none ({cause})")),
    };
    light.map_err(fail)
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

fn print(json: bool, rows: &[(String, Score)], all: &Score, merged: Option<&Score>, classes: &[Class]) {
    if json {
        let cameras: serde_json::Map<_, _> =
            rows.iter().map(|(name, score)| (name.clone(), serde_json::json!(score))).collect();
        let mut report = serde_json::json!({"cameras": cameras, "directional": all, "merged": merged});
        if !classes.is_empty() {
            report["uncertainty"] = serde_json::json!(classes);
        }
        println!("{report}");
        return;
    }
    println!(
        "                points    rms mm  right mm    p95 mm robust mm   wrong %   (off %)  of lit %  normals: median, p95 deg"
    );
    let named = rows.iter().map(|(name, score)| (name.as_str(), score));
    for (name, score) in named.chain([("directional", all)]).chain(merged.map(|score| ("merged", score))) {
        let Score { points, rms_mm, rms_right_order_mm: right, p95_mm, robust_mm, .. } = score;
        let shares = [score.wrong_order_share, score.off_surface_share, score.completeness_of_lit];
        let [wrong, off, of_lit] = shares.map(|share| 100.0 * share);
        let (median, p95) = (score.normal_median_deg, score.normal_p95_deg);
        println!(
            "{name:<12} {points:>9} {rms_mm:>9.3} {right:>9.3} {p95_mm:>9.3} {robust_mm:>9.3} {wrong:>9.3} {off:>9.3} {of_lit:>9.2}  {median:.2}, {p95:.2}"
        );
    }
    print_modulation(all);
    print_uncertainty(classes);
}

fn print_modulation(all: &Score) {
    if all.by_modulation.is_empty() {
        return;
    }
    println!("\ndirectional, by modulation; whole: a whole fringe around the pixel is on one lit surface");
    println!("at least          of lit % complete %   wrong % |   whole % complete %   wrong %");
    for class in &all.by_modulation {
        let usable = if class.min_modulation_dn == USABLE_DN { "  usable" } else { "" };
        let percent = [
            class.share_of_lit,
            class.completeness,
            class.wrong_share,
            class.whole_share_of_lit,
            class.whole_completeness,
            class.whole_wrong_share,
        ];
        let [a, b, c, d, e, f] = percent.map(|share| 100.0 * share);
        let bound = format!("{} DN{usable}", class.min_modulation_dn);
        println!("{bound:<16} {a:>9.2} {b:>10.2} {c:>9.3} | {d:>9.2} {e:>10.2} {f:>9.3}");
    }
}

fn print_uncertainty(classes: &[Class]) {
    if !classes.is_empty() {
        println!("\nclass by           from .. to    points  predicted mm  robust mm  ratio  within 2 %");
    }
    for Class { by, from, to, points, predicted_mm, robust_mm, ratio, within_two } in classes {
        let (bounds, within) = (format!("{from} .. {to}"), 100.0 * within_two);
        println!(
            "{by:<14} {bounds:>14} {points:>9} {predicted_mm:>13.3} {robust_mm:>10.3} {ratio:>6.2} {within:>11.1}"
        );
    }
}
