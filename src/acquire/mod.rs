//! Frames from cameras to the writer: buffer pool, trigger matching, bounded hand-offs.
