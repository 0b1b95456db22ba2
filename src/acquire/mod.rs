//! Frames from cameras to the writer: buffer pool, trigger matching, bounded hand-offs.

pub mod clock;
pub mod matcher;
pub mod pool;
pub mod receiver;
pub mod recorder;
