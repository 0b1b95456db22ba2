// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frame memory: page-aligned blocks, mapped, locked and touched before a session, returned by dropping.
//!
//! A block holds room for the message envelope, then the pixels, so that a frame is written to disk from
//! where the camera layer received it. Its pixels start on a page boundary. The node's [`Pool`] cuts blocks out of
//! few large mappings, on huge pages where the kernel gives them, and keeps them from session to session: blocks of
//! an ended stream go to its shelf, those that are still out with frames when they are dropped.

use super::realtime::{limit_text, soft_limit, warn};
use crossbeam_channel::Sender;
use std::fmt;
use std::io;
use std::ptr::NonNull;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

/// Bytes kept before the pixels: one page, of which the envelope uses the end.
pub const ROOM_BYTES: usize = 4096;

/// Size and alignment of a huge page on x86-64 and on arm64 with 4 KiB pages.
const HUGE_PAGE: usize = 2 << 20;

/// An anonymous mapping that one or several blocks share; it is unmapped when the last of them is dropped.
#[derive(Debug)]
struct Region {
    /// Address at which the blocks begin: a page, or a huge page where there is room for one.
    memory: NonNull<u8>,
    /// Address at which the mapping begins, and its length.
    start: NonNull<u8>,
    length: usize,
}

// SAFETY: a region's memory is reached through its blocks only, each of which has bytes of its own.
unsafe impl Send for Region {}
// SAFETY: as above; the region itself gives no access.
unsafe impl Sync for Region {}

impl Region {
    /// Maps memory of zeros; from a huge page on it starts on a huge page's boundary.
    fn map(bytes: usize) -> io::Result<Self> {
        let align = if bytes < HUGE_PAGE { ROOM_BYTES } else { HUGE_PAGE };
        let whole = bytes.checked_next_multiple_of(align);
        let length = whole.and_then(|whole| whole.checked_add(align)).ok_or(io::ErrorKind::OutOfMemory)?;
        let protection = libc::PROT_READ | libc::PROT_WRITE;
        let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS;
        // SAFETY: a fresh anonymous mapping at an address of the kernel's choice touches nothing that exists.
        let start = unsafe { libc::mmap(std::ptr::null_mut(), length, protection, flags, -1, 0) };
        let start =
            NonNull::new(start.cast::<u8>()).filter(|start| start.as_ptr().cast() != libc::MAP_FAILED);
        let start = start.ok_or_else(io::Error::last_os_error)?;
        let offset = start.as_ptr().align_offset(align);
        // SAFETY: the offset is less than the alignment, by which the mapping is longer than what is used of it.
        let memory = unsafe { start.add(offset) };
        if align == HUGE_PAGE {
            // SAFETY: the range lies in the mapping just made; the advice changes how it is backed, not what it holds.
            // A kernel without huge pages refuses it, and ordinary pages serve.
            unsafe { libc::madvise(memory.as_ptr().cast(), length - align, libc::MADV_HUGEPAGE) };
        }
        Ok(Self { memory, start, length })
    }

    /// Locks the pages in memory.
    fn lock(&self, bytes: usize) -> io::Result<()> {
        // SAFETY: the range lies in the region; locking changes nothing that it holds.
        match unsafe { libc::mlock(self.memory.as_ptr().cast(), bytes) } {
            0 => Ok(()),
            _ => Err(io::Error::last_os_error()),
        }
    }
}

impl Drop for Region {
    fn drop(&mut self) {
        // SAFETY: mapped in `map` with this start and length, and no block is left. It also unlocks.
        unsafe { libc::munmap(self.start.as_ptr().cast(), self.length) };
    }
}

/// Blocks that no stream has.
type Shelf = Mutex<Vec<Block>>;

fn open(shelf: &Shelf) -> MutexGuard<'_, Vec<Block>> {
    // Only whole blocks are pushed and taken under the lock: what a panic left is whole.
    shelf.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A node's frame blocks, in use and not. Clones share them.
///
/// The node makes one when it starts and keeps it until it ends: blocks are lent to streams, and come back to its shelf
/// when they are dropped. So a session allocates nothing that an earlier one has left.
#[derive(Debug, Clone)]
pub struct Pool {
    shelf: Arc<Shelf>,
    lock: bool,
    /// Bytes that the node needs in all, for the warning.
    needed: u64,
}

impl Pool {
    /// An empty pool. With `lock`, memory is locked where the system permits; `needed_bytes` is what the whole node
    /// will take ([`block_bytes`] for each block), for the warning where it does not.
    pub fn new(lock: bool, needed_bytes: u64) -> Self {
        Self { shelf: Arc::default(), lock, needed: needed_bytes }
    }

    /// `count` blocks for `pixel_bytes` of pixels each that come as `received_bytes`, which may be more: those of
    /// earlier sessions first, then fresh ones, all touched. Kept blocks of other sizes are freed.
    ///
    /// # Errors
    /// The system has no memory for them; a camera that comes back during a session then stays away, and the others go on.
    pub fn take(&self, pixel_bytes: usize, received_bytes: usize, count: usize) -> io::Result<Vec<Block>> {
        let sizes = Sizes::new(pixel_bytes, received_bytes);
        let (mut blocks, others): (Vec<Block>, Vec<Block>) = {
            let mut shelf = open(&self.shelf);
            shelf.drain(..).partition(|block| block.sizes == sizes)
        };
        drop(others);
        let surplus = blocks.split_off(count.min(blocks.len()));
        open(&self.shelf).extend(surplus);
        let missing = count - blocks.len();
        if missing > 0 {
            match self.make(sizes, missing) {
                Ok(made) => blocks.extend(made),
                Err(error) => {
                    open(&self.shelf).extend(blocks);
                    return Err(error);
                }
            }
        }
        for block in &mut blocks {
            block.shelf = Some(Arc::downgrade(&self.shelf));
        }
        Ok(blocks)
    }

    /// Bytes of the blocks that no stream has.
    pub fn idle_bytes(&self) -> u64 {
        open(&self.shelf).iter().map(|block| block.sizes.in_memory() as u64).sum()
    }

    /// Gives the memory of blocks that no stream has back to the system.
    pub fn release(&self) {
        let blocks = std::mem::take(&mut *open(&self.shelf));
        drop(blocks);
    }

    fn make(&self, sizes: Sizes, count: usize) -> io::Result<Vec<Block>> {
        let bytes = sizes.in_memory() * count;
        let region = Region::map(bytes).map_err(|error| {
            let message = format!(
                "the system has no {} MiB of memory for {count} frames ({error}); lower \
                 acquisition.buffers_per_camera, or raise the limit on this process' memory",
                bytes >> 20
            );
            io::Error::new(io::ErrorKind::OutOfMemory, message)
        })?;
        let region = Arc::new(region);
        if self.lock
            && let Err(error) = region.lock(bytes)
        {
            let limit = limit_text(soft_limit(libc::RLIMIT_MEMLOCK));
            let message = format!(
                "frame memory is not locked ({error}): RLIMIT_MEMLOCK is {limit} bytes, needed {}; set LimitMEMLOCK, \
                 or lock_memory = false",
                self.needed
            );
            warn("memory_not_locked", message);
        }
        Ok((0..count).map(|i| Block::cut(&region, i * sizes.in_memory(), sizes)).collect())
    }
}

/// Bytes of memory of a block that receives `received_bytes`: whole pages, so that the pixels of all blocks start on
/// one.
pub fn block_bytes(received_bytes: usize) -> usize {
    Sizes::new(received_bytes, received_bytes).in_memory()
}

/// How long a block is, its room counted in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sizes {
    /// To the end of the pixels.
    pixels: usize,
    /// To the end of what a camera sends: pixels that take more than a byte there are shifted to one in place.
    received: usize,
}

impl Sizes {
    fn new(pixel_bytes: usize, received_bytes: usize) -> Self {
        Self { pixels: ROOM_BYTES + pixel_bytes, received: ROOM_BYTES + received_bytes.max(pixel_bytes) }
    }

    fn in_memory(self) -> usize {
        self.received.next_multiple_of(ROOM_BYTES)
    }
}

/// One frame's memory: `ROOM_BYTES` of room, then the pixels.
pub struct Block {
    memory: NonNull<u8>,
    sizes: Sizes,
    region: Arc<Region>,
    home: Option<Sender<Block>>,
    shelf: Option<Weak<Shelf>>,
}

// SAFETY: a block is the only owner of its bytes; nothing in it is tied to a thread.
unsafe impl Send for Block {}
// SAFETY: a shared block gives only shared slices.
unsafe impl Sync for Block {}

impl Block {
    /// Maps a block of its own for `pixel_bytes` of pixels and touches every page.
    ///
    /// # Panics
    /// The system has no memory for it.
    pub fn allocate(pixel_bytes: usize) -> Self {
        let region = Region::map(block_bytes(pixel_bytes)).expect("memory for a frame");
        Self::cut(&Arc::new(region), 0, Sizes::new(pixel_bytes, pixel_bytes))
    }

    /// The block at `offset` of a region that is long enough. No two blocks share bytes: offsets are multiples of
    /// [`Sizes::in_memory`].
    fn cut(region: &Arc<Region>, offset: usize, sizes: Sizes) -> Self {
        // SAFETY: the callers made the region at least `offset + sizes.in_memory()` long.
        let memory = unsafe { region.memory.add(offset) };
        let mut block = Self { memory, sizes, region: Arc::clone(region), home: None, shelf: None };
        // Zeroed memory may be lazily mapped: writing once per page makes it resident before frame 0.
        block.whole_mut().iter_mut().step_by(4096).for_each(|byte| *byte = 0);
        block
    }

    /// Sets the channel that it goes to when it is dropped.
    pub fn set_home(&mut self, home: Sender<Block>) {
        self.home = Some(home);
    }

    /// Room and what is received.
    fn whole(&self) -> &[u8] {
        // SAFETY: the memory is initialized (the mapping is of zeros), `received` long and borrowed with self.
        unsafe { std::slice::from_raw_parts(self.memory.as_ptr(), self.sizes.received) }
    }

    /// Room and what is received.
    fn whole_mut(&mut self) -> &mut [u8] {
        // SAFETY: as in `whole`, and self is borrowed uniquely.
        unsafe { std::slice::from_raw_parts_mut(self.memory.as_ptr(), self.sizes.received) }
    }

    /// The room for the envelope, and the pixels.
    pub fn bytes(&self) -> &[u8] {
        &self.whole()[..self.sizes.pixels]
    }

    /// The room for the envelope, and the pixels.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        let end = self.sizes.pixels;
        &mut self.whole_mut()[..end]
    }

    /// The bytes that a camera sends, which are made to pixels in place.
    pub fn received(&self) -> &[u8] {
        &self.whole()[ROOM_BYTES..]
    }

    /// The bytes that a camera sends, which are made to pixels in place.
    pub fn received_mut(&mut self) -> &mut [u8] {
        &mut self.whole_mut()[ROOM_BYTES..]
    }

    /// The pixels, without the room in front of them.
    pub fn pixels(&self) -> &[u8] {
        &self.bytes()[ROOM_BYTES..]
    }

    /// Bytes after what is received that are the block's own and of no use.
    pub fn spare(&self) -> usize {
        self.sizes.in_memory() - self.sizes.received
    }

    /// The room before the pixels.
    pub fn room_mut(&mut self) -> &mut [u8] {
        &mut self.bytes_mut()[..ROOM_BYTES]
    }

    /// Address at which the camera layer may write what it receives while it holds the block.
    pub fn pixel_pointer(&mut self) -> *mut u8 {
        self.received_mut().as_mut_ptr()
    }

    /// The same memory in a new value, for the way back; self must not be used afterwards.
    fn taken(&mut self, shelf: Option<Weak<Shelf>>) -> Self {
        Self { memory: self.memory, sizes: self.sizes, region: Arc::clone(&self.region), home: None, shelf }
    }
}

impl Drop for Block {
    fn drop(&mut self) {
        if let Some(home) = self.home.take() {
            let shelf = self.shelf.take();
            let back = self.taken(shelf);
            // Without its stream the block comes back in the error, and has no home then: it goes to the shelf.
            drop(home.send(back));
        } else if let Some(shelf) = self.shelf.take().and_then(|shelf| shelf.upgrade()) {
            let back = self.taken(None);
            open(&shelf).push(back);
        }
    }
}

impl fmt::Debug for Block {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Block of {} bytes", self.sizes.pixels)
    }
}

#[cfg(test)]
mod tests {
    use super::{Block, HUGE_PAGE, Pool, ROOM_BYTES, Region};
    use std::collections::BTreeSet;

    #[test]
    fn dropped_blocks_come_home_with_their_bytes() {
        let (home, returns) = crossbeam_channel::bounded(1);
        let mut block = Block::allocate(100);
        block.set_home(home);
        block.bytes_mut()[ROOM_BYTES] = 42;
        drop(block);
        let back = returns.try_recv().expect("came home");
        assert_eq!((back.pixels()[0], back.pixels().len()), (42, 100));
        assert_eq!(back.pixels().as_ptr() as usize % 4096, 0);
    }

    #[test]
    fn blocks_without_a_stream_are_freed() {
        let (home, returns) = crossbeam_channel::bounded(1);
        let mut block = Block::allocate(100);
        block.set_home(home);
        drop(returns);
        drop(block);
    }

    fn idle(pool: &Pool) -> usize {
        super::open(&pool.shelf).len()
    }

    fn places(blocks: &[Block]) -> BTreeSet<usize> {
        blocks.iter().map(|block| block.pixels().as_ptr() as usize).collect()
    }

    #[test]
    fn a_thousand_sessions_use_the_same_memory() {
        let pool = Pool::new(false, 0);
        let first = places(&pool.take(10_000, 10_000, 5).expect("memory"));
        assert!(first.len() == 5 && first.iter().all(|place| place % 4096 == 0));
        for _ in 0..1000 {
            let (home, returns) = crossbeam_channel::bounded(5);
            let mut blocks = pool.take(10_000, 10_000, 5).expect("memory");
            assert_eq!(places(&blocks), first);
            // One is out with a frame when its stream ends, one is on its way back to it, the rest are lent.
            blocks.iter_mut().take(2).for_each(|block| block.set_home(home.clone()));
            let out = blocks.remove(0);
            drop(blocks.remove(0));
            drop(home);
            drop(blocks);
            // As the stream does when it ends.
            returns.try_iter().for_each(drop);
            drop(returns);
            assert_eq!(idle(&pool), 4);
            drop(out);
            assert_eq!(idle(&pool), 5);
        }
    }

    #[test]
    fn blocks_of_a_session_do_not_overlap_and_other_sizes_make_room() {
        let pool = Pool::new(true, 0);
        let mut blocks = pool.take(5000, 5000, 3).expect("memory");
        blocks.extend(pool.take(5000, 5000, 2).expect("memory"));
        for (i, block) in blocks.iter_mut().enumerate() {
            block.bytes_mut().fill(i as u8 + 1);
        }
        for (i, block) in blocks.iter().enumerate() {
            assert!(block.bytes().iter().all(|&byte| byte == i as u8 + 1));
        }
        drop(blocks);
        assert_eq!(idle(&pool), 5);
        let other = pool.take(6000, 6000, 1).expect("memory");
        assert_eq!((idle(&pool), other[0].pixels().len()), (0, 6000));
        drop(pool);
        // The pool is gone: its blocks are freed where they are dropped.
        drop(other);
    }

    #[test]
    fn what_is_received_may_be_longer_than_the_pixels() {
        let pool = Pool::new(false, 0);
        let mut blocks = pool.take(5000, 10_000, 2).expect("memory");
        for (i, block) in blocks.iter_mut().enumerate() {
            assert_eq!((block.pixels().len(), block.received().len()), (5000, 10_000));
            block.received_mut().fill(i as u8 + 1);
            assert_eq!(block.pixels().as_ptr(), block.received().as_ptr());
        }
        assert!(blocks.iter().zip(1u8..).all(|(block, i)| block.received().iter().all(|&byte| byte == i)));
        drop(blocks);
        assert_eq!(pool.idle_bytes(), 2 * super::block_bytes(10_000) as u64);
        // A camera that sends 8 bits again has no use for them.
        drop(pool.take(5000, 5000, 1).expect("memory"));
        assert_eq!(pool.idle_bytes(), super::block_bytes(5000) as u64);
    }

    #[test]
    fn mappings_start_on_a_huge_page() {
        let region = Region::map(3 * HUGE_PAGE + 1).expect("memory");
        assert_eq!(region.memory.as_ptr() as usize % HUGE_PAGE, 0);
        assert!(Region::map(usize::MAX - 1).is_err());
    }
}
