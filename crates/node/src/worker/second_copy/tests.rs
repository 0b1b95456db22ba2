// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is a second copy and what is not, on small files.

use super::{PROBE, SecondCopy};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

const NAMES: [&str; 2] = ["segment-000.mcap", "segment-001.mcap"];

/// A directory with a recording of two files.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        std::fs::create_dir(place.recording()).expect("made");
        NAMES.iter().for_each(|name| std::fs::write(place.recording().join(name), name).expect("written"));
        place
    }

    fn recording(&self) -> PathBuf {
        self.0.path().join("recording")
    }

    fn copy(&self) -> PathBuf {
        self.0.path().join("copy")
    }

    /// A place whose copy has the recording's bytes.
    fn copied() -> Self {
        let place = Self::new();
        std::fs::create_dir(place.copy()).expect("made");
        for name in NAMES {
            std::fs::copy(place.recording().join(name), place.copy().join(name)).expect("copied");
        }
        place
    }

    /// Why there is no second copy.
    fn refused(&self) -> String {
        let judged = SecondCopy::open(&self.recording(), &self.copy()).and_then(|copy| copy.compare());
        let reason = judged.expect_err("no second copy");
        assert!(self.recording().join(NAMES[1]).exists());
        let left = list(&self.recording()).into_iter().filter(|name| name.starts_with(PROBE)).count();
        assert_eq!(left, 0, "what was made to be looked for is gone");
        reason
    }

    fn delete(&self, copy: &SecondCopy) -> Result<(), String> {
        copy.delete(&self.0.path().join(".aside"))
    }
}

fn list(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).expect("a directory");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn other_files_with_the_same_bytes_are_a_second_copy_and_the_recording_may_go() {
    let place = Place::copied();
    std::fs::write(place.recording().join(format!("{PROBE}0")), "").expect("written");
    let copy = SecondCopy::open(&place.recording(), &place.copy()).expect("opened");
    copy.compare().expect("the same bytes");
    place.delete(&copy).expect("deleted");
    assert_eq!(list(place.0.path()), ["copy"]);
    assert_eq!(list(&place.copy()), NAMES);
}

#[test]
fn the_same_files_under_another_name_are_none() {
    const SAME: &str = "is no second copy";
    let place = Place::new();
    symlink(place.recording(), place.copy()).expect("linked");
    assert!(place.refused().contains(SAME), "a link to the directory");

    let place = Place::new();
    std::fs::create_dir(place.copy()).expect("made");
    NAMES
        .iter()
        .for_each(|name| symlink(place.recording().join(name), place.copy().join(name)).expect("linked"));
    assert!(place.refused().contains(SAME), "links to the files");

    let place = Place::copied();
    std::fs::remove_file(place.copy().join(NAMES[1])).expect("there");
    std::fs::hard_link(place.recording().join(NAMES[1]), place.copy().join(NAMES[1])).expect("linked");
    assert!(place.refused().contains(SAME), "one file of two with two names");

    // The recording leads to the archive, which has the bytes.
    let place = Place::copied();
    std::fs::remove_file(place.recording().join(NAMES[0])).expect("there");
    symlink(place.copy().join(NAMES[0]), place.recording().join(NAMES[0])).expect("linked");
    assert!(place.refused().contains("found a link"));
    std::fs::remove_dir_all(place.recording()).expect("there");
    symlink(place.copy(), place.recording()).expect("linked");
    assert!(place.refused().contains(SAME), "the recording is a link to the copy");
}

#[test]
fn a_directory_that_is_mounted_twice_is_none() {
    let place = Place::new();
    std::fs::create_dir(place.copy()).expect("made");
    let mounted = Command::new("mount").arg("--bind").args([place.recording(), place.copy()]).output();
    if !mounted.is_ok_and(|mounted| mounted.status.success()) {
        println!("skipped: this user may not mount");
        return;
    }
    let told = std::panic::catch_unwind(|| place.refused());
    assert!(Command::new("umount").arg(place.copy()).status().expect("umount is there").success());
    assert!(told.expect("refused").contains("is no second copy"));
}

/// As of an export that a server shows at two places: nothing in the numbers of the files shows it.
#[test]
fn a_directory_that_shows_what_is_made_in_the_recording_is_none() {
    let place = Place::copied();
    let copy = SecondCopy::open(&place.recording(), &place.copy()).expect("other files, as it seems");
    std::fs::remove_dir_all(place.copy()).expect("there");
    symlink(place.recording(), place.copy()).expect("linked");
    assert!(copy.look_for_a_probe().expect_err("it is there, too").contains("is no second copy"));
}

#[test]
fn what_lacks_a_byte_or_is_no_file_is_none() {
    let place = Place::new();
    assert!(place.refused().contains("No such file"));
    let place = Place::copied();
    std::fs::write(place.copy().join(NAMES[1]), "segment-001.mcaP").expect("written");
    assert!(place.refused().contains("differs from the recording"));
    std::fs::write(place.copy().join(NAMES[1]), "segment").expect("written");
    assert!(place.refused().contains("has 7 bytes, the recording 16"));
    std::fs::remove_file(place.copy().join(NAMES[1])).expect("there");
    symlink("/dev/zero", place.copy().join(NAMES[1])).expect("linked");
    assert!(place.refused().contains("found a device"));
    let place = Place::copied();
    std::fs::create_dir(place.recording().join("notes")).expect("made");
    assert!(place.refused().contains("found a directory named \"notes\""));
    let empty = Place(tempfile::tempdir().expect("a directory"));
    std::fs::create_dir(empty.recording()).expect("made");
    let none = SecondCopy::open(&empty.recording(), &empty.copy()).expect_err("nothing");
    assert!(none.contains("there is no file in it"), "{none}");
}

#[test]
fn what_changes_between_the_look_and_the_end_is_not_deleted() {
    type Change = fn(&Place);
    let changes: [(&str, Change); 6] = [
        ("has changed since", |place| {
            std::fs::write(place.copy().join(NAMES[0]), "segment-000.mcap").expect("ok")
        }),
        ("has changed since", |place| std::fs::remove_dir_all(place.copy()).expect("there")),
        ("has changed since", |place| {
            std::fs::remove_dir_all(place.copy()).expect("there");
            symlink(place.recording(), place.copy()).expect("linked");
        }),
        ("has changed since", |place| {
            std::fs::rename(place.copy().join(NAMES[0]), place.copy().join("away")).expect("there");
            std::fs::hard_link(place.recording().join(NAMES[0]), place.copy().join(NAMES[0]))
                .expect("linked");
        }),
        ("has changed since", |place| {
            std::fs::remove_file(place.recording().join(NAMES[1])).expect("there");
            std::fs::write(place.recording().join(NAMES[1]), "of another").expect("written");
        }),
        ("has other files than were compared", |place| {
            std::fs::write(place.recording().join("segment-002.mcap"), "more").expect("written");
        }),
    ];
    for (expected, change) in changes {
        let place = Place::copied();
        let copy = SecondCopy::open(&place.recording(), &place.copy()).expect("opened");
        copy.compare().expect("the same bytes");
        // A file system may count its times in milliseconds.
        std::thread::sleep(std::time::Duration::from_millis(20));
        change(&place);
        let before = list(&place.recording());
        let reason = place.delete(&copy).expect_err(expected);
        assert!(reason.contains(expected), "{expected}: {reason}");
        assert_eq!(list(&place.recording()), before, "all of it stands where it stood");
    }
}
