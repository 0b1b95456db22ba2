// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bytes to the disk past the page cache.
//!
//! A buffered writer at 1.1 GB/s fills the page cache until the kernel makes the writer wait for seconds;
//! `O_DIRECT` keeps the pace of the disk. It requires addresses, offsets and lengths in multiples of
//! [`BLOCK`]. Where a file system refuses it, the same writes go through the page cache.

use super::statistics::DiskAccess;
use crate::host::realtime::soft_limit;
use std::ffi::CString;
use std::fs::{File, OpenOptions};
use std::io::{self, IoSlice};
use std::os::fd::AsRawFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

/// Alignment of direct writes, bytes.
pub const BLOCK: usize = 4096;
/// Parts of one `pwritev` (`IOV_MAX` of Linux).
const MAX_PARTS: usize = 1024;

/// Where a segment's bytes go. The offset and the address and length of every part are multiples of [`BLOCK`].
pub trait Store: Send {
    /// Writes all of `parts`, one after the other, from `offset` on.
    fn write_at(&mut self, offset: u64, parts: &mut [IoSlice<'_>]) -> io::Result<()>;
    /// Cuts the file to its true length, and gives back what was set aside beyond it.
    fn set_len(&mut self, length: u64) -> io::Result<()>;
    /// Returns when everything written, and the file's name, is on the medium (`fdatasync`).
    fn sync(&mut self) -> io::Result<()>;
    /// Sets disk space aside, without a change to the file's length; returns how much.
    fn preallocate(&mut self, bytes: u64) -> io::Result<u64> {
        let _ = bytes;
        Ok(0)
    }
    /// How writes reach the disk.
    fn access(&self) -> DiskAccess {
        DiskAccess::Direct
    }
}

/// A new file, written directly where that is possible.
pub struct DirectFile {
    file: File,
    /// Whose entry for the file is not durable yet.
    directory: Option<PathBuf>,
    access: DiskAccess,
}

impl DirectFile {
    /// Creates the file; it must not exist.
    pub fn create(path: &Path) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).mode(0o640);
        let directory = path.parent().map(Path::to_owned);
        match options.clone().custom_flags(libc::O_DIRECT).open(path) {
            Ok(file) => Ok(Self { file, directory, access: DiskAccess::Direct }),
            Err(error) if error.raw_os_error() == Some(libc::EINVAL) => {
                // Some file systems have created the file by the time they refuse the flag.
                let _ = std::fs::remove_file(path);
                tracing::warn!(
                    path = %path.display(),
                    "the file system refuses O_DIRECT; writing through the page cache, which may stall at full rate"
                );
                Ok(Self { file: options.open(path)?, directory, access: DiskAccess::PageCache })
            }
            Err(error) => Err(error),
        }
    }
}

impl Store for DirectFile {
    fn write_at(&mut self, offset: u64, parts: &mut [IoSlice<'_>]) -> io::Result<()> {
        write_all_vectored_at(&self.file, offset, parts)
    }

    fn set_len(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.sync_data()?;
        if let Some(directory) = &self.directory {
            sync_directory(directory)?;
            self.directory = None;
        }
        Ok(())
    }

    fn preallocate(&mut self, bytes: u64) -> io::Result<u64> {
        let length = libc::off_t::try_from(bytes).map_err(io::Error::other)?;
        // SAFETY: the descriptor is open for the duration of the call; no memory is passed.
        let code = unsafe { libc::fallocate(self.file.as_raw_fd(), libc::FALLOC_FL_KEEP_SIZE, 0, length) };
        if code == 0 { Ok(bytes) } else { Err(io::Error::last_os_error()) }
    }

    fn access(&self) -> DiskAccess {
        self.access
    }
}

/// `pwritev` until everything is written. After a short write it goes on at a whole block, as `O_DIRECT` wants.
fn write_all_vectored_at(file: &File, mut offset: u64, mut parts: &mut [IoSlice<'_>]) -> io::Result<()> {
    while !parts.is_empty() {
        let count = libc::c_int::try_from(parts.len().min(MAX_PARTS)).map_err(io::Error::other)?;
        let at = libc::off_t::try_from(offset).map_err(io::Error::other)?;
        // SAFETY: `IoSlice` has the layout of `iovec` on Unix; `count` of them, and the bytes that they point
        // to, are borrowed for the duration of the call, which only reads them.
        let written = unsafe { libc::pwritev(file.as_raw_fd(), parts.as_ptr().cast(), count, at) };
        let Ok(written) = usize::try_from(written) else {
            let error = io::Error::last_os_error();
            if error.kind() == io::ErrorKind::Interrupted {
                continue;
            }
            return Err(error);
        };
        let whole = written - written % BLOCK;
        if whole == 0
            && written > 0
            && soft_limit(libc::RLIMIT_FSIZE).is_some_and(|limit| offset + BLOCK as u64 > limit)
        {
            // The next write would fail with this error, if it could write less than a block.
            return Err(io::Error::from_raw_os_error(libc::EFBIG));
        }
        if whole == 0 {
            return Err(io::Error::new(io::ErrorKind::WriteZero, "the file takes no whole block"));
        }
        IoSlice::advance_slices(&mut parts, whole);
        offset += whole as u64;
    }
    Ok(())
}

/// Lets a write beyond the limit on file sizes fail with `EFBIG`, as any other write fails, instead of ending the
/// process with `SIGXFSZ` in the middle of a session.
pub fn survive_file_limit() {
    // SAFETY: ignoring a signal installs no handler: no code of ours runs in signal context.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}

/// Memory that starts at a multiple of [`BLOCK`]; it grows in whole blocks.
pub struct AlignedBuffer {
    memory: Vec<u8>,
    start: usize,
    capacity: usize,
}

impl AlignedBuffer {
    /// At least `capacity` bytes of zeros.
    pub fn new(capacity: usize) -> Self {
        let capacity = capacity.next_multiple_of(BLOCK);
        let memory = vec![0; capacity + BLOCK];
        let start = memory.as_ptr().align_offset(BLOCK).min(BLOCK);
        Self { memory, start, capacity }
    }

    /// The whole memory, from its aligned start.
    pub fn as_slice(&self) -> &[u8] {
        &self.memory[self.start..self.start + self.capacity]
    }

    /// The whole memory, from its aligned start.
    pub fn as_mut_slice(&mut self) -> &mut [u8] {
        &mut self.memory[self.start..self.start + self.capacity]
    }

    /// Grows to at least `capacity` bytes and keeps the content.
    pub fn reserve(&mut self, capacity: usize) {
        if capacity > self.capacity {
            let mut grown = Self::new(capacity.max(self.capacity * 2));
            grown.as_mut_slice()[..self.capacity].copy_from_slice(self.as_slice());
            *self = grown;
        }
    }
}

/// Bytes that the file system of `path` has left for this process.
pub fn free_bytes(path: &Path) -> io::Result<u64> {
    let directory = File::open(path)?;
    // SAFETY: statvfs is a plain C struct for which all-zero bytes are a valid value.
    let mut stat: libc::statvfs = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor is open for the duration of the call, and `stat` is valid for writing.
    if unsafe { libc::fstatvfs(directory.as_raw_fd(), &mut stat) } != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Makes the directory's entries durable (a new file's name is not, before this).
pub fn sync_directory(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Gives a file its final name, which must not be taken.
pub fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    let name = |path: &Path| CString::new(path.as_os_str().as_bytes()).map_err(io::Error::other);
    let (old, new) = (name(from)?, name(to)?);
    // SAFETY: both are C strings that live for the duration of the call.
    let code = unsafe {
        libc::renameat2(libc::AT_FDCWD, old.as_ptr(), libc::AT_FDCWD, new.as_ptr(), libc::RENAME_NOREPLACE)
    };
    if code == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

#[cfg(test)]
mod tests {
    use super::{AlignedBuffer, BLOCK, DirectFile, Store, free_bytes};
    use std::io::IoSlice;

    #[test]
    fn buffers_are_aligned_and_keep_their_content() {
        let mut buffer = AlignedBuffer::new(1);
        buffer.as_mut_slice()[17] = 5;
        for capacity in [BLOCK + 1, 10 * BLOCK, 1 << 20] {
            buffer.reserve(capacity);
            assert_eq!(buffer.as_slice().as_ptr().align_offset(BLOCK), 0);
            assert!(buffer.as_slice().len() >= capacity && buffer.as_slice()[17] == 5);
        }
    }

    #[test]
    fn an_existing_file_is_never_opened() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("segment-000.mcap");
        let mut file = DirectFile::create(&path).expect("a new file");
        file.write_at(0, &mut [IoSlice::new(AlignedBuffer::new(BLOCK).as_slice())]).expect("one block");
        file.set_len(100).expect("a true length");
        file.sync().expect("synced");
        assert!(DirectFile::create(&path).is_err());
        assert_eq!(std::fs::metadata(&path).expect("a file").len(), 100);
        assert!(free_bytes(dir.path()).expect("a file system") > 0);
    }
}
