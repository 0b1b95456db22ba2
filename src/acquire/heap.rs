//! The allocator of a process that holds one session after the other.
//!
//! A session takes large buffers and gives them back at its end: room for small records (9.4 MB, `ring.rs`), staging
//! memory of each segment. glibc maps a block of at least 128 KiB by itself and unmaps it when it is freed; but the first
//! such block that is freed raises that limit to its own size (at most 32 MiB), and from then on blocks up to it come out
//! of the arena of the thread that asks. Any small block that outlives the session may then come to lie in the hole that
//! a large one left, which the next session's no longer fits: the heap grows by its whole size, in steps, after any
//! number of sessions. A limit that was set does not move.

/// Blocks of at least this many bytes are mapped by themselves: glibc's own limit before it moves.
#[cfg(target_env = "gnu")]
const MAPPED_FROM_BYTES: libc::c_int = 128 << 10;

/// From here on every block of 128 KiB or more goes back to the system when it is freed. For the whole process; called
/// before the first session. Nothing on the pixel path allocates, so that the cost (a system call and fresh pages) falls
/// on the beginning and the end of sessions and segments. Other C libraries have no such limit to move.
pub fn give_large_blocks_back() {
    #[cfg(target_env = "gnu")]
    {
        // SAFETY: sets a number in the allocator, under the allocator's own lock.
        let set = unsafe { libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED_FROM_BYTES) };
        if set != 1 {
            tracing::warn!(
                "the allocator refused a fixed mapping threshold: memory may grow from session to session"
            );
        }
    }
}
