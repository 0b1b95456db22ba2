// SPDX-License-Identifier: MIT OR Apache-2.0
//! Real system calls on a mounted disk, as the recorder makes them.

use super::{DiskPlan, SimulatedDisk};
use crate::faults::{DiskFault, TruthLog, read_disk_truth};
use std::ffi::CString;
use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::Path;
use std::sync::Arc;

/// A disk with this plan; `None`, with the reason said, where there is no FUSE.
fn disk(dir: &Path, text: &str) -> Option<SimulatedDisk> {
    if let Some(reason) = SimulatedDisk::unavailable() {
        eprintln!("skipped: {reason}");
        return None;
    }
    let plan = DiskPlan::parse(&format!("[disk]\nseed = 1\n{text}")).expect("valid").expect("there");
    let truth = Arc::new(TruthLog::create(&dir.join("truth")).expect("writable"));
    let mounted = SimulatedDisk::mount(&plan, "a", &dir.join("backing"), &dir.join("disk"), Some(truth));
    Some(mounted.expect("it can be mounted"))
}

fn create(path: &Path) -> io::Result<File> {
    OpenOptions::new().write(true).create_new(true).custom_flags(libc::O_DIRECT).open(path)
}

/// Renames without replacing anything, as the recorder does.
fn rename_new(from: &Path, to: &Path) -> io::Result<()> {
    let name = |path: &Path| CString::new(path.as_os_str().as_bytes()).expect("no zero in it");
    let (old, new) = (name(from), name(to));
    // SAFETY: both are C strings that live for the duration of the call.
    let code = unsafe {
        libc::renameat2(libc::AT_FDCWD, old.as_ptr(), libc::AT_FDCWD, new.as_ptr(), libc::RENAME_NOREPLACE)
    };
    if code == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

/// A page of this byte, where `O_DIRECT` wants it.
#[repr(align(4096))]
struct Page([u8; 4096]);

fn errno<T>(result: io::Result<T>) -> Option<i32> {
    result.err().and_then(|e| e.raw_os_error())
}

#[test]
fn without_faults_it_is_a_directory_like_any_other() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let Some(disk) = disk(dir.path(), "") else { return };
    let root = disk.mount_point();
    std::fs::create_dir_all(root.join("s/node-a")).expect("directories");
    let next = root.join("s/node-a/.next");
    let file = create(&next).expect("a file");
    // SAFETY: the descriptor is open for the duration of the call.
    let code = unsafe { libc::fallocate(file.as_raw_fd(), libc::FALLOC_FL_KEEP_SIZE, 0, 1 << 20) };
    assert_eq!((code, file.metadata().expect("a file").len()), (0, 0));
    for n in 0..3 {
        file.write_all_at(&Page([n; 4096]).0, u64::from(n) * 4096).expect("written");
    }
    file.sync_data().expect("synced");
    let name = root.join("s/node-a/segment-000.mcap");
    rename_new(&next, &name).expect("renamed");
    file.set_len(9000).expect("cut");
    drop(file);
    assert_eq!(errno(create(&name)), Some(libc::EEXIST));
    // As files are written that must replace none.
    let linked = root.join("s/node-a/linked");
    std::fs::hard_link(&name, &linked).expect("linked");
    assert_eq!(errno(std::fs::hard_link(&name, &linked)), Some(libc::EEXIST));
    assert_eq!(std::fs::read(&linked).expect("readable").len(), 9000);
    std::fs::remove_file(&linked).expect("removed");
    assert_eq!(std::fs::metadata(&name).expect("there").len(), 9000);
    let other = create(&next).expect("another file");
    assert_eq!(errno(rename_new(&next, &name)), Some(libc::EEXIST));
    drop(other);
    std::fs::remove_file(&next).expect("removed");
    File::open(root.join("s")).and_then(|dir| dir.sync_all()).expect("a directory's names");

    for root in [root.to_owned(), dir.path().join("backing")] {
        let mut bytes = Vec::new();
        File::open(root.join("s/node-a/segment-000.mcap"))
            .and_then(|mut file| file.read_to_end(&mut bytes))
            .expect("readable");
        assert_eq!((bytes.len(), bytes[4095], bytes[8999]), (9000, 0, 2));
        let names: Vec<_> = std::fs::read_dir(root.join("s/node-a"))
            .expect("a directory")
            .map(|entry| entry.expect("an entry").file_name())
            .collect();
        assert_eq!(names, ["segment-000.mcap"]);
    }
    std::fs::remove_dir_all(root.join("s")).expect("removed");
    assert_eq!(std::fs::read_dir(dir.path().join("backing")).expect("a directory").count(), 0);
    assert_eq!(read_disk_truth(&dir.path().join("truth")), Ok(Vec::new()));
    drop(disk);
    assert_eq!(std::fs::read_dir(dir.path().join("disk")).expect("unmounted").count(), 0);
}

#[test]
fn the_caller_is_told_of_every_fault() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let plan = "[disk.full]\ncapacity_bytes = 40_960\n[[disk.error]]\non = \"sync\"\nnth = 2\n\
                [[disk.error]]\non = \"write\"\nnth = 8\nfor_good = true\n";
    let Some(disk) = disk(dir.path(), plan) else { return };
    let root = disk.mount_point();
    let free = || fourdbody::record::free_bytes(root).expect("a file system");
    assert_eq!(free(), 40_960);
    let file = create(&root.join("one")).expect("a file");
    let page = |n: u64| file.write_at(&Page([1; 4096]).0, n * 4096);
    assert!((0..3).all(|n| page(n).is_ok_and(|taken| taken == 4096)));
    file.sync_data().expect("the first is good");
    assert!((3..5).all(|n| page(n).is_ok()));
    assert_eq!(errno(file.sync_data()), Some(libc::EIO));
    assert_eq!(free(), 40_960 - 5 * 4096);
    let bytes = std::fs::read(root.join("one")).expect("readable");
    assert!(bytes[..3 * 4096].iter().all(|byte| *byte == 1), "what was synced is there");
    assert!(bytes[3 * 4096..].iter().all(|byte| *byte == 0), "the rest is gone");

    let two = create(&root.join("two")).expect("a file");
    #[repr(align(4096))]
    struct Much([u8; 40_960]);
    assert_eq!(two.write_at(&Much([2; 40_960]).0, 0).ok(), Some(5 * 4096), "what fits");
    assert_eq!(errno(two.write_at(&Much([2; 40_960]).0, 5 * 4096)), Some(libc::ENOSPC));
    assert_eq!(free(), 0);
    assert_eq!(errno(page(0)), Some(libc::EIO), "the eighth write");
    let gone = [
        errno(page(1)),
        errno(file.sync_data()),
        errno(file.set_len(0)),
        errno(create(&root.join("three"))),
        errno(std::fs::remove_file(root.join("two"))),
    ];
    assert_eq!(gone, [Some(libc::EIO); 5]);
    disk.repair();
    assert_eq!(errno(page(0)), None);
    let truth = read_disk_truth(&dir.path().join("truth")).expect("readable");
    let count = |kind| truth.iter().filter(|event| event.kind == kind).count();
    assert_eq!((count(DiskFault::Limited), count(DiskFault::Full)), (2, 2));
    assert_eq!(count(DiskFault::IoError), 7, "{truth:#?}");
    let sync = truth.iter().find(|event| event.operation == "sync").expect("the failed sync");
    assert_eq!((sync.number, sync.lost, sync.for_good), (2, 2 * 4096, false));
}
