// SPDX-License-Identifier: MIT OR Apache-2.0
//! The same bytes from any number of threads, any shard and any width of vectors.
//!
//! Two photographs of a mannequin by each camera of two heads at half size, one of them over-exposed, reconstructed by child
//! processes: the width is chosen once per process.

use fourdbody::base::image::{Mono8, read_png_grey, write_png_grey};
use fourdbody::config::Rig;
use fourdbody_simulator::cache::{CachedImages, Manifest};
use fourdbody_simulator::scenario::Scenario;
use fourdbody_simulator::sequence::{Changes, Run};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Everything that a run leaves beside its summary, by name.
type Files = BTreeMap<String, Vec<u8>>;

/// Renders the light of the first so many heads; returns the images' directory.
pub fn render(dir: &Path, heads: usize) -> PathBuf {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/scenarios/poses/arms_crossed.toml");
    let mut scenario = Scenario::load(&path).expect("a valid scenario");
    scenario.optics.exposure_samples = 1;
    let mut rig = Rig::load(&scenario.rig).expect("a valid rig");
    rig.heads.truncate(heads);
    let changes = Changes { size_divisor: 2, instants: Some(2), ..Changes::default() };
    Run::new(scenario, &rig, &changes).expect("fits").render(dir, |_, _| {}).expect("rendered");
    let (manifest, images) = (Manifest::load(dir).expect("complete"), dir.join("images"));
    for camera in &manifest.cameras {
        let (cached, folder) = (
            CachedImages::open(dir, &manifest, &camera.id).expect("complete"),
            images.join(camera.id.as_str()),
        );
        std::fs::create_dir_all(&folder).expect("writable");
        for instant in 0..2 {
            let image = cached.image(instant).expect("an image");
            write_png_grey(&folder.join(format!("{instant:06}.png")), image).expect("writable");
        }
    }
    images
}

/// The command that reconstructs into `dir/name`.
fn command(dir: &Path, name: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fourdbody"));
    command.args(["reconstruct".as_ref(), dir.join("images").as_os_str(), "--calibration".as_ref()]);
    command.args([dir.join("calibration.json").as_os_str(), "--out".as_ref(), dir.join(name).as_os_str()]);
    command.env_remove("FOURDBODY_SIMD");
    command
}

/// Reconstructs into `dir/name`, once for each list of options.
fn reconstruct(dir: &Path, name: &str, simd: Option<&str>, options: &[&[&str]]) -> Files {
    let out = dir.join(name);
    for options in options {
        let mut command = command(dir, name);
        command.args(*options);
        if !options.contains(&"--format") {
            command.args(["--format", "ply"]);
        }
        if let Some(simd) = simd {
            command.env("FOURDBODY_SIMD", simd);
        }
        let made = command.output().expect("starts");
        assert!(made.status.success(), "{name}: {}", String::from_utf8_lossy(&made.stderr));
    }
    let mut files = Files::new();
    for folder in ["clouds", "merged", "phases"].into_iter().filter(|folder| out.join(folder).exists()) {
        for entry in std::fs::read_dir(out.join(folder)).expect("a directory") {
            let path = entry.expect("an entry").path();
            let name = format!("{folder}/{}", path.file_name().expect("a name").to_string_lossy());
            files.insert(name, std::fs::read(path).expect("readable"));
        }
    }
    files
}

#[test]
fn threads_shards_and_vectors_give_the_same_bytes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    over_expose(&render(dir.path(), 2), 1);
    let run = |name: &str, simd, options: &[&[&str]]| reconstruct(dir.path(), name, simd, options);
    let one = run("one", None, &[&["--jobs", "1"]]);
    assert_eq!(one.len(), 10, "{:?}", one.keys());
    assert!(one.values().map(Vec::len).sum::<usize>() > 1_000_000, "there is something to compare");
    let shards: [&[&str]; 2] = [&["--shard", "0/2", "--jobs", "1"], &["--shard", "1/2", "--jobs", "2"]];
    // The paper makes nothing of the other.
    let paper: [&[&str]; 1] = [&["--jobs", "1", "--method", "paper", "--triggers", "0..1"]];
    let two = |simd| run(simd, Some(simd), &[&["--jobs", "2"]]);
    for (name, files) in [
        ("two threads", run("two", None, &[&["--jobs", "2"]])),
        ("two shards", run("shards", None, &shards)),
        ("portable", two("portable")),
        ("avx2", two("avx2")),
        ("avx512", two("avx512")),
    ] {
        assert_same(name, &one, &files);
    }
    let phases: [&[&str]; 1] = [&["--jobs", "2", "--format", "phase", "--uncertainty"]];
    let maps = run("phases", None, &phases);
    assert_eq!(maps.len(), 8, "{:?}", maps.keys());
    assert_same("phase maps, portable", &maps, &run("phases-portable", Some("portable"), &phases));
    let plain = run("paper", None, &paper);
    assert_same("paper, portable", &plain, &run("paper-portable", Some("portable"), &paper));
}

/// Gives the photographs of an instant twice their light.
fn over_expose(images: &Path, instant: u64) {
    for folder in std::fs::read_dir(images).expect("a directory") {
        let path = folder.expect("an entry").path().join(format!("{instant:06}.png"));
        let mut image = read_png_grey(&path).expect("an image");
        image.as_mut_slice().iter_mut().for_each(|x| *x = x.saturating_mul(2));
        assert!(image.as_slice().iter().filter(|x| **x == 255).count() > 1000, "{}", path.display());
        write_png_grey(&path, Mono8::from(&image)).expect("writable");
    }
}

fn assert_same(name: &str, expected: &Files, found: &Files) {
    assert!(expected.keys().eq(found.keys()), "{name}: {:?}", found.keys());
    for (file, bytes) in expected {
        assert!(found[file] == *bytes, "{name}: {file} differs");
    }
}
