// SPDX-License-Identifier: MIT OR Apache-2.0
//! One thread per camera: takes frames off its stream and hands them to the recorder.
//!
//! The checksum is computed here, so that it covers the way through the recorder and is spread over cores.

use super::progress::Progress;
use crate::base::ids::BlockId;
use crate::base::time::HostClock;
use crate::camera::{FrameStream, Transfer};
use crate::host::frame_memory::Block;
use crate::host::realtime;
use crate::record::envelope::pixels_crc;
use crossbeam_channel::Sender;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A frame on its way to the recorder.
#[derive(Debug)]
pub struct Arrival {
    /// The camera's place in the node's list.
    pub camera: usize,
    /// Number of the camera's stream in this session: 0, and one more whenever the camera is back.
    pub stream: u32,
    /// The outcome of the transfer.
    pub transfer: Transfer,
    /// The camera's frame number (GVSP block id).
    pub block_id: BlockId,
    /// Start of exposure, camera clock, ns.
    pub camera_ns: u64,
    /// Arrival of the first packet, the session's host clock, ns.
    pub host_ns: u64,
    /// CRC-32 of the pixels; 0 when the transfer is not complete.
    pub pixels_crc: u32,
    /// When the frame was taken from the stream.
    pub taken: Instant,
    /// The pixels, with room before them.
    pub block: Block,
}

/// A running receiver: the thread that takes frames from one stream. Whoever starts the stream owns it; it ends with
/// [`Receiver::stop`], or when the recorder has ended.
#[derive(Debug)]
pub struct Receiver {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Vec<(String, u64)>>,
}

/// The parameters of a receiver.
#[derive(Debug, Clone)]
pub struct ReceiverSetup {
    /// The camera's place in the node's list.
    pub camera: usize,
    /// Number of the stream, see [`Arrival::stream`].
    pub stream: u32,
    /// Channel to the recorder; it has room for all blocks.
    pub recorder: Sender<Arrival>,
    /// Counters of packets and frames.
    pub progress: Arc<Progress>,
    /// The host clock of the session.
    pub clock: HostClock,
    /// Longest wait for a frame before the packets are counted again: a trigger period.
    pub patience: Duration,
}

impl Receiver {
    /// Starts the receiver's thread for one stream.
    pub fn start(mut stream: Box<dyn FrameStream>, setup: ReceiverSetup) -> std::io::Result<Self> {
        let ReceiverSetup { camera, stream: number, recorder, progress, clock, patience } = setup;
        // The count of the camera's earlier streams in this session.
        let before = progress.activity[camera].load(Ordering::Relaxed);
        let stop = Arc::new(AtomicBool::new(false));
        let stopping = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name(format!("receive-{camera}")).spawn(move || {
            realtime::enter_configured("receiver");
            while !stopping.load(Ordering::Acquire) {
                let frame = stream.next(patience);
                progress.activity[camera].store(before + stream.activity(), Ordering::Relaxed);
                let Some(frame) = frame else { continue };
                progress.received[camera].fetch_add(1, Ordering::Relaxed);
                let complete = frame.transfer == Transfer::Complete;
                // A frame that lost its leader has no identity: the frames around it show that it is missing.
                if !complete && frame.block_id == BlockId(0) && frame.camera_ns == 0 {
                    continue;
                }
                let arrival = Arrival {
                    camera,
                    stream: number,
                    transfer: frame.transfer,
                    block_id: frame.block_id,
                    camera_ns: frame.camera_ns,
                    host_ns: clock.from_recent_realtime(frame.host_ns),
                    pixels_crc: if complete { pixels_crc(frame.block.pixels()) } else { 0 },
                    taken: Instant::now(),
                    block: frame.block,
                };
                // The channel holds as many frames as there are blocks: it is never full.
                if recorder.send(arrival).is_err() {
                    break;
                }
            }
            stream.counters()
        })?;
        Ok(Self { stop, thread })
    }

    /// Ends the stream and returns its counters by Aravis' names.
    pub fn stop(self) -> Vec<(String, u64)> {
        self.stop.store(true, Ordering::Release);
        self.thread.join().unwrap_or_default()
    }
}
