// SPDX-License-Identifier: MIT OR Apache-2.0
//! The one way to open a file that another program may have made: a regular file, of a bounded size, without waiting.
//!
//! Sessions, results and archives lie in directories that others may write to. Whatever has the name there (a device
//! without an end, a pipe without a writer, a socket, a sparse file of a terabyte), opening it costs no memory and no
//! time. `tests/it/architecture.rs` keeps the program from opening files in another way.

use std::fs::{File, FileType, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};
use std::path::Path;

/// The most bytes of a text that people write: configurations, artwork, lists.
pub const TEXT_BYTES: u64 = 4 << 20;

/// The most bytes of what a program writes about a session or a calibration: jobs, states, keys, calibrations.
pub const STATEMENT_BYTES: u64 = 64 << 20;

/// The most bytes of what is written about every frame of a session: summaries, timings. A million frames take 200 MB.
pub const SUMMARY_BYTES: u64 = 1 << 30;

/// Opens a regular file, or a link to one, for reading.
///
/// # Errors
/// What the system reports, or what is there instead of a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    open_with(path, OpenOptions::new().read(true))
}

/// Opens a regular file for writing, or makes one with this mode: a log that is appended to.
///
/// # Errors
/// As [`open`].
pub fn append(path: &Path, mode: u32) -> io::Result<File> {
    open_with(path, OpenOptions::new().append(true).create(true).mode(mode))
}

/// Makes a new file in place of what has the name. A file that a link of this name led to keeps its bytes: it may be
/// a recording.
///
/// # Errors
/// What the system reports; a directory stays.
pub fn create(path: &Path) -> io::Result<File> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    File::create_new(path)
}

/// Opens a regular file in order to lock it, or makes one; its bytes stay.
///
/// # Errors
/// As [`open`].
pub fn lock_file(path: &Path) -> io::Result<File> {
    open_with(path, OpenOptions::new().write(true).create(true))
}

/// The bytes of a regular file that has no more than `most`.
///
/// # Errors
/// As [`open`]; or the file is larger, or grows beyond it while it is read.
pub fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let file = open(path)?;
    let metadata = file.metadata()?;
    let length = metadata.len();
    let too_large = |found: String| {
        let message = format!("expected at most {most} bytes, found {found}; it is not what belongs there");
        io::Error::new(io::ErrorKind::FileTooLarge, message)
    };
    if length > most {
        return Err(too_large(length.to_string()));
    }
    // A sparse file takes no room on the disk, and all of the reader's memory. A file system that compresses needs at
    // least a tenth of a text's length, so that the limit of a 256th spares its files.
    let held = metadata.blocks().saturating_mul(512);
    if length > 1 << 20 && held.saturating_mul(256) < length {
        let message =
            format!("expected a file that was written, found {length} bytes of which the disk has {held}");
        return Err(io::Error::new(io::ErrorKind::InvalidData, message));
    }
    let mut bytes = Vec::with_capacity(usize::try_from(length).map_err(io::Error::other)?);
    file.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    match bytes.len() as u64 > most {
        true => Err(too_large("more, and it grows".to_owned())),
        false => Ok(bytes),
    }
}

/// As [`read`], as text.
///
/// # Errors
/// As [`read`]; or it is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read(path, most)?).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        io::Error::new(io::ErrorKind::InvalidData, format!("expected UTF-8 text, found another byte at {at}"))
    })
}

fn open_with(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    // Opening a device may already do something to it, so it is not even tried. A file that is to be made is not there.
    match std::fs::metadata(path) {
        Ok(found) => expect_regular(found.file_type())?,
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    // A pipe may have taken the name meanwhile: opening it without O_NONBLOCK would wait for a writer.
    let file = options.custom_flags(libc::O_NONBLOCK | libc::O_NOCTTY).open(path)?;
    expect_regular(file.metadata()?.file_type())?;
    Ok(file)
}

/// Refuses what is no regular file.
///
/// # Errors
/// What it is instead.
pub fn expect_regular(kind: FileType) -> io::Result<()> {
    let found = match kind {
        _ if kind.is_file() => return Ok(()),
        _ if kind.is_dir() => "a directory",
        _ if kind.is_fifo() => "a pipe",
        _ if kind.is_socket() => "a socket",
        _ => "a device",
    };
    Err(io::Error::new(io::ErrorKind::InvalidInput, format!("expected a regular file, found {found}")))
}

#[cfg(test)]
mod tests {
    use super::{append, create, lock_file, open, read, read_text};
    use std::io::{self, Read, Write};
    use std::os::unix::ffi::OsStrExt;
    use std::path::{Path, PathBuf};

    /// Everything that may lie under a file's name and is none, each with what is named in the refusal.
    fn none_of_them(dir: &Path) -> Vec<(PathBuf, &'static str)> {
        let at = |name: &str| dir.join(name);
        std::fs::create_dir(at("directory")).expect("made");
        let pipe = std::ffi::CString::new(at("pipe").as_os_str().as_bytes()).expect("no zero in it");
        // SAFETY: a C string that lives for the duration of the call.
        assert_eq!(unsafe { libc::mkfifo(pipe.as_ptr(), 0o600) }, 0);
        std::os::unix::net::UnixListener::bind(at("socket")).expect("made");
        for (name, to) in [("zero", "/dev/zero"), ("tty", "/dev/tty"), ("link", "pipe"), ("dir", "directory")]
        {
            std::os::unix::fs::symlink(to, at(name)).expect("made");
        }
        [
            ("directory", "a directory"),
            ("dir", "a directory"),
            ("pipe", "a pipe"),
            ("link", "a pipe"),
            ("socket", "a socket"),
            ("zero", "a device"),
            ("tty", "a device"),
        ]
        .map(|(name, what)| (at(name), what))
        .to_vec()
    }

    #[test]
    fn what_is_no_regular_file_is_refused_by_name_and_not_waited_for() {
        let dir = tempfile::tempdir().expect("a directory");
        for (path, what) in none_of_them(dir.path()) {
            let refused = |result: io::Result<()>| {
                let error = result.expect_err("no file").to_string();
                assert!(
                    error.contains("expected a regular file") && error.contains(what),
                    "{path:?}: {error}"
                );
            };
            refused(open(&path).map(drop));
            refused(read(&path, 10).map(drop));
            refused(read_text(&path, 10).map(drop));
            refused(append(&path, 0o600).map(drop));
            refused(lock_file(&path).map(drop));
        }
        assert_eq!(open(&dir.path().join("none")).expect_err("nothing").kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn what_is_read_is_bounded_however_large_the_file_calls_itself() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("sparse");
        std::fs::File::create(&path).and_then(|file| file.set_len(1 << 40)).expect("made");
        let error = read(&path, 1000).expect_err("too large");
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        assert!(error.to_string().contains("expected at most 1000 bytes, found 1099511627776"), "{error}");
        let error = read(&path, u64::MAX).expect_err("nothing but holes");
        assert!(error.to_string().contains("of which the disk has 0"), "{error}");
        // A file of the kernel's calls itself empty.
        let mounts = Path::new("/proc/self/mounts");
        assert!(!read(mounts, 1 << 20).expect("readable").is_empty());
        assert_eq!(read(mounts, 3).expect_err("more").kind(), io::ErrorKind::FileTooLarge);
        std::fs::write(&path, "four").expect("written");
        assert_eq!((read(&path, 4).expect("fits"), read(&path, 3).is_err()), (b"four".to_vec(), true));
        std::fs::write(&path, [b'a', 0xff]).expect("written");
        assert_eq!(read_text(&path, 9).expect_err("no text").kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn what_is_made_is_made_and_what_is_locked_or_appended_to_keeps_its_bytes() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("log");
        for word in [b"one", b"two"] {
            append(&path, 0o600).and_then(|mut file| file.write_all(word)).expect("written");
        }
        lock_file(&path).expect("there");
        let mut text = String::new();
        open(&path).and_then(|mut file| file.read_to_string(&mut text)).expect("readable");
        assert_eq!(text, "onetwo");
        let link = dir.path().join("link");
        for hard in [false, true] {
            match hard {
                true => std::fs::hard_link(&path, &link).expect("linked"),
                false => std::os::unix::fs::symlink(&path, &link).expect("linked"),
            }
            create(&link).and_then(|mut file| file.write_all(b"three")).expect("made anew");
            assert_eq!(read(&link, 9).expect("readable"), b"three");
            std::fs::remove_file(&link).expect("there");
        }
        assert_eq!(read(&path, 9).expect("readable"), b"onetwo", "what a link led to is as it was");
        for (path, what) in none_of_them(dir.path()) {
            assert_eq!(create(&path).is_err(), path.is_dir(), "{what}: {}", path.display());
        }
    }
}
