// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody export`: every format is opened by readers that are not ours, runs go on where they were, and wrong
//! requests are refused with a reason.

use crate::back_end::{Frames, calibration};
use crate::lab::{FOURDBODY, text_of};
use crate::recording::{header, record};
use crate::third_party_mcap::python;
use fourdbody::base::ids::{CameraId, NodeId};
use fourdbody::base::image::Plane;
use fourdbody::batch::run::{self, Format, Plan};
use fourdbody::data::{Calibration, Cloud};
use fourdbody::formats::ply;
use fourdbody::record::node_dir;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

const RADIUS: f32 = 0.15;

/// One side of a ball, as a camera far away sees it: up to 85 degrees from the line of sight.
fn half_a_ball(side: f32) -> Cloud {
    let mut cloud = Cloud::default();
    for v in 0..150u16 {
        for u in 0..150u16 {
            let (y, z) = ((f32::from(u) - 74.5) * 2e-3, (f32::from(v) - 74.5) * 2e-3);
            let x = side * (RADIUS * RADIUS - y * y - z * z).sqrt();
            if x.abs() > 0.087 * RADIUS {
                cloud.position_m.push([x + 0.1, y, z + 1.0]);
                cloud.normal.push([x, y, z].map(|x| x / RADIUS));
                cloud.intensity.push(f32::from(u) / 150.0);
                cloud.pixel.push([u + 400, v + 300]);
                cloud.sigma_m.push(1e-4 * (1.0 + f32::from(v)));
            }
        }
    }
    cloud
}

/// A reconstruction of these triggers, of two cameras; the merged cloud of all of them.
pub fn reconstruction(dir: &Path, triggers: &[u64]) -> Cloud {
    let clouds = [(0u8, "h0_up", half_a_ball(1.0)), (3, "h1_low", half_a_ball(-1.0))];
    let mut merged = Cloud::default();
    clouds.iter().for_each(|(number, _, cloud)| merged.merge(cloud, *number));
    for folder in ["clouds", "merged"] {
        std::fs::create_dir_all(dir.join(folder)).expect("writable");
    }
    for trigger in triggers {
        let comments = |last: &str| {
            ["fourdbody test", "parameters abc", &format!("trigger {trigger}"), last].map(str::to_owned)
        };
        for (_, name, cloud) in &clouds {
            let path = dir.join(format!("clouds/{name}_{trigger:06}.ply"));
            ply::save(&path, cloud, &comments(&format!("camera {name}"))).expect("writable");
        }
        let path = dir.join(format!("merged/{trigger:06}.ply"));
        ply::save(&path, &merged, &comments("cameras 0=h0_up 3=h1_low")).expect("writable");
    }
    merged
}

/// The merged cloud as the Python script expects it.
fn expected_bytes(cloud: &Cloud) -> Vec<u8> {
    let mut bytes = Vec::new();
    for i in 0..cloud.len() {
        let floats = cloud.position_m[i].iter().chain([&cloud.intensity[i]]).chain(&cloud.normal[i]);
        floats.for_each(|x| bytes.extend(x.to_le_bytes()));
        cloud.pixel[i].iter().for_each(|x| bytes.extend(x.to_le_bytes()));
        bytes.push(cloud.camera[i]);
        bytes.extend(cloud.sigma_m[i].to_le_bytes());
    }
    bytes
}

fn export(from: &Path, out: &Path, arguments: &[&str]) -> Output {
    let command =
        Command::new(FOURDBODY).arg("export").arg(from).arg("--out").arg(out).args(arguments).output();
    command.expect("the program runs")
}

fn exported(from: &Path, out: &Path, arguments: &[&str]) -> Value {
    let output = export(from, out, &[arguments, &["--json"]].concat());
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", text_of(&output));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

/// What the script with the readers found; `None`, with a printed reason, where there is no Python for it.
fn read_by_others(arguments: &[&str]) -> Option<Value> {
    let Some(python) = python() else {
        println!("skipped: no Python with the readers (`make test` installs them into tests/.venv)");
        return None;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/third_party_export.py");
    let output = Command::new(python).arg(script).args(arguments).output().expect("Python runs");
    let text = text_of(&output);
    if text.contains("ModuleNotFoundError") {
        println!("skipped: {text}");
        return None;
    }
    assert!(output.status.success(), "{text}");
    Some(serde_json::from_slice(&output.stdout).expect("JSON"))
}

#[test]
fn every_format_of_points_and_triangles_opens_elsewhere_with_the_same_numbers() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (from, out) = (dir.path().join("in"), dir.path().join("out"));
    let cloud = reconstruction(&from, &[5]);
    std::fs::write(dir.path().join("expected.bin"), expected_bytes(&cloud)).expect("writable");
    let both = ["--clouds", "merged,directional"];
    exported(&from, &out, &[&["--to", "ply,ply-ascii,pcd,xyz,e57,glb,obj"], &both[..]].concat());
    // A merged cloud put together again is the file that was there.
    let bytes = |dir: &Path, file: &str| std::fs::read(dir.join(file)).expect("was written");
    assert!(bytes(&from, "merged/000005.ply") == bytes(&out, "merged/000005.ply"));
    assert!(bytes(&from, "clouds/h0_up_000005.ply") == bytes(&out, "clouds/h0_up_000005.ply"));
    let (plain, narrow) = (dir.path().join("plain"), dir.path().join("narrow"));
    exported(&from, &plain, &["--to", "xyz", "--no-comments"]);
    exported(&from, &narrow, &["--to", "xyz", "--no-comments", "--columns", "6"]);
    exported(&from, &out, &["--to", "ply,ply-ascii,glb,obj", "--mesh", "grid"]);
    exported(&from, &out, &["--to", "ply,ply-ascii,glb,obj", "--mesh", "watertight"]);
    let Some(found) = read_by_others(&["clouds", &dir.path().display().to_string()]) else { return };
    println!("{found}");
    assert_eq!(found["points"], cloud.len());
    // The guide's table of readers, for those that are installed.
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut readers = Command::new(python().expect("it has run"));
    let readers = readers.arg(root.join("tests/it/third_party_readers.py")).arg(dir.path());
    let output = readers.arg(root.join("docs/guide/exporting.md")).output().expect("Python runs");
    assert!(output.status.success(), "{}", text_of(&output));
    println!("{}", String::from_utf8_lossy(&output.stdout));
    let (pi, radius) = (std::f64::consts::PI, f64::from(RADIUS));
    // Each half to where it is turned by 75 to 85 degrees.
    let zones = |degrees: f64| 4.0 * pi * radius * radius * (1.0 - degrees.to_radians().cos());
    let number = |kind: &str, format: &str, i: usize| found[kind][format][i].as_f64().expect("a number");
    for format in ["ply", "ascii.ply", "obj", "glb"] {
        let area = number("grid", format, 2);
        assert!(area > zones(70.0) && area < zones(85.0), "{format}: {area}");
        let volume = number("watertight", format, 2) / (4.0 / 3.0 * pi * radius.powi(3));
        assert!((volume - 1.0).abs() < 0.01, "{format}: {volume}");
        for (kind, i) in [("grid", 0), ("grid", 1), ("watertight", 0), ("watertight", 1)] {
            assert_eq!(number(kind, format, i), number(kind, "ply", i), "{kind} {format}");
        }
    }
}

#[test]
fn frames_and_times_of_a_session_open_elsewhere() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let session = dir.path().join("walk-01");
    let recording = node_dir(&session, &NodeId::from("a"));
    record(&recording, header("a", &["h0_up", "h0_low"], Some(6)), 6, &[(1, 4)]);
    let out = dir.path().join("out");
    let output = export(&session, &out, &["--to", "png,tiff,csv"]);
    assert_eq!(output.status.code(), Some(3), "a frame is missing: {}", text_of(&output));
    let again = export(&session, &out, &["--to", "png", "--json"]);
    let found: Value = serde_json::from_slice(&again.stdout).expect("JSON");
    assert_eq!((&found["frames"]["skipped"], &found["frames"]["written"]), (&11.into(), &0.into()));
    let Some(found) = read_by_others(&["frames", &dir.path().display().to_string()]) else { return };
    assert_eq!(found["frames"], 11);
}

/// Each pixel of a picture is the intensity of the point that was seen there; a video has the pictures at their places.
#[test]
fn images_without_fringes_open_elsewhere() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (from, out) = (dir.path().join("in"), dir.path().join("out"));
    let cloud = reconstruction(&from, &[3, 5]);
    std::fs::write(dir.path().join("expected.bin"), expected_bytes(&cloud)).expect("writable");
    calibration().save(&from.join("calibration.json")).expect("writable");
    let found = exported(&from, &out, &["--to", "intensity-png"]);
    assert_eq!((&found["written"], &found["empty"]), (&4.into(), &0.into()));
    let again = exported(&from, &out, &["--to", "intensity-png"]);
    assert_eq!((&again["written"], &again["skipped"]), (&0.into(), &4.into()));
    let with_video = Command::new("ffmpeg").arg("-version").output().is_ok();
    if with_video {
        let output = export(&from, &out, &["--to", "mp4", "--rate-hz", "60", "--cameras", "h1_low"]);
        let text = text_of(&output);
        assert_eq!(output.status.code(), Some(3), "trigger 4 has no cloud: {text}");
        assert!(text.contains("3 frames, 60 Hz; the first is trigger 3"), "{text}");
    } else {
        println!("skipped: videos: no ffmpeg (`make test` installs it)");
    }
    let videos = if with_video { "1" } else { "0" };
    let Some(found) = read_by_others(&["images", &dir.path().display().to_string(), videos]) else { return };
    println!("{found}");
    assert_eq!(found["pictures"], 4);
}

#[test]
fn an_interrupted_export_goes_on_and_what_changed_is_made_again() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (from, out) = (dir.path().join("in"), dir.path().join("out"));
    reconstruction(&from, &[0, 1, 2, 3]);
    let counts = |summary: &Value| (summary["written"].clone(), summary["skipped"].clone());
    let first = exported(&from, &out, &["--to", "pcd,xyz", "--triggers", "1..3"]);
    assert_eq!(counts(&first), (4.into(), 0.into()));
    std::fs::write(out.join("merged/000001.xyz.partial"), b"half").expect("writable");
    std::fs::remove_file(out.join("merged/000001.xyz")).expect("was written");
    let all = exported(&from, &out, &["--to", "pcd,xyz"]);
    assert_eq!(counts(&all), (5.into(), 3.into()));
    reconstruction(&from, &[2]);
    let changed = exported(&from, &out, &["--to", "pcd,xyz"]);
    assert_eq!(counts(&changed), (2.into(), 6.into()));
    // The same folder cannot hold clouds of other cameras, or of another reconstruction.
    let other = export(&from, &out, &["--to", "xyz", "--cameras", "h1_low"]);
    assert_eq!(other.status.code(), Some(2), "{}", text_of(&other));
    assert!(text_of(&other).contains("give another directory"), "{}", text_of(&other));
    let elsewhere = dir.path().join("elsewhere");
    reconstruction(&elsewhere, &[0]);
    assert_eq!(export(&elsewhere, &out, &["--to", "xyz"]).status.code(), Some(2));
    // Without directional clouds they are picked out of the merged ones.
    let picked = dir.path().join("picked");
    exported(&from, &picked, &["--to", "ply", "--clouds", "directional", "--triggers", "0..1"]);
    std::fs::remove_dir_all(from.join("clouds")).expect("was written");
    let merged_only = dir.path().join("merged-only");
    exported(&from, &merged_only, &["--to", "ply", "--clouds", "directional", "--triggers", "0..1"]);
    let points = |dir: &Path| ply::load(&dir.join("clouds/h1_low_000000.ply")).expect("a cloud").1;
    assert!(points(&picked) == points(&merged_only));
}

#[test]
fn wrong_requests_are_refused_and_damage_is_listed() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (from, out) = (dir.path().join("in"), dir.path().join("out"));
    reconstruction(&from, &[0, 1]);
    let refused = |arguments: &[&str], words: &str| {
        let output = export(&from, &out, arguments);
        let text = text_of(&output);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {text}");
        assert!(text.contains(words), "{arguments:?}: {text}");
    };
    refused(&["--to", "e57", "--mesh", "grid"], "points only");
    refused(&["--to", "ply", "--triggers", "1..9"], "0..2");
    refused(&["--to", "pcd", "--cameras", "h9_up"], "h0_up, h1_low");
    refused(&["--to", "png,pcd"], "one after the other");
    refused(&["--to", "png"], "expected a session");
    refused(&["--to", "glb", "--quantize", "0.02"], "mcap");
    refused(&["--to", "mcap", "--quantize", "0"], "millimetres");
    refused(&["--to", "pcd", "--no-comments"], "--to xyz");
    refused(&["--to", "intensity-png", "--mesh", "grid"], "points only");
    refused(&["--to", "intensity-png"], "calibration.json");
    let mut command = Command::new(FOURDBODY);
    let command = command.arg("export").arg(&from).args(["--to", "mp4", "--out"]).arg(&out).env("PATH", "");
    let output = command.output().expect("the program runs");
    assert_eq!(output.status.code(), Some(2), "there is no encoder");
    assert!(text_of(&output).contains("install ffmpeg"), "{}", text_of(&output));
    exported(&from, &out, &["--to", "xyz", "--triggers", "0"]);
    refused(&["--to", "xyz", "--triggers", "0", "--no-comments"], "give another directory");
    assert_eq!(export(&from, &from, &["--to", "ply"]).status.code(), Some(2), "it would write what it reads");
    assert_eq!(export(dir.path(), &out, &["--to", "pcd"]).status.code(), Some(2), "there are no clouds");

    let damaged = from.join("clouds/h0_up_000001.ply");
    let bytes = std::fs::read(&damaged).expect("was written");
    std::fs::write(&damaged, &bytes[..bytes.len() / 2]).expect("writable");
    let output = export(&from, &out, &["--to", "pcd"]);
    assert_eq!(output.status.code(), Some(4), "{}", text_of(&output));
    assert!(text_of(&output).contains("h0_up_000001.ply"), "{}", text_of(&output));
    assert!(out.join("merged/000000.pcd").exists() && !out.join("merged/000001.pcd").exists());
}

/// A sequence is read by time and by camera: only what is wanted leaves the disk.
#[test]
fn one_trigger_of_one_camera_is_read_without_the_others() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let from = dir.path().join("in");
    let triggers: Vec<u64> = (0..20).collect();
    let cloud = reconstruction(&from, &triggers);
    let time = (12.0 * 1e9f64 / 120.0).round() as u64;
    for (name, arguments, compression) in [
        ("plain", &[][..], ""),
        ("packed", &["--compress", "3"][..], "zstd"),
        ("small", &["--quantize", "0.02"][..], "zstd"),
    ] {
        let out = dir.path().join(name);
        let to = ["--to", "mcap", "--clouds", "merged,directional"];
        exported(&from, &out, &[&to, arguments].concat());
        let path = out.join("sequence.mcap").display().to_string();
        let Some(found) = read_by_others(&["sequence", &path, "h1_low", &time.to_string()]) else { return };
        let topics = ["/cloud", "/cloud/h0_up", "/cloud/h1_low"];
        assert_eq!(found["topics"], serde_json::json!(topics));
        assert_eq!(found["compression"], serde_json::json!([compression]));
        assert_eq!(found["chunks"], 3 * triggers.len());
        let (size, one) = (found["size"].as_u64().expect("bytes"), &found["one"]);
        assert_eq!(one["messages"].as_array().map(Vec::len), Some(1));
        assert_eq!((&one["messages"][0][0], &one["messages"][0][1]), (&topics[2].into(), &time.into()));
        // The message's own chunk, the summary with a few hundred bytes a chunk, and no more.
        let (bytes, chunk) = (one["bytes"].as_u64().expect("bytes"), size / triggers.len() as u64);
        println!("{name}: {size} bytes, {} of one message read", bytes);
        assert!(bytes < chunk + 30_000, "{name}: {bytes} of {size}");
        assert_eq!(found["camera"]["messages"].as_array().map(Vec::len), Some(triggers.len()));
        let camera = found["camera"]["bytes"].as_u64().expect("bytes");
        assert!(camera < size / 3, "{name}: {camera} of {size} for one camera of two and the merged cloud");
        if name == "small" {
            let points = 2 * cloud.len() * triggers.len();
            assert!(size < 20 * points as u64, "{size} bytes for {points} points");
        }
    }
}

/// A frame of a ball by camera and projector of one head: lit where both see it.
fn photograph(
    camera: &fourdbody::geometry::Device,
    projector: &fourdbody::geometry::Device,
    pattern: &fourdbody::geometry::pattern::Pattern,
    ball: (Point3<f64>, f64),
) -> Plane<u8> {
    let (centre, radius) = ball;
    let mut image = Plane::filled(camera.width, camera.height, 2u8);
    for v in 0..camera.height {
        for u in 0..camera.width {
            let Some(ray) = camera.ray(u as f64, v as f64) else { continue };
            let to: Vector3<f64> = centre - ray.origin;
            let along = to.dot(&ray.direction);
            let under = radius * radius - (to.norm_squared() - along * along);
            if !(under > 0.0) {
                continue;
            }
            let point = ray.at(along - under.sqrt());
            let normal = (point - centre) / radius;
            let incidence = (projector.centre() - point).normalize().dot(&normal);
            let panel = projector.project(&point).filter(|panel| projector.contains(*panel));
            let Some([pu, pv]) = panel.filter(|_| incidence > 0.0) else { continue };
            let light = 2.0 + 200.0 * incidence * pattern.light(pu, pv);
            image.set(u, v, light.round().clamp(0.0, 255.0) as u8);
        }
    }
    image
}

/// A ball photographed by all eight cameras, reconstructed, and closed: the volume that is known.
#[test]
fn the_closed_mesh_of_a_rendered_ball_has_its_volume() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    // As every program gets it: from a file.
    let file = dir.path().join("calibration.json");
    calibration().save(&file).expect("writable");
    let calibration = Calibration::load(&file).expect("just written");
    let ball = (Point3::new(0.05, -0.03, 1.02), 0.2);
    let cameras: Vec<CameraId> = calibration.cameras().map(|(_, camera)| camera.id.clone()).collect();
    let pairs: Vec<_> = calibration.cameras().collect();
    let frames: Vec<(CameraId, Option<Plane<u8>>)> = pairs
        .par_iter()
        .map(|(head, camera)| {
            let image = photograph(&camera.device, &head.projector, &calibration.pattern, ball);
            (camera.id.clone(), Some(image))
        })
        .collect();
    let plan = Plan {
        out: dir.path().join("in"),
        triggers: 0..1,
        cameras: cameras.clone(),
        formats: vec![Format::Phase],
        ..Plan::default()
    };
    let (summary, _) =
        run::run(&Frames(frames, cameras), &calibration, &plan, run::to_the_end).expect("runs");
    assert_eq!(summary.clouds, 8, "{summary:?}");
    summary.save(&plan.out.join("summary.json")).expect("writable");
    // A format that has a place for uncertainties says that there are none.
    let says = |to: &str| {
        text_of(&export(&plan.out, &dir.path().join("said"), &["--to", to])).contains("--uncertainty")
    };
    assert!(says("pcd") && !says("e57"));
    // From stored phase maps, with the calibration beside them, or with the one that is given.
    let (out, beside) = (dir.path().join("out"), plan.out.join("calibration.json"));
    exported(&plan.out, &out, &["--to", "ply", "--mesh", "grid"]);
    std::fs::remove_file(beside).expect("there");
    let needed = export(&plan.out, &out, &["--to", "ply", "--mesh", "watertight"]);
    assert!(needed.status.code() == Some(2) && text_of(&needed).contains("calibration.json"));
    let file = file.display().to_string();
    exported(&plan.out, &out, &["--to", "ply", "--mesh", "watertight", "--calibration", &file]);
    let mesh = |folder: &str| out.join(folder).join("000000.ply").display().to_string();
    let arguments = ["ball", &mesh("watertight"), &mesh("meshes"), "0.05", "-0.03", "1.02", "0.2"];
    let Some(found) = read_by_others(&arguments) else { return };
    println!("{found}");
    let number = |key: &str| found[key].as_f64().expect("a number");
    assert_eq!(found["watertight"], true);
    assert!(number("seen_volume_error").abs() < 0.002, "{found}");
    // No camera sees the poles, above 48 degrees of latitude: they are closed flat, at most.
    assert!(number("volume_error") < 0.0 && number("volume_error") > -0.08, "{found}");
    assert!(number("median_m") < 0.0003 && number("seen_worst_m") < 0.003, "{found}");
    // Each camera sees up to half of it, and neighbours see much of the same.
    assert!(number("grid_area") > 1.5 && number("grid_area") < 4.0, "{found}");
    assert!(number("grid_worst_m") < 0.002, "no triangle leaves the surface: {found}");
}

/// The layout's topics are those that a session and an exported sequence have.
#[test]
fn the_viewers_layout_names_topics_that_exist() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let names = ["h0_up", "h0_low", "h1_up", "h1_low", "h2_up", "h2_low", "h3_up", "h3_low"];
    for (node, cameras) in [("a", &names[..4]), ("b", &names[4..])] {
        record(&dir.path().join(format!("node-{node}")), header(node, cameras, Some(2)), 2, &[]);
    }
    let mut there = std::collections::BTreeSet::new();
    let mut list = |path: &Path| {
        let bytes = std::fs::read(path).expect("readable");
        let summary = mcap::Summary::read(&bytes).expect("intact").expect("a summary");
        there.extend(summary.channels.values().map(|channel| channel.topic.clone()));
    };
    list(&dir.path().join("node-a/segment-000.mcap"));
    list(&dir.path().join("node-b/segment-000.mcap"));
    let from = dir.path().join("in");
    let mut merged = Cloud::default();
    for folder in ["clouds", "merged"] {
        std::fs::create_dir_all(from.join(folder)).expect("writable");
    }
    for (number, name) in (0..).zip(names) {
        ply::save(&from.join(format!("clouds/{name}_000000.ply")), &half_a_ball(1.0), &[]).expect("writable");
        merged.merge(&half_a_ball(1.0), number);
    }
    let numbered: Vec<String> = names.iter().enumerate().map(|(i, name)| format!("{i}={name}")).collect();
    let comments = [format!("cameras {}", numbered.join(" "))];
    ply::save(&from.join("merged/000000.ply"), &merged, &comments).expect("writable");
    let session = dir.path().display().to_string();
    let arguments = ["--to", "mcap", "--clouds", "merged,directional", "--session", &session];
    exported(&from, &dir.path().join("out"), &arguments);
    let path = dir.path().join("out/sequence.mcap");
    list(&path);
    // With the session's times, so that both play together.
    let bytes = std::fs::read(&path).expect("readable");
    let first = mcap::MessageStream::new(&bytes).expect("intact").next().expect("a message").expect("intact");
    assert_eq!(first.log_time, 1_790_000_000_000_000_000);

    let layout = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/foxglove-layout.json");
    let layout: Value = serde_json::from_slice(&std::fs::read(layout).expect("readable")).expect("JSON");
    let panels = layout["configById"].as_object().expect("panels");
    let mut named: Vec<&str> = Vec::new();
    for panel in panels.values() {
        named.extend(panel["imageMode"]["imageTopic"].as_str());
        named.extend(
            panel["topics"].as_object().into_iter().flat_map(|topics| topics.keys().map(String::as_str)),
        );
    }
    assert_eq!(named.len(), 8 + 1 + 8);
    for topic in named {
        assert!(there.contains(topic), "{topic} is not in {there:?}");
    }
    // Every panel has its place.
    fn leaves(node: &Value, found: &mut Vec<String>) {
        match node.as_str() {
            Some(name) => found.push(name.to_owned()),
            None => [&node["first"], &node["second"]].into_iter().for_each(|node| leaves(node, found)),
        }
    }
    let mut shown = Vec::new();
    leaves(&layout["layout"], &mut shown);
    shown.sort();
    assert_eq!(shown, panels.keys().cloned().collect::<Vec<_>>());
}

/// The scripts of `scripts/readers`, as they are shown to users.
#[test]
fn the_readers_scripts_run() {
    let Some(python) = python() else { return };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let from = dir.path().join("in");
    let cloud = reconstruction(&from, &[0, 1, 2]);
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/readers");
    let (plain, small) = (dir.path().join("plain"), dir.path().join("small"));
    exported(&from, &plain, &["--to", "mcap"]);
    exported(&from, &small, &["--to", "mcap", "--quantize", "0.02"]);
    std::fs::write(dir.path().join("expected.bin"), expected_bytes(&cloud)).expect("writable");
    let check = "import sys, types, runpy, numpy as np\n\
        sys.path.insert(0, sys.argv[1])\n\
        import open_numpy\n\
        kind = np.dtype([('p', '<f4', 3), ('i', '<f4'), ('n', '<f4', 3), ('uv', '<u2', 2), ('c', 'u1'), ('s', '<f4')])\n\
        e = np.fromfile(sys.argv[4], kind)\n\
        n = 0\n\
        for n, (t, c) in enumerate(open_numpy.clouds(sys.argv[2]), 1):\n\
        \x20   assert all(np.array_equal(c[a], e['p'][:, k]) for k, a in enumerate('xyz')) and np.array_equal(c['camera'], e['c'])\n\
        \x20   assert all(np.array_equal(c['normal_' + a], e['n'][:, k]) for k, a in enumerate('xyz'))\n\
        \x20   assert np.array_equal(c['sigma'], e['s']) and all(np.array_equal(c[a], e['uv'][:, k]) for k, a in enumerate('uv'))\n\
        assert n == 3, n\n\
        one = [t for t, _ in open_numpy.clouds(sys.argv[2], '/cloud', 8_333_333, 8_333_334)]\n\
        assert one == [8_333_333], one\n\
        for n, (t, c) in enumerate(open_numpy.clouds(sys.argv[3]), 1):\n\
        \x20   error = max(abs(c[a].astype(float) - e['p'][:, k].astype(float)).max() for k, a in enumerate('xyz'))\n\
        \x20   assert error <= 1.0001e-5, error\n\
        \x20   assert max(abs(c['normal_' + a] - e['n'][:, k]).max() for k, a in enumerate('xyz')) <= 1 / 512\n\
        \x20   assert abs(c['intensity'] - e['i']).max() <= 0.5 / 1024\n\
        \x20   assert np.array_equal(c['camera'], e['c'])\n\
        assert n == 3, n\n\
        try:\n\
        \x20   import open3d\n\
        except ImportError:\n\
        \x20   print('without Open3D')\n\
        else:\n\
        \x20   shown = []\n\
        \x20   class Window:\n\
        \x20       def add_geometry(self, cloud): shown.append(cloud)\n\
        \x20       def update_geometry(self, cloud): shown.append(len(cloud.points))\n\
        \x20       def __getattr__(self, name): return lambda *a: None\n\
        \x20   open3d.visualization.Visualizer = Window\n\
        \x20   sys.argv = ['play_open3d.py', sys.argv[2]]\n\
        \x20   runpy.run_path(sys.path[0] + '/play_open3d.py', run_name='__main__')\n\
        \x20   assert len(shown) == 3 and len(shown[0].points) == len(e), shown\n\
        \x20   print('with Open3D', open3d.__version__)";
    let output = Command::new(&python)
        .args(["-c", check])
        .arg(&scripts)
        .args([plain.join("sequence.mcap"), small.join("sequence.mcap"), dir.path().join("expected.bin")])
        .output()
        .expect("Python runs");
    let text = text_of(&output);
    if text.contains("ModuleNotFoundError") {
        println!("skipped: {text}");
        return;
    }
    assert!(output.status.success(), "{text}");
    println!("{text}");
    // And as programs.
    for out in [&plain, &small] {
        let program =
            Command::new(&python).arg(scripts.join("open_numpy.py")).arg(out.join("sequence.mcap")).output();
        let program = program.expect("Python runs");
        assert!(program.status.success(), "{}", text_of(&program));
        assert_eq!(String::from_utf8_lossy(&program.stdout).lines().count(), 3);
    }
    for script in ["open_numpy.py", "play_open3d.py"] {
        let text = std::fs::read_to_string(scripts.join(script)).expect("readable");
        assert!(text.lines().count() <= 30, "{script} is short enough to be read");
    }
}
