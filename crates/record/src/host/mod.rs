// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the program requires of Linux: memory for frames, real-time threads, an allocator that keeps its memory, idle
//! processes.

/// Blocks of memory that frames are received into.
pub mod frame_memory;
/// Settings of the allocator against growing from session to session.
pub mod heap;
/// Work that nothing waits for, in processes of its own.
pub mod idle_process;
/// How much memory may still be taken.
pub mod memory;
/// Limits on the memory of this process.
pub mod process_limits;
/// Real-time scheduling and locked memory.
pub mod realtime;
/// How long threads had work and no processor.
pub mod run_delay;
