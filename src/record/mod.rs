//! Recordings: layout, writer, reader, verification.
//!
//! `docs/design/recording.md` states what they must keep true. [`layout`] is the contract between writer and
//! reader; [`Recording`] writes one node's part of a session; [`SessionReader`] reads a session back.

mod belonging;
pub mod catalogue;
pub mod describe;
mod direct;
mod disk;
pub mod envelope;
mod interrupted;
pub mod layout;
mod metadata;
mod partial;
mod protobuf;
mod reader;
pub mod recover;
mod scan;
mod segment;
mod segment_file;
mod session;
mod statistics;
mod topic;
mod verdict;
pub mod verify;
mod window;

mod writer;

pub use direct::free_bytes;
pub use direct::survive_file_limit;
pub use envelope::{ENVELOPE_CAPACITY, Envelope, EnvelopeError, FrameMeta, parse_envelope, write_envelope};
pub use interrupted::{Interrupted, interrupted};
pub use layout::{
    CameraHeader, ClockSample, GapCause, GapRecord, HsuIdentity, MAX_TRIGGERS, NOT_ASKED, NodeEvent,
    RecordingHeader, TriggerRecord, WarmUp,
};
pub use partial::{copy_frames, is_segment};
pub use reader::{GapRun, ReadError, RecordedFrame, RecordingReader, SegmentReader};
pub use segment_file::BadRange;
pub use session::{SessionReader, Unreadable, node_dir, open_each};
pub use statistics::{DiskAccess, DiskProgress, Latency, WriteStatistics};
pub(crate) use verdict::CameraTally;
pub use verdict::{CameraVerdict, Noted, SessionEnd, Status, UNCONFIRMED, Verdict};
#[cfg(test)]
pub(crate) use writer::tests as small_recordings;
#[cfg(test)]
pub(crate) use writer::tests::header as two_cameras;
pub use writer::{BLOCKS_HELD, RecordError, Recording, WriterOptions};
