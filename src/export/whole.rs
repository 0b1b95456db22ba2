//! Files that are never half there.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

/// Writes a file under a temporary name beside its place and renames it once its bytes are on the medium: whatever
/// happens meanwhile, what has the name is complete. The file is also open for reading.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<()> {
    let partial = partial_name(path);
    let options = File::options().read(true).write(true).create(true).truncate(true).open(&partial);
    let written = options.and_then(|mut file| {
        write(&mut file)?;
        file.sync_data()?;
        std::fs::rename(&partial, path)
    });
    if written.is_err() {
        // What has failed once may fail again; the next attempt starts anew in any case.
        let _ = std::fs::remove_file(&partial);
    }
    written
}

/// The temporary name.
fn partial_name(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".partial");
    name.into()
}

#[cfg(test)]
mod tests {
    use super::write_whole;
    use std::io::{self, Write};

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
}
