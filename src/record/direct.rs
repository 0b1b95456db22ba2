//! Bytes to the disk past the page cache, and files into memory.
//!
//! A buffered writer at 1.1 GB/s fills the page cache until the kernel makes the writer wait for seconds;
//! `O_DIRECT` keeps the pace of the disk. It wants addresses, offsets and lengths in multiples of
//! [`BLOCK`]. Where a file system refuses it, the same writes go through the page cache.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::Path;

/// Alignment of direct writes, bytes.
pub const BLOCK: usize = 4096;

/// Where a segment's bytes go. Offsets and lengths are multiples of [`BLOCK`], and so is the address.
pub trait Store: Send {
    /// Writes all of `bytes` at `offset`.
    fn write_at(&mut self, offset: u64, bytes: &[u8]) -> io::Result<()>;
    /// Cuts the file to its true length.
    fn set_len(&mut self, length: u64) -> io::Result<()>;
    /// Returns when everything written is on the medium (`fdatasync`).
    fn sync(&mut self) -> io::Result<()>;
}

/// A new file, written directly where that is possible.
pub struct DirectFile {
    file: File,
}

impl DirectFile {
    /// Creates the file; it must not exist.
    pub fn create(path: &Path) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).mode(0o640);
        match options.clone().custom_flags(libc::O_DIRECT).open(path) {
            Ok(file) => Ok(Self { file }),
            Err(error) if error.raw_os_error() == Some(libc::EINVAL) => {
                // Some file systems have created the file by the time they refuse the flag.
                let _ = std::fs::remove_file(path);
                tracing::warn!(
                    path = %path.display(),
                    "the file system refuses O_DIRECT; writing through the page cache, which may stall at full rate"
                );
                Ok(Self { file: options.open(path)? })
            }
            Err(error) => Err(error),
        }
    }
}

impl Store for DirectFile {
    fn write_at(&mut self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all_at(bytes, offset)
    }

    fn set_len(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.sync_data()
    }
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

    /// All of it.
    pub fn as_slice(&self) -> &[u8] {
        &self.memory[self.start..self.start + self.capacity]
    }

    /// All of it.
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

/// Maps a file for reading.
pub fn map_file(path: &Path) -> io::Result<memmap2::Mmap> {
    let file = File::open(path)?;
    // SAFETY: the mapping is only read. Recordings are append-only: a segment that is being written is cut
    // only inside its last page, which stays mapped, so no mapped page disappears. Bytes that change while
    // they are read (somebody else writes to the file) are covered by the checksums: everything read from a
    // recording is treated as untrusted.
    unsafe { memmap2::Mmap::map(&file) }
}

#[cfg(test)]
mod tests {
    use super::{AlignedBuffer, BLOCK, DirectFile, Store, free_bytes};

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
        file.write_at(0, AlignedBuffer::new(BLOCK).as_slice()).expect("one block");
        file.set_len(100).expect("a true length");
        file.sync().expect("synced");
        assert!(DirectFile::create(&path).is_err());
        assert_eq!(std::fs::metadata(&path).expect("a file").len(), 100);
        assert!(free_bytes(dir.path()).expect("a file system") > 0);
    }
}
