//! How fast this machine records: frames of a node's four cameras, from memory to disk, nothing else running.
//!
//! `cargo run --release --no-default-features --example record_rate -- DIR [FRAMES [SYNC_MS]]`
//!
//! Prints the time of a `Recording::frame` call (mean, p99, maximum), the rate, and the processor time of the
//! whole process per GB recorded, the checksum of the pixels apart. A node needs 480 frames/s, 1.106 GB/s.

use fourdbody::ids::{BlockId, CameraId, NodeId, SessionName, TriggerIndex};
use fourdbody::record::envelope::pixels_crc;
use fourdbody::record::{
    CameraHeader, ENVELOPE_CAPACITY, FrameMeta, GapCause, Recording, RecordingHeader, SessionEnd,
    WriterOptions, write_envelope,
};
use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

const CAMERAS: usize = 4;
const WIDTH: u32 = 1920;
const HEIGHT: u32 = 1200;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;
/// Buffers that take turns, so that caches do not flatter the result.
const POOL: usize = 64;

fn header() -> RecordingHeader {
    let camera = |i: usize| CameraHeader {
        id: CameraId(format!("camera_{i}")),
        width: WIDTH,
        height: HEIGHT,
        device: String::new(),
        settings: Vec::new(),
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

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let dir = args.next().ok_or("usage: record_rate DIR [FRAMES [SYNC_MS]]")?;
    let frames: u64 = args.next().map_or(Ok(2400), |text| text.parse())?;
    let mut pool: Vec<Vec<u8>> =
        (0..POOL).map(|i| (0..ENVELOPE_CAPACITY + PIXELS).map(|p| (p * 31 + i) as u8).collect()).collect();
    let mut options = WriterOptions::default();
    if let Some(text) = args.next() {
        options.sync_interval = Duration::from_millis(text.parse()?);
        options.sync_bytes = u64::MAX;
    }
    let mut recording = Recording::create(Path::new(&dir), header(), options)?;
    let (mut calls, mut checksums) = (Vec::new(), Duration::ZERO);
    let (started, processor_before) = (Instant::now(), processor_time()?);
    for n in 0..frames {
        let (camera, trigger) = (n as usize % CAMERAS, n / CAMERAS as u64);
        let buffer = &mut pool[n as usize % POOL];
        let before = Instant::now();
        let pixels_crc = pixels_crc(&buffer[ENVELOPE_CAPACITY..]);
        checksums += before.elapsed();
        let meta = FrameMeta {
            trigger: TriggerIndex(trigger),
            block: BlockId(trigger),
            camera_time_ns: trigger * 8_333_333,
            host_time_ns: trigger * 8_333_333,
            width: WIDTH,
            height: HEIGHT,
            pixels_crc,
        };
        let id = CameraId(format!("camera_{camera}"));
        let length = write_envelope(&mut buffer[..ENVELOPE_CAPACITY], &id, &meta)?;
        let before = Instant::now();
        recording.frame(camera, &meta, &buffer[ENVELOPE_CAPACITY - length..])?;
        calls.push(before.elapsed());
    }
    let end =
        SessionEnd { triggers_emitted: None, aborted: None, absent: GapCause::Unknown, host_time_ns: 0 };
    let before = Instant::now();
    recording.finish(end)?;
    let (finish, wall) = (before.elapsed(), started.elapsed());
    let processor = processor_time()? - processor_before;
    calls.sort();
    let ms = |d: Duration| d.as_secs_f64() * 1e3;
    let gb = frames as f64 * PIXELS as f64 / 1e9;
    let mean = calls.iter().sum::<Duration>() / frames.max(1) as u32;
    println!("frames              {frames} ({gb:.2} GB)");
    println!(
        "rate                {:.0} frames/s, {:.2} GB/s",
        frames as f64 / wall.as_secs_f64(),
        gb / wall.as_secs_f64()
    );
    println!("pixel checksum      {:.3} ms/frame", ms(checksums) / frames as f64);
    println!(
        "Recording::frame    {:.3} ms mean, {:.3} ms p99, {:.3} ms max",
        ms(mean),
        ms(calls[calls.len() * 99 / 100]),
        ms(calls[calls.len() - 1])
    );
    println!("Recording::finish   {:.1} ms", ms(finish));
    println!("processor           {:.3} s/GB in all", processor.as_secs_f64() / gb);
    Ok(())
}
