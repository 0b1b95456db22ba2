// SPDX-License-Identifier: MIT OR Apache-2.0
//! Directories of images, `DIR/CAMERA/INDEX.png`, as `import`, `reconstruct` and `calibrate` read them: one reader,
//! so that they agree about what is a frame.
//!
//! A folder is a camera's when the caller knows a camera of this name, or when an `INDEX.png` is in it. A file that
//! is no frame and cannot have been meant as one is left out, and named. A picture in a camera's folder that has no
//! index, and two files of one index, are refused: they may be frames. [`super::image_names`] has other names.

use crate::base::ids::CameraId;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Indexes are below this: that of recordings (`record::MAX_TRIGGERS`).
pub const INDEX_END: u64 = 1 << 24;

/// The most names of left-out files in a message.
const NAMED: usize = 8;

/// The images of one camera by trigger index.
pub type Images = BTreeMap<u64, PathBuf>;

/// The images of a directory, by camera and trigger index.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct ImageTree {
    /// The cameras that have a folder. Those that the caller knows may have no images.
    pub cameras: BTreeMap<CameraId, Images>,
    /// Folders and files that are no frames.
    pub left_out: Vec<PathBuf>,
    /// What rests on an assumption, for people.
    pub remark: Option<String>,
}

impl ImageTree {
    /// Lists the images, whose names have one of these endings; `known`: cameras that the caller knows. The error:
    /// everything that must not be left out silently.
    pub fn list(directory: &Path, known: &[CameraId], endings: &[&str]) -> Result<Self, Vec<String>> {
        let mut problems = Vec::new();
        let mut tree = Self::default();
        for path in entries(directory, &mut problems) {
            let name = path.file_name().and_then(|name| name.to_str()).map(CameraId::from);
            let camera = name.filter(|_| path.is_dir());
            let Some(camera) = camera else {
                tree.left_out.push(path);
                continue;
            };
            let mut folder = Self::default();
            let mut own = Vec::new();
            let images = folder.images(&path, endings, &mut own);
            if images.is_empty() && !known.contains(&camera) {
                tree.left_out.push(path);
                continue;
            }
            problems.append(&mut own);
            tree.left_out.append(&mut folder.left_out);
            tree.cameras.insert(camera, images);
        }
        if problems.is_empty() { Ok(tree) } else { Err(problems) }
    }

    /// The images of a camera's folder.
    fn images(&mut self, folder: &Path, endings: &[&str], problems: &mut Vec<String>) -> Images {
        let mut images = Images::new();
        for path in entries(folder, problems) {
            match index(&path, endings) {
                Named::Other => self.left_out.push(path),
                Named::Unindexed => problems.push(format!(
                    "{}: expected INDEX.{} with a trigger index from 0 to {}; rename it, or move it away",
                    path.display(),
                    endings[0],
                    INDEX_END - 1
                )),
                Named::Index(index) => {
                    if let Some(other) = images.insert(index, path.clone()) {
                        problems.push(twice(index, &other, &path));
                    }
                }
            }
        }
        images
    }

    /// A line that names what is left out; `None` where that is nothing.
    pub fn remark(left_out: &[PathBuf]) -> Option<String> {
        (!left_out.is_empty()).then(|| format!("left out, no frames: {}", named(left_out)))
    }
}

/// The first files of a list, and how many more there are.
pub(super) fn named(paths: &[PathBuf]) -> String {
    let names: Vec<String> = paths.iter().take(NAMED).map(|path| path.display().to_string()).collect();
    let more = paths.len().saturating_sub(NAMED);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    format!("{}{more}", names.join(", "))
}

/// That two files have one index.
pub(super) fn twice(index: u64, a: &Path, b: &Path) -> String {
    format!("{} and {}: both are trigger {index}; move one of them away", a.display(), b.display())
}

/// Whether a file's name has one of these endings; what other systems leave beside a file begins with a dot.
pub(super) fn is_picture(path: &Path, endings: &[&str]) -> bool {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
    let hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
    !hidden && endings.iter().any(|known| known.eq_ignore_ascii_case(ending)) && !path.is_dir()
}

/// What a file is by its name.
enum Named {
    /// The frame of a trigger.
    Index(u64),
    /// A picture of no trigger.
    Unindexed,
    Other,
}

fn index(path: &Path, endings: &[&str]) -> Named {
    if !is_picture(path, endings) {
        return Named::Other;
    }
    let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
    let digits = Some(stem).filter(|stem| stem.bytes().all(|byte| byte.is_ascii_digit()));
    match digits.and_then(|digits| digits.parse().ok()).filter(|index| *index < INDEX_END) {
        Some(index) => Named::Index(index),
        None => Named::Unindexed,
    }
}

/// What is in a directory, by name.
pub(super) fn entries(directory: &Path, problems: &mut Vec<String>) -> Vec<PathBuf> {
    let read = std::fs::read_dir(directory).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Ok(entries) => {
            let mut paths: Vec<PathBuf> = entries.iter().map(std::fs::DirEntry::path).collect();
            paths.sort();
            paths
        }
        Err(error) => {
            problems.push(format!("{}: {error}", directory.display()));
            Vec::new()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::ImageTree;
    use crate::base::ids::CameraId;
    use std::path::Path;

    fn tree(files: &[&str], known: &[&str]) -> (tempfile::TempDir, Result<ImageTree, Vec<String>>) {
        let dir = tempfile::tempdir().expect("a temporary directory");
        for file in files {
            let path = dir.path().join(file);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("writable");
            std::fs::write(path, "").expect("writable");
        }
        let known: Vec<CameraId> = known.iter().map(|id| CameraId::from(*id)).collect();
        let listed = ImageTree::list(dir.path(), &known, &["png"]);
        (dir, listed)
    }

    #[test]
    fn frames_are_kept_apart_from_what_lies_beside_them() {
        let files = [
            "h0_up/000000.png",
            "h0_up/1.PNG",
            "h0_up/Thumbs.db",
            "h0_up/._000000.png",
            "h0_low/notes.txt",
            "other/7.png",
            "truth/h0_up_000000.npz",
            "previews/front.png",
            "poses.json",
        ];
        let (dir, tree) = tree(&files, &["h0_up", "h0_low"]);
        let tree = tree.expect("no doubt");
        let indexes =
            |camera: &str| tree.cameras[&CameraId::from(camera)].keys().copied().collect::<Vec<_>>();
        assert_eq!((indexes("h0_up"), indexes("h0_low"), indexes("other")), (vec![0, 1], vec![], vec![7]));
        assert_eq!(tree.cameras.len(), 3);
        let left_out: Vec<&Path> =
            tree.left_out.iter().map(|path| path.strip_prefix(dir.path()).expect("inside")).collect();
        let expected =
            ["h0_low/notes.txt", "h0_up/._000000.png", "h0_up/Thumbs.db", "poses.json", "previews", "truth"];
        assert_eq!(left_out, expected.map(Path::new));
        let remark = ImageTree::remark(&tree.left_out).expect("something");
        assert!(remark.contains("Thumbs.db") && remark.contains("truth"), "{remark}");
    }

    #[test]
    fn what_may_be_a_frame_is_refused_by_name_all_at_once() {
        let files =
            ["h0_up/0.png", "h0_up/000000.png", "h0_up/front.png", "h0_up/99999999.png", "h0_low/-1.png"];
        let problems = tree(&files, &["h0_up", "h0_low"]).1.expect_err("doubt");
        for words in
            [["0.png and ", "both are trigger 0"], ["front.png", "INDEX.png"], ["99999999.png", "16777215"]]
        {
            let has_all = |problem: &String| words.iter().all(|word| problem.contains(word));
            assert!(problems.iter().any(has_all), "{words:?} missing in {problems:#?}");
        }
        assert_eq!(problems.len(), 4, "{problems:#?}");
    }
}
