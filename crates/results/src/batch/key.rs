// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a result is made of: `OUT/reconstruct.json`, written before the first cloud. A directory takes the clouds of
//! one session, made in one way; everything else is refused with what differs, so that no result is ever of two.
//!
//! The files state themselves what else they depend on: the frames of their trigger ([`super::run`]).

use super::plan::{Format, Plan, method_name};
use crate::base::ids::CameraId;
use crate::base::{Exit, Fault, json, regular, write_new};
use crate::data::{Calibration, SessionIdentity};
use crate::reconstruct::paper;
use crate::reconstruct::pipeline::Method;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};

/// The algorithm's number: raised whenever the same frames may give other points, or a file other bytes than its
/// comments. `it::reused` holds the digest of a small scene's clouds beside it, and fails when one changes without
/// the other.
pub const ALGORITHM: u32 = 39;

/// Everything that the clouds of a directory share. A run makes the key of its plan, claims the directory with it
/// before the first cloud, and refuses a directory that has another one; the key stays there as `reconstruct.json` as
/// long as the results, and readers hold every file against it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Key {
    /// The session whose frames the result is made of.
    pub session: SessionIdentity,
    /// [`ALGORITHM`], or [`paper::ALGORITHM`] with `--method paper`.
    pub algorithm: u32,
    /// SHA-256 of the calibration, all of it.
    pub calibration_sha256: String,
    /// `joint` or `paper`, as the command line calls it.
    pub method: String,
    /// By how much a fringe order must lead any other.
    pub margin: f32,
    /// Whether points have their standard uncertainty.
    pub uncertainty: bool,
    /// Rows of the photographs that make one row of the frames.
    pub bin_rows: usize,
    /// `phase`, `ply` or both, with a comma between them.
    pub format: String,
    /// The cameras, in the calibration's order: each frame of a trigger may give the others their fringe orders.
    pub cameras: Vec<CameraId>,
}

/// Where the calibration of a result is.
pub fn calibration_path(out: &Path) -> PathBuf {
    out.join(CALIBRATION_FILE)
}

/// The calibration's name in the directory of a result.
pub const CALIBRATION_FILE: &str = "calibration.json";

/// What all files of a result follow from beside their frames.
pub const COMMON_FILES: [&str; 2] = [KEY_FILE, CALIBRATION_FILE];

/// The key's name in the directory of a result.
pub const KEY_FILE: &str = "reconstruct.json";

/// The digest of a calibration, all of it.
pub fn calibration_sha256(calibration: &Calibration) -> Result<String, String> {
    let text = serde_json::to_string(calibration).map_err(|e| e.to_string())?;
    Ok(Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect())
}

impl Key {
    /// The key of what a plan makes of a session.
    pub fn of(session: SessionIdentity, calibration: &Calibration, plan: &Plan) -> Result<Self, String> {
        let cameras = calibration.cameras().map(|(_, camera)| &camera.id);
        Ok(Self {
            session,
            algorithm: match plan.method {
                Method::Joint => ALGORITHM,
                Method::Paper => paper::ALGORITHM,
            },
            calibration_sha256: calibration_sha256(calibration)?,
            method: method_name(plan.method).to_owned(),
            margin: plan.margin,
            uncertainty: plan.uncertainty,
            bin_rows: plan.bin_rows,
            format: Format::names(&plan.formats),
            cameras: cameras.filter(|id| plan.cameras.contains(id)).cloned().collect(),
        })
    }

    /// As clouds state it: a hash over what they depend on beside the frames, whatever session these are of.
    pub fn parameters(&self) -> String {
        let Self { algorithm, calibration_sha256, method, margin, bin_rows, uncertainty, .. } = self;
        let value = serde_json::json!([algorithm, calibration_sha256, method, margin, bin_rows, uncertainty]);
        Sha256::digest(value.to_string()).iter().take(16).map(|byte| format!("{byte:02x}")).collect()
    }

    /// The key of the result in a directory; `None` where there is none. The error: it cannot be read.
    pub fn load(out: &Path) -> Result<Option<Self>, String> {
        let path = out.join(KEY_FILE);
        match regular::read(&path, regular::STATEMENT_BYTES) {
            Ok(text) => json::from_slice(&text)
                .map(Some)
                .map_err(|e| format!("{}: {e}; another version wrote it", path.display())),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(format!("{}: {error}", path.display())),
        }
    }

    /// Refuses a directory that has results of another key.
    pub fn check(&self, out: &Path) -> Result<(), Fault> {
        let occupied = |reason: String| {
            let path = out.display();
            Fault::new(
                Exit::Usage,
                format!("{path}: {reason}\nChoose another --out, or move away what is there"),
            )
        };
        match Self::load(out).map_err(&occupied)? {
            Some(there) if there == *self => Ok(()),
            Some(there) => {
                let differences = there.differences(self).join("\n  ");
                Err(occupied(format!("has results of something else:\n  {differences}")))
            }
            None if has_results(out) => {
                Err(occupied(format!("has results, but no {KEY_FILE} that states which session they are of")))
            }
            None => Ok(()),
        }
    }

    /// Marks a directory as one for results of this key, or finds that it is marked so already.
    pub fn claim(&self, out: &Path) -> Result<(), Fault> {
        self.check(out)?;
        let path = out.join(KEY_FILE);
        let failed = |e: &dyn Display| format!("{}: {e}", path.display());
        if path.exists() {
            return Ok(());
        }
        let text = serde_json::to_string_pretty(self).map_err(|e| failed(&e))?;
        std::fs::create_dir_all(out).map_err(|e| failed(&e))?;
        let written = write_new(&path, |file| writeln!(file, "{text}")).map_err(|e| failed(&e))?;
        // Another process has written its key in between.
        if written { Ok(()) } else { self.check(out) }
    }

    /// Puts the calibration beside the results, which are read with it; refuses a directory that has another one.
    pub fn keep_calibration(&self, out: &Path, calibration: &Calibration) -> Result<(), Fault> {
        let path = calibration_path(out);
        let failed = |e: &dyn Display| format!("{}: {e}", path.display());
        let text = calibration.text().map_err(|e| failed(&e))?;
        if !path.exists()
            && write_new(&path, |file| file.write_all(text.as_bytes())).map_err(|e| failed(&e))?
        {
            return Ok(());
        }
        let there = Calibration::load(&path).map_err(|e| e.to_string());
        match there.and_then(|there| calibration_sha256(&there)) {
            Ok(there) if there == self.calibration_sha256 => Ok(()),
            Ok(_) => Err(Fault::new(
                Exit::Usage,
                format!(
                    "{}: expected the requested calibration, found another one. Choose another --out, or move it away",
                    path.display()
                ),
            )),
            Err(reason) => Err(Fault::new(
                Exit::Usage,
                format!("{reason}. It would be read with the results: choose another --out, or move it away"),
            )),
        }
    }

    /// What is there, and what was requested.
    fn differences(&self, requested: &Self) -> Vec<String> {
        let cameras = |key: &Self| key.cameras.iter().map(CameraId::as_str).collect::<Vec<_>>().join(",");
        let shown = |key: &Self| {
            [
                ("session", key.session.to_string()),
                ("algorithm", key.algorithm.to_string()),
                ("calibration", key.calibration_sha256.chars().take(16).collect()),
                ("method", key.method.clone()),
                ("margin", key.margin.to_string()),
                ("bin-rows", key.bin_rows.to_string()),
                ("uncertainty", key.uncertainty.to_string()),
                ("format", key.format.clone()),
                ("cameras", cameras(key)),
            ]
        };
        let both =
            shown(self).into_iter().zip(shown(requested)).filter(|(there, requested)| there != requested);
        let named: Vec<String> = both
            .map(|((what, there), (_, requested))| format!("{what}: there {there}, requested {requested}"))
            .collect();
        if named.is_empty() { vec!["its description differs".to_owned()] } else { named }
    }
}

/// Whether a directory has clouds, maps, or a summary of them.
fn has_results(out: &Path) -> bool {
    let files = |folder: &str| std::fs::read_dir(out.join(folder)).into_iter().flatten().flatten();
    let is_result = |entry: std::fs::DirEntry| {
        let name = entry.file_name();
        let end = Path::new(&name).extension().and_then(|end| end.to_str());
        matches!(end, Some("ply" | "phase"))
    };
    ["clouds", "merged", "phases"].into_iter().flat_map(files).any(is_result)
        || out.join("summary.json").exists()
}

#[cfg(test)]
mod tests {
    use super::{ALGORITHM, Key};
    use crate::base::Fault;
    use crate::data::SessionIdentity;

    fn key() -> Key {
        let session = SessionIdentity {
            id: "0123".to_owned(),
            name: Some("walk-01".to_owned()),
            nodes: vec!["a".to_owned()],
            cameras: vec!["h0_up".into(), "h0_low".into()],
        };
        Key {
            session,
            algorithm: ALGORITHM,
            calibration_sha256: "c".repeat(64),
            method: "joint".to_owned(),
            margin: 1.0,
            bin_rows: 1,
            uncertainty: false,
            format: "ply".to_owned(),
            cameras: vec!["h0_up".into(), "h0_low".into()],
        }
    }

    #[test]
    fn a_directory_takes_results_of_one_key_only_and_the_difference_is_named() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        key().claim(dir.path()).expect("empty");
        key().claim(dir.path()).expect("the same");
        let refused = |change: &dyn Fn(&mut Key), words: &[&str]| {
            let mut other = key();
            change(&mut other);
            let Err(Fault { exit: 2, message }) = other.claim(dir.path()) else {
                panic!("{other:?} was taken");
            };
            words.iter().for_each(|word| assert!(message.contains(word), "{word:?} missing in {message}"));
        };
        refused(&|key| key.session.id = "4567".to_owned(), &["session: there", "0123", "4567", "--out"]);
        refused(&|key| key.session.nodes.push("b".to_owned()), &["session: there", "a,b"]);
        refused(&|key| key.algorithm += 1, &["algorithm: there"]);
        refused(&|key| key.calibration_sha256 = "d".repeat(64), &["calibration: there cccc", "dddd"]);
        refused(&|key| key.method = "paper".to_owned(), &["method: there joint, requested paper"]);
        refused(&|key| key.margin = 2.0, &["margin: there 1, requested 2"]);
        refused(&|key| key.bin_rows = 2, &["bin-rows: there 1, requested 2"]);
        refused(&|key| key.uncertainty = true, &["uncertainty: there false"]);
        refused(&|key| key.format = "phase".to_owned(), &["format: there ply"]);
        refused(&|key| key.cameras.truncate(1), &["cameras: there h0_up,h0_low, requested h0_up"]);
        assert_eq!(Key::load(dir.path()), Ok(Some(key())));
    }

    #[test]
    fn results_that_do_not_say_of_what_they_are_are_not_taken_for_anything() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        std::fs::create_dir(dir.path().join("clouds")).expect("writable");
        key().check(dir.path()).expect("nothing is there yet");
        std::fs::write(dir.path().join("clouds/h0_up_000000.ply"), "ply").expect("writable");
        let error = key().claim(dir.path()).expect_err("must be refused").to_string();
        assert!(error.contains("reconstruct.json") && error.contains("--out"), "{error}");
        std::fs::write(dir.path().join("reconstruct.json"), "{").expect("writable");
        assert_eq!(key().claim(dir.path()).expect_err("unreadable").exit, 2);
    }
}
