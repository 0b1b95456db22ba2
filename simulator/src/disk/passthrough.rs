// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file system: what lies in the backing directory, seen through a [`Medium`].
//!
//! Files opened for writing alone go past the kernel's page cache, so that every write of the program under test is
//! one call here and gets its answer. Nothing is cached by name or attribute: two disks may show the same directory.

use super::medium::{BLOCK, Medium};
use super::nodes::Nodes;
use super::plan::ReadFault;
use super::unsynced::Unsynced;
use crate::faults::{DiskEvent, DiskFault, TruthLog};
use fuser::{
    Errno, FileAttr, FileHandle, FileType, Filesystem, FopenFlags, Generation, INodeNo, LockOwner,
    OpenAccMode, OpenFlags, RenameFlags, ReplyAttr, ReplyCreate, ReplyData, ReplyDirectory, ReplyEmpty,
    ReplyEntry, ReplyOpen, ReplyStatfs, ReplyWrite, Request, TimeOrNow, WriteFlags,
};
use std::collections::HashMap;
use std::ffi::{CString, OsStr, OsString};
use std::fs::{DirBuilder, File, Metadata, OpenOptions};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, FileExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

/// How long the kernel may keep names and attributes: it requests them every time.
const NO_CACHE: Duration = Duration::ZERO;

/// A file that the kernel has opened.
#[derive(Debug, Clone)]
struct Open {
    node: u64,
    file: Arc<File>,
}

#[derive(Debug)]
struct State {
    nodes: Nodes,
    files: HashMap<u64, Open>,
    listings: HashMap<u64, Vec<(u64, FileType, OsString)>>,
    next_handle: u64,
    medium: Medium,
    unsynced: HashMap<u64, Unsynced>,
}

/// What all requests share, and what the owner of the disk may ask.
#[derive(Debug)]
pub struct Shared {
    root: PathBuf,
    node: String,
    fallocate: bool,
    truth: Option<Arc<TruthLog>>,
    unreadable: Mutex<Vec<ReadFault>>,
    state: Mutex<State>,
}

type Answer<T> = Result<T, Errno>;

impl Shared {
    /// The disk of `node`, which shows `root`.
    pub fn new(
        root: PathBuf,
        node: &str,
        medium: Medium,
        fallocate: bool,
        truth: Option<Arc<TruthLog>>,
    ) -> Self {
        let state = State {
            nodes: Nodes::new(),
            files: HashMap::new(),
            listings: HashMap::new(),
            next_handle: 1,
            medium,
            unsynced: HashMap::new(),
        };
        let (unreadable, state) = (Mutex::new(Vec::new()), Mutex::new(state));
        Self { root, node: node.to_owned(), fallocate, truth, unreadable, state }
    }

    /// There is no room any more.
    pub fn fill(&self) {
        self.lock().medium.fill();
    }

    /// Ends all faults: from now on every call succeeds.
    pub fn repair(&self) {
        self.lock().medium.repair();
        self.set_unreadable(Vec::new());
    }

    /// What cannot be read from now on; files that are open already are concerned as well.
    pub fn set_unreadable(&self, faults: Vec<ReadFault>) {
        *self.unreadable.lock().unwrap_or_else(PoisonError::into_inner) = faults;
    }

    /// Fails as a whole for one bad byte; then the kernel asks for single pages.
    fn read(&self, handle: FileHandle, offset: u64, size: u32) -> Answer<Vec<u8>> {
        let Open { node, file } = self.open(handle)?;
        let path = self.lock().nodes.path(node).map(Path::to_owned).unwrap_or_default();
        let end = offset.saturating_add(u64::from(size));
        let concerns = |fault: &ReadFault| {
            Path::new(&fault.path) == path && fault.from < end && fault.to.is_none_or(|to| to > offset)
        };
        if self.unreadable.lock().unwrap_or_else(PoisonError::into_inner).iter().any(concerns) {
            self.note(&path, DiskFault::IoError, "read", |event| {
                (event.offset, event.bytes) = (offset, u64::from(size));
            });
            return Err(Errno::EIO);
        }
        let mut bytes = vec![0; size as usize];
        let mut filled = 0;
        while filled < bytes.len() {
            match file.read_at(&mut bytes[filled..], offset + filled as u64)? {
                0 => break,
                more => filled += more,
            }
        }
        bytes.truncate(filled);
        Ok(bytes)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The path of an inode below the root.
    fn path(&self, node: INodeNo) -> Answer<PathBuf> {
        self.lock().nodes.path(node.0).map(Path::to_owned).ok_or(Errno::ENOENT)
    }

    fn child(&self, parent: INodeNo, name: &OsStr) -> Answer<PathBuf> {
        Ok(self.path(parent)?.join(name))
    }

    fn open(&self, handle: FileHandle) -> Answer<Open> {
        self.lock().files.get(&handle.0).cloned().ok_or(Errno::EBADF)
    }

    fn attributes(&self, node: u64, metadata: &Metadata) -> FileAttr {
        let time = |seconds: i64, nanoseconds: i64| {
            let since = Duration::new(
                u64::try_from(seconds).unwrap_or(0),
                u32::try_from(nanoseconds).unwrap_or(0).min(999_999_999),
            );
            SystemTime::UNIX_EPOCH + since
        };
        let held = self.lock().medium.held(node);
        FileAttr {
            ino: INodeNo(node),
            size: metadata.size(),
            blocks: if held > 0 { held / 512 } else { metadata.blocks() },
            atime: time(metadata.atime(), metadata.atime_nsec()),
            mtime: time(metadata.mtime(), metadata.mtime_nsec()),
            ctime: time(metadata.ctime(), metadata.ctime_nsec()),
            crtime: SystemTime::UNIX_EPOCH,
            kind: kind_of(metadata),
            perm: u16::try_from(metadata.mode() & 0o7777).unwrap_or(0o600),
            nlink: u32::try_from(metadata.nlink()).unwrap_or(u32::MAX),
            uid: metadata.uid(),
            gid: metadata.gid(),
            rdev: 0,
            blksize: BLOCK as u32,
            flags: 0,
        }
    }

    /// The attributes of a path, which gets a number if it has none.
    fn entry(&self, path: &Path) -> Answer<FileAttr> {
        let metadata = std::fs::symlink_metadata(self.root.join(path))?;
        let node = self.lock().nodes.number(path);
        Ok(self.attributes(node, &metadata))
    }

    fn attributes_of(&self, node: INodeNo, handle: Option<FileHandle>) -> Answer<FileAttr> {
        if let Some(open) = handle.and_then(|handle| self.open(handle).ok()) {
            return Ok(self.attributes(node.0, &open.file.metadata()?));
        }
        self.entry(&self.path(node)?)
    }

    /// A disk that is gone changes nothing any more.
    fn changeable(&self, path: &Path, operation: &str) -> Answer<()> {
        if !self.lock().medium.is_gone() {
            return Ok(());
        }
        self.note(path, DiskFault::IoError, operation, |_| {});
        Err(Errno::EIO)
    }

    fn note(&self, path: &Path, kind: DiskFault, operation: &str, details: impl FnOnce(&mut DiskEvent)) {
        let Some(truth) = &self.truth else { return };
        let mut event = DiskEvent::new(&self.node, path, kind, operation);
        event.for_good = self.lock().medium.is_gone();
        details(&mut event);
        truth.write_down(&event);
    }

    fn opened(&self, node: u64, file: File) -> FileHandle {
        let mut state = self.lock();
        let handle = state.next_handle;
        state.next_handle += 1;
        state.files.insert(handle, Open { node, file: Arc::new(file) });
        FileHandle(handle)
    }

    fn create(&self, parent: INodeNo, name: &OsStr, mode: u32, flags: i32) -> Answer<(FileAttr, FileHandle)> {
        let path = self.child(parent, name)?;
        self.changeable(&path, "create")?;
        let mut options = OpenOptions::new();
        // What is written over may have to be read, see `Unsynced`.
        options.read(true).write(true).mode(mode).create(true).create_new(flags & libc::O_EXCL != 0);
        let file = options.open(self.root.join(&path))?;
        let attributes = self.entry(&path)?;
        Ok((attributes, self.opened(attributes.ino.0, file)))
    }

    fn write(&self, handle: FileHandle, offset: u64, data: &[u8]) -> Answer<u32> {
        let Open { node, file } = self.open(handle)?;
        let (outcome, path) = {
            let mut state = self.lock();
            let outcome = state.medium.write(node, offset, data.len() as u64, Instant::now());
            (outcome, state.nodes.path(node).map(Path::to_owned).unwrap_or_default())
        };
        let details = |event: &mut DiskEvent| {
            event.number = outcome.number;
            (event.offset, event.bytes, event.taken) = (offset, data.len() as u64, outcome.taken);
        };
        if outcome.limited {
            self.note(&path, DiskFault::Limited, "write", details);
        }
        if outcome.first_delay {
            self.note(&path, DiskFault::Slow, "write", details);
        }
        std::thread::sleep(outcome.delay);
        let taken = usize::try_from(outcome.taken).unwrap_or(0).min(data.len());
        self.lock().unsynced.entry(node).or_default().write(&file, offset, outcome.taken)?;
        file.write_all_at(&data[..taken], offset)?;
        if outcome.full {
            self.note(&path, DiskFault::Full, "write", details);
        }
        match outcome.errno {
            Some(libc::EIO) => {
                self.lose_if_gone();
                self.note(&path, DiskFault::IoError, "write", details);
                Err(Errno::EIO)
            }
            Some(errno) => Err(Errno::from_i32(errno)),
            None => Ok(u32::try_from(taken).unwrap_or(u32::MAX)),
        }
    }

    fn sync(&self, handle: FileHandle) -> Answer<()> {
        let Open { node, file } = self.open(handle)?;
        let mut state = self.lock();
        let (number, fails) = state.medium.sync();
        let unsynced = state.unsynced.entry(node).or_default();
        if !fails {
            unsynced.sync();
            return Ok(());
        }
        let lost = unsynced.lose(&file)?;
        let path = state.nodes.path(node).map(Path::to_owned).unwrap_or_default();
        drop(state);
        self.lose_if_gone();
        self.note(&path, DiskFault::IoError, "sync", |event| (event.number, event.lost) = (number, lost));
        Err(Errno::EIO)
    }

    /// With the disk goes what was only in its cache.
    fn lose_if_gone(&self) {
        let mut state = self.lock();
        if !state.medium.is_gone() {
            return;
        }
        let state = &mut *state;
        for open in state.files.values() {
            let lost = state.unsynced.get_mut(&open.node).map_or(Ok(0), |unsynced| unsynced.lose(&open.file));
            if let Err(error) = lost {
                tracing::error!(%error, "the backing file of a simulated disk cannot be written");
            }
        }
    }

    fn set_length(&self, node: INodeNo, handle: Option<FileHandle>, length: u64) -> Answer<()> {
        let path = self.path(node).unwrap_or_default();
        self.changeable(&path, "truncate")?;
        match handle.and_then(|handle| self.open(handle).ok()) {
            Some(open) => open.file.set_len(length)?,
            None => OpenOptions::new().write(true).open(self.root.join(&path))?.set_len(length)?,
        }
        let mut state = self.lock();
        state.medium.cut(node.0, length);
        state.unsynced.entry(node.0).or_default().cut(length);
        Ok(())
    }

    fn set_aside(&self, handle: FileHandle, offset: u64, length: u64, mode: i32) -> Answer<()> {
        // Only what the recorder asks for: room, without a change to the length.
        if !self.fallocate || mode != libc::FALLOC_FL_KEEP_SIZE {
            return Err(Errno::EOPNOTSUPP);
        }
        let node = self.open(handle)?.node;
        let mut state = self.lock();
        if state.medium.is_gone() {
            return Err(Errno::EIO);
        }
        let enough = state.medium.set_aside(node, offset.saturating_add(length));
        if enough { Ok(()) } else { Err(Errno::ENOSPC) }
    }

    fn remove(&self, parent: INodeNo, name: &OsStr, directory: bool) -> Answer<()> {
        let path = self.child(parent, name)?;
        self.changeable(&path, "remove")?;
        let full = self.root.join(&path);
        let removed = if directory { std::fs::remove_dir(full) } else { std::fs::remove_file(full) };
        removed?;
        let mut state = self.lock();
        if let Some(node) = state.nodes.remove(&path) {
            state.medium.cut(node, 0);
        }
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path, flags: RenameFlags) -> Answer<()> {
        self.changeable(from, "rename")?;
        let name = |path: &Path| CString::new(self.root.join(path).as_os_str().as_bytes());
        let (Ok(old), Ok(new)) = (name(from), name(to)) else { return Err(Errno::EINVAL) };
        // SAFETY: both are C strings that live for the duration of the call.
        let code = unsafe {
            libc::renameat2(libc::AT_FDCWD, old.as_ptr(), libc::AT_FDCWD, new.as_ptr(), flags.bits())
        };
        if code != 0 {
            return Err(io::Error::last_os_error().into());
        }
        let mut state = self.lock();
        if let Some(replaced) = state.nodes.rename(from, to) {
            state.medium.cut(replaced, 0);
        }
        Ok(())
    }

    fn list(&self, node: INodeNo) -> Answer<FileHandle> {
        let path = self.path(node)?;
        let mut entries = vec![(node.0, FileType::Directory, OsString::from("."))];
        entries.push((node.0, FileType::Directory, OsString::from("..")));
        for entry in std::fs::read_dir(self.root.join(&path))? {
            let entry = entry?;
            let kind = FileType::from_std(entry.file_type()?).unwrap_or(FileType::RegularFile);
            let number = self.lock().nodes.number(&path.join(entry.file_name()));
            entries.push((number, kind, entry.file_name()));
        }
        let mut state = self.lock();
        let handle = state.next_handle;
        state.next_handle += 1;
        state.listings.insert(handle, entries);
        Ok(FileHandle(handle))
    }

    /// Blocks in all and free.
    fn room(&self) -> (u64, u64) {
        match self.lock().medium.room() {
            Some((all, free)) => (all / BLOCK, free / BLOCK),
            None => {
                let free = fourdbody::record::free_bytes(&self.root).unwrap_or(0) / BLOCK;
                (free, free)
            }
        }
    }
}

fn kind_of(metadata: &Metadata) -> FileType {
    FileType::from_std(metadata.file_type()).unwrap_or(FileType::RegularFile)
}

/// The file system that answers the kernel's requests.
pub struct Passthrough(pub Arc<Shared>);

macro_rules! answer {
    ($reply:ident, $result:expr, $good:expr) => {
        match $result {
            Ok(value) => $good(value),
            Err(errno) => $reply.error(errno),
        }
    };
}

impl Filesystem for Passthrough {
    fn lookup(&self, _: &Request, parent: INodeNo, name: &OsStr, reply: ReplyEntry) {
        let found = self.0.child(parent, name).and_then(|path| self.0.entry(&path));
        answer!(reply, found, |attributes| reply.entry(&NO_CACHE, &attributes, Generation(0)));
    }

    fn getattr(&self, _: &Request, ino: INodeNo, fh: Option<FileHandle>, reply: ReplyAttr) {
        answer!(reply, self.0.attributes_of(ino, fh), |attributes| reply.attr(&NO_CACHE, &attributes));
    }

    fn setattr(
        &self,
        _: &Request,
        ino: INodeNo,
        mode: Option<u32>,
        _: Option<u32>,
        _: Option<u32>,
        size: Option<u64>,
        _: Option<TimeOrNow>,
        _: Option<TimeOrNow>,
        _: Option<SystemTime>,
        fh: Option<FileHandle>,
        _: Option<SystemTime>,
        _: Option<SystemTime>,
        _: Option<SystemTime>,
        _: Option<fuser::BsdFileFlags>,
        reply: ReplyAttr,
    ) {
        let cut = size.map_or(Ok(()), |size| self.0.set_length(ino, fh, size));
        let changed = cut.and_then(|()| match mode {
            Some(mode) => {
                let path = self.0.root.join(self.0.path(ino)?);
                Ok(std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode & 0o7777))?)
            }
            None => Ok(()),
        });
        let result = changed.and_then(|()| self.0.attributes_of(ino, fh));
        answer!(reply, result, |attributes| reply.attr(&NO_CACHE, &attributes));
    }

    fn mkdir(&self, _: &Request, parent: INodeNo, name: &OsStr, mode: u32, _: u32, reply: ReplyEntry) {
        let made = self.0.child(parent, name).and_then(|path| {
            self.0.changeable(&path, "mkdir")?;
            DirBuilder::new().mode(mode).create(self.0.root.join(&path))?;
            self.0.entry(&path)
        });
        answer!(reply, made, |attributes| reply.entry(&NO_CACHE, &attributes, Generation(0)));
    }

    // The room of a second name is not counted: programs link a whole file, and remove its first name.
    fn link(&self, _: &Request, ino: INodeNo, newparent: INodeNo, newname: &OsStr, reply: ReplyEntry) {
        let linked = self.0.path(ino).and_then(|from| {
            let to = self.0.child(newparent, newname)?;
            self.0.changeable(&to, "link")?;
            std::fs::hard_link(self.0.root.join(from), self.0.root.join(&to))?;
            self.0.entry(&to)
        });
        answer!(reply, linked, |attributes| reply.entry(&NO_CACHE, &attributes, Generation(0)));
    }

    fn unlink(&self, _: &Request, parent: INodeNo, name: &OsStr, reply: ReplyEmpty) {
        answer!(reply, self.0.remove(parent, name, false), |()| reply.ok());
    }

    fn rmdir(&self, _: &Request, parent: INodeNo, name: &OsStr, reply: ReplyEmpty) {
        answer!(reply, self.0.remove(parent, name, true), |()| reply.ok());
    }

    fn rename(
        &self,
        _: &Request,
        parent: INodeNo,
        name: &OsStr,
        newparent: INodeNo,
        newname: &OsStr,
        flags: RenameFlags,
        reply: ReplyEmpty,
    ) {
        let paths = self.0.child(parent, name).and_then(|from| Ok((from, self.0.child(newparent, newname)?)));
        let result = paths.and_then(|(from, to)| self.0.rename(&from, &to, flags));
        answer!(reply, result, |()| reply.ok());
    }

    fn open(&self, _: &Request, ino: INodeNo, flags: OpenFlags, reply: ReplyOpen) {
        let writes = flags.acc_mode() != OpenAccMode::O_RDONLY;
        let opened = self.0.path(ino).and_then(|path| {
            let file = OpenOptions::new().read(true).write(writes).open(self.0.root.join(path))?;
            Ok(self.0.opened(ino.0, file))
        });
        answer!(reply, opened, |handle| reply.opened(handle, way(flags.acc_mode())));
    }

    fn create(
        &self,
        _: &Request,
        parent: INodeNo,
        name: &OsStr,
        mode: u32,
        _: u32,
        flags: i32,
        reply: ReplyCreate,
    ) {
        answer!(reply, self.0.create(parent, name, mode, flags), |(attributes, handle)| {
            let way = way(OpenFlags(flags).acc_mode());
            reply.created(&NO_CACHE, &attributes, Generation(0), handle, way);
        });
    }

    fn read(
        &self,
        _: &Request,
        _: INodeNo,
        fh: FileHandle,
        offset: u64,
        size: u32,
        _: OpenFlags,
        _: Option<LockOwner>,
        reply: ReplyData,
    ) {
        let read = self.0.read(fh, offset, size);
        answer!(reply, read, |bytes: Vec<u8>| reply.data(&bytes));
    }

    fn write(
        &self,
        _: &Request,
        _: INodeNo,
        fh: FileHandle,
        offset: u64,
        data: &[u8],
        _: WriteFlags,
        _: OpenFlags,
        _: Option<LockOwner>,
        reply: ReplyWrite,
    ) {
        answer!(reply, self.0.write(fh, offset, data), |taken| reply.written(taken));
    }

    fn flush(&self, _: &Request, _: INodeNo, _: FileHandle, _: LockOwner, reply: ReplyEmpty) {
        reply.ok();
    }

    fn release(
        &self,
        _: &Request,
        _: INodeNo,
        fh: FileHandle,
        _: OpenFlags,
        _: Option<LockOwner>,
        _: bool,
        reply: ReplyEmpty,
    ) {
        self.0.lock().files.remove(&fh.0);
        reply.ok();
    }

    fn fsync(&self, _: &Request, _: INodeNo, fh: FileHandle, _: bool, reply: ReplyEmpty) {
        answer!(reply, self.0.sync(fh), |()| reply.ok());
    }

    fn fallocate(
        &self,
        _: &Request,
        _: INodeNo,
        fh: FileHandle,
        offset: u64,
        length: u64,
        mode: i32,
        reply: ReplyEmpty,
    ) {
        answer!(reply, self.0.set_aside(fh, offset, length, mode), |()| reply.ok());
    }

    fn opendir(&self, _: &Request, ino: INodeNo, _: OpenFlags, reply: ReplyOpen) {
        answer!(reply, self.0.list(ino), |handle| reply.opened(handle, FopenFlags::empty()));
    }

    fn readdir(&self, _: &Request, _: INodeNo, fh: FileHandle, offset: u64, mut reply: ReplyDirectory) {
        let state = self.0.lock();
        let Some(entries) = state.listings.get(&fh.0) else { return reply.error(Errno::EBADF) };
        let from = usize::try_from(offset).unwrap_or(usize::MAX);
        for (place, (number, kind, name)) in (1u64..).zip(entries).skip(from) {
            if reply.add(INodeNo(*number), place, *kind, name) {
                break;
            }
        }
        reply.ok();
    }

    fn releasedir(&self, _: &Request, _: INodeNo, fh: FileHandle, _: OpenFlags, reply: ReplyEmpty) {
        self.0.lock().listings.remove(&fh.0);
        reply.ok();
    }

    fn fsyncdir(&self, _: &Request, ino: INodeNo, _: FileHandle, _: bool, reply: ReplyEmpty) {
        // Names are on the medium at once.
        let path = self.0.path(ino).unwrap_or_default();
        answer!(reply, self.0.changeable(&path, "sync"), |()| reply.ok());
    }

    fn statfs(&self, _: &Request, _: INodeNo, reply: ReplyStatfs) {
        let (blocks, free) = self.0.room();
        reply.statfs(blocks, free, free, 1 << 20, 1 << 20, BLOCK as u32, 255, BLOCK as u32);
    }
}

/// Writers go past the page cache.
fn way(access: OpenAccMode) -> FopenFlags {
    match access {
        OpenAccMode::O_WRONLY => FopenFlags::FOPEN_DIRECT_IO,
        OpenAccMode::O_RDONLY | OpenAccMode::O_RDWR => FopenFlags::empty(),
    }
}
