//! Frames from cameras to the writer: clocks, trigger matching, frame sets, bounded hand-offs.

pub mod assembler;
pub mod block_ids;
mod books;
mod breaches;
pub mod clock;
pub mod dry_run;
pub mod heap;
pub mod latency;
pub mod matcher;
mod pause;
pub mod pool;
pub mod preview;
pub mod realtime;
pub mod receiver;
pub mod recorder;
mod relation;
mod ring;
pub mod trigger_table;
