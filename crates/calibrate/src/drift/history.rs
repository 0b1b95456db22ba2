// SPDX-License-Identifier: MIT OR Apache-2.0
//! The history of a calibration's checks: a line of JSON per session, and a plot beside it.
//!
//! Both files are written whole, by one process at a time. Lines are in the order in which the sessions were recorded,
//! whatever the order of the checks. A line that is not whole is left out.

use super::{Drift, plot};
use crate::base::{json, regular, write_whole};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

/// File name of the lines in a history's directory.
pub const LINES: &str = "calibration-history.jsonl";
/// File name of the plot in a history's directory.
pub const PLOT: &str = "calibration-history.svg";
/// File name of the lock, held while a check is under way and while the history is written.
const LOCK: &str = "calibration-history.lock";
/// Directory in which the check that holds the lock keeps its phase maps.
const SCRATCH: &str = "calibration-check";

/// Most sessions in a history: those recorded last are kept.
pub const MOST: usize = 1000;
/// Bytes of the lines that are read at most: more than that many sessions take.
const MOST_BYTES: u64 = 16 << 20;

/// Whether the devices stand as they were calibrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No device has moved what it sees by more than a quarter of the limit.
    Stands,
    /// A device has moved what it sees by more than a quarter of the limit, but not certainly by more than the limit.
    Turned,
    /// A device has certainly moved what it sees by more than the limit: calibrate again.
    CalibrateAgain,
    /// The session does not determine it for every device.
    NotKnown,
}

/// By how much one device has turned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceTurn {
    /// `camera h0_up` or `projector h0`.
    pub device: String,
    /// About its own axes, thousandths of a degree.
    pub turn_mdeg: [f64; 3],
    /// How far that moves what it sees, or lights, in the middle of the volume, mm.
    pub at_body_mm: f64,
    /// Standard deviation of that, mm.
    pub at_body_sigma_mm: f64,
}

/// What the check of one session has found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Checked {
    /// When the session was recorded, host clock, ns; 0 where that is not known.
    pub recorded_ns: u64,
    pub session: String,
    /// The session id that its recordings share.
    pub session_id: String,
    /// Checksum of the whole calibration, in hexadecimal.
    pub calibration_sha256: String,
    pub verdict: Verdict,
    /// The verdict in a sentence, for people.
    pub said: String,
    /// How far a device may have moved what it sees, mm.
    pub most_mm: f64,
    /// The calibration's devices; none where they were not measured.
    pub devices: Vec<DeviceTurn>,
}

impl Checked {
    /// Adds the turns that were measured, and their verdict.
    pub fn measured(mut self, drift: &Drift) -> Self {
        let rounded = |x: f64| (x * 1e4).round() / 1e4;
        let turn = |turn: &super::Move| DeviceTurn {
            device: turn.device.clone(),
            turn_mdeg: turn.turn_deg.map(|degree| rounded(degree * 1e3)),
            at_body_mm: rounded(turn.at_body_mm),
            at_body_sigma_mm: rounded(turn.at_body_sigma_mm),
        };
        self.devices = drift.devices.iter().map(turn).collect();
        (self.verdict, self.said) = drift.verdict(self.most_mm);
        self
    }

    fn order(&self) -> (u64, &str, &str) {
        (self.recorded_ns, &self.session_id, &self.calibration_sha256)
    }
}

/// A directory with a history, which this process alone may write until it drops this.
pub struct History {
    dir: PathBuf,
    _lock: File,
}

impl History {
    /// Waits until no other process has the directory, and takes it.
    pub fn open(dir: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(dir)?;
        let lock = regular::lock_file(&dir.join(LOCK))?;
        lock.lock()?;
        let history = Self { dir: dir.to_owned(), _lock: lock };
        // The scratch files of a check that was killed.
        match std::fs::remove_dir_all(history.scratch()) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(history),
        }
    }

    /// Where the process that has the directory may work.
    pub fn scratch(&self) -> PathBuf {
        self.dir.join(SCRATCH)
    }

    /// Adds the check of a session; an earlier check of it with the same calibration is replaced.
    pub fn add(&self, checked: Checked) -> io::Result<()> {
        let mut all = load(&self.dir);
        let same = |other: &Checked| {
            other.session_id == checked.session_id && other.calibration_sha256 == checked.calibration_sha256
        };
        all.retain(|other| !same(other));
        all.push(checked);
        all.sort_by(|a, b| a.order().cmp(&b.order()));
        all.drain(..all.len().saturating_sub(MOST));
        let lines: io::Result<Vec<String>> =
            all.iter().map(|one| Ok(serde_json::to_string(one)? + "\n")).collect();
        let lines = lines?.concat();
        write_whole(&self.dir.join(LINES), |file| file.write_all(lines.as_bytes()))?;
        write_whole(&self.dir.join(PLOT), |file| file.write_all(plot::svg(&all).as_bytes()))
    }
}

/// The history in a directory, sessions recorded first before others; nothing where there is none.
pub fn load(dir: &Path) -> Vec<Checked> {
    let mut bytes = Vec::new();
    let Ok(file) = regular::open(&dir.join(LINES)) else { return Vec::new() };
    // Lines that were read before an error are as good as those of a torn file.
    let _ = file.take(MOST_BYTES).read_to_end(&mut bytes);
    bytes.split(|byte| *byte == b'\n').filter_map(|line| json::from_slice(line).ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::{Checked, DeviceTurn, History, LINES, MOST, PLOT, Verdict, load};
    use std::io::Write;

    fn checked(number: u64) -> Checked {
        Checked {
            recorded_ns: 1_790_000_000_000_000_000 + number * 3_600_000_000_000,
            session: format!("walk-{number:02}"),
            session_id: format!("{number:016x}"),
            calibration_sha256: "c0".repeat(32),
            verdict: Verdict::Stands,
            said: "no device has moved".to_owned(),
            most_mm: 0.2,
            devices: vec![DeviceTurn {
                device: "camera h0_<up>".to_owned(),
                turn_mdeg: [0.5, -1.0, 0.0],
                at_body_mm: 0.03 + number as f64 * 1e-4,
                at_body_sigma_mm: 0.004,
            }],
        }
    }

    #[test]
    fn lines_do_not_depend_on_the_order_in_which_sessions_are_looked_at() {
        let files = |order: &[u64]| {
            let dir = tempfile::tempdir().expect("a directory");
            for number in order {
                // A process after the other.
                History::open(dir.path()).expect("there").add(checked(*number)).expect("writable");
            }
            [LINES, PLOT].map(|name| std::fs::read_to_string(dir.path().join(name)).expect("written"))
        };
        let [lines, plot] = files(&[2, 0, 1]);
        assert_eq!(lines.lines().count(), 3);
        assert!(plot.contains("camera h0_&lt;up&gt;") && plot.ends_with("</svg>\n"), "{plot}");
        assert_eq!([lines, plot], files(&[0, 1, 2, 1]));
    }

    #[test]
    fn a_torn_line_costs_itself_alone() {
        let dir = tempfile::tempdir().expect("a directory");
        let history = History::open(dir.path()).expect("there");
        history.add(checked(0)).expect("writable");
        history.add(checked(1)).expect("writable");
        let path = dir.path().join(LINES);
        let whole = std::fs::metadata(&path).expect("there").len();
        std::fs::File::options().append(true).open(&path).expect("there").write_all(b"{\"sess").expect("ok");
        assert_eq!(load(dir.path()), [checked(0), checked(1)]);
        std::fs::File::options().write(true).open(&path).expect("there").set_len(whole - 9).expect("ok");
        assert_eq!(load(dir.path()), [checked(0)]);
        history.add(checked(2)).expect("writable");
        assert_eq!(load(dir.path()), [checked(0), checked(2)]);
    }

    #[test]
    fn the_sessions_recorded_last_are_kept() {
        let dir = tempfile::tempdir().expect("a directory");
        let all: String = (0..MOST as u64)
            .map(|number| serde_json::to_string(&checked(number)).expect("JSON") + "\n")
            .collect();
        std::fs::write(dir.path().join(LINES), all).expect("writable");
        History::open(dir.path()).expect("there").add(checked(MOST as u64)).expect("writable");
        let kept = load(dir.path());
        assert_eq!((kept.len(), &kept[0], kept.last()), (MOST, &checked(1), Some(&checked(MOST as u64))));
    }

    #[test]
    fn what_a_killed_check_has_left_is_removed_by_the_next() {
        let dir = tempfile::tempdir().expect("a directory");
        let left = History::open(dir.path()).expect("there").scratch();
        std::fs::create_dir_all(left.join("phases")).expect("writable");
        assert_eq!(History::open(dir.path()).expect("there").scratch(), left);
        assert!(!left.exists());
    }
}
