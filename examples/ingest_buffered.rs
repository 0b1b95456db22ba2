// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorder that one would write in an afternoon: the same cameras and the same train as `fourdbody node`, each
//! frame a message of a plain `mcap::Writer` over a buffered file. What `make bench-ingest` compares the node with.
//!
//! `cargo run --release --example ingest_buffered -- NODE.toml FILE.mcap TRIGGERS`
//!
//! Prints one JSON line when the train starts, one when the last frame is written, one when the file is closed. No
//! gap records, no checksums of its own, no matching of frames to triggers: only what writing costs.

use crossbeam_channel::{Receiver, bounded};
use fourdbody::base::ids::SessionName;
use fourdbody::camera::{
    AravisCameras, Camera, CameraBackend, FrameContract, Received, StreamOptions, Transfer, Wishes,
};
use fourdbody::config::{NodeConfig, Pixel};
use fourdbody::host::frame_memory::Block;
use fourdbody::hsu::{ArmRequest, Hsu, HsuTimeouts, HsuTiming, TriggerUnit, session_id};
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

type Failure = Box<dyn Error>;

/// After the last trigger is due, how long no frame may come before the rest counts as lost.
const PATIENCE: Duration = Duration::from_millis(1500);

struct Cameras {
    opened: Vec<Box<dyn Camera>>,
    frames: Receiver<(usize, Received)>,
    stop: Arc<AtomicBool>,
    threads: Vec<std::thread::JoinHandle<()>>,
}

impl Cameras {
    /// Opens, sets and starts every camera, with a thread each that takes frames off its stream.
    fn start(config: &NodeConfig, period_ns: u64) -> Result<Self, Failure> {
        let mut backend = AravisCameras;
        let mut opened = Vec::new();
        for camera in &config.cameras {
            let mut device = backend.open(&camera.address)?;
            device.set_up(&Wishes::of(config, camera))?;
            opened.push(device);
        }
        let (sender, frames) = bounded(config.buffers_per_camera * opened.len());
        let stop = Arc::new(AtomicBool::new(false));
        let mut threads = Vec::new();
        for (number, camera) in opened.iter_mut().enumerate() {
            let size = camera.image_size()?;
            let contract =
                FrameContract { pixel: Pixel::Mono8, size, place: (0, 0), offset: (0, 0), chunk_room: 0 };
            let blocks = (0..config.buffers_per_camera).map(|_| Block::allocate(contract.pixels())).collect();
            let (packet_bytes, socket) = (config.packet_bytes, config.socket);
            let options = StreamOptions { contract, packet_bytes, socket, period_ns };
            let mut stream = camera.create_stream(blocks, &options)?;
            let (sender, stop) = (sender.clone(), Arc::clone(&stop));
            threads.push(std::thread::spawn(move || {
                while !stop.load(Ordering::Acquire) {
                    let Some(frame) = stream.next(Duration::from_millis(20)) else { continue };
                    if sender.send((number, frame)).is_err() {
                        return;
                    }
                }
            }));
        }
        opened.iter_mut().try_for_each(|camera| camera.start())?;
        Ok(Self { opened, frames, stop, threads })
    }

    fn stop(mut self) -> Result<(), Failure> {
        self.opened.iter_mut().try_for_each(|camera| camera.stop())?;
        self.stop.store(true, Ordering::Release);
        drop(self.frames);
        self.threads.into_iter().try_for_each(|thread| thread.join()).map_err(|_| "a receiver panicked")?;
        Ok(())
    }
}

fn start_train(config: &NodeConfig, triggers: u64) -> Result<Hsu, Failure> {
    let hsu = TriggerUnit::of(config).connect(&config.node, &HsuTimeouts::default())?;
    hsu.configure(&HsuTiming::from_rig(&config.rig))?;
    let session = session_id(&SessionName::from(format!("buffered-{}", std::process::id()).as_str()));
    hsu.arm(&ArmRequest { session, triggers: Some(triggers), warm_up: 0, nodes: vec![config.node.clone()] })?;
    hsu.wait_armed(session, Duration::from_secs(5))?;
    hsu.start(session)?;
    Ok(hsu)
}

fn main() -> Result<(), Failure> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [config, file, triggers] = args.as_slice() else {
        return Err("usage: ingest_buffered NODE.toml FILE.mcap TRIGGERS".into());
    };
    let (config, triggers) = (NodeConfig::load(Path::new(config))?, triggers.parse::<u64>()?);
    let mut writer = mcap::Writer::new(BufWriter::new(File::create_new(file)?))?;
    let schema = writer.add_schema("pixels", "", &[])?;
    let channels = config
        .cameras
        .iter()
        .map(|camera| writer.add_channel(schema, &format!("/camera/{}", camera.id), "", &BTreeMap::new()))
        .collect::<Result<Vec<u16>, _>>()?;

    let period = Duration::from_secs_f64(1.0 / config.rig.trigger_rate_hz);
    let cameras = Cameras::start(&config, u64::try_from(period.as_nanos())?)?;
    let hsu = start_train(&config, triggers)?;
    println!("{}", serde_json::json!({ "started": true }));

    let expected = triggers * cameras.opened.len() as u64;
    let train_ends = Instant::now() + period * u32::try_from(triggers)?;
    let (mut last, mut taken, mut recorded, mut high_water) = (Instant::now(), 0, 0, 0);
    let mut writes = Vec::with_capacity(usize::try_from(expected)?);
    while taken < expected && (Instant::now() < train_ends + PATIENCE || last.elapsed() < PATIENCE) {
        let Ok((camera, frame)) = cameras.frames.recv_timeout(Duration::from_millis(100)) else { continue };
        (last, taken) = (Instant::now(), taken + 1);
        high_water = high_water.max(cameras.frames.len() + 1);
        if frame.transfer != Transfer::Complete {
            continue;
        }
        let header = MessageHeader {
            channel_id: channels[camera],
            sequence: frame.block_id.0 as u32,
            log_time: frame.host_ns,
            publish_time: frame.camera_ns,
        };
        writer.write_to_known_channel(&header, frame.block.pixels())?;
        writes.push(last.elapsed());
        recorded += 1;
    }
    writes.sort();
    let p99 = writes.get(writes.len() * 99 / 100).map(|d| d.as_secs_f64() * 1e3);
    println!(
        "{}",
        serde_json::json!({
            "ended": true, "frames_expected": expected, "frames_recorded": recorded,
            "ring_high_water_frames": high_water, "write_p99_ms": p99,
        })
    );
    cameras.stop()?;
    drop(hsu);
    writer.finish()?;
    println!("{}", serde_json::json!({ "closed": true }));
    Ok(())
}
