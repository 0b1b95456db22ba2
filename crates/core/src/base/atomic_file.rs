// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files that are never half there, whoever writes them at the same time.
//!
//! A file is written under a temporary name beside its place, which no other process has, and renamed when it is
//! complete. Two processes that write the same file, on one machine or on two that share the directory, do not touch
//! each other's bytes: the last one to finish gives the file its name, and what had the name stays whole until then.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// The end of the names of files that are not complete yet.
const SUFFIX: &str = ".partial";

/// A temporary file that has not been written to for this time belongs to a process that was killed: no writer pauses
/// for an hour.
pub const STALE: Duration = Duration::from_secs(3600);

/// Writes a file so that what has its name is complete and on the medium. The file is also open for reading.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<()> {
    write_with(path, |file| {
        write(file)?;
        file.sync_data()
    })
}

/// As [`write_whole`], but leaves it to the system when the bytes reach the medium: for files that are checked before
/// they are taken for finished, and can be made again. After a power cut such a file may be short.
pub fn write_whole_cached(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<()> {
    write_with(path, write)
}

/// As [`write_whole`], unless a file has the name already: then that file stays, and the answer is `false`.
pub fn write_new(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<bool> {
    let partial = partial_name(path)?;
    let file = File::options().write(true).create_new(true).open(&partial);
    let linked = file.and_then(|mut file| {
        write(&mut file)?;
        file.sync_data()?;
        // Unlike a rename, a link never takes a name away from another file.
        std::fs::hard_link(&partial, path)
    });
    let _ = std::fs::remove_file(&partial);
    match linked {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(false),
        Err(error) => Err(error),
    }
}

fn write_with(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<()> {
    let partial = partial_name(path)?;
    let file = File::options().read(true).write(true).create_new(true).open(&partial);
    let written = file.and_then(|mut file| {
        write(&mut file)?;
        std::fs::rename(&partial, path)
    });
    if written.is_err() {
        // What has failed once may fail again; a stale file is removed by a later run.
        let _ = std::fs::remove_file(&partial);
    }
    written
}

/// Removes what killed processes have left in a directory: temporary files that are older than `age`. A writer that
/// still runs after that time fails when it renames its file, and damages nothing.
pub fn remove_stale(directory: &Path, age: Duration) -> io::Result<usize> {
    let mut removed = 0;
    for entry in std::fs::read_dir(directory)? {
        let entry = entry?;
        if !entry.file_name().to_string_lossy().ends_with(SUFFIX) {
            continue;
        }
        // Another process may be cleaning up as well.
        let modified = entry.metadata().and_then(|meta| meta.modified());
        let old = modified.is_ok_and(|time| time.elapsed().is_ok_and(|since| since >= age));
        removed += usize::from(old && std::fs::remove_file(entry.path()).is_ok());
    }
    Ok(removed)
}

/// A temporary name that no other process has, on this machine or another, and no other thread of this one.
fn partial_name(path: &Path) -> io::Result<PathBuf> {
    static PROCESS: OnceLock<u64> = OnceLock::new();
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let process = match PROCESS.get() {
        Some(process) => *process,
        None => {
            let drawn = getrandom::u64().map_err(|e| io::Error::other(e.to_string()))?;
            *PROCESS.get_or_init(|| drawn)
        }
    };
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{process:016x}-{}{SUFFIX}", COUNT.fetch_add(1, Ordering::Relaxed)));
    Ok(name.into())
}

#[cfg(test)]
mod tests {
    use super::{remove_stale, write_new, write_whole, write_whole_cached};
    use std::io::{self, Write};
    use std::time::Duration;

    #[test]
    fn a_failure_leaves_what_was_there() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("a.xyz");
        write_whole(&path, |file| file.write_all(b"old")).expect("writable");
        let failed = write_whole(&path, |file| {
            file.write_all(b"half")?;
            Err(io::Error::other("no more"))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read(&path).expect("readable"), b"old");
        assert_eq!(dir.path().read_dir().expect("a directory").count(), 1, "nothing temporary stays");
    }

    #[test]
    fn writers_of_one_file_do_not_touch_each_other() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("a.ply");
        write_whole_cached(&path, |slow| {
            slow.write_all(b"sl")?;
            write_whole_cached(&path, |quick| quick.write_all(b"quick"))?;
            assert_eq!(std::fs::read(&path)?, b"quick");
            slow.write_all(b"ow")
        })
        .expect("writable");
        assert_eq!(std::fs::read(&path).expect("readable"), b"slow");
    }

    #[test]
    fn a_name_that_is_taken_stays_with_what_has_it() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("a.json");
        let write = |text: &'static [u8]| write_new(&path, |file| file.write_all(text)).expect("writable");
        assert_eq!([write(b"first"), write(b"second")], [true, false]);
        assert_eq!(std::fs::read(&path).expect("readable"), b"first");
        assert_eq!(dir.path().read_dir().expect("a directory").count(), 1, "nothing temporary stays");
    }

    #[test]
    fn only_stale_temporary_files_are_removed() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        for name in ["a.ply", "a.ply.0123-0.partial", "b.ply.partial"] {
            std::fs::write(dir.path().join(name), name).expect("writable");
        }
        assert_eq!(remove_stale(dir.path(), Duration::from_secs(60)).expect("a directory"), 0);
        assert_eq!(remove_stale(dir.path(), Duration::ZERO).expect("a directory"), 2);
        assert!(dir.path().join("a.ply").exists());
    }
}
