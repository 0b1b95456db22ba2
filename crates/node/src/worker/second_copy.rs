// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether what an archive has of a recording is a second copy: other files, with the same bytes, which were read
//! there.
//!
//! A copy that is the recording itself under another name dies with it: a link, the same directory mounted at two
//! places, the same export of a server under two paths. Device and inode show most of them. A server's export may have
//! another device number at each place; there a file that is made in the recording's directory is looked for beside
//! the copy. The same open files are checked again just before the recording is deleted.

use crate::base::{ids::printable, regular};
use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::fs::{File, Metadata};
use std::io::{self, ErrorKind, Read};
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Bytes that are read at a time while comparing.
const BLOCK: usize = 1 << 20;

/// First characters of the probe files' names; one that a killed process left behind may be removed.
const PROBE: &str = ".prune-probe-";

/// A recording and its copy, file by file.
#[derive(Debug)]
pub struct SecondCopy {
    recording: PathBuf,
    copy: PathBuf,
    files: Vec<Pair>,
}

/// A file of the recording and that of the copy.
#[derive(Debug)]
struct Pair {
    name: OsString,
    own: Held,
    other: Held,
}

/// An open file, and what it was when it was opened.
#[derive(Debug)]
struct Held {
    file: File,
    was: Identity,
}

/// Which file it is, and in which state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Identity {
    device: u64,
    inode: u64,
    bytes: u64,
    modified: (i64, i64),
}

impl Identity {
    fn of(file: &Metadata) -> Self {
        let modified = (file.mtime(), file.mtime_nsec());
        Self { device: file.dev(), inode: file.ino(), bytes: file.len(), modified }
    }

    /// Of what stands under a path now.
    fn at(path: &Path) -> Option<Self> {
        std::fs::metadata(path).ok().map(|file| Self::of(&file))
    }
}

impl Held {
    fn open(path: &Path) -> io::Result<Self> {
        let file = regular::open(path)?;
        let was = Identity::of(&file.metadata()?);
        Ok(Self { file, was })
    }

    fn is_as_it_was(&self) -> bool {
        self.file.metadata().is_ok_and(|file| file.nlink() > 0 && Identity::of(&file) == self.was)
    }
}

impl SecondCopy {
    /// Opens the files of a recording and of its copy, which are others of the same lengths. Their bytes are not
    /// compared.
    ///
    /// # Errors
    /// What is no second copy, and why.
    pub fn open(recording: &Path, copy: &Path) -> Result<Self, String> {
        let mut files = Vec::new();
        for (name, bytes) in list(recording).map_err(|e| format!("{}: {e}", recording.display()))? {
            let (from, to) = (recording.join(&name), copy.join(&name));
            let held = |path: &Path| Held::open(path).map_err(|e| format!("{}: {e}", path.display()));
            let (own, other) = (held(&from)?, held(&to)?);
            if other.was.bytes != bytes {
                return Err(format!("{} has {} bytes, the recording {bytes}", to.display(), other.was.bytes));
            }
            if is_same(&own, &other) {
                return Err(same_file(&to));
            }
            files.push(Pair { name, own, other });
        }
        if files.is_empty() {
            return Err(format!("{}: there is no file in it", recording.display()));
        }
        Ok(Self { recording: recording.to_owned(), copy: copy.to_owned(), files })
    }

    /// Reads both and compares them, byte by byte; the copy from its medium, as far as the system knows what that is.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn compare(&self) -> Result<(), String> {
        self.look_for_a_probe()?;
        for pair in &self.files {
            let to = self.copy.join(&pair.name);
            let failed = |e: io::Error| format!("{}: {e}", to.display());
            from_medium(&pair.other.file).map_err(failed)?;
            if !has_same_bytes(&pair.own.file, &pair.other.file).map_err(failed)? {
                return Err(format!("{} differs from the recording", to.display()));
            }
            self.is_still_there(pair, &self.recording)?;
        }
        Ok(())
    }

    /// Deletes the recording, whose copy was compared, and which goes out of sight as `aside` first. Nothing is
    /// deleted where either is not what was compared any more.
    ///
    /// # Errors
    /// What has changed, or what the system reports. Where nothing was deleted, the recording stands where it stood.
    pub fn delete(&self, aside: &Path) -> Result<(), String> {
        self.files.iter().try_for_each(|pair| self.is_still_there(pair, &self.recording))?;
        let failed = |path: &Path, e: io::Error| format!("{}: {e}", path.display());
        std::fs::rename(&self.recording, aside).map_err(|e| failed(&self.recording, e))?;
        // A copy that was the recording under another name has gone with it.
        let looked = self
            .is_all_of(aside)
            .and_then(|()| self.files.iter().try_for_each(|pair| self.is_still_there(pair, aside)));
        if let Err(reason) = looked {
            std::fs::rename(aside, &self.recording).map_err(|e| format!("{reason}; {}", failed(aside, e)))?;
            return Err(reason);
        }
        for pair in &self.files {
            let path = aside.join(&pair.name);
            std::fs::remove_file(&path).map_err(|e| failed(&path, e))?;
        }
        std::fs::remove_dir(aside).map_err(|e| failed(aside, e))
    }

    /// That both files of a pair are those that were opened, under their names as by their handles.
    fn is_still_there(&self, pair: &Pair, recording: &Path) -> Result<(), String> {
        for (held, path) in
            [(&pair.own, recording.join(&pair.name)), (&pair.other, self.copy.join(&pair.name))]
        {
            if !held.is_as_it_was() || Identity::at(&path) != Some(held.was) {
                return Err(format!("{} has changed since it was compared", path.display()));
            }
        }
        if is_same(&pair.own, &pair.other) { Err(same_file(&self.copy.join(&pair.name))) } else { Ok(()) }
    }

    /// That a directory has the recording's files and nothing else.
    fn is_all_of(&self, directory: &Path) -> Result<(), String> {
        let failed = |e: io::Error| format!("{}: {e}", directory.display());
        let found: Vec<OsString> = list(directory).map_err(failed)?.into_keys().collect();
        let known: Vec<&OsString> = self.files.iter().map(|pair| &pair.name).collect();
        match found.iter().collect::<Vec<_>>() == known {
            true => Ok(()),
            false => Err(format!("{} has other files than were compared", self.recording.display())),
        }
    }

    /// Makes a file in the recording's directory and looks for it where the copies lie.
    fn look_for_a_probe(&self) -> Result<(), String> {
        let failed = |e: io::Error| {
            format!(
                "{}: without writing there it cannot be distinguished from its copy: {e}",
                self.recording.display()
            )
        };
        let number = getrandom::u64().map_err(|e| failed(io::Error::other(e.to_string())))?;
        let probe = self.recording.join(format!("{PROBE}{number:016x}"));
        File::create_new(&probe).map_err(failed)?;
        let looked = self.files.iter().try_for_each(|pair| {
            let to = self.copy.join(&pair.name);
            // Behind all links: that is where the bytes are.
            let place = to.canonicalize().map_err(|e| format!("{}: {e}", to.display()))?;
            let beside = place.with_file_name(probe.file_name().unwrap_or_default());
            match std::fs::symlink_metadata(&beside) {
                Ok(_) => Err(same_file(&to)),
                Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
                Err(error) => Err(format!("{}: {error}", beside.display())),
            }
        });
        std::fs::remove_file(&probe).map_err(failed)?;
        looked
    }
}

/// Whether two open files are one: by device and inode; or by inode alone where both have several names, which a server
/// may show under two devices.
fn is_same(own: &Held, other: &Held) -> bool {
    let names = |held: &Held| held.file.metadata().map_or(0, |file| file.nlink());
    own.was.inode == other.was.inode
        && (own.was.device == other.was.device || (names(own) > 1 && names(other) > 1))
}

fn same_file(copy: &Path) -> String {
    format!(
        "{} is no second copy: it is the recording's own file under another name (a link, or a directory that is \
         mounted twice); copy the bytes to another place",
        copy.display()
    )
}

/// Names and sizes of a recording's files, which has neither folders nor links.
///
/// # Errors
/// What the system reports, or what is no file.
pub fn list(recording: &Path) -> io::Result<BTreeMap<OsString, u64>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(recording)? {
        let (name, file) = entry.and_then(|entry| Ok((entry.file_name(), entry.metadata()?)))?;
        if name.as_encoded_bytes().starts_with(PROBE.as_bytes()) {
            std::fs::remove_file(recording.join(name))?;
            continue;
        }
        expect_file(&name, &file)?;
        files.insert(name, file.len());
    }
    Ok(files)
}

fn expect_file(name: &OsStr, file: &Metadata) -> io::Result<()> {
    let found = match file.file_type() {
        kind if kind.is_file() => return Ok(()),
        kind if kind.is_symlink() => "a link",
        kind if kind.is_dir() => "a directory",
        _ => "something else",
    };
    let name = printable(&name.to_string_lossy());
    Err(io::Error::other(format!("expected the files of a recording, found {found} named {name:?}")))
}

/// Lets the system forget what it has of a file in memory, so that what is read comes from the medium.
fn from_medium(file: &File) -> io::Result<()> {
    match file.sync_all() {
        // There is nothing to be written where nothing can be.
        Err(error) if !matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::ReadOnlyFilesystem) => {
            return Err(error);
        }
        _ => {}
    }
    // SAFETY: the descriptor is open for the duration of the call, which changes nothing that the file holds. It is a
    // wish: a file system that does not know it reads as ever.
    unsafe { libc::posix_fadvise(file.as_raw_fd(), 0, 0, libc::POSIX_FADV_DONTNEED) };
    Ok(())
}

/// Whether two files have the same bytes.
fn has_same_bytes(mut a: &File, mut b: &File) -> io::Result<bool> {
    let (mut left, mut right) = (vec![0; BLOCK], vec![0; BLOCK]);
    loop {
        let n = a.read(&mut left)?;
        if n == 0 {
            return Ok(b.read(&mut right)? == 0);
        }
        match b.read_exact(&mut right[..n]) {
            Ok(()) if left[..n] == right[..n] => {}
            Ok(()) => return Ok(false),
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(false),
            Err(error) => return Err(error),
        }
    }
}

#[cfg(test)]
mod tests;
