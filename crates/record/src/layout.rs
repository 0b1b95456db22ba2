// SPDX-License-Identifier: MIT OR Apache-2.0
//! The contract of a recording: topics, schemas, metadata keys, the format's version, and the records that
//! are JSON. Frames are in [`super::envelope`]. `docs/reference/recordings.md` specifies the format.

use crate::base::ids::{CameraId, NodeId, SessionName, TriggerIndex};
use crate::config::FeatureSetting;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::collections::BTreeMap;
use std::fmt;

/// `format` in the header metadata.
pub const FORMAT: &str = "fourdbody-recording";
/// `version` in the header metadata; a reader refuses a higher one.
pub const VERSION: u32 = 2;

/// Metadata record at the start of every segment.
pub const HEADER_METADATA: &str = "fourdbody.header";
/// Metadata record at the end of every segment: its range of triggers.
pub const SEGMENT_METADATA: &str = "fourdbody.segment";
/// Metadata record at the end of the last segment.
pub const VERDICT_METADATA: &str = "fourdbody.verdict";

/// Metadata record at the end of the last segment: how the disk kept up.
pub const STATISTICS_METADATA: &str = "fourdbody.write_statistics";

/// Key of these metadata records: JSON of [`RecordingHeader`] without the rig; of the verdict; of the statistics.
pub const KEY_JSON: &str = "json";
/// Key of all these metadata records: CRC-32 of the other entries, in the order of their keys, each as key, zero,
/// value, zero. It vouches for them while the segment is open and the data section's checksum is still to come.
pub const KEY_CRC: &str = "crc32";
/// Key of the header metadata: the rig file, word for word.
pub const KEY_RIG: &str = "rig";
/// Key of header and segment metadata: the segment's number, from 0.
pub const KEY_SEGMENT: &str = "segment";
/// Key of header and segment metadata: no frame or gap below this trigger belongs to the segment.
pub const KEY_FIRST_TRIGGER: &str = "first_trigger";
/// Key of the segment metadata: the first trigger of the next segment; absent in the last one.
pub const KEY_END_TRIGGER: &str = "end_trigger";

/// Keys of the segment metadata: where the message of [`INDEX_TOPIC`] has its payload, and its CRC-32.
pub const KEY_INDEX_OFFSET: &str = "index_offset";
/// Key of the segment metadata: length of that payload, bytes.
pub const KEY_INDEX_LENGTH: &str = "index_length";
/// Key of the segment metadata: CRC-32 of that payload.
pub const KEY_INDEX_CRC: &str = "index_crc32";

/// Key of the segment's, the verdict's and the statistics' metadata: the mark of the session.
pub const KEY_SESSION: &str = "session_mark";
/// Key of the verdict's metadata: how many small records the recording has; they are numbered from 0.
pub const KEY_RECORDS: &str = "records";

pub const GAPS_TOPIC: &str = "/gaps";
/// Topic of the HSU's trigger table.
pub const TRIGGERS_TOPIC: &str = "/hsu/triggers";
/// Topic of raw clock samples.
pub const CLOCK_TOPIC: &str = "/clock";
pub const EVENTS_TOPIC: &str = "/events";
/// Topic of the segment's index, the last message of a closed segment.
pub const INDEX_TOPIC: &str = "/index";

/// A session has fewer triggers than this: 38 hours at 120 Hz. It bounds what a wrong index can cost.
pub const MAX_TRIGGERS: u64 = 1 << 24;
/// A recording has at most this many cameras.
pub const MAX_CAMERAS: usize = 64;
/// A camera's name has at most this many bytes; it is part of every frame's message.
pub const MAX_CAMERA_NAME: usize = 64;

/// The entries of a metadata record: keys and texts.
pub type Entries = BTreeMap<String, String>;

/// Topic of a camera's frames.
pub fn image_topic(camera: &CameraId) -> String {
    format!("/camera/{camera}/image")
}

/// File name of a segment.
pub fn segment_name(number: u32) -> String {
    format!("segment-{number:03}.mcap")
}

/// Name of the file that becomes a segment when its time has come. No reader takes it for a segment; one that a
/// crash has left behind is empty and may be deleted.
pub fn next_segment_name(number: u32) -> String {
    format!(".{}.next", segment_name(number))
}

/// The number in a segment's file name.
pub fn segment_number(name: &str) -> Option<u32> {
    let digits = name.strip_prefix("segment-")?.strip_suffix(".mcap")?;
    (digits.len() >= 3 && digits.bytes().all(|b| b.is_ascii_digit())).then(|| digits.parse().ok())?
}

/// Kind of the event whose message names a node of the rig that does not take part: the session is of a part of the
/// rig, as requested.
pub const NOT_ASKED: &str = "node_not_asked";

/// Kind of the events whose message is a camera's PTP status: at the beginning where PTP is on, at each change, and at
/// the end.
pub const PTP_STATUS: &str = "ptp_status";

/// Whether PTP keeps the clock of a camera with this status.
pub fn ptp_keeps(status: &str) -> bool {
    status == "Slave" || status == "Master"
}

/// The HSU's id in recordings of nodes that trigger their cameras by action commands.
pub const ACTION_UNIT: [u8; 16] = *b"action-commands.";
/// Kind of the event of a session whose cameras acted as soon as a command reached them: no PTP was in it.
pub const ACTIONS_AT_ONCE: &str = "actions_at_once";

/// One camera of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraHeader {
    /// Its name in the rig.
    pub id: CameraId,
    /// Columns of its frames, pixels (its rows are `height`).
    pub width: u32,
    pub height: u32,
    /// Model, serial number and firmware as the camera states them; empty where unknown.
    pub device: String,
    /// What its pixels were before they became the recording's 8 bits, by its PFNC name; empty in older recordings, and
    /// where it is not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub pixel_format: String,
    /// Settings as read back from the camera after they were set.
    pub settings: Vec<FeatureSetting>,
    /// Everything that could be read of it when it was prepared, as text; none in older recordings.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub state: BTreeMap<String, String>,
}

/// The device that emitted and counted the triggers.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct HsuIdentity {
    /// Unique id of the device.
    pub uid: String,
    pub firmware: String,
    /// Version of the serial protocol spoken.
    pub protocol: u32,
}

/// The header of every segment: it makes each understandable alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingHeader {
    pub session: SessionName,
    /// Unique id of the session, the same on both nodes.
    pub session_id: String,
    pub node: NodeId,
    /// The rig file, word for word.
    #[serde(skip)]
    pub rig_text: String,
    /// The node's cameras in the rig's order.
    pub cameras: Vec<CameraHeader>,
    /// The HSU; `None` for images that were imported.
    pub hsu: Option<HsuIdentity>,
    /// Triggers requested; `None` runs until stop.
    pub expected_triggers: Option<u64>,
    pub trigger_rate_hz: f64,
    /// Name of the clock behind every `host_time_ns`, for instance `CLOCK_REALTIME`: UTC, ns since 1970 without leap
    /// seconds.
    pub host_clock: String,
    /// Host time when the recording was created, ns.
    pub created_ns: u64,
    /// Name and version of the recording software.
    pub software: String,
    pub subject: Option<String>,
    /// Free text that was given when the session was started.
    pub note: Option<String>,
}

/// Why a frame is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GapCause {
    /// Packets of the frame were lost and not resent.
    MissingPackets,
    /// The frame did not arrive in time.
    Timeout,
    /// The camera did not expose at this trigger.
    NotTriggered,
    /// The frame arrived, but no buffer was free for it.
    DroppedRingFull,
    /// The frame arrived, but could not be written.
    DroppedDisk,
    /// The camera was unplugged or off, or the network to it was down.
    Unplugged,
    /// The camera was there, but not under our control: another program took it, or our signs of life got lost.
    ControlLost,
    /// The session was aborted before the frame came.
    Aborted,
    /// The frame had another size than the session's: columns, rows, place on the sensor, padding, or bytes.
    SizeMismatch,
    /// The frame was no plain image of 8-bit grey: another pixel format, chunks, several parts.
    WrongFormat,
    /// Block id and camera timestamp named different triggers.
    IdentityMismatch,
    /// Imported images: there was no file for this trigger.
    NotRecorded,
    /// The node's process stood still, and frames of this trigger were lost meanwhile: the whole set is given up.
    NodePaused,
    /// The frame was recorded, but is damaged (written by `recover`).
    Damaged,
    /// The cause is not known, or is one of a later version.
    #[serde(other)]
    Unknown,
}

impl GapCause {
    /// All of them; a cause's place is `cause as usize`.
    pub const ALL: [Self; 15] = [
        Self::MissingPackets,
        Self::Timeout,
        Self::NotTriggered,
        Self::DroppedRingFull,
        Self::DroppedDisk,
        Self::Unplugged,
        Self::ControlLost,
        Self::Aborted,
        Self::SizeMismatch,
        Self::WrongFormat,
        Self::IdentityMismatch,
        Self::NotRecorded,
        Self::NodePaused,
        Self::Damaged,
        Self::Unknown,
    ];
}

impl fmt::Display for GapCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The serialized name is the name everywhere.
        self.serialize(f)
    }
}

/// Stands where a frame is missing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GapRecord {
    pub camera: CameraId,
    pub trigger: TriggerIndex,
    pub cause: GapCause,
}

/// One row of the HSU's trigger table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct TriggerRecord {
    pub index: TriggerIndex,
    /// When it was emitted, HSU clock, ns.
    pub hsu_time_ns: u64,
    /// Flags as the HSU reports them; 0 is an ordinary trigger.
    pub flags: u32,
    /// When the report arrived, host clock, ns.
    pub host_time_ns: u64,
}

/// One exchange with a device, for fitting its clock again later.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockSample {
    /// The camera; `None` for the HSU.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraId>,
    /// Request sent, host clock, ns.
    pub host_send_ns: u64,
    /// Answer received, host clock, ns.
    pub host_receive_ns: u64,
    /// Answered, the device's clock, ns.
    pub device_time_ns: u64,
}

/// Something that happened on the node during the session.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeEvent {
    /// When it happened, host clock, ns.
    pub host_time_ns: u64,
    /// A word, for instance `camera_lost` or `duplicate`.
    pub kind: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraId>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trigger: Option<TriggerIndex>,
    /// Text that a person reads; for some kinds JSON, or a format of its own.
    pub message: String,
}

/// Kind of the events that name a segment which the disk refused.
const GIVEN_UP: &str = "segment_given_up";

impl NodeEvent {
    /// An event that names neither a camera nor a trigger.
    pub fn new(kind: &str, host_time_ns: u64, message: String) -> Self {
        Self { host_time_ns, kind: kind.to_owned(), camera: None, trigger: None, message }
    }

    /// An event whose message is a value in JSON.
    pub(super) fn of_json(kind: &str, host_time_ns: u64, value: &impl Serialize) -> Self {
        Self::new(kind, host_time_ns, serde_json::to_string(value).unwrap_or_default())
    }

    /// The value of an event of this kind, whose message is JSON.
    pub(super) fn json<T: DeserializeOwned>(&self, kind: &str) -> Option<T> {
        (self.kind == kind).then(|| serde_json::from_str(&self.message).ok())?
    }

    /// The event of a segment that stays open because the disk refused it.
    pub(super) fn segment_given_up(number: u32, host_time_ns: u64) -> Self {
        let message = format!("{}: refused by the disk; what it lost is accounted for", segment_name(number));
        Self::new(GIVEN_UP, host_time_ns, message)
    }

    /// Whether it is that event of this segment.
    pub(super) fn gives_up(&self, number: u32) -> bool {
        let named = self.message.split(':').next();
        self.kind == GIVEN_UP && named.and_then(segment_number) == Some(number)
    }
}

/// A raw sample of the warm-up, from which the beginning of every stream can be found again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum WarmUp {
    /// A frame of the event's camera.
    Frame {
        block: u64,
        /// Its timestamp, camera clock, ns; 0 without one.
        camera_time_ns: u64,
        /// Its first packet's arrival, host clock, ns.
        host_time_ns: u64,
    },
    /// A trigger of the warm-up, as the HSU reported it.
    Trigger {
        /// Number of the trigger, negative: -1 is the last one before trigger 0.
        number: i64,
        /// When it was fired, HSU clock, ns.
        hsu_time_ns: u64,
    },
}

/// Kind of the events that hold a [`WarmUp`].
const WARM_UP: &str = "warm_up";

impl WarmUp {
    /// The event that records it; its message is JSON.
    pub fn event(&self, camera: Option<CameraId>, host_time_ns: u64) -> NodeEvent {
        NodeEvent { camera, ..NodeEvent::of_json(WARM_UP, host_time_ns, self) }
    }

    /// The sample that an event holds; `None` for other kinds.
    pub fn of(event: &NodeEvent) -> Option<Self> {
        event.json(WARM_UP)
    }
}

/// All outcomes of a segment, and its part of the trigger table, so that a closed one opens without walking its
/// records.
#[derive(Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SegmentIndex {
    /// Camera (its place in the header), trigger, offset of the message's payload in the file, its length.
    pub frames: Vec<(u32, u64, u64, u64)>,
    pub gaps: Vec<GapRecord>,
    /// Rows of the trigger table ([`TriggerRecord::row`]); none in segments of versions that left them out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub triggers: Option<Vec<TriggerRow>>,
}

/// A trigger's index, HSU time, flags, and host time, ns.
pub type TriggerRow = (u64, u64, u32, u64);

impl TriggerRecord {
    /// The row of the index for it.
    pub fn row(&self) -> TriggerRow {
        (self.index.0, self.hsu_time_ns, self.flags, self.host_time_ns)
    }

    /// The record of a row of the index.
    pub fn of_row((index, hsu_time_ns, flags, host_time_ns): TriggerRow) -> Self {
        Self { index: TriggerIndex(index), hsu_time_ns, flags, host_time_ns }
    }
}

/// JSON schema of the channel that carries [`SegmentIndex`].
pub(crate) fn index_schema() -> serde_json::Value {
    let frames =
        "camera (its place in the header), trigger, offset in the file and length of the message's payload";
    serde_json::json!({"type": "object", "required": ["frames", "gaps"], "properties": {
        "frames": {"type": "array", "description": frames, "items": {"type": "array", "items": {"type": "integer"}}},
        "gaps": {"type": "array", "items": {"type": "object"}},
        "triggers": {"type": "array", "description": "index, HSU time, flags and host time of each trigger",
            "items": {"type": "array", "items": {"type": "integer"}}},
    }})
}

/// Topic, name and JSON schema of the channels whose messages are JSON. A field with a question mark may be absent.
pub(crate) fn json_channels() -> [(&'static str, &'static str, serde_json::Value); 4] {
    [
        (GAPS_TOPIC, "fourdbody.Gap", "camera:text trigger cause:text"),
        (TRIGGERS_TOPIC, "fourdbody.Trigger", "index hsu_time_ns flags host_time_ns"),
        (CLOCK_TOPIC, "fourdbody.ClockSample", "camera?:text host_send_ns host_receive_ns device_time_ns"),
        (EVENTS_TOPIC, "fourdbody.Event", "host_time_ns kind:text camera?:text trigger? message:text"),
    ]
    .map(|(topic, name, fields)| (topic, name, schema_of(fields)))
}

/// The JSON schema of an object with these fields, which are natural numbers unless they are texts.
fn schema_of(fields: &str) -> serde_json::Value {
    let (mut required, mut properties) = (Vec::new(), serde_json::Map::new());
    for field in fields.split(' ') {
        let (name, kind) = match field.strip_suffix(":text") {
            Some(name) => (name, serde_json::json!({"type": "string"})),
            None => (field, serde_json::json!({"type": "integer", "minimum": 0})),
        };
        let optional = name.strip_suffix('?');
        required.extend(optional.is_none().then_some(name));
        properties.insert(optional.unwrap_or(name).to_owned(), kind);
    }
    serde_json::json!({"type": "object", "required": required, "properties": properties})
}

impl RecordingHeader {
    /// An error for a header that would make a recording impossible or ambiguous.
    pub(crate) fn check(&self) -> Result<(), String> {
        if self.cameras.is_empty() || self.cameras.len() > MAX_CAMERAS {
            return Err(format!("{} cameras, expected 1 to {MAX_CAMERAS}", self.cameras.len()));
        }
        // Both become names of directories.
        SessionName::parse(self.session.as_str())?;
        SessionName::parse(self.node.as_str()).map_err(|e| format!("node: {e}"))?;
        let mut ids = std::collections::BTreeSet::new();
        for camera in &self.cameras {
            let name = camera.id.as_str();
            if name.is_empty() || name.len() > MAX_CAMERA_NAME {
                return Err(format!(
                    "camera name {name:?} has {} bytes, expected 1 to {MAX_CAMERA_NAME}",
                    name.len()
                ));
            }
            crate::base::ids::check_name(name).map_err(|e| format!("camera: {e}"))?;
            if !ids.insert(name) {
                return Err(format!("camera {name} is listed twice"));
            }
            if camera.width == 0 || camera.height == 0 || camera.width > 1 << 16 || camera.height > 1 << 16 {
                return Err(format!(
                    "camera {name}: frames of {} x {}, expected sides of 1 to 65536",
                    camera.width, camera.height
                ));
            }
        }
        match self.expected_triggers {
            Some(n) if n > MAX_TRIGGERS => {
                Err(format!("{n} triggers expected, at most {MAX_TRIGGERS} can be recorded"))
            }
            _ => Ok(()),
        }
    }

    /// Bytes of frames that the session will bring at most, where that is known.
    pub fn expected_bytes(&self) -> Option<u64> {
        // Envelope, headers, and the padding that aligns the pixels.
        const PER_FRAME: u64 = 4096 + 512;
        let per_trigger: u64 =
            self.cameras.iter().map(|c| u64::from(c.width) * u64::from(c.height) + PER_FRAME).sum();
        self.expected_triggers.map(|n| n.saturating_mul(per_trigger))
    }
}

#[cfg(test)]
mod tests {
    use super::{GapCause, json_channels, segment_name, segment_number};

    #[test]
    fn golden_schema_of_events() {
        let integer = r#"{"minimum":0,"type":"integer"}"#;
        let text = r#"{"type":"string"}"#;
        let expected = format!(
            r#"{{"properties":{{"camera":{text},"host_time_ns":{integer},"kind":{text},"message":{text},"trigger":{integer}}},"required":["host_time_ns","kind","message"],"type":"object"}}"#
        );
        assert_eq!(json_channels()[3].2.to_string(), expected);
    }

    #[test]
    fn causes_keep_their_names() {
        assert_eq!(GapCause::MissingPackets.to_string(), "missing_packets");
        assert_eq!(serde_json::to_string(&GapCause::DroppedDisk).expect("JSON"), "\"dropped_disk\"");
        let later: GapCause = serde_json::from_str("\"invented_in_2031\"").expect("any word");
        assert_eq!(later, GapCause::Unknown);
    }

    #[test]
    fn segment_names_read_back() {
        for number in [0, 7, 999, 1000, 123_456] {
            assert_eq!(segment_number(&segment_name(number)), Some(number));
        }
        for other in [
            "segment-01.mcap",
            "segment-000.mcap.partial",
            "segment--01.mcap",
            "segment-+01.mcap",
            ".segment-003.mcap.next",
        ] {
            assert_eq!(segment_number(other), None, "{other}");
        }
    }
}
