//! Frame memory: page-aligned blocks, allocated and touched before a session, returned by dropping.
//!
//! A block holds room for the message envelope, then the pixels, so that a frame is written to disk from
//! where the camera layer received it. Its pixels start on a page boundary.

use crossbeam_channel::Sender;
use std::alloc::{Layout, alloc_zeroed, dealloc, handle_alloc_error};
use std::fmt;
use std::ptr::NonNull;

/// Bytes kept before the pixels: one page, of which the envelope uses the end.
pub const ROOM_BYTES: usize = 4096;

/// One frame's memory: `ROOM_BYTES` of room, then the pixels.
pub struct Block {
    memory: NonNull<u8>,
    layout: Layout,
    home: Option<Sender<Block>>,
}

// SAFETY: a block is the only owner of its memory; nothing in it is tied to a thread.
unsafe impl Send for Block {}
// SAFETY: a shared block gives only shared slices.
unsafe impl Sync for Block {}

impl Block {
    /// Allocates a block for `pixel_bytes` of pixels and touches every page.
    pub fn allocate(pixel_bytes: usize) -> Self {
        let size = ROOM_BYTES + pixel_bytes;
        let layout = Layout::from_size_align(size, ROOM_BYTES)
            .expect("invariant: a frame fits in half the address space");
        // SAFETY: the layout's size is at least ROOM_BYTES, hence not zero.
        let memory = unsafe { alloc_zeroed(layout) };
        let Some(memory) = NonNull::new(memory) else { handle_alloc_error(layout) };
        let mut block = Self { memory, layout, home: None };
        // Zeroed memory may be lazily mapped: writing once per page makes it resident before frame 0.
        block.bytes_mut().iter_mut().step_by(4096).for_each(|byte| *byte = 0);
        block
    }

    /// Where it goes when it is dropped.
    pub fn set_home(&mut self, home: Sender<Block>) {
        self.home = Some(home);
    }

    /// Room and pixels.
    pub fn bytes(&self) -> &[u8] {
        // SAFETY: the memory is initialized, `layout.size()` long and borrowed with self.
        unsafe { std::slice::from_raw_parts(self.memory.as_ptr(), self.layout.size()) }
    }

    /// Room and pixels.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as in `bytes`, and self is borrowed uniquely.
        unsafe { std::slice::from_raw_parts_mut(self.memory.as_ptr(), self.layout.size()) }
    }

    /// The pixels.
    pub fn pixels(&self) -> &[u8] {
        &self.bytes()[ROOM_BYTES..]
    }

    /// The room before the pixels.
    pub fn room_mut(&mut self) -> &mut [u8] {
        &mut self.bytes_mut()[..ROOM_BYTES]
    }

    /// Where the camera layer may write pixels while it holds the block.
    pub fn pixel_pointer(&mut self) -> *mut u8 {
        self.bytes_mut()[ROOM_BYTES..].as_mut_ptr()
    }
}

impl Drop for Block {
    fn drop(&mut self) {
        if let Some(home) = self.home.take() {
            let back = Self { memory: self.memory, layout: self.layout, home: None };
            // Without its stream the block comes back in the error and is freed: it has no home then.
            drop(home.send(back));
            return;
        }
        // SAFETY: allocated in `allocate` with this layout, and owned by nobody else.
        unsafe { dealloc(self.memory.as_ptr(), self.layout) };
    }
}

impl fmt::Debug for Block {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Block of {} bytes", self.layout.size())
    }
}

#[cfg(test)]
mod tests {
    use super::{Block, ROOM_BYTES};

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
}
