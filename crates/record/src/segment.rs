// SPDX-License-Identifier: MIT OR Apache-2.0
//! One segment: an MCAP file whose bytes on disk are a clean prefix at every instant.

use super::belonging::{Belonging, Label, SessionMark};
use super::direct_io::{BLOCK, Store};
use super::envelope::{self, FrameMeta};
use super::layout::{
    FORMAT, HEADER_METADATA, INDEX_TOPIC, KEY_CRC, KEY_END_TRIGGER, KEY_FIRST_TRIGGER, KEY_INDEX_CRC,
    KEY_INDEX_LENGTH, KEY_INDEX_OFFSET, KEY_JSON, KEY_RECORDS, KEY_RIG, KEY_SEGMENT, KEY_SESSION,
    RecordingHeader, SEGMENT_METADATA, STATISTICS_METADATA, SegmentIndex, TriggerRecord, VERDICT_METADATA,
    image_topic, index_schema, json_channels,
};
use super::metadata::checksum;
use super::open_chunk::{CHUNK_HEADER, Handle, Window, lock};
use super::scan::{MESSAGE_HEADER, PREAMBLE};
use super::statistics::WriteStatistics;
use super::verdict::Verdict;
use crate::base::ids::CameraId;
use crate::host::frame_memory::{Block, ROOM_BYTES};
use mcap::McapError;
use mcap::records::{MessageHeader, Metadata};
use mcap::write::PrivateRecordOptions;
use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard};

/// Opcode of the records of zeros that move a message to where its pixels can be aligned. Opcodes from 0x80 on
/// are private, and readers skip them.
const FILLER: u8 = 0x80;
/// Staging memory: headers, envelopes and tails of the frames of a chunk, and room for small records.
const STAGING_BYTES: usize = 256 << 10;

/// The contents of the last segment besides its own records.
pub(super) struct Closing<'a> {
    pub verdict: &'a Verdict,
    /// Small records that the recording has.
    pub records: u64,
    /// `None` where it is not known how the disk kept up.
    pub statistics: Option<&'a WriteStatistics>,
}

/// Channels whose messages are JSON, in the order of [`json_channels`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JsonChannel {
    Gaps,
    Triggers,
    Clock,
    Events,
}

/// A segment being written: one MCAP file of a recording.
///
/// The recording makes one when it is created and at each split, and owns it. It promises that the file is a readable
/// prefix at every instant. It ends with [`Self::finish`]; after a failed write its window is abandoned.
pub struct Segment {
    mcap: mcap::Writer<Handle>,
    window: Arc<Mutex<Window>>,
    pub(super) number: u32,
    pub(super) first_trigger: u64,
    /// `None` in a copy of a recording without marks.
    mark: Option<SessionMark>,
    images: Vec<u16>,
    json: Vec<u16>,
    index_channel: u16,
    index: SegmentIndex,
    last_time_ns: u64,
    chunk_open: bool,
}

impl Segment {
    /// Starts a segment in an empty store; its header is on its way to the disk.
    pub fn create(
        store: Box<dyn Store>,
        number: u32,
        first_trigger: u64,
        header: &RecordingHeader,
        version: u32,
    ) -> io::Result<Self> {
        let window = Arc::new(Mutex::new(Window::new(store, STAGING_BYTES)?));
        // `commit` ends chunks. docs/design/recording.md explains why seeking is allowed; the window adds the
        // checksums.
        let options = mcap::WriteOptions::new()
            .compression(None)
            .chunk_size(None)
            .calculate_chunk_crcs(false)
            .calculate_data_section_crc(false)
            .profile("")
            .library(concat!("fourdbody ", env!("CARGO_PKG_VERSION")));
        let mcap = options.create(Handle(Arc::clone(&window))).map_err(io_error)?;
        let mut segment = Self {
            mcap,
            window,
            number,
            first_trigger,
            mark: Belonging::of(header, version).written(),
            images: Vec::new(),
            json: Vec::new(),
            index_channel: 0,
            index: SegmentIndex::default(),
            last_time_ns: header.created_ns,
            chunk_open: false,
        };
        segment.begin(header, version).map_err(io_error)?;
        segment.commit()?;
        Ok(segment)
    }

    fn begin(&mut self, header: &RecordingHeader, version: u32) -> Result<(), McapError> {
        let json = serde_json::to_string(header).map_err(|e| McapError::Io(e.into()))?;
        let entries = [
            ("format", FORMAT.to_owned()),
            ("version", version.to_string()),
            ("session", header.session.to_string()),
            ("session_id", header.session_id.clone()),
            ("node", header.node.to_string()),
            (KEY_SEGMENT, self.number.to_string()),
            (KEY_FIRST_TRIGGER, self.first_trigger.to_string()),
            (KEY_JSON, json),
            (KEY_RIG, header.rig_text.clone()),
        ];
        self.mcap.write_metadata(&metadata(HEADER_METADATA, entries))?;
        let none = BTreeMap::new();
        let image = self.mcap.add_schema(envelope::SCHEMA_NAME, "protobuf", &envelope::schema())?;
        for camera in &header.cameras {
            let id = self.mcap.add_channel(image, &image_topic(&camera.id), "protobuf", &none)?;
            self.images.push(id);
        }
        for (topic, name, schema) in json_channels() {
            let schema = self.mcap.add_schema(name, "jsonschema", schema.to_string().as_bytes())?;
            let id = self.mcap.add_channel(schema, topic, "json", &none)?;
            self.json.push(id);
        }
        let schema = index_schema().to_string();
        let schema = self.mcap.add_schema("fourdbody.Index", "jsonschema", schema.as_bytes())?;
        self.index_channel = self.mcap.add_channel(schema, INDEX_TOPIC, "json", &none)?;
        Ok(())
    }

    /// Bytes so far, the open chunk included.
    pub fn bytes(&self) -> u64 {
        self.window().position()
    }

    /// The open chunk, and what is on its way to the disk.
    pub(super) fn window(&self) -> MutexGuard<'_, Window> {
        lock(&self.window)
    }

    /// Adds a frame to the open chunk.
    pub fn frame(&mut self, camera: usize, meta: &FrameMeta, message: &[u8]) -> io::Result<()> {
        let channel_id = *self.images.get(camera).ok_or_else(|| io::Error::other("no such camera"))?;
        self.write(channel_id, meta.trigger.0, meta.host_time_ns, message)?;
        let offset = self.bytes() - message.len() as u64;
        self.index.frames.push((camera as u32, meta.trigger.0, offset, message.len() as u64));
        Ok(())
    }

    /// Adds a frame to the open chunk from its own memory, of which the envelope takes the room.
    pub fn frame_in_place(
        &mut self,
        camera: usize,
        id: &CameraId,
        meta: &FrameMeta,
        mut block: Block,
    ) -> io::Result<()> {
        let length = self.align(id, meta)?;
        envelope::write_padded_envelope(block.room_mut(), self.mark, id, meta, length)
            .map_err(io::Error::other)?;
        self.window().announce(block.pixels(), meta.pixels_crc);
        let result = self.frame(camera, meta, &block.bytes()[ROOM_BYTES - length..]);
        self.window().deliver(block);
        result
    }

    /// Length of the envelope that makes the next message's pixels begin at a whole block.
    fn align(&mut self, id: &CameraId, meta: &FrameMeta) -> io::Result<usize> {
        let possible = envelope::padded_lengths(self.mark, id, meta).map_err(io::Error::other)?;
        let room = |segment: &Self| {
            let chunk = if segment.chunk_open { 0 } else { CHUNK_HEADER };
            BLOCK - (segment.bytes() % BLOCK as u64) as usize + 2 * BLOCK - chunk - MESSAGE_HEADER
        };
        let length = |room: usize| if room.is_multiple_of(BLOCK) { BLOCK } else { room % BLOCK };
        let left = length(room(self));
        if possible.contains(&left) {
            return Ok(left);
        }
        // Too little is left of this block: the message begins with the next one, or just behind its start.
        let filler = vec![0; left.saturating_sub(PREAMBLE)];
        let options = PrivateRecordOptions::IncludeInChunks.into();
        self.mcap.write_private_record(FILLER, &filler, options).map_err(io_error)?;
        self.chunk_open = true;
        Ok(length(room(self)))
    }

    /// Adds a small record to the open chunk.
    pub fn json(&mut self, channel: JsonChannel, sequence: u64, time_ns: u64, json: &[u8]) -> io::Result<()> {
        match channel {
            JsonChannel::Gaps => self.index.gaps.push(serde_json::from_slice(json)?),
            JsonChannel::Triggers => {
                let row: TriggerRecord = serde_json::from_slice(json)?;
                self.index.triggers.get_or_insert_default().push(row.row());
            }
            JsonChannel::Clock | JsonChannel::Events => {}
        }
        self.write(self.json[channel as usize], sequence, time_ns, json)
    }

    fn write(&mut self, channel_id: u16, sequence: u64, time_ns: u64, data: &[u8]) -> io::Result<()> {
        self.last_time_ns = self.last_time_ns.max(time_ns);
        let header =
            MessageHeader { channel_id, sequence: sequence as u32, log_time: time_ns, publish_time: time_ns };
        self.chunk_open = true;
        self.mcap.write_to_known_channel(&header, data).map_err(io_error)
    }

    /// Ends the open chunk and hands it to the disk; returns the length of the file with it. An error concerns
    /// this commit or an earlier one.
    pub fn commit(&mut self) -> io::Result<u64> {
        self.mcap.flush().map_err(io_error)?;
        self.chunk_open = false;
        Ok(self.bytes())
    }

    /// Writes the index, the segment's range, and the summary; `closing` in the last one. The segment can only
    /// be dropped afterwards.
    pub fn finish(&mut self, end_trigger: Option<u64>, closing: Option<Closing<'_>>) -> io::Result<()> {
        let mut index = serde_json::to_vec(&self.index)?;
        Label { session: self.mark, number: None }.attach(&mut index);
        let mark = self.mark.map(|mark| (KEY_SESSION, mark.to_string()));
        self.write(self.index_channel, 0, self.last_time_ns, &index)?;
        let mut entries = vec![
            (KEY_SEGMENT, self.number.to_string()),
            (KEY_FIRST_TRIGGER, self.first_trigger.to_string()),
            (KEY_INDEX_OFFSET, (self.bytes() - index.len() as u64).to_string()),
            (KEY_INDEX_LENGTH, index.len().to_string()),
            (KEY_INDEX_CRC, crc32fast::hash(&index).to_string()),
        ];
        entries.extend(end_trigger.map(|end| (KEY_END_TRIGGER, end.to_string())));
        entries.extend(mark.clone());
        self.mcap.write_metadata(&metadata(SEGMENT_METADATA, entries)).map_err(io_error)?;
        if let Some(closing) = closing {
            if let Some(statistics) = closing.statistics {
                let entries =
                    [(KEY_JSON, serde_json::to_string(statistics)?)].into_iter().chain(mark.clone());
                self.mcap.write_metadata(&metadata(STATISTICS_METADATA, entries)).map_err(io_error)?;
            }
            let verdict = (KEY_JSON, serde_json::to_string(closing.verdict)?);
            let counted = mark.as_ref().map(|_| (KEY_RECORDS, closing.records.to_string()));
            let entries = [verdict].into_iter().chain(counted).chain(mark);
            self.mcap.write_metadata(&metadata(VERDICT_METADATA, entries)).map_err(io_error)?;
        }
        self.window().end_data();
        self.mcap.finish().map_err(io_error)?;
        self.window().close()
    }
}

fn metadata<'a>(name: &str, entries: impl IntoIterator<Item = (&'a str, String)>) -> Metadata {
    let mut metadata: BTreeMap<String, String> =
        entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    let crc = checksum(metadata.iter().map(|(key, value)| (key.as_str(), value.as_str())));
    metadata.insert(KEY_CRC.to_owned(), crc.to_string());
    Metadata { name: name.to_owned(), metadata }
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}
