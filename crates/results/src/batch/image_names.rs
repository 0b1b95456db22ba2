// SPDX-License-Identifier: MIT OR Apache-2.0
//! Directories of images whose names have another pattern than `CAMERA/INDEX.png`, and another numbering.

use super::image_tree::{INDEX_END, ImageTree, Images, entries, is_picture, named, twice};
use crate::base::ids::CameraId;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How images are named below their directory, without the ending: `{camera}` and `{index}` stand for a camera's name
/// and digits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamePattern(String);

impl std::str::FromStr for NamePattern {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let once = |part: &str| text.matches(part).count() == 1;
        let rest = text.replace("{camera}", "").replace("{index}", "");
        if !once("{index}") || text.matches("{camera}").count() > 1 || rest.contains(['{', '}']) {
            return Err("expected {index} once, and {camera} at most once, as in {camera}_{index}".to_owned());
        }
        Ok(Self(text.to_owned()))
    }
}

impl NamePattern {
    /// The digits in the name of a camera's image; `None`: it is not one of this camera.
    fn index<'a>(&self, name: &'a str, camera: &CameraId) -> Option<&'a str> {
        let own = self.0.replace("{camera}", camera.as_str());
        let (before, behind) = own.split_once("{index}")?;
        let digits = name.strip_prefix(before)?.strip_suffix(behind)?;
        (!digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit())).then_some(digits)
    }

    /// Lists the images of these cameras. With `renumber` each camera's are numbered from 0 in the order of their
    /// numbers. The error: everything that must not be left out silently.
    pub fn list(
        &self,
        directory: &Path,
        cameras: &[CameraId],
        endings: &[&str],
        renumber: bool,
    ) -> Result<ImageTree, Vec<String>> {
        if !self.0.contains("{camera}") && cameras.len() > 1 {
            return Err(vec![format!("the pattern {} has no {{camera}}, but the rig has several", self.0)]);
        }
        let mut problems = Vec::new();
        let mut tree = ImageTree::default();
        let (mut pictures, mut misfits) = (Vec::new(), Vec::new());
        self.collect(
            directory,
            endings,
            self.0.matches('/').count(),
            &mut pictures,
            &mut tree,
            &mut problems,
        );
        for path in pictures {
            let below = path.strip_prefix(directory).unwrap_or(&path).with_extension("");
            let name = below.to_str().unwrap_or_default();
            let fit = cameras.iter().find_map(|camera| Some((camera, self.index(name, camera)?)));
            let Some((camera, digits)) = fit else {
                misfits.push(path);
                continue;
            };
            match digits.parse::<u64>().ok().filter(|index| renumber || *index < INDEX_END) {
                Some(index) => {
                    let images = tree.cameras.entry(camera.clone()).or_default();
                    if let Some(other) = images.insert(index, path.clone()) {
                        problems.push(twice(index, &other, &path));
                    }
                }
                None => problems.push(format!(
                    "{}: expected a trigger index from 0 to {}, found {digits}; --renumber counts from 0",
                    path.display(),
                    INDEX_END - 1
                )),
            }
        }
        if !misfits.is_empty() {
            let known: Vec<&str> = cameras.iter().map(CameraId::as_str).collect();
            problems.push(format!(
                "expected names as {} of the rig's cameras {}, found {} others: {}; give another --pattern, or move \
                 them away",
                self.0,
                known.join(", "),
                misfits.len(),
                named(&misfits)
            ));
        }
        if renumber && problems.is_empty() {
            match renumbered(&mut tree.cameras, cameras) {
                Ok(remark) => tree.remark = remark,
                Err(problem) => problems.push(problem),
            }
        }
        if problems.is_empty() { Ok(tree) } else { Err(problems) }
    }

    /// The pictures so many folders below a directory; what lies elsewhere, or is no picture, is left out.
    fn collect(
        &self,
        directory: &Path,
        endings: &[&str],
        depth: usize,
        pictures: &mut Vec<PathBuf>,
        tree: &mut ImageTree,
        problems: &mut Vec<String>,
    ) {
        for path in entries(directory, problems) {
            match depth {
                0 if is_picture(&path, endings) => pictures.push(path),
                1.. if path.is_dir() => {
                    self.collect(&path, endings, depth - 1, pictures, tree, problems);
                }
                _ => tree.left_out.push(path),
            }
        }
    }
}

/// Numbers each camera's images from 0, in the order of their numbers; a remark where these differ between cameras.
fn renumbered(all: &mut BTreeMap<CameraId, Images>, cameras: &[CameraId]) -> Result<Option<String>, String> {
    let counts: Vec<usize> = cameras.iter().map(|camera| all.get(camera).map_or(0, Images::len)).collect();
    if counts.iter().any(|count| *count != counts[0]) {
        let each: Vec<String> =
            cameras.iter().zip(counts).map(|(id, count)| format!("{id} {count}")).collect();
        return Err(format!(
            "--renumber: expected as many images of every camera, found {}; without it images keep their numbers, and \
             one that a camera lacks is a gap",
            each.join(", ")
        ));
    }
    let numbers: std::collections::BTreeSet<Vec<u64>> =
        all.values().map(|images| images.keys().copied().collect()).collect();
    for images in all.values_mut() {
        *images = std::mem::take(images).into_values().zip(0..).map(|(path, index)| (index, path)).collect();
    }
    let remark =
        "the cameras' images have different numbers; that image k of each shows the same instant is assumed";
    Ok((numbers.len() > 1).then(|| remark.to_owned()))
}
