// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a file would lose if the power went now: what was written since its last good `fdatasync`.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

/// The ranges of one file that are not yet on the medium.
#[derive(Debug, Default)]
pub struct Unsynced {
    /// Length that is on the medium.
    durable: u64,
    /// End of what was written since.
    end: u64,
    /// What lay on the medium where it was written over, oldest first.
    before: Vec<(u64, Vec<u8>)>,
}

impl Unsynced {
    /// Call it before `length` bytes at `offset` are written.
    pub fn write(&mut self, file: &File, offset: u64, length: u64) -> io::Result<()> {
        let end = offset.saturating_add(length);
        if offset < self.durable {
            let covered = end.min(self.durable) - offset;
            let mut bytes = vec![0; usize::try_from(covered).unwrap_or(0)];
            file.read_exact_at(&mut bytes, offset)?;
            self.before.push((offset, bytes));
        }
        self.end = self.end.max(end);
        Ok(())
    }

    /// Notes a successful `fdatasync`: all is on the medium.
    pub fn sync(&mut self) {
        self.durable = self.durable.max(self.end);
        self.before.clear();
    }

    /// The file's length is set; that is as good as on the medium.
    pub fn cut(&mut self, length: u64) {
        self.durable = self.durable.min(length);
        self.end = self.end.min(length);
    }

    /// Takes away what is not on the medium, and leaves zeros; returns how many bytes were lost.
    pub fn lose(&mut self, file: &File) -> io::Result<u64> {
        let length = file.metadata()?.len();
        let end = self.end.min(length);
        let lost = end.saturating_sub(self.durable);
        let zeros = vec![0; 64 << 10];
        let mut at = self.durable;
        while at < end {
            let part = usize::try_from(end - at).unwrap_or(usize::MAX).min(zeros.len());
            file.write_all_at(&zeros[..part], at)?;
            at += part as u64;
        }
        for (offset, bytes) in std::mem::take(&mut self.before).iter().rev() {
            let inside = usize::try_from(length.saturating_sub(*offset)).unwrap_or(usize::MAX);
            file.write_all_at(&bytes[..bytes.len().min(inside)], *offset)?;
        }
        self.end = self.durable;
        Ok(lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_synced_is_gone_and_the_rest_is_as_before() {
        let file = tempfile::tempfile().expect("a file");
        let mut unsynced = Unsynced::default();
        let write = |unsynced: &mut Unsynced, offset: u64, bytes: &[u8]| {
            unsynced.write(&file, offset, bytes.len() as u64).expect("readable");
            file.write_all_at(bytes, offset).expect("writable");
        };
        write(&mut unsynced, 0, b"abcdef");
        unsynced.sync();
        write(&mut unsynced, 4, b"EFGH");
        write(&mut unsynced, 5, b"xx");
        assert_eq!(unsynced.lose(&file).expect("writable"), 2);
        let mut found = [9; 8];
        file.read_exact_at(&mut found, 0).expect("as long as before");
        assert_eq!(&found, b"abcdef\0\0");
        assert_eq!(unsynced.lose(&file).expect("writable"), 0, "nothing more to lose");
    }
}
