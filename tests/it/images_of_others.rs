// SPDX-License-Identifier: MIT OR Apache-2.0
//! `import` of photographs that other programs wrote (OpenCV, Pillow, tifffile), by other names, and of what is none.

use crate::lab::{assert_contains, fourdbody, text_of};
use crate::third_party_mcap::python;
use fourdbody::base::ids::{CameraId, TriggerIndex};
use fourdbody::data::{Frame, FrameSource};
use fourdbody::record::SessionReader;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A directory with the photographs of `third_party_images.py`, or of nothing without these programs, and rigs.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/rig.toml");
        let text = std::fs::read_to_string(shipped).expect("config/rig.toml is in the repository");
        let small = text.replace("width = 1920\nheight = 1200", "width = 48\nheight = 32");
        std::fs::write(dir.path().join("rig.toml"), &small).expect("writable");
        let first_head: Vec<&str> = small.splitn(3, "[[head]]").take(2).collect();
        let pair = first_head.join("[[head]]").replace("h0_up", "left").replace("h0_low", "right");
        std::fs::write(dir.path().join("pair.toml"), pair).expect("writable");
        Self(dir)
    }

    fn with_photographs() -> Option<Self> {
        let place = Self::new();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/third_party_images.py");
        let made = Command::new(python()?).arg(script).arg(place.0.path()).output().expect("Python runs");
        let problem = String::from_utf8_lossy(&made.stderr);
        if problem.contains("ModuleNotFoundError") {
            println!("skipped: {problem} (`make test` installs it into tests/.venv)");
            return None;
        }
        assert!(made.status.success(), "{problem}");
        Some(place)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Exit code and text of an import; `more` are further arguments.
    fn import(&self, rig: &str, images: &str, more: &[&str]) -> (Option<i32>, String) {
        let [rig, images, out] =
            [rig, images, "session"].map(|name| self.path(name).to_str().expect("UTF-8").to_owned());
        let _ = std::fs::remove_dir_all(&out);
        let args = [&["import", "--rig", &rig, "--images", &images, "--out", &out], more].concat();
        let output = fourdbody(&args);
        (output.status.code(), text_of(&output))
    }

    fn pixels(&self, camera: &str, trigger: u64) -> Vec<u8> {
        let reader = SessionReader::open(&self.path("session")).expect("a session");
        match reader.frame(&CameraId::from(camera), TriggerIndex(trigger)).expect("an outcome") {
            Frame::Owned(found) => found.as_slice().to_vec(),
            _ => panic!("{camera} {trigger}: expected a frame"),
        }
    }
}

fn image(value: impl Fn(usize, usize) -> usize) -> Vec<u8> {
    (0..48 * 32).map(|i| value(i % 48, i / 48) as u8).collect()
}

fn eight(u: usize, v: usize) -> usize {
    (3 * u + 7 * v) % 256
}

#[test]
fn photographs_of_other_programs_are_frames_pixel_for_pixel() {
    let Some(place) = Place::with_photographs() else { return };
    let as_they_are = image(eight);
    for (kind, count) in [("grey", 5), ("grey_as_rgb", 4)] {
        let (code, text) = place.import("rig.toml", kind, &[]);
        assert_eq!(code, Some(3), "other cameras have no images: {text}");
        for trigger in 0..count {
            assert_eq!(place.pixels("h0_up", trigger), as_they_are, "{kind} {trigger}");
        }
    }
    let scaled = image(|u, v| (2 * 255 * ((37 * u + 11 * v) % 4096) + 4095) / (2 * 4095));
    let (code, text) = place.import("rig.toml", "twelve", &["--scale", "4095"]);
    assert_eq!(code, Some(3), "{text}");
    (0..3).for_each(|trigger| assert_eq!(place.pixels("h0_up", trigger), scaled, "twelve bits, {trigger}"));
    let (code, text) = place.import("rig.toml", "narrow", &["--scale", "15"]);
    assert_eq!(code, Some(3), "{text}");
    assert_eq!(place.pixels("h0_up", 0), image(|u, v| eight(u, v) / 16 * 17));
    for (channel, value) in [("red", eight as fn(usize, usize) -> usize), ("green", |u, v| 255 - eight(u, v))]
    {
        let (code, text) = place.import("rig.toml", "colour", &["--channel", channel]);
        assert_eq!(code, Some(3), "{text}");
        (0..3).for_each(|trigger| assert_eq!(place.pixels("h0_up", trigger), image(value), "{channel}"));
    }
    let (code, text) = place.import("rig.toml", "jpeg", &[]);
    assert_eq!(code, Some(3), "{text}");
    assert_contains(&text, &["1 images are JPEG, whose compression changes phases"]);
    let off = place.pixels("h0_up", 0).iter().zip(&as_they_are).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(off.is_some_and(|off| off <= 3), "{off:?}");
}

#[test]
fn what_is_not_grey_of_eight_bits_is_refused_by_its_kind() {
    let Some(place) = Place::with_photographs() else { return };
    for (kind, words) in [
        ("twelve", ["found 16 bits, the largest value 2080", "--scale 4095"]),
        ("narrow", ["found 4 bits, the largest value 15", "--scale"]),
        ("colour", ["found colour: its channels differ by up to 255", "--channel red, green or blue"]),
    ] {
        let (code, text) = place.import("rig.toml", kind, &[]);
        assert_eq!(code, Some(2), "{kind}: {text}");
        assert_contains(&text, &words);
        assert!(!place.path("session").exists(), "{kind}");
    }
}

#[test]
fn names_and_numbers_of_other_recorders_are_told_by_a_pattern() {
    let Some(place) = Place::with_photographs() else { return };
    let (code, text) = place.import("pair.toml", "names", &[]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["of the cameras left, right, found none", "--pattern '{camera}_{index}'"]);
    let (code, text) = place.import("pair.toml", "names", &["--pattern", "{camera}_{index}"]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["found 6 others", "left01.png", "give another --pattern"]);
    let pattern = ["--pattern", "{camera}{index}"];
    let (code, text) = place.import("pair.toml", "names", &pattern);
    assert_eq!(code, Some(3), "what a camera lacks is a gap: {text}");
    assert_eq!(place.pixels("right", 103), image(|u, v| eight(u, v) + 103));
    let renumber = [&pattern[..], &["--renumber"]].concat();
    let (code, text) = place.import("pair.toml", "names", &renumber);
    assert_eq!(code, Some(0), "{text}");
    assert_contains(&text, &["that image k of each shows the same instant is assumed"]);
    assert_eq!(place.pixels("left", 2), image(|u, v| eight(u, v) + 11));
    assert_eq!(place.pixels("right", 1), image(|u, v| eight(u, v) + 103));
    std::fs::remove_file(place.path("names/left03.png")).expect("there");
    let (code, text) = place.import("pair.toml", "names", &renumber);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["as many images of every camera, found left 2, right 3"]);
}

/// First bytes of files that people give in place of photographs.
#[test]
fn what_is_no_photograph_is_named() {
    let place = Place::new();
    let image = place.path("images/h0_up/0.png");
    std::fs::create_dir_all(image.parent().expect("a folder")).expect("made");
    for (bytes, words) in [
        (&b"PK\x03\x04rest"[..], "a zip archive; unpack it"),
        (b"\0\0\0\x18ftypheic\0\0", "a HEIC photograph"),
        (b"\0\0\0\x18ftypisom\0\0", "ffmpeg -i VIDEO"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"\x10\x11\x12\x13\x14\x15", "begins with [10, 11, 12, 13]"),
        (b"", "found 0 bytes"),
        (b"\x89PNG\r\n\x1a\nrest", "not a readable PNG"),
        (b"II*\0\x08\0\0\0", "not a readable TIFF"),
        (b"\xff\xd8\xff\xe0", "not a readable JPEG"),
        (b"BM", "not a readable BMP"),
    ] {
        std::fs::write(&image, bytes).expect("written");
        let (code, text) = place.import("rig.toml", "images", &[]);
        assert_eq!(code, Some(2), "{words}: {text}");
        assert_contains(&text, &["0.png", words]);
    }
    std::fs::write(place.path("shots.zip"), b"PK\x03\x04rest").expect("written");
    let (code, text) = place.import("rig.toml", "shots.zip", &[]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["expected a directory of images, found a zip archive"]);
    std::fs::write(&image, b"x").expect("written");
    std::fs::rename(&image, place.path("images/h0_up/1700000000000.png")).expect("renamed");
    let (code, text) = place.import("rig.toml", "images", &["--pattern", "{camera}/{index}"]);
    assert_eq!(code, Some(2), "{text}");
    assert_contains(&text, &["found 1700000000000; --renumber counts from 0"]);
    for pattern in ["{camera}", "{index}{index}", "{camera}_{number}_{index}"] {
        let (code, text) = place.import("rig.toml", "images", &["--pattern", pattern]);
        assert_eq!(code, Some(2), "{text}");
        assert_contains(&text, &["expected {index} once"]);
    }
}
