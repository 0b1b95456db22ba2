// SPDX-License-Identifier: MIT OR Apache-2.0
//! `verify`, `info` and `import` as scripts see them: exit codes, standard output, nothing half-written.

use crate::lab::{assert_contains, fourdbody};
use crate::recording::{header, record};
use fourdbody::base::ids::{CameraId, NodeId, TriggerIndex};
use fourdbody::base::image::{Plane, write_png_grey};
use fourdbody::config::Rig;
use fourdbody::data::{Frame, FrameSource};
use fourdbody::record::{SessionReader, node_dir};
use std::path::Path;
use std::process::Output;

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

fn code(output: &Output) -> i32 {
    output.status.code().expect("an exit code")
}

#[test]
fn verify_exits_by_what_it_finds() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let [good, gaps, bad] = ["good", "gaps", "bad"].map(|name| dir.path().join(name));
    let cameras = ["h0_up", "h0_low"];
    for (session, missing) in [(&good, &[][..]), (&gaps, &[(1, 3)]), (&bad, &[])] {
        record(&node_dir(session, &NodeId::from("a")), header("a", &cameras, Some(20)), 20, missing);
    }
    let segment = bad.join("node-a/segment-000.mcap");
    let mut bytes = std::fs::read(&segment).expect("readable");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&segment, bytes).expect("writable");

    assert_eq!(code(&fourdbody(&["verify", text(&good)])), 0);
    let output = fourdbody(&["verify", text(&good), text(&gaps)]);
    assert_eq!(code(&output), 3);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(printed.contains("loss: node a camera h0_low trigger 3: gap: missing_packets"), "{printed}");
    let output = fourdbody(&["verify", "--json", text(&gaps), text(&bad)]);
    assert_eq!(code(&output), 4);
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((&json["exit"], &json["reports"][1]["worst"]), (&4.into(), &"corrupt".into()));
    assert_eq!(code(&fourdbody(&["verify", text(&dir.path().join("nothing"))])), 2);
    assert_eq!(code(&fourdbody(&["verify", text(dir.path())])), 4, "a directory without recordings");
}

#[test]
fn info_describes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("node-a");
    record(&path, header("a", &["h0_up"], Some(20)), 20, &[(0, 4)]);
    let output = fourdbody(&["info", text(&path)]);
    assert_eq!(code(&output), 0);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert_contains(
        &printed,
        &[
            "walk-01",
            "20 at 120 Hz (0.16 s)",
            "h0_up   40 x 30  19      1     0       -        test",
            "gap         h0_up: 1 missing_packets, the first at trigger 4",
            "segment-000.mcap",
            "table       20 rows",
            "incomplete: 20 triggers",
        ],
    );
    let output = fourdbody(&["info", "--json", text(&path)]);
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(json["recordings"][0]["header"]["cameras"][0]["id"], "h0_up");
    assert_eq!(json["end_trigger"], 20);
    let recording = &json["recordings"][0];
    assert_eq!(recording["cameras"][0]["gaps"]["missing_packets"], 1, "{recording:#}");
    assert_eq!(
        (&recording["cameras"][0]["frames"], &recording["trigger_table_rows"]),
        (&19.into(), &20.into())
    );
    assert_eq!(
        (&recording["segment_files"][0]["closed"], &recording["clock_samples"]),
        (&true.into(), &8.into())
    );
    assert!(recording["write_statistics"]["written"]["max_us"].is_u64(), "{recording:#}");
}

/// The shipped rig with small cameras, so that images are cheap.
fn small_rig(dir: &Path) -> std::path::PathBuf {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
    let text = std::fs::read_to_string(shipped).expect("config/rig.toml is in the repository");
    let path = dir.join("rig.toml");
    std::fs::write(&path, text.replace("width = 1920\nheight = 1200", "width = 48\nheight = 32"))
        .expect("writable");
    path
}

fn image(camera: usize, trigger: usize) -> Plane<u8> {
    let pixels = (0..48 * 32).map(|i| (i * 3 + trigger * 7 + camera * 31) as u8).collect();
    Plane::from_vec(48, 32, pixels).expect("the right size")
}

fn write_images(dir: &Path, rig: &Rig, triggers: usize) {
    for (number, (_, camera)) in rig.cameras().enumerate() {
        let dir = dir.join(camera.id.as_str());
        std::fs::create_dir_all(&dir).expect("a directory");
        for trigger in 0..triggers {
            let path = dir.join(format!("{trigger:06}.png"));
            write_png_grey(&path, (&image(number, trigger)).into()).expect("written");
        }
    }
}

#[test]
fn imported_images_are_a_session() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (rig_path, images, out) =
        (small_rig(dir.path()), dir.path().join("images"), dir.path().join("sessions/walk-02"));
    let rig = Rig::load(&rig_path).expect("a rig");
    write_images(&images, &rig, 5);
    std::fs::remove_file(images.join("h2_up/000003.png")).expect("there");
    let args = ["import", "--rig", text(&rig_path), "--images", text(&images), "--out", text(&out)];
    let output = fourdbody(&args);
    assert_eq!(code(&output), 3, "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(code(&fourdbody(&["verify", text(&out)])), 3);
    let reader = SessionReader::open(&out).expect("a session");
    assert_eq!((reader.recordings().len(), reader.triggers()), (2, 0..5));
    for (number, camera) in reader.cameras().to_vec().iter().enumerate() {
        for trigger in 0..5 {
            match reader.frame(camera, TriggerIndex(trigger as u64)).expect("an outcome") {
                Frame::Owned(found) => assert_eq!(found.as_slice(), image(number, trigger).as_slice()),
                Frame::Image(_) => panic!("a recording is read into memory of its own"),
                Frame::Gap(cause) => {
                    assert_eq!(
                        (camera, trigger, cause.as_str()),
                        (&CameraId::from("h2_up"), 3, "not_recorded")
                    );
                }
            }
        }
    }
    let again = fourdbody(&args);
    assert_eq!(code(&again), 2, "never overwritten");
    let left: Vec<_> = out.parent().expect("a parent").read_dir().expect("readable").collect();
    assert_eq!(left.len(), 1, "nothing half-written remains: {left:?}");
}

#[test]
fn all_wrong_images_are_named_at_once_and_nothing_is_written() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (rig_path, images, out) =
        (small_rig(dir.path()), dir.path().join("images"), dir.path().join("sessions/walk-03"));
    let rig = Rig::load(&rig_path).expect("a rig");
    write_images(&images, &rig, 2);
    let args = ["import", "--rig", text(&rig_path), "--images", text(&images), "--out", text(&out)];

    let wrong_size = Plane::filled(47, 32, 1u8);
    write_png_grey(&images.join("h0_up/1.png"), (&wrong_size).into()).expect("written");
    std::fs::create_dir(images.join("h9_up")).expect("a directory");
    std::fs::write(images.join("h1_up/notes.txt"), "hello").expect("written");
    let output = fourdbody(&args);
    assert_eq!(code(&output), 2);
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_contains(&printed, &["both are trigger 1"]);

    std::fs::remove_dir(images.join("h9_up")).expect("there");
    std::fs::remove_file(images.join("h1_up/notes.txt")).expect("there");
    std::fs::remove_file(images.join("h0_up/000001.png")).expect("there");
    std::fs::write(images.join("h2_low/000000.png"), b"not a picture").expect("written");
    let colour = images.join("h3_up/000001.png");
    fourdbody::base::image::write_png_rgb(&colour, 48, 32, &[7, 7, 9].repeat(48 * 32)).expect("written");
    let output = fourdbody(&args);
    assert_eq!(code(&output), 2);
    let printed = String::from_utf8_lossy(&output.stderr);
    assert_contains(
        &printed,
        &[
            "h0_up/1.png: expected 48 x 32 pixels (camera h0_up of the rig), found 47 x 32",
            "h2_low/000000.png: expected a photograph as PNG, TIFF, BMP, PGM or JPEG, found a file that begins",
            "h3_up/000001.png: expected grey, found colour: its channels differ by up to 2 of 255",
            "3 problems",
        ],
    );
    assert!(!out.parent().expect("a parent").exists(), "nothing was written");
}
