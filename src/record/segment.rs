//! One segment: an MCAP file whose bytes on disk are a clean prefix at every instant.

use super::direct::{AlignedBuffer, BLOCK, Store};
use super::envelope::{self, FrameMeta};
use super::layout::{
    FORMAT, HEADER_METADATA, INDEX_TOPIC, KEY_END_TRIGGER, KEY_FIRST_TRIGGER, KEY_INDEX_CRC,
    KEY_INDEX_LENGTH, KEY_INDEX_OFFSET, KEY_JSON, KEY_RIG, KEY_SEGMENT, RecordingHeader, SEGMENT_METADATA,
    SegmentIndex, VERDICT_METADATA, VERSION, image_topic, index_schema, json_channels,
};
use super::verdict::Verdict;
use crossbeam_channel::{Receiver, Sender, bounded};
use mcap::McapError;
use mcap::records::{MessageHeader, Metadata};
use std::collections::BTreeMap;
use std::io::{self, Seek, SeekFrom, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What the disk thread of a segment is asked for.
enum Command {
    Write { buffer: AlignedBuffer, offset: u64, length: usize },
    SetLength(u64),
    Sync,
}

/// The answer; a buffer comes back with it.
type Reply = (io::Result<()>, Option<AlignedBuffer>);

/// Writes on a thread of its own, so that the next chunk is copied while the disk takes the last one. One
/// command is under way at a time.
struct Disk {
    commands: Sender<Command>,
    replies: Receiver<Reply>,
}

impl Disk {
    fn start(mut store: Box<dyn Store>) -> io::Result<Self> {
        let (commands, orders) = bounded::<Command>(1);
        let (answers, replies) = bounded::<Reply>(1);
        // Ends when the segment drops its side of the channels.
        std::thread::Builder::new().name("segment-disk".to_owned()).spawn(move || {
            for command in orders {
                let reply = match command {
                    Command::Write { buffer, offset, length } => {
                        (store.write_at(offset, &buffer.as_slice()[..length]), Some(buffer))
                    }
                    Command::SetLength(length) => (store.set_len(length), None),
                    Command::Sync => (store.sync(), None),
                };
                if answers.send(reply).is_err() {
                    break;
                }
            }
        })?;
        Ok(Self { commands, replies })
    }

    fn send(&self, command: Command) -> io::Result<()> {
        self.commands.send(command).map_err(|_| io::Error::other("the disk thread is gone"))
    }

    fn receive(&self) -> Reply {
        self.replies.recv().unwrap_or_else(|_| (Err(io::Error::other("the disk thread is gone")), None))
    }

    fn call(&self, command: Command) -> io::Result<()> {
        self.send(command)?;
        self.receive().0
    }
}

/// Holds the open chunk; what was committed before has left for the disk, except the start of its last
/// block, which is written again with what follows.
struct Window {
    disk: Disk,
    buffer: AlignedBuffer,
    spare: Option<AlignedBuffer>,
    /// Offset in the file of the buffer's first byte; a multiple of [`BLOCK`].
    base: u64,
    /// Bytes of the buffer in use.
    filled: usize,
    cursor: usize,
    /// True length of what the disk has.
    committed: u64,
    /// True length once the write under way is done.
    under_way: Option<u64>,
    failed: bool,
    closed: bool,
}

impl Window {
    fn new(store: Box<dyn Store>, bytes: usize) -> io::Result<Self> {
        Ok(Self {
            disk: Disk::start(store)?,
            buffer: AlignedBuffer::new(bytes),
            spare: None,
            base: 0,
            filled: 0,
            cursor: 0,
            committed: 0,
            under_way: None,
            failed: false,
            closed: false,
        })
    }

    fn position(&self) -> u64 {
        self.base + self.cursor as u64
    }

    fn check(&self) -> io::Result<()> {
        if self.failed { Err(io::Error::other("an earlier write to this segment failed")) } else { Ok(()) }
    }

    /// Waits for the write under way.
    fn settle(&mut self) -> io::Result<()> {
        self.check()?;
        let Some(end) = self.under_way.take() else { return Ok(()) };
        let (result, buffer) = self.disk.receive();
        self.spare = buffer;
        if result.is_err() {
            self.failed = true;
            // What was committed before must stay a clean prefix, and frames of this commit are reported
            // lost: they must not reappear. If this fails as well, nothing more can be done.
            let _ = self.disk.call(Command::SetLength(self.committed));
        } else {
            self.committed = end;
        }
        result
    }

    /// Hands everything to the disk, once it is done with the commit before; the last block is padded with
    /// zeros.
    fn commit(&mut self) -> io::Result<()> {
        self.settle()?;
        let end = self.base + self.filled as u64;
        if end == self.committed {
            return Ok(());
        }
        let length = self.filled.next_multiple_of(BLOCK);
        let whole = self.filled - self.filled % BLOCK;
        self.buffer.as_mut_slice()[self.filled..length].fill(0);
        let capacity = self.buffer.as_slice().len();
        let mut next = self.spare.take().unwrap_or_else(|| AlignedBuffer::new(capacity));
        next.as_mut_slice()[..self.filled - whole]
            .copy_from_slice(&self.buffer.as_slice()[whole..self.filled]);
        let buffer = std::mem::replace(&mut self.buffer, next);
        self.disk
            .send(Command::Write { buffer, offset: self.base, length })
            .inspect_err(|_| self.failed = true)?;
        self.under_way = Some(end);
        self.base += whole as u64;
        self.filled -= whole;
        self.cursor = self.filled;
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        self.settle()?;
        self.disk.call(Command::Sync).inspect_err(|_| self.failed = true)
    }

    fn close(&mut self) -> io::Result<()> {
        self.commit()?;
        self.settle()?;
        self.closed = true;
        self.disk.call(Command::SetLength(self.committed))?;
        self.sync()
    }
}

impl Drop for Window {
    fn drop(&mut self) {
        if !self.closed && !self.failed {
            // Somebody gave up before `finish`: keep what there is. There is nobody left to tell.
            let _ = self.close();
        }
    }
}

/// The window as the `mcap` writer holds it.
struct Handle(Arc<Mutex<Window>>);

impl Handle {
    fn lock(&self) -> MutexGuard<'_, Window> {
        // A panic in between leaves counts, not invariants, behind: the window stays usable.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Write for Handle {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut window = self.lock();
        window.check()?;
        let (cursor, end) = (window.cursor, window.cursor + bytes.len());
        window.buffer.reserve(end + BLOCK);
        window.buffer.as_mut_slice()[cursor..end].copy_from_slice(bytes);
        window.cursor = end;
        window.filled = window.filled.max(end);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.lock().commit()
    }
}

impl Seek for Handle {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let mut window = self.lock();
        let end = window.base + window.filled as u64;
        let target = match to {
            SeekFrom::Start(offset) => Some(offset),
            SeekFrom::Current(by) => window.position().checked_add_signed(by),
            SeekFrom::End(by) => end.checked_add_signed(by),
        };
        let inside = target.filter(|target| (window.base..=end).contains(target));
        let target = inside.ok_or_else(|| io::Error::other("seek to what has left the window"))?;
        window.cursor = (target - window.base) as usize;
        Ok(target)
    }
}

/// Channels whose messages are JSON, in the order of [`json_channels`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JsonChannel {
    /// Gap records.
    Gaps,
    /// The HSU's trigger table.
    Triggers,
    /// Clock samples.
    Clock,
    /// Node events.
    Events,
}

/// A segment being written.
pub struct Segment {
    mcap: mcap::Writer<Handle>,
    window: Arc<Mutex<Window>>,
    number: u32,
    first_trigger: u64,
    images: Vec<u16>,
    json: Vec<u16>,
    index_channel: u16,
    index: SegmentIndex,
    last_time_ns: u64,
}

impl Segment {
    /// Starts a segment in an empty store; its header is committed.
    pub fn create(
        store: Box<dyn Store>,
        window_bytes: usize,
        number: u32,
        first_trigger: u64,
        header: &RecordingHeader,
    ) -> io::Result<Self> {
        let window = Arc::new(Mutex::new(Window::new(store, window_bytes)?));
        // Chunks end where `commit` says; see docs/design/recording.md for why seeking is allowed.
        let options = mcap::WriteOptions::new()
            .compression(None)
            .chunk_size(None)
            .profile("")
            .library(concat!("fourdbody ", env!("CARGO_PKG_VERSION")));
        let mcap = options.create(Handle(Arc::clone(&window))).map_err(io_error)?;
        let mut segment = Self {
            mcap,
            window,
            number,
            first_trigger,
            images: Vec::new(),
            json: Vec::new(),
            index_channel: 0,
            index: SegmentIndex::default(),
            last_time_ns: header.created_ns,
        };
        segment.begin(header).map_err(io_error)?;
        segment.commit()?;
        segment.settle()?;
        Ok(segment)
    }

    fn begin(&mut self, header: &RecordingHeader) -> Result<(), McapError> {
        let json = serde_json::to_string(header).map_err(|e| McapError::Io(e.into()))?;
        let entries = [
            ("format", FORMAT.to_owned()),
            ("version", VERSION.to_string()),
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

    /// First trigger of the segment.
    pub fn first_trigger(&self) -> u64 {
        self.first_trigger
    }

    /// Bytes so far, the open chunk included.
    pub fn bytes(&self) -> u64 {
        self.lock().position()
    }

    fn lock(&self) -> MutexGuard<'_, Window> {
        self.window.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a frame to the open chunk.
    pub fn frame(&mut self, camera: usize, meta: &FrameMeta, message: &[u8]) -> io::Result<()> {
        let channel_id = *self.images.get(camera).ok_or_else(|| io::Error::other("no such camera"))?;
        self.write(channel_id, meta.trigger.0, meta.host_time_ns, message)?;
        let offset = self.bytes() - message.len() as u64;
        self.index.frames.push((camera as u32, meta.trigger.0, offset, message.len() as u64));
        Ok(())
    }

    /// Adds a small record to the open chunk.
    pub fn json(&mut self, channel: JsonChannel, sequence: u64, time_ns: u64, json: &[u8]) -> io::Result<()> {
        if channel == JsonChannel::Gaps {
            self.index.gaps.push(serde_json::from_slice(json)?);
        }
        self.write(self.json[channel as usize], sequence, time_ns, json)
    }

    fn write(&mut self, channel_id: u16, sequence: u64, time_ns: u64, data: &[u8]) -> io::Result<()> {
        self.last_time_ns = self.last_time_ns.max(time_ns);
        let header =
            MessageHeader { channel_id, sequence: sequence as u32, log_time: time_ns, publish_time: time_ns };
        self.mcap.write_to_known_channel(&header, data).map_err(io_error)
    }

    /// Ends the open chunk and hands it to the disk, once the chunk before is written: that one survives the
    /// process from here on. An error concerns one of the two.
    pub fn commit(&mut self) -> io::Result<()> {
        self.mcap.flush().map_err(io_error)
    }

    /// Waits until the last commit is written.
    pub fn settle(&mut self) -> io::Result<()> {
        self.lock().settle()
    }

    /// Commits, and returns when it survives a power cut.
    pub fn sync(&mut self) -> io::Result<()> {
        self.commit()?;
        self.lock().sync()
    }

    /// Makes sure that nothing more is written: the open chunk's frames are accounted for elsewhere.
    pub fn abandon(&mut self) {
        self.lock().failed = true;
    }

    /// Writes the index, the segment's range, the verdict if this is the last one, and the summary.
    pub fn finish(mut self, end_trigger: Option<u64>, verdict: Option<&Verdict>) -> io::Result<()> {
        let index = serde_json::to_vec(&self.index)?;
        self.write(self.index_channel, 0, self.last_time_ns, &index)?;
        let mut entries = vec![
            (KEY_SEGMENT, self.number.to_string()),
            (KEY_FIRST_TRIGGER, self.first_trigger.to_string()),
            (KEY_INDEX_OFFSET, (self.bytes() - index.len() as u64).to_string()),
            (KEY_INDEX_LENGTH, index.len().to_string()),
            (KEY_INDEX_CRC, crc32fast::hash(&index).to_string()),
        ];
        entries.extend(end_trigger.map(|end| (KEY_END_TRIGGER, end.to_string())));
        self.mcap.write_metadata(&metadata(SEGMENT_METADATA, entries)).map_err(io_error)?;
        if let Some(verdict) = verdict {
            let entries = [(KEY_JSON, serde_json::to_string(verdict)?)];
            self.mcap.write_metadata(&metadata(VERDICT_METADATA, entries)).map_err(io_error)?;
        }
        self.mcap.finish().map_err(io_error)?;
        self.lock().close()
    }
}

fn metadata<'a>(name: &str, entries: impl IntoIterator<Item = (&'a str, String)>) -> Metadata {
    let metadata = entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    Metadata { name: name.to_owned(), metadata }
}

fn io_error(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}
