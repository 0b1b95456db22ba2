// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is reused of an earlier run, and what is nothing (docs/design/reconstruction.md, "Results"): a directory takes the clouds of
//! one session made in one way; a run that made nothing is no success.

use crate::analytic_scene::{pair_of, photograph, sphere};
use crate::lab::{assert_contains, fourdbody, text_of};
use fourdbody::base::image::{Mono8, Plane, write_png_grey};
use fourdbody::batch::key::ALGORITHM;
use fourdbody::config::Rig;
use fourdbody::data::Calibration;
#[cfg(feature = "aravis")]
use fourdbody::formats::ply;
use nalgebra::Point3;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::OnceLock;

/// The number of the algorithm, and the digest of the points that it makes of the fixture. Where this fails, clouds have changed:
/// raise `fourdbody::batch::key::ALGORITHM`, so that no result is a mixture of both, and put the new digest here.
const GOLDEN: (u32, &str) = (39, "737ddf98bfd2dd7bfdf8005691501e36");

/// Digest of the photographs that this is of: where it fails as well, it is the light that has changed.
const LIGHT: &str = "930ceb2a184e08c75a495d1570d038ea";

const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];
const SIZE: (usize, usize) = (1920, 1200);

/// Centre and radius of the ball, m.
pub const BALL: ([f64; 3], f64) = ([0.05, -0.02, 1.03], 0.2);

/// A ball with the marker on it, as both cameras of the first head see it.
pub fn light() -> &'static [Plane<u8>; 2] {
    static LIGHT: OnceLock<[Plane<u8>; 2]> = OnceLock::new();
    LIGHT.get_or_init(|| {
        [0, 1].map(|camera| {
            let pair = pair_of(0, camera, None);
            photograph(&pair, sphere(Point3::from(BALL.0), BALL.1))
        })
    })
}

/// A rig of one head, its calibration, and one frame set of it.
pub struct Place(tempfile::TempDir);

impl Place {
    pub fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a temporary directory"));
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
        let text = std::fs::read_to_string(shipped).expect("config/rig.toml is in the repository");
        let mut rig: toml::Table = text.parse().expect("valid");
        rig["head"].as_array_mut().expect("heads").truncate(1);
        std::fs::write(place.path("rig.toml"), rig.to_string()).expect("writable");
        let rig = Rig::load(&place.path("rig.toml")).expect("a rig");
        Calibration::nominal(&rig).save(&place.path("calibration.json")).expect("writable");
        for (camera, image) in CAMERAS.into_iter().zip(light()) {
            std::fs::create_dir_all(place.path("images").join(camera)).expect("writable");
            place.put(&format!("images/{camera}/000000.png"), Mono8::from(image));
        }
        std::fs::create_dir(place.path("sessions")).expect("writable");
        place
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn put(&self, name: &str, image: Mono8<'_>) {
        write_png_grey(&self.path(name), image).expect("writable");
    }

    fn import(&self, images: &Path, name: &str) -> Output {
        let out = self.path("sessions").join(name);
        run(&["import"], &[("--rig", &self.path("rig.toml")), ("--images", images), ("--out", &out)])
    }

    /// The frame set as a session.
    pub fn session(&self, name: &str) -> PathBuf {
        let imported = self.import(&self.path("images"), name);
        assert_eq!(imported.status.code(), Some(0), "{}", text_of(&imported));
        self.path("sessions").join(name)
    }
}

/// Runs the program with the paths as arguments.
pub fn run(words: &[&str], paths: &[(&str, &Path)]) -> Output {
    let mut args: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
    for (option, path) in paths {
        args.extend([(*option).to_owned(), path.display().to_string()].into_iter().filter(|x| !x.is_empty()));
    }
    fourdbody(&args.iter().map(String::as_str).collect::<Vec<_>>())
}

fn refused(output: &Output, code: i32, words: &[&str]) {
    assert_eq!(output.status.code(), Some(code), "{}", text_of(output));
    assert_contains(&text_of(output), words);
}

pub fn reconstruct(place: &Place, from: &Path, out: &Path, options: &[&str]) -> Output {
    let calibration = place.path("calibration.json");
    let format: &[&str] = if options.contains(&"--format") { &[] } else { &["--format", "ply"] };
    let words: Vec<&str> = ["reconstruct"].iter().chain(format).chain(options).copied().collect();
    run(&words, &[("", from), ("--calibration", &calibration), ("--out", out)])
}

/// Gives a result of clouds of trigger 0 the same ones of other triggers, as if there had been more of them.
#[cfg(feature = "aravis")]
pub fn repeat(out: &Path, triggers: impl IntoIterator<Item = u64>) {
    let mut summary = json(&out.join("summary.json"));
    let all = summary["triggers"].as_array_mut().expect("triggers");
    let (mut first, own) = (all[0].clone(), all[0]["trigger"].as_u64().expect("a trigger"));
    first.as_object_mut().expect("an object").remove("time_ns");
    for trigger in triggers {
        first["trigger"] = trigger.into();
        all.push(first.clone());
        for (folder, stem) in [("clouds", "h0_up_"), ("clouds", "h0_low_"), ("merged", "")] {
            let path = |trigger: u64| out.join(folder).join(format!("{stem}{trigger:06}.ply"));
            let (mut header, cloud) = ply::load(&path(own)).expect("a cloud");
            header
                .comments
                .retain(|comment| !comment.starts_with("trigger ") && !comment.starts_with("time_ns "));
            header.comments.push(format!("trigger {trigger}"));
            ply::save(&path(trigger), &cloud, &header.comments).expect("writable");
        }
    }
    std::fs::write(out.join("summary.json"), summary.to_string()).expect("writable");
}

pub fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("readable")).expect("JSON")
}

fn inodes(out: &Path) -> BTreeMap<PathBuf, u64> {
    let files =
        ["clouds", "merged"].into_iter().flat_map(|folder| out.join(folder).read_dir().expect("a directory"));
    files.flatten().map(|entry| (entry.path(), entry.metadata().expect("metadata").ino())).collect()
}

fn hex(digest: impl AsRef<[u8]>) -> String {
    digest.as_ref().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

/// What a PLY file has behind its comments.
pub fn points_of(path: &Path) -> Vec<u8> {
    let mut bytes = std::fs::read(path).expect("readable");
    let head = b"end_header\n";
    let end = bytes.windows(head.len()).position(|window| window == head).expect("a PLY file");
    bytes.split_off(end)
}

/// Of all points of a result, without the comments.
fn points_digest(out: &Path) -> String {
    let mut digest = Sha256::new();
    for path in inodes(out).keys() {
        digest.update(path.file_name().expect("a name").as_encoded_bytes());
        digest.update(points_of(path));
    }
    hex(digest.finalize())
}

#[test]
fn a_result_is_of_one_session_and_of_one_algorithm() {
    let place = Place::new();
    let seen = hex(light()
        .iter()
        .fold(Sha256::new(), |digest, image| digest.chain_update(image.as_slice()))
        .finalize());
    let (first, second, out) = (place.session("first"), place.session("second"), place.path("out"));
    let done = reconstruct(&place, &first, &out, &[]);
    assert_eq!(done.status.code(), Some(0), "{}", text_of(&done));
    assert_eq!(seen, LIGHT, "the photographs are others: put their digest here, and that of the points");
    let golden = (ALGORITHM, points_digest(&out));
    assert_eq!((golden.0, golden.1.as_str()), GOLDEN, "other points need another ALGORITHM, see GOLDEN");

    let summary = json(&out.join("summary.json"));
    assert_eq!(summary["algorithm"], ALGORITHM);
    assert_eq!(summary["session"]["name"], "first");
    let state = || (inodes(&out), std::fs::read(out.join("summary.json")).expect("readable"));
    let before = state();
    // The same once more: everything is there.
    assert_eq!(reconstruct(&place, &first, &out, &[]).status.code(), Some(0));
    assert_eq!(inodes(&out), before.0);
    // Another session of the very same photographs; the name used again; another way; other cameras.
    let other = |from: &Path, options: &[&str], words: &[&str]| {
        refused(&reconstruct(&place, from, &out, options), 2, words);
        assert!(state().1 == before.1 && state().0 == before.0, "something was written over");
    };
    other(&second, &[], &["session: there first", "requested second", "--out"]);
    other(&place.path("images"), &[], &["session: there first", "images "]);
    other(&first, &["--method", "paper"], &["method: there joint"]);
    other(&first, &["--margin", "2"], &["margin: there 1, requested 2"]);
    other(&first, &["--bin-rows", "2"], &["calibration: there", "bin-rows: there 1, requested 2"]);
    other(&first, &["--format", "phase"], &["format: there ply, requested phase"]);
    other(&first, &["--format", "ply,phase"], &["format: there ply, requested phase,ply"]);
    other(&first, &["--cameras", "h0_up"], &["cameras: there h0_up,h0_low"]);
    std::fs::remove_dir_all(&first).expect("ours");
    place.session("first");
    other(&first, &[], &["session: there first", "requested first"]);
    other(&first, &["--shard", "0/2"], &["session: there first"]);
    // Neither is a page about one session made of the other one's clouds.
    let page = place.path("page.html");
    let report = run(&["report"], &[("", &second), ("--clouds", &out), ("--out", &page)]);
    refused(&report, 4, &["results of the session first", "second"]);
    assert!(!page.exists());
    // Clouds that do not say of what they are.
    std::fs::remove_file(out.join("reconstruct.json")).expect("there");
    other(&first, &[], &["no reconstruct.json"]);
}

/// Robust deviation of the directional clouds from the ball, mm, and how many points they have.
fn score(out: &Path) -> (f64, f64) {
    let ([x, y, z], radius) = BALL;
    let ball = format!("{x},{y},{z},{radius}");
    let scored = run(&["validate", "truth", "--json", "--sphere", &ball], &[("--clouds", out)]);
    assert_eq!(scored.status.code(), Some(0), "{}", text_of(&scored));
    let scored: Value = serde_json::from_slice(&scored.stdout).expect("JSON");
    let of = |key: &str| CAMERAS.map(|camera| scored["cameras"][camera][key].as_f64().expect("a number"));
    (of("robust_mm").into_iter().fold(0.0, f64::max), of("points").iter().sum())
}

#[test]
fn a_result_is_read_as_it_is_whatever_is_stored_of_it() {
    let place = Place::new();
    let session = place.session("ball");
    let (phases, both) = (place.path("phases"), place.path("both"));
    let picture = place.path("picture.png");
    for (out, format) in [(&phases, "phase"), (&both, "phase,ply")] {
        for _ in 0..2 {
            let made = reconstruct(&place, &session, out, &["--format", format]);
            assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
        }
        for what in [out, &out.join("phases/h0_up_000000.phase")] {
            let drawn = run(&["view"], &[("", what), ("--out", &picture)]);
            assert_eq!(drawn.status.code(), Some(0), "{}", text_of(&drawn));
            std::fs::remove_file(&picture).expect("was drawn");
        }
        refused(&run(&["view", "--trigger", "9"], &[("", out), ("--out", &picture)]), 2, &["--trigger", "0"]);
        let page = place.path("page.html");
        let report = run(&["report"], &[("", &session), ("--clouds", out), ("--out", &page)]);
        assert_eq!(report.status.code(), Some(0), "{}", text_of(&report));
    }
    assert!(!phases.join("clouds").exists() && !phases.join("sequence.mcap").exists());
    assert_eq!(score(&phases), score(&both));
    // What is exported of maps are the bytes that are written directly.
    let exported = place.path("exported");
    let made = run(&["export"], &[("", &phases), ("--out", &exported)]);
    assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
    for path in inodes(&exported).into_keys() {
        let other = both.join(path.strip_prefix(&exported).expect("below"));
        assert_eq!(points_of(&path), points_of(&other), "{}", path.display());
    }
    // A calibration that is not the one of the maps is not read with them, and not written over.
    let text = std::fs::read_to_string(phases.join("calibration.json")).expect("beside the maps");
    std::fs::write(phases.join("calibration.json"), text.replace("\"origin\": \"", "\"origin\": \"not "))
        .expect("writable");
    refused(&run(&["view"], &[("", &phases), ("--out", &picture)]), 4, &["calibration.json", "sha256"]);
    refused(
        &reconstruct(&place, &session, &phases, &["--format", "phase"]),
        2,
        &["calibration.json", "sha256", "--out"],
    );
}

/// Clouds of binned rows have as many points less, of the same surface.
#[test]
fn two_rows_that_are_binned_give_half_the_points_of_the_same_surface() {
    let place = Place::new();
    let images = place.path("images");
    let of = |rows: &str| {
        let out = place.path(rows);
        let made = reconstruct(&place, &images, &out, &["--format", "phase", "--bin-rows", rows]);
        assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
        score(&out)
    };
    let ((whole_mm, whole), (robust_mm, points)) = (of("1"), of("2"));
    assert!(robust_mm < 1.2 * whole_mm, "{robust_mm} mm, {whole_mm} mm of all rows");
    assert!((2.0 * points / whole - 1.0).abs() < 0.1, "{points} points of {whole}");
    refused(
        &reconstruct(&place, &place.path("images"), &place.path("out"), &["--bin-rows", "4"]),
        2,
        &["1 to 3"],
    );
}

#[test]
fn an_export_is_of_one_result_whatever_lies_at_its_place_later() {
    let place = Place::new();
    let (out, exported) = (place.path("out"), place.path("exported"));
    let export = |options: &[&str]| {
        let calibration = place.path("calibration.json");
        let words: Vec<&str> = ["export"].iter().chain(options).copied().collect();
        run(&words, &[("", &out), ("--calibration", &calibration), ("--out", &exported)])
    };
    for (round, options) in [(0, vec!["--to", "pcd"]), (1, vec![])] {
        let format = if round == 0 { "ply" } else { "phase" };
        for name in ["first", "second"] {
            let session = place.session(&format!("{name}-{round}"));
            let _ = std::fs::remove_dir_all(&out);
            let made = reconstruct(&place, &session, &out, &["--format", format]);
            assert_eq!(made.status.code(), Some(0), "{}", text_of(&made));
            match name {
                "first" => assert_eq!(export(&options).status.code(), Some(0)),
                _ => refused(&export(&options), 2, &["first", "second", "--out"]),
            }
        }
        std::fs::remove_dir_all(&exported).expect("there");
    }
}

/// A directory of images, of the cameras of the first head, all of this grey.
fn flat(dir: &Path, size: (usize, usize), grey: u8) -> PathBuf {
    let pixels = vec![grey; size.0 * size.1];
    for camera in CAMERAS {
        std::fs::create_dir_all(dir.join(camera)).expect("writable");
        let image = Mono8::new(size.0, size.1, &pixels).expect("fits");
        for index in 0..2 {
            write_png_grey(&dir.join(camera).join(format!("{index:06}.png")), image).expect("writable");
        }
    }
    dir.to_owned()
}

#[test]
fn nothing_is_not_success_and_what_is_empty_is_not_shown() {
    let place = Place::new();
    let calibration = place.path("calibration.json");
    let nothing = ["no frame was reconstructed", "4 were refused"];
    for (name, size, grey, why) in
        [("black", SIZE, 0, "there is no object"), ("small", (64, 48), 90, "expected a frame of")]
    {
        let images = flat(&place.path(&format!("{name}-images")), size, grey);
        let out = place.path(name);
        for _ in 0..2 {
            let made = reconstruct(&place, &images, &out, &[]);
            refused(&made, 4, &[&nothing[..], &[why]].concat());
            assert_eq!(out.join("merged").read_dir().expect("a directory").count(), 0, "{name}");
            assert!(!out.join("sequence.mcap").exists() && out.join("summary.json").exists());
        }
        let picture = place.path("picture.png");
        let view = run(&["view"], &[("", &out.join("clouds/h0_up_000000.ply")), ("--out", &picture)]);
        refused(&view, 4, &["has no points", why]);
        let exported = place.path(&format!("{name}-exported"));
        for to in ["ply,pcd", "mcap"] {
            let made = run(&["export", "--to", to], &[("", &out), ("--out", &exported)]);
            refused(&made, 4, &["nothing was exported", "found none in 2 triggers"]);
            assert!(!exported.join("sequence.mcap").exists() && !picture.exists());
        }
        let phases = place.path(&format!("{name}-phases"));
        refused(&reconstruct(&place, &images, &phases, &["--format", "phase"]), 4, &nothing);
        let again = place.path(&format!("{name}-again"));
        let made = run(&["export"], &[("", &phases), ("--calibration", &calibration), ("--out", &again)]);
        refused(&made, 4, &["nothing to export"]);
        assert_eq!(again.join("merged").read_dir().expect("a directory").count(), 0);
        // Shards say it as well, and so does what is collected of them.
        let shards = place.path(&format!("{name}-shards"));
        for shard in ["0/2", "1/2"] {
            refused(&reconstruct(&place, &images, &shards, &["--shard", shard]), 4, &nothing[..1]);
        }
        refused(&reconstruct(&place, &images, &shards, &["--collect", "2"]), 4, &nothing);
    }
    // A part is loss that is told.
    std::fs::copy(place.path("black-images/h0_up/000000.png"), place.path("images/h0_up/000000.png"))
        .expect("writable");
    let part = place.path("part");
    refused(
        &reconstruct(&place, &place.path("images"), &part, &[]),
        3,
        &["2 frames: 1 clouds, 1 refused", "no object"],
    );
    let made =
        run(&["export", "--clouds", "directional"], &[("", &part), ("--out", &place.path("part-exported"))]);
    refused(&made, 3, &["1 files written", "1 without points"]);
}

#[test]
fn a_part_of_the_cameras_is_asked_for_by_name() {
    let place = Place::new();
    let images = place.path("images");
    std::fs::create_dir(images.join("h1_up")).expect("writable");
    std::fs::copy(images.join("h0_up/000000.png"), images.join("h1_up/000000.png")).expect("writable");
    let with = |name: &str, options: &[&str]| reconstruct(&place, &images, &place.path(name), options);
    refused(&with("all", &[]), 2, &["the session has h1_up, which the calibration has not", "--partial"]);
    assert!(!place.path("all").exists());
    let asked = ["--partial"];
    let partial = with("part", &asked);
    refused(&partial, 0, &["2 clouds", "partial, as requested: without h1_up"]);
    assert_eq!(json(&place.path("part/summary.json"))["left_out"], Value::from(["h1_up"]));
    let named = with("named", &["--cameras", "h0_up"]);
    refused(&named, 0, &["1 clouds", "without h0_low, h1_up"]);
    // The other way round: a camera of the calibration has no images at all.
    std::fs::remove_dir_all(images.join("h1_up")).expect("ours");
    std::fs::rename(images.join("h0_low"), place.path("elsewhere")).expect("moved");
    refused(&with("less", &[]), 2, &["the calibration has h0_low, which the session has not"]);
    refused(&with("less", &asked), 0, &["1 clouds", "without h0_low"]);
}

#[test]
fn import_and_reconstruct_agree_about_what_is_a_frame() {
    let place = Place::new();
    let images = place.path("images");
    for stray in ["truth/h0_up_000000.npz", "h0_up/Thumbs.db", "poses.json"] {
        std::fs::create_dir_all(images.join(stray).parent().expect("a folder")).expect("writable");
        std::fs::write(images.join(stray), "no frame").expect("writable");
    }
    let imported = |name: &str| place.import(&images, name);
    let made = |name: &str| reconstruct(&place, &images, &place.path(name), &[]);
    let left_out = ["left out", "truth", "Thumbs.db", "poses.json"];
    refused(&imported("walk"), 0, &left_out);
    refused(&made("clouds"), 0, &left_out);
    // Two files of one index, and a picture that may be a frame.
    std::fs::copy(images.join("h0_up/000000.png"), images.join("h0_up/0.png")).expect("writable");
    std::fs::copy(images.join("h0_up/000000.png"), images.join("h0_up/front.png")).expect("writable");
    let doubt = ["both are trigger 0", "0.png", "000000.png", "front.png"];
    refused(&imported("again"), 2, &doubt);
    refused(&made("again-clouds"), 2, &doubt);
    assert!(!place.path("sessions/again").exists() && !place.path("again-clouds").exists());
}
