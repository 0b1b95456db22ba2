// SPDX-License-Identifier: MIT OR Apache-2.0
//! The allocator of a process that holds one session after the other.
//!
//! A session takes large buffers and gives them back at its end: room for small records (9.4 MB, `ring.rs`), staging
//! memory of each segment. glibc maps a block of at least 128 KiB by itself and unmaps it when it is freed; but the
//! first such block that is freed raises that limit to its own size (at most 32 MiB), and from then on blocks up to it
//! come out of the arena of the thread that asks. Any small block that outlives the session may then come to lie in the
//! hole that a large one left, which the next session's no longer fits: the heap grows by its whole size, in steps,
//! after any number of sessions. A limit that was set does not move.

/// Blocks of at least this many bytes are mapped by themselves: glibc's own limit before it moves.
#[cfg(target_env = "gnu")]
const MAPPED_FROM_BYTES: libc::c_int = 128 << 10;

/// From here on every block of 128 KiB or more goes back to the system when it is freed. For the whole process; called
/// before the first session. Nothing on the pixel path allocates, so that the cost (a system call and fresh pages)
/// falls on the beginning and the end of sessions and segments. Other C libraries have no such limit to move.
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

#[cfg(all(test, target_env = "gnu"))]
mod tests {
    use super::give_large_blocks_back;

    /// Whether the page of this address is mapped.
    fn is_mapped(address: usize) -> bool {
        let mut resident = 0;
        // SAFETY: the call only reads the page table, and writes one byte for the one page of the address.
        unsafe { libc::mincore((address & !4095) as *mut libc::c_void, 1, &mut resident) == 0 }
    }

    /// What other tests of this process freed before would serve again, whatever the limit is.
    #[test]
    fn the_limit_does_not_move_with_the_blocks_that_are_freed() {
        let program = std::env::current_exe().expect("the running tests");
        let child = ["--ignored", "--exact", "host::heap::tests::in_a_process_of_its_own"];
        let output = std::process::Command::new(program).args(child).output().expect("it starts");
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && text.contains("1 passed"), "{text}");
    }

    #[test]
    #[ignore = "the child process of the test above, which runs it"]
    fn in_a_process_of_its_own() {
        give_large_blocks_back();
        // Would raise it to 16 MiB.
        drop(std::hint::black_box(vec![1u8; 16 << 20]));
        let block = std::hint::black_box(vec![1u8; 4 << 20]);
        let address = block.as_ptr() as usize + (2 << 20);
        assert!(is_mapped(address));
        drop(block);
        assert!(!is_mapped(address));
    }
}
