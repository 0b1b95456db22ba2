// SPDX-License-Identifier: MIT OR Apache-2.0
//! How fast this machine records: frames of a node's four cameras, from memory to disk, nothing else running.
//!
//! `cargo run --release --no-default-features --example record_rate -- DIR [FRAMES] [--buffered-mcap] [--no-preallocation] [--copy] [--small-pages]`
//!
//! Prints the rate, the time of the call that hands a frame over, write latencies, and the processor time of the
//! whole process per GB recorded, the checksum of the pixels included. A node needs 480 frames/s, 1.106 GB/s.
//! `--buffered-mcap` writes the same frames with the `mcap` crate over a plain buffered file, `--copy` with
//! `Recording::frame`, which copies them, `--small-pages` takes each block from the allocator, as before the node had a
//! pool on huge pages. The files are deleted at the end.

use crossbeam_channel::{Receiver, unbounded};
use fourdbody::base::ids::{BlockId, CameraId, NodeId, SessionName, TriggerIndex};
use fourdbody::host::frame_memory::{Block, Pool, ROOM_BYTES, block_bytes};
use fourdbody::record::envelope::{pixels_crc, schema};
use fourdbody::record::{
    BLOCKS_HELD, CameraHeader, FrameMeta, GapCause, Recording, RecordingHeader, SessionEnd, WriteStatistics,
    WriterOptions, write_envelope,
};
use std::collections::BTreeMap;
use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const CAMERAS: usize = 4;
const WIDTH: u32 = 1920;
const HEIGHT: u32 = 1200;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;
/// Blocks that take turns, so that caches do not flatter the result.
const POOL: usize = 64;
const _: () = assert!(POOL > BLOCKS_HELD);

fn header() -> RecordingHeader {
    let camera = |i: usize| CameraHeader {
        id: CameraId(format!("camera_{i}")),
        width: WIDTH,
        height: HEIGHT,
        device: String::new(),
        pixel_format: String::new(),
        settings: Vec::new(),
        state: std::collections::BTreeMap::new(),
    };
    RecordingHeader {
        session: SessionName::from("rate"),
        session_id: "rate".to_owned(),
        node: NodeId::from("a"),
        rig_text: String::new(),
        cameras: (0..CAMERAS).map(camera).collect(),
        hsu: None,
        expected_triggers: None,
        trigger_rate_hz: 120.0,
        host_clock: "none".to_owned(),
        created_ns: 0,
        software: "record_rate".to_owned(),
        subject: None,
        note: None,
    }
}

/// Processor time of this process so far (fields 14 and 15 of `/proc/self/stat`, in ticks of 10 ms).
fn processor_time() -> Result<Duration, Box<dyn Error>> {
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    let after_name = stat.rsplit(") ").next().unwrap_or_default();
    let ticks: u64 = after_name.split(' ').skip(11).take(2).filter_map(|t| t.parse::<u64>().ok()).sum();
    Ok(Duration::from_millis(ticks * 10))
}

/// The writer that receives the frames.
enum Sink {
    InPlace(Box<Recording>),
    Copied(Box<Recording>),
    Buffered { writer: Box<mcap::Writer<BufWriter<File>>>, channels: Vec<u16> },
}

impl Sink {
    fn create(path: &Path, flags: &[String]) -> Result<Self, Box<dyn Error>> {
        let given = |flag: &str| flags.iter().any(|given| given == flag);
        if given("--buffered-mcap") {
            std::fs::create_dir(path)?;
            let file = BufWriter::with_capacity(1 << 20, File::create_new(path.join("plain.mcap"))?);
            let mut writer = mcap::WriteOptions::new().compression(None).create(file)?;
            let schema = writer.add_schema("foxglove.RawImage", "protobuf", &schema())?;
            let mut add =
                |i| writer.add_channel(schema, &format!("/camera_{i}"), "protobuf", &BTreeMap::new());
            let channels = (0..CAMERAS).map(&mut add).collect::<Result<_, _>>()?;
            return Ok(Self::Buffered { writer: Box::new(writer), channels });
        }
        let options = WriterOptions { preallocate: !given("--no-preallocation"), ..WriterOptions::default() };
        let recording = Box::new(Recording::create(path, header(), options)?);
        Ok(if given("--copy") { Self::Copied(recording) } else { Self::InPlace(recording) })
    }

    fn frame(&mut self, camera: usize, meta: &FrameMeta, mut block: Block) -> Result<(), Box<dyn Error>> {
        if let Self::InPlace(recording) = self {
            return Ok(recording.frame_in_place(camera, meta, block)?);
        }
        let id = CameraId(format!("camera_{camera}"));
        let length = write_envelope(block.room_mut(), &id, meta)?;
        let message = &block.bytes()[ROOM_BYTES - length..];
        match self {
            Self::InPlace(_) => {}
            Self::Copied(recording) => recording.frame(camera, meta, message)?,
            Self::Buffered { writer, channels } => {
                let time = meta.host_time_ns;
                let (channel_id, sequence) = (channels[camera], meta.trigger.0 as u32);
                let header =
                    mcap::records::MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
                writer.write_to_known_channel(&header, message)?;
            }
        }
        Ok(())
    }

    /// Waits until all bytes are on the medium.
    fn finish(self) -> Result<Option<WriteStatistics>, Box<dyn Error>> {
        match self {
            Self::InPlace(recording) | Self::Copied(recording) => {
                let statistics = recording.statistics();
                let absent = GapCause::Unknown;
                recording.finish(SessionEnd {
                    triggers_emitted: None,
                    aborted: None,
                    absent,
                    host_time_ns: 0,
                })?;
                Ok(Some(statistics))
            }
            Self::Buffered { mut writer, .. } => {
                writer.finish()?;
                writer.into_inner().into_inner()?.sync_data()?;
                Ok(None)
            }
        }
    }
}

/// Blocks that come back when the disk has them.
fn pool(small_pages: bool) -> Result<Receiver<Block>, Box<dyn Error>> {
    let (home, returns) = unbounded();
    let blocks: Vec<Block> = match small_pages {
        true => (0..POOL).map(|_| Block::allocate(PIXELS)).collect(),
        false => Pool::new(true, (POOL * block_bytes(PIXELS)) as u64).take(PIXELS, PIXELS, POOL)?,
    };
    for (i, mut block) in blocks.into_iter().enumerate() {
        block.bytes_mut().iter_mut().enumerate().for_each(|(p, byte)| *byte = (p * 31 + i) as u8);
        block.set_home(home.clone());
        drop(block);
    }
    // The pool keeps the sending end: a block that comes home has forgotten it.
    HOME.get_or_init(|| home);
    Ok(returns)
}

static HOME: std::sync::OnceLock<crossbeam_channel::Sender<Block>> = std::sync::OnceLock::new();

fn main() -> Result<(), Box<dyn Error>> {
    let (flags, args): (Vec<_>, Vec<_>) = std::env::args().skip(1).partition(|arg| arg.starts_with("--"));
    let dir: PathBuf = args.first().ok_or("usage: record_rate DIR [FRAMES] [--buffered-mcap] ...")?.into();
    let frames: u64 = args.get(1).map_or(Ok(2400), |text| text.parse())?;
    let blocks = pool(flags.iter().any(|flag| flag == "--small-pages"))?;
    let mut sink = Sink::create(&dir, &flags)?;
    let (mut calls, mut waited) = (Vec::new(), Duration::ZERO);
    let (started, processor_before) = (Instant::now(), processor_time()?);
    for n in 0..frames {
        let (camera, trigger) = (n as usize % CAMERAS, n / CAMERAS as u64);
        let before = Instant::now();
        let mut block = blocks.recv()?;
        waited += before.elapsed();
        block.set_home(HOME.get().ok_or("no pool")?.clone());
        let time = trigger * 8_333_333;
        let meta = FrameMeta {
            trigger: TriggerIndex(trigger),
            block: BlockId(trigger),
            camera_time_ns: time,
            host_time_ns: time,
            width: WIDTH,
            height: HEIGHT,
            pixels_crc: pixels_crc(block.pixels()),
        };
        let before = Instant::now();
        sink.frame(camera, &meta, block)?;
        calls.push(before.elapsed());
    }
    let statistics = sink.finish()?;
    let (wall, processor) = (started.elapsed(), processor_time()? - processor_before);
    std::fs::remove_dir_all(&dir)?;
    calls.sort();
    let ms = |d: Duration| d.as_secs_f64() * 1e3;
    let gb = frames as f64 * PIXELS as f64 / 1e9;
    let (rate, speed) = (frames as f64 / wall.as_secs_f64(), gb / wall.as_secs_f64());
    println!("{frames} frames, {gb:.2} GB: {rate:.0} frames/s, {speed:.2} GB/s");
    println!("processor {:.3} s/GB, checksum of the pixels included", processor.as_secs_f64() / gb);
    let at =
        |part: usize| ms(calls.get(calls.len().saturating_sub(1) * part / 100).copied().unwrap_or_default());
    println!(
        "call: p50 {:.3} ms, p99 {:.3} ms, max {:.3} ms; waited for blocks {:.0} ms in all",
        at(50),
        at(99),
        at(100),
        ms(waited)
    );
    if let Some(statistics) = statistics {
        println!("{statistics:?}");
    }
    Ok(())
}
