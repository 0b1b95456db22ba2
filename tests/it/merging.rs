// SPDX-License-Identifier: MIT OR Apache-2.0
//! Merged clouds: that they leave out what is worse and nothing else, held against rendered truth, and that every way to
//! them gives the same bytes. Skipped, with a printed reason, where the shared scene is not at hand.

use crate::lab::{FOURDBODY, text_of};
use crate::shared_scene::{calibration, scene};
use fourdbody::base::ids::CameraId;
use fourdbody::batch::from_phase_maps;
use fourdbody::batch::png_source::PngSource;
use fourdbody::batch::run::{self, Format, Plan, cloud_path, merged_path};
use fourdbody::batch::summary::Summary;
use fourdbody::batch::timings::Timings;
use fourdbody::data::{Calibration, Cloud};
use fourdbody::formats::npz::NpzReader;
use fourdbody::formats::ply;
use fourdbody::merge::{self, Rule, View, Viewpoint};
use fourdbody::validate::truth::{Reference, Score, Tally, Truth};
use nalgebra::Point3;
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::process::Command;

/// All eight cameras of the one trigger of the shared scene.
struct Scene {
    calibration: Calibration,
    cameras: Vec<CameraId>,
    source: PngSource,
    scene: std::path::PathBuf,
    dir: tempfile::TempDir,
}

impl Scene {
    fn open() -> Option<Self> {
        let scene = scene()?;
        let dir = tempfile::tempdir().expect("a temporary directory");
        // As a file gives it: what is exported is checked against that.
        let file = dir.path().join("calibration.json");
        calibration(&scene).save(&file).expect("writable");
        let calibration = Calibration::load(&file).expect("a calibration");
        let cameras: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
        let source = PngSource::open(&scene.join("body_arms_raised"), &cameras).expect("images");
        Some(Self { calibration, cameras, source, scene, dir })
    }

    fn run(&self, name: &str, format: Format, threads: usize) -> (Summary, Timings) {
        let plan = Plan {
            out: self.dir.path().join(name),
            triggers: 0..1,
            cameras: self.cameras.clone(),
            formats: vec![format],
            ..Plan::default()
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let done =
            pool.install(|| run::run(&self.source, &self.calibration, &plan, run::to_the_end)).expect("runs");
        done.0.save(&plan.out.join("summary.json")).expect("writable");
        done
    }

    fn merged(&self, name: &str) -> Vec<u8> {
        std::fs::read(merged_path(&self.dir.path().join(name), 0)).expect("was written")
    }

    fn export(&self, from: &str, to: &str, options: &[&str]) {
        let path = |name: &str| self.dir.path().join(name);
        let mut command = Command::new(FOURDBODY);
        command.arg("export").arg(path(from)).arg("--out").arg(path(to)).args(options);
        let output = command.output().expect("the program runs");
        assert_eq!(output.status.code(), Some(0), "{}", text_of(&output));
    }

    fn score(&self, clouds: &[Cloud], select: impl Fn(usize, usize) -> bool) -> Score {
        let mut all = Tally::default();
        for (number, (head, camera)) in self.calibration.cameras().enumerate() {
            let path = self.scene.join(format!("body_arms_raised/truth/{}_000000.npz", camera.id));
            let truth = Truth::load(&path, &camera.device, 1).expect("truth");
            let (projector, pattern) = (&head.projector, &self.calibration.pattern);
            let reference = Reference { camera: &camera.device, projector, pattern };
            all.add(&clouds[number], |i| select(number, i), &truth, reference, None);
        }
        all.score()
    }

    /// Places of the true surface that projectors light and cameras see, of every seventh row and column.
    fn surface(&self) -> Vec<Point3<f64>> {
        let mut points = Vec::new();
        for (_, camera) in self.calibration.cameras() {
            let path = self.scene.join(format!("body_arms_raised/truth/{}_000000.npz", camera.id));
            let mut archive = NpzReader::open(&path).expect("truth");
            let (_, crop) = archive.array::<i64>("crop").expect("whole");
            let (_, depth) = archive.array::<f32>("depth").expect("numbers");
            let (_, lit) = archive.array::<bool>("lit").expect("truths");
            let crop: Vec<usize> = crop.iter().map(|&x| usize::try_from(x).expect("a place")).collect();
            let width = crop[3] - crop[2];
            for v in (0..crop[1] - crop[0]).step_by(7) {
                for u in (0..width).step_by(7) {
                    let (z, lit) = (f64::from(depth[v * width + u]), lit[v * width + u]);
                    let ray = camera.device.lens.undistort((crop[2] + u) as f64, (crop[0] + v) as f64);
                    if let Some([x, y]) = ray.filter(|_| lit && !z.is_nan()) {
                        let to_world = camera.device.world_from_device.isometry();
                        points.push(to_world.transform_point(&Point3::new(x * z, y * z, z)));
                    }
                }
            }
        }
        points
    }
}

/// Share of places with a point no further than `reach_m`.
fn covered(
    places: &[Point3<f64>],
    clouds: &[Cloud],
    keep: impl Fn(usize, usize) -> bool,
    reach_m: f64,
) -> f64 {
    let cell = |p: &Point3<f64>| [p.x, p.y, p.z].map(|x| (x / reach_m).floor() as i32);
    let mut cells: HashMap<[i32; 3], Vec<Point3<f64>>> = HashMap::new();
    for (number, cloud) in clouds.iter().enumerate() {
        for (_, place) in cloud.position_m.iter().enumerate().filter(|(i, _)| keep(number, *i)) {
            let place = Point3::from(*place).cast::<f64>();
            cells.entry(cell(&place)).or_default().push(place);
        }
    }
    let has = |place: &&Point3<f64>| {
        let [x, y, z] = cell(place);
        let around = (0..27).map(|i| [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1]);
        let mut near = around.filter_map(|cell| cells.get(&cell)).flatten();
        near.any(|point| (point - **place).norm() <= reach_m)
    };
    places.iter().filter(has).count() as f64 / places.len() as f64
}

/// The points that a merged cloud leaves out are worse than those it keeps, and the surface stays covered.
#[test]
fn what_is_left_out_is_worse_than_what_is_kept() {
    let Some(scene) = Scene::open() else { return };
    let (summary, timings) = scene.run("direct", Format::Ply, 2);
    let out = scene.dir.path().join("direct");
    let load = |camera: &CameraId| ply::load(&cloud_path(&out, camera, 0)).expect("was written");
    let (headers, clouds): (Vec<ply::Header>, Vec<Cloud>) = scene.cameras.iter().map(load).unzip();
    let from: Vec<Option<Viewpoint>> = headers.iter().map(|header| Viewpoint::of(&header.comments)).collect();
    assert!(from.iter().all(Option::is_some));
    let views = (0..).zip(clouds.iter().zip(&from));
    let views = views.map(|(camera, (cloud, from))| View { camera, cloud, from: from.as_ref() });
    let views: Vec<View<'_>> = views.collect();

    // The merged cloud is a part of the directional ones, bit for bit.
    let (_, merged) = ply::load(&merged_path(&out, 0)).expect("was written");
    assert_eq!(
        (Some(merged.len()), Some(merged.len())),
        (summary.merged_points, summary.triggers[0].merged_points)
    );
    for (number, cloud) in (0u8..).zip(&clouds) {
        let part = merged.of_camera(number);
        let kept: HashSet<[u16; 2]> = part.pixel.iter().copied().collect();
        let places: Vec<usize> = (0..cloud.len()).filter(|&i| kept.contains(&cloud.pixel[i])).collect();
        assert!(cloud.pick(&places) == part && kept.len() == part.len(), "camera {number}");
    }

    let surface = scene.surface();
    let all = scene.score(&clouds, |_, _| true);
    let covered_before = [0.001, 0.003].map(|reach_m| covered(&surface, &clouds, |_, _| true, reach_m));
    let line = |what: &str, score: &Score, covered: [f64; 2]| {
        println!(
            "{what}: {} points, mean {:.3} mm, right {:.3} mm, p95 {:.3} mm, robust {:.3} mm, {:.3} % wrong; within 1 mm {:.2} %, 3 mm {:.2} %",
            score.points,
            score.mean_right_order_mm,
            score.rms_right_order_mm,
            score.p95_mm,
            score.robust_mm,
            100.0 * score.wrong_order_share,
            100.0 * covered[0],
            100.0 * covered[1]
        );
    };
    println!("{:.1} ms to decide", timings.merge_ms);
    line("directional", &all, covered_before);
    for (grazing, well) in [(0.3, 0.6), (0.35, 0.6), (0.4, 0.6), (0.45, 0.6), (0.5, 0.6), (0.5, 0.7)] {
        let rule = Rule { grazing, well, ..Rule::default() };
        let left_out = merge::left_out(&views, rule);
        let is_out = |number: usize, i: usize| left_out.points[number].get(i).copied().unwrap_or(false);
        let (kept, out) =
            (scene.score(&clouds, |number, i| !is_out(number, i)), scene.score(&clouds, is_out));
        let covered_after =
            [0.001, 0.003].map(|reach_m| covered(&surface, &clouds, |n, i| !is_out(n, i), reach_m));
        line(&format!("grazing {grazing} well {well}, kept"), &kept, covered_after);
        line("    left out", &out, [f64::NAN; 2]);
        if rule != Rule::default() {
            continue;
        }
        assert_eq!(kept.points, merged.len());
        let share = left_out.removed as f64 / all.points as f64;
        assert!((0.02..0.15).contains(&share), "{share}");
        assert!(out.robust_mm > 1.4 * kept.robust_mm && out.p95_mm > 1.15 * kept.p95_mm, "{out:?} {kept:?}");
        assert!(out.mean_right_order_mm > 1.15 * kept.mean_right_order_mm, "{out:?} {kept:?}");
        assert!(kept.p95_mm <= all.p95_mm && kept.robust_mm <= all.robust_mm, "{kept:?} {all:?}");
        assert!(kept.wrong_order_share <= 1.05 * all.wrong_order_share, "{kept:?} {all:?}");
        // Of what is lit, no place further than the reach from where a point was.
        assert!(covered_before[1] - covered_after[1] < 0.0005, "{covered_before:?} {covered_after:?}");
    }
}

/// From memory, from files taken up again, from phase maps, with any number of threads, and by `export` of either.
#[test]
fn every_way_to_a_merged_cloud_gives_the_same_bytes() {
    let Some(scene) = Scene::open() else { return };
    let dir = |name: &str| scene.dir.path().join(name);
    let (summary, _) = scene.run("direct", Format::Ply, 1);
    let expected = scene.merged("direct");
    let points: usize = summary.triggers[0].frames.iter().map(|frame| frame.points).sum();
    assert!(summary.merged_points.is_some_and(|merged| merged < points), "{summary:?}");

    // What is finished is not touched; merged again from files, it is the same; what lacks other points is not accepted.
    let again = || scene.run("direct", Format::Ply, 2);
    let (same, timings) = again();
    assert_eq!((&same, timings.merge_ms), (&summary, 0.0));
    let path = merged_path(&dir("direct"), 0);
    std::fs::remove_file(&path).expect("was written");
    let (same, timings) = again();
    assert_eq!((&same, timings.frames), (&summary, 0));
    assert!(scene.merged("direct") == expected);
    let (mut header, mut cloud) = ply::load(&path).expect("whole");
    cloud = cloud.pick(&(1..cloud.len()).collect::<Vec<_>>());
    ply::save(&path, &cloud, &header.comments).expect("writable");
    assert_eq!(again().0, summary);
    assert!(scene.merged("direct") == expected, "a point was missing");
    header.comments.pop();
    let (_, whole) = ply::load(&path).expect("whole");
    ply::save(&path, &whole, &header.comments).expect("writable");
    assert_eq!(again().0, summary);
    assert!(scene.merged("direct") == expected, "it did not say what it lacks");

    // Of phase maps nothing is merged before they are exported.
    let (phases, _) = scene.run("stored", Format::Phase, 2);
    assert_eq!((phases.merged_points, phases.points()), (None, points));
    let export =
        || from_phase_maps::export(&dir("stored"), &scene.calibration, &dir("made"), 120.0, |_, _| ());
    for kept in [0, 1] {
        let made = export().expect("exports");
        assert_eq!((Some(made.merged_points), made.kept), (summary.merged_points, kept));
        assert!(scene.merged("made") == expected);
    }

    let merged = ["--to", "ply,xyz", "--clouds", "merged"];
    scene.export("direct", "from-clouds", &merged);
    scene.export("stored", "from-phases", &merged);
    for name in ["from-clouds", "from-phases"] {
        assert!(scene.merged(name) == expected, "{name}");
    }
    // Without directional clouds a merged cloud stays as it is.
    std::fs::create_dir_all(dir("alone/merged")).expect("writable");
    std::fs::copy(merged_path(&dir("direct"), 0), merged_path(&dir("alone"), 0)).expect("writable");
    scene.export("alone", "from-merged", &merged);
    assert!(scene.merged("from-merged") == expected);
    let text = |name: &str| std::fs::read(dir(name).join("merged/000000.xyz")).expect("was written");
    assert!(text("from-clouds") == text("from-phases") && text("from-clouds") == text("from-merged"));
    // Of some of its cameras nobody knows how many they lack.
    scene.export("alone", "some", &["--cameras", "h0_up,h1_up"]);
    let load = |name: &str| ply::load(&merged_path(&dir(name), 0)).expect("whole");
    assert_eq!(merge::split_removed(&load("some").0.comments), None);
    // The sequences hold the same points.
    scene.export("direct", "sequence", &["--to", "mcap"]);
    scene.export("stored", "sequence-of-phases", &["--to", "mcap"]);
    let clouds = |path: &Path| {
        let bytes = std::fs::read(path).expect("was written");
        let messages = mcap::MessageStream::new(&bytes).expect("intact");
        messages.map(|message| message.expect("intact").data.into_owned()).collect::<Vec<_>>()
    };
    let sequence = |name: &str| clouds(&dir(name).join("sequence.mcap"));
    assert!(
        sequence("sequence") == sequence("sequence-of-phases") && sequence("sequence") == sequence("made")
    );
    // Of one head nothing is left out: nobody else sees it.
    scene.export("direct", "head", &["--cameras", "h0_up,h0_low"]);
    let head: usize = summary.triggers[0].frames[..2].iter().map(|frame| frame.points).sum();
    assert_eq!(load("head").1.len(), head);
}
