// SPDX-License-Identifier: MIT OR Apache-2.0
//! Makes room while a session runs: finished segments are removed, some of them after `fourdbody verify`.

use super::process::{Program, failed};
use super::train::program;
use super::{Args, insert};
use fourdbody::cmds::Failure;
use serde_json::{Map, Value};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// One of this number of segments is verified before it goes: reading and checking 2 GiB takes two seconds of a core.
const VERIFY_ONE_IN: u64 = 25;

/// Segments that were removed, and how many of them were verified before.
#[derive(Debug, Default)]
pub struct Dropped {
    segments: u64,
    bytes: u64,
    verified: u64,
    refused: Vec<PathBuf>,
}

impl Dropped {
    /// Adds its figures to the summary of a benchmark.
    pub fn report(&self, summary: &mut Map<String, Value>, suffix: &str) -> Result<(), Failure> {
        insert(summary, &format!("segments_dropped{suffix}"), self.segments);
        insert(summary, &format!("segments_verified{suffix}"), self.verified);
        insert(summary, &format!("gb_dropped{suffix}"), self.bytes as f64 / 1e9);
        match self.refused.first() {
            None => Ok(()),
            Some(path) => Err(failed(format!(
                "{} segments did not pass verify, first {}",
                self.refused.len(),
                path.display()
            ))),
        }
    }
}

/// Removes closed segments below `sessions` until it is stopped.
pub fn drop_segments(args: &Args, sessions: &Path, stop: &AtomicBool) -> Dropped {
    let mut dropped = Dropped::default();
    while !stop.load(Ordering::Acquire) {
        std::thread::sleep(Duration::from_millis(200));
        for path in closed_segments(sessions) {
            let bytes = path.metadata().map_or(0, |metadata| metadata.len());
            if dropped.segments.is_multiple_of(VERIFY_ONE_IN) {
                dropped.verified += 1;
                if !verifies(args, &path) {
                    dropped.refused.push(path.clone());
                }
            }
            if std::fs::remove_file(&path).is_ok() {
                dropped.segments += 1;
                dropped.bytes += bytes;
            }
        }
    }
    dropped
}

/// Passes a segment through `fourdbody verify`, which is halted most of the time: reading 2 GiB at full speed would
/// take half of what the disk can do, and that is not what is measured here.
fn verifies(args: &Args, path: &Path) -> bool {
    let mut command = Command::new("nice");
    command.arg("-n19").arg(program(args, "fourdbody")).arg("verify").arg(path);
    let Ok(mut verify) = Program::start("verify", &mut command, &args.out) else { return false };
    while !verify.ended() {
        verify.signal("STOP");
        std::thread::sleep(Duration::from_millis(90));
        verify.signal("CONT");
        std::thread::sleep(Duration::from_millis(10));
    }
    verify.finish().is_ok_and(|(_, status)| status.success())
}

/// Segments of all recordings below a directory that are closed: a file that is being written, or made ready to be,
/// does not end as an MCAP file ends.
fn closed_segments(sessions: &Path) -> Vec<PathBuf> {
    let entries = |directory: &Path| -> Vec<PathBuf> {
        std::fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
    };
    let mut segments: Vec<PathBuf> = entries(sessions)
        .iter()
        .flat_map(|path| if path.is_dir() { entries(path) } else { Vec::new() })
        .flat_map(|path| if path.is_dir() { entries(&path) } else { vec![path] })
        .filter(|path| path.extension().is_some_and(|extension| extension == "mcap") && is_closed(path))
        .collect();
    segments.sort();
    segments
}

fn is_closed(path: &Path) -> bool {
    let mut end = [0; mcap_magic().len()];
    let length = end.len() as i64;
    let read = File::open(path).and_then(|mut file| {
        file.seek(SeekFrom::End(-length))?;
        file.read_exact(&mut end)
    });
    read.is_ok() && end == mcap_magic()
}

/// The first and the last bytes of every whole MCAP file.
const fn mcap_magic() -> [u8; 8] {
    [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n']
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_closed_segments_are_found() {
        let directory = tempfile::tempdir().expect("a directory");
        let recording = directory.path().join("session/node-a");
        std::fs::create_dir_all(&recording).expect("a recording");
        let write = |name: &str, bytes: &[u8]| std::fs::write(recording.join(name), bytes).expect("a file");
        write("segment-000.mcap", &[&mcap_magic()[..], b"records", &mcap_magic()].concat());
        write("segment-001.mcap", &[&mcap_magic()[..], b"records"].concat());
        write("segment-002.mcap", &[0; 4096]);
        write("segment-003.mcap", b"");
        write("notes.txt", &mcap_magic());
        assert_eq!(closed_segments(directory.path()), [recording.join("segment-000.mcap")]);
    }
}
