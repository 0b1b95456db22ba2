// SPDX-License-Identifier: MIT OR Apache-2.0
//! Recordings: layout, writer, reader, verification.
//!
//! `docs/design/recording.md` states what they must keep true. [`layout`] is the contract between writer and
//! reader; [`Recording`] writes one node's part of a session; [`SessionReader`] reads a session back.

#![allow(missing_docs, reason = "fields and variants whose names say it carry no comment")]

use fourdbody_core::{base, config, data};

mod action_counts;
mod advice;
mod belonging;
pub mod catalogue;
mod credible;
pub mod describe;
mod direct_io;
mod disk_thread;
pub mod envelope;
mod files;
mod frame_check;
/// Linux: real-time threads, locked memory, frame memory, idle processes.
pub mod host;
mod input_edge;
pub mod layout;
/// The trigger of each frame, by two independent sources.
pub mod matcher;
mod metadata;
mod noted;
mod open_chunk;
mod partial;
pub mod protobuf;
mod reader;
pub mod recover;
pub mod remark;
mod scan;
mod segment;
mod segment_file;
mod session;
mod simultaneous;
mod statistics;
mod time_code;
mod time_scale;
mod topic;
mod trigger_times;
mod unfinished;
mod verdict;
pub mod verify;

mod writer;

/// Number of the way that a frame takes from the socket to the disk. Raised when its cost changes by more than the noise of
/// `make bench-ingest`; tables of documents name the number that they were measured with.
pub const INGEST: u32 = 1;

pub use action_counts::{ACTION_COMMANDS, ActionCounts};
pub use advice::Advice;
pub use direct_io::{free_bytes, survive_file_limit};
pub use envelope::{ENVELOPE_CAPACITY, Envelope, FrameMeta, parse_envelope, write_envelope};
pub use files::{ReadError, node_dir};
pub use input_edge::InputEdge;
pub use layout::{
    ACTION_UNIT, ACTIONS_AT_ONCE, CameraHeader, ClockSample, GapCause, GapRecord, HsuIdentity, MAX_TRIGGERS,
    NOT_ASKED, NodeEvent, PTP_STATUS, RecordingHeader, TriggerRecord, WarmUp, ptp_keeps,
};
pub use noted::{Noted, SETTING_CHANGED, UNCONFIRMED};
pub use partial::{copy_frames, is_segment};
pub use reader::{GapRun, RecordedFrame, RecordingReader, SegmentReader};
pub use session::{SessionReader, Unreadable, open_each};
pub use simultaneous::{NOT_SIMULTANEOUS, TriggerRow, TriggerRows};
pub use statistics::{DiskProgress, WriteStatistics};
pub use time_code::{HeardTimeCode, TimeCodeLine};
pub use time_scale::ScaleFound;
pub use unfinished::{Interrupted, interrupted};
pub use verdict::{CameraTally, CameraVerdict, SessionEnd, Status, TriggerSet, Verdict};
pub use writer::{BLOCKS_HELD, RecordError, Recording, WriterOptions};
