// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cameras through Aravis 0.8: with its folder the only place that names it.
//!
//! Pitfalls of Aravis, and what is done about them here (measured on 0.8.26):
//! * `Camera::new` succeeds without control of the camera: [`open`](CameraBackend::open) checks for it.
//! * Late blocks of a reused stream are thrown away silently: every session gets a fresh stream.
//! * Automatic packet size may exceed the MTU: it is explicit, adjustment is off.
//! * An incomplete frame holds back later ones for `frame-retention`: it is set to a few trigger periods.
//! * A truncated packet counts as a whole one: GigE blocks carry [`Canaries`], and the bytes that arrived are
//!   counted.
//! * A frame is complete when its packets came, whatever its leader describes: each frame is checked against its
//!   contract.
//! * Without a tick frequency frames get the host's time as timestamp: such a timestamp is ignored.

use self::registers::holder;
use super::backend::{
    Camera, CameraBackend, CameraClockSample, CameraIdentity, CameraListing, FrameStream, PacketTest,
    Received, StreamOptions, Transfer,
};
use super::canary::Canaries;
use super::chunks::first_chunk;
use super::contract::{Breach, Chunks, FrameContract, FrameForm, Payload};
use super::device_clock::{self, DeviceClock};
use super::error::CameraError;
use super::features::{Failed, Features, or_reason};
use super::packet_size;
use super::unpack::{take_plane, unpack};
use crate::base::ids::{BlockId, one_line};
use crate::config::SocketMode;
use crate::host::frame_memory::Block;
use crate::host::realtime;
use aravis::prelude::*;
use crossbeam_channel::{Receiver, Sender, bounded};
use glib::prelude::{Cast, ObjectExt};
use glib::translate::{ToGlibPtr, from_glib_full};
use std::ffi::c_void;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

mod checked;
mod device_features;
#[cfg(test)]
mod fake_tests;
mod registers;
mod test_packets;

/// Largest number of columns or rows that is accepted; no sensor has as many.
const SIDE_MAX: usize = 1 << 20;

/// The cameras that Aravis can reach.
#[derive(Debug, Default)]
pub struct AravisCameras;

impl CameraBackend for AravisCameras {
    fn list(&mut self) -> Vec<CameraListing> {
        // SAFETY: plain calls without arguments; Aravis serializes access to its device list.
        let count = unsafe {
            aravis_sys::arv_update_device_list();
            aravis_sys::arv_get_n_devices()
        };
        let text = |pointer: *const std::ffi::c_char| {
            // SAFETY: null, or a text that lives until the next list update; copied at once.
            one_line(unsafe { checked::text(pointer) }.unwrap_or_default())
        };
        let describe = |i| {
            // SAFETY: i is below the count of devices.
            unsafe {
                CameraListing {
                    id: text(aravis_sys::arv_get_device_id(i)),
                    address: text(aravis_sys::arv_get_device_address(i)),
                    vendor: text(aravis_sys::arv_get_device_vendor(i)),
                    model: text(aravis_sys::arv_get_device_model(i)),
                    serial: text(aravis_sys::arv_get_device_serial_nbr(i)),
                    protocol: text(aravis_sys::arv_get_device_protocol(i)),
                }
            }
        };
        (0..count).map(describe).collect()
    }

    fn open(&mut self, address: &str) -> Result<Box<dyn Camera>, CameraError> {
        let not_found =
            |e: glib::Error| CameraError::NotFound { address: address.to_owned(), detail: message_of(&e) };
        let camera = checked::open(address).map_err(not_found)?;
        let device = camera
            .device()
            .ok_or(CameraError::Link { doing: "opening it", detail: "Aravis gave no device".to_owned() })?;
        if let Some(gv) = device.downcast_ref::<aravis::GvDevice>()
            && !gv.is_controller()
        {
            return Err(CameraError::Owned { address: address.to_owned(), holder: holder(&device) });
        }
        let lost = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&lost);
        device.connect_control_lost(move |_| flag.store(true, Ordering::Release));
        let [vendor, model, serial] = checked::identity(&camera).map(one_line);
        let identity = CameraIdentity { vendor, model, serial };
        Ok(Box::new(AravisCamera { camera, device, identity, lost, clock: None }))
    }
}

/// A camera that Aravis has opened and this program controls, until it is dropped or control is lost.
struct AravisCamera {
    camera: aravis::Camera,
    device: aravis::Device,
    identity: CameraIdentity,
    lost: Arc<AtomicBool>,
    /// How the clock is read, or why it cannot be; `None` before the first attempt.
    clock: Option<Result<DeviceClock, String>>,
}

fn link_error(doing: &'static str) -> impl Fn(glib::Error) -> CameraError {
    move |e| CameraError::Link { doing, detail: message_of(&e) }
}

/// Aravis' error text for messages, without the GenICam nodes `[Width] [WidthReg] ...` in front, which go to the log.
fn message_of(error: &glib::Error) -> String {
    let whole = error.message();
    let short = without_nodes(whole);
    if short != whole {
        tracing::debug!("Aravis: {whole}");
    }
    short.to_owned()
}

/// A message without the names in brackets in front of it.
fn without_nodes(message: &str) -> &str {
    let mut text = message.trim();
    while let Some((_, rest)) = text.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        // A message of names alone stays as it is.
        if rest.trim().is_empty() {
            return message.trim();
        }
        text = rest.trim_start();
    }
    text
}

impl Camera for AravisCamera {
    fn identity(&self) -> &CameraIdentity {
        &self.identity
    }

    fn is_alive(&self) -> bool {
        !self.lost.load(Ordering::Acquire)
    }

    fn not_ours(&self) -> Option<CameraError> {
        // A camera that does not answer cannot report its controller.
        let privilege = self.privilege()?;
        let holder = holder(&self.device).filter(|_| privilege != 0);
        Some(CameraError::NotOurs { holder, detail: "its control channel was lost".to_owned() })
    }

    fn features(&self) -> &dyn Features {
        self
    }

    fn image_size(&mut self) -> Result<(usize, usize), CameraError> {
        const DOING: &str = "reading the image size";
        let read = |feature| {
            or_reason(self.integer(feature))?.map_err(|detail| CameraError::Link { doing: DOING, detail })
        };
        let (width, height) = (read("Width")?, read("Height")?);
        let side = |pixels: i64| usize::try_from(pixels).ok().filter(|side| (1..=SIDE_MAX).contains(side));
        side(width).zip(side(height)).ok_or_else(|| CameraError::Nonsense {
            doing: DOING,
            detail: format!("an image of {width} x {height} pixels"),
        })
    }

    fn sample_clock(&mut self) -> Result<Option<CameraClockSample>, CameraError> {
        const DOING: &str = "reading its clock";
        let clock = match &self.clock {
            Some(known) => known.clone(),
            None => self.clock.insert(or_reason(device_clock::find(self))?).clone(),
        };
        let Ok(clock) = clock else { return Ok(None) };
        clock.sample(self).map(Some).map_err(|failed| match failed {
            Failed::Lost(error) => error,
            Failed::Refused(detail) => CameraError::Link { doing: DOING, detail },
            Failed::Nonsense(detail) => CameraError::Nonsense { doing: DOING, detail },
        })
    }

    fn why_no_clock(&self) -> Option<&str> {
        self.clock.as_ref()?.as_ref().err().map(String::as_str)
    }

    fn ptp_status(&mut self) -> Result<Option<String>, CameraError> {
        device_clock::ptp_status(self)
    }

    fn test_packet_size(&mut self, bytes: u32) -> Result<Option<PacketTest>, CameraError> {
        if self.has_registers() { self.test_packets(bytes) } else { Ok(None) }
    }

    fn create_stream(
        &mut self,
        blocks: Vec<Block>,
        options: &StreamOptions,
    ) -> Result<Box<dyn FrameStream>, CameraError> {
        let is_gigevision = self.device.is::<aravis::GvDevice>();
        if is_gigevision {
            self.camera.gv_set_packet_size_adjustment(aravis::GvPacketSizeAdjustment::Never);
            // A size that the camera refuses is a problem of its set-up, not of its link.
            or_reason(packet_size::set(self, options.packet_bytes))?
                .map_err(|problem| CameraError::SetUp { problems: vec![problem] })?;
            self.packet_bytes()?;
            let socket = match options.socket {
                SocketMode::Auto => aravis::GvStreamOption::NONE,
                SocketMode::Standard => aravis::GvStreamOption::PACKET_SOCKET_DISABLED,
            };
            self.camera.gv_set_stream_options(socket);
        }
        let stream = new_stream(&self.camera).map_err(link_error("creating the stream"))?;
        if let Some(gv) = stream.downcast_ref::<aravis::GvStream>() {
            tune(gv, options.period_ns);
            self.restrict(gv, options.socket)?;
        }
        // The marks lie at the ends of packets, so they follow from the size that the camera made of the requested one.
        let marks = |bytes| Canaries::new(options.contract.sent_bytes(), bytes);
        let canaries = self.packet_bytes()?.map(marks);
        Ok(Box::new(AravisStream::new(stream, blocks, canaries, options.contract)))
    }

    fn start(&mut self) -> Result<(), CameraError> {
        self.camera.start_acquisition().map_err(link_error("starting the acquisition"))
    }

    fn stop(&mut self) -> Result<(), CameraError> {
        let stopped = self.camera.stop_acquisition().map_err(link_error("stopping the acquisition"));
        self.close_stream_channel();
        stopped
    }
}

/// Creates a stream whose thread, Aravis' own, asks for its priority and cores when it starts.
fn new_stream(camera: &aravis::Camera) -> Result<aravis::Stream, glib::Error> {
    let mut error = std::ptr::null_mut();
    // SAFETY: the camera lives during the call; the callback uses no data and lives for ever; `error` is null, as
    // GLib asks. The result is a new reference, or null with `error` set, which is ours then.
    unsafe {
        let stream = aravis_sys::arv_camera_create_stream(
            camera.to_glib_none().0,
            Some(on_stream_thread),
            std::ptr::null_mut(),
            &mut error,
        );
        match (error.is_null(), stream.is_null()) {
            (true, false) => Ok(from_glib_full(stream)),
            (true, true) => Err(glib::Error::new(aravis::DeviceError::Unknown, "Aravis gave no stream")),
            (false, _) => Err(from_glib_full(error)),
        }
    }
}

/// Called by Aravis in the stream's thread.
///
/// # Safety
/// Takes anything: it looks at the kind alone.
unsafe extern "C" fn on_stream_thread(
    _: *mut c_void,
    kind: aravis_sys::ArvStreamCallbackType,
    _: *mut aravis_sys::ArvBuffer,
) {
    if kind == aravis_sys::ARV_STREAM_CALLBACK_TYPE_INIT {
        realtime::enter_configured("stream");
    }
}

/// Sets timeouts in trigger periods, within bounds that suit a network (microseconds), and the socket's buffer.
fn tune(stream: &aravis::GvStream, period_ns: u64) {
    let periods_us = |n: u64| u32::try_from(n * period_ns / 1000).unwrap_or(u32::MAX);
    stream.set_packet_timeout(periods_us(1).clamp(2_000, 20_000));
    stream.set_frame_retention(periods_us(4).clamp(40_000, 200_000));
    // The default socket buffer holds less than one frame.
    stream.set_socket_buffer(aravis::GvStreamSocketBuffer::Fixed);
    stream.set_socket_buffer_size(8 << 20);
}

/// Names of a stream's counters in Aravis.
const COUNTERS: [&str; 8] = [
    "n_completed_buffers",
    "n_failures",
    "n_underruns",
    "n_received_packets",
    "n_missing_packets",
    "n_error_packets",
    "n_resend_requests",
    "n_resent_packets",
];

/// A stream and its blocks. The receiver's thread owns it. A block is either lent to Aravis, or out with a frame
/// while the Aravis buffer that wraps it waits in `parked`; a block that is dropped comes home and is lent again.
/// Dropping the stream ends Aravis' thread.
struct AravisStream {
    /// Before `lent`, as fields are dropped in this order: the last reference to a stream ends its thread.
    stream: aravis::Stream,
    lent: Vec<Option<Block>>,
    parked: Vec<Option<aravis::Buffer>>,
    home: Sender<Block>,
    returns: Receiver<Block>,
    /// Marks that a whole frame overwrites; `None` for transports without packets that could be truncated.
    canaries: Option<Canaries>,
    /// The contract of every frame.
    contract: FrameContract,
    /// The counters that this transport has; Aravis logs an error when others are read.
    counters: Vec<&'static str>,
}

impl AravisStream {
    fn count(&self, name: &str) -> Option<u64> {
        self.counters.contains(&name).then(|| self.stream.info_uint64_by_name(name))
    }

    fn new(
        stream: aravis::Stream,
        blocks: Vec<Block>,
        canaries: Option<Canaries>,
        contract: FrameContract,
    ) -> Self {
        let (home, returns) = bounded(blocks.len().max(1));
        let (mut lent, mut parked) = (Vec::new(), Vec::new());
        for mut block in blocks {
            plant(canaries.as_ref(), &mut block);
            // With room for chunks, the byte that reveals frames that are too long is not used.
            let over = contract.chunk_room == 0
                && canaries.as_ref().is_some_and(|canaries| block.spare() > 0 && canaries.last_has_room());
            let (pointer, length) = (block.pixel_pointer(), block.received().len() + usize::from(over));
            // SAFETY: the block's memory stays allocated while Aravis holds the buffer: it waits untouched in
            // `lent`, and the stream has ended before the blocks are freed (see `drop`). The byte after them is
            // the block's own where it has any to spare.
            let buffer = unsafe { aravis::Buffer::new_preallocated_borrowed(pointer, length) };
            stream.push_buffer(buffer);
            lent.push(Some(block));
            parked.push(None);
        }
        let named =
            |name: &&&str| (0..stream.n_infos()).any(|i| stream.info_name(i).is_some_and(|n| n == **name));
        let counters = COUNTERS.iter().filter(named).copied().collect();
        Self { stream, lent, parked, home, returns, canaries, contract, counters }
    }

    /// Checks a frame that Aravis reports as complete.
    fn judge(&self, buffer: &aravis::Buffer, block: &Block) -> Transfer {
        let is_whole =
            || self.canaries.as_ref().is_none_or(|canaries| canaries.survivor(block.received()).is_none());
        // Another datagram took the leader's place, and the buffer still describes an older frame.
        if self.canaries.is_some() && buffer.frame_id() == 0 {
            return Transfer::Unwritten;
        }
        let breach = match self.form_of(buffer, block) {
            Ok(form) => self.contract.breach(&form),
            Err(payload) => Some(Breach::Payload(payload)),
        };
        match breach {
            // A truncated packet, as opposed to packets of another size.
            None | Some(Breach::Bytes { .. } | Breach::Chunks { .. }) if !is_whole() => Transfer::Unwritten,
            None => Transfer::Complete,
            Some(breach) => Transfer::Breach(breach),
        }
    }

    /// The form of a frame, or the payload that came instead of an image.
    fn form_of(&self, buffer: &aravis::Buffer, block: &Block) -> Result<FrameForm, Payload> {
        use aravis::BufferPayloadType as Type;
        let with_chunks = match buffer.payload_type() {
            Type::Image => buffer.has_chunks(),
            Type::ExtendedChunkData | Type::ChunkData => true,
            Type::Multipart => return Err(Payload::Parts(buffer.n_parts())),
            Type::Rawdata => return Err(Payload::Other("raw data")),
            Type::File => return Err(Payload::Other("a file")),
            Type::Jpeg | Type::Jpeg2000 => return Err(Payload::Other("a compressed image")),
            Type::H264 => return Err(Payload::Other("a film")),
            _ => return Err(Payload::Other("of an unknown kind")),
        };
        // The leader of chunk data does not describe an image.
        let image = match buffer.n_parts() {
            1 => Some(checked::image_of(buffer)),
            0 if with_chunks => None,
            parts => return Err(Payload::Parts(parts)),
        };
        let bytes = checked::bytes_of(buffer);
        let chunks = with_chunks.then(|| Chunks {
            // In GigE Vision the upper byte comes first, in USB3 Vision the lower.
            first: block.received().get(..bytes).and_then(|all| first_chunk(all, self.canaries.is_some())),
        });
        Ok(FrameForm { image, chunks, bytes })
    }

    /// Converts the received image to the recorded one: one plane of a mosaic, or 8 bits.
    fn to_8_bits(&self, block: &mut Block) -> Transfer {
        let FrameContract { pixel, size, place, .. } = self.contract;
        if pixel.step() > 1 {
            take_plane(block.received_mut(), size, place);
            return Transfer::Complete;
        }
        match unpack(pixel, block.received_mut(), self.contract.pixels()) {
            0 => Transfer::Complete,
            _ => Transfer::Breach(Breach::TooLarge(pixel)),
        }
    }

    /// Lends blocks that came home to Aravis again.
    fn recycle(&mut self) {
        for mut block in self.returns.try_iter() {
            plant(self.canaries.as_ref(), &mut block);
            let pointer = block.pixel_pointer();
            // The buffer that wraps this memory.
            let slot = self.parked.iter().position(|b| b.as_ref().is_some_and(|b| b.data().0 == pointer));
            if let Some(slot) = slot {
                self.lent[slot] = Some(block);
                if let Some(buffer) = self.parked[slot].take() {
                    // A leader sets both; without one they would be those of an earlier frame.
                    buffer.set_frame_id(0);
                    buffer.set_timestamp(0);
                    self.stream.push_buffer(buffer);
                }
            }
        }
    }
}

/// Marks a block's pixels before it is lent.
fn plant(canaries: Option<&Canaries>, block: &mut Block) {
    if let Some(canaries) = canaries {
        canaries.plant(block.received_mut());
    }
}

impl FrameStream for AravisStream {
    fn next(&mut self, timeout: Duration) -> Option<Received> {
        self.recycle();
        let timeout_us = u64::try_from(timeout.as_micros()).unwrap_or(u64::MAX);
        let buffer = self.stream.timeout_pop_buffer(timeout_us)?;
        let pointer = buffer.data().0;
        let is_it = |block: &mut Option<Block>| block.as_mut().is_some_and(|b| b.pixel_pointer() == pointer);
        let slot = self.lent.iter_mut().position(is_it)?;
        let mut block = self.lent[slot].take()?;
        block.set_home(self.home.clone());
        let transfer = match buffer.status() {
            aravis::BufferStatus::Success => match self.judge(&buffer, &block) {
                Transfer::Complete => self.to_8_bits(&mut block),
                transfer => transfer,
            },
            aravis::BufferStatus::Timeout => Transfer::Timeout,
            aravis::BufferStatus::Aborted => Transfer::Aborted,
            aravis::BufferStatus::SizeMismatch => Transfer::SizeMismatch,
            _ => Transfer::MissingPackets,
        };
        let (block_id, camera_ns) = (BlockId(buffer.frame_id()), buffer.timestamp());
        let host_ns = buffer.system_timestamp();
        self.parked[slot] = Some(buffer);
        Some(Received {
            transfer,
            block_id,
            // Without a unit for the camera's timestamp, Aravis gives the host's time.
            camera_ns: if camera_ns == host_ns { 0 } else { camera_ns },
            host_ns,
            block,
        })
    }

    fn activity(&self) -> u64 {
        // USB3 Vision has no packets.
        let packets = self.count("n_received_packets").unwrap_or(0);
        if packets > 0 { packets } else { self.count("n_completed_buffers").unwrap_or(0) }
    }

    fn counters(&self) -> Vec<(String, u64)> {
        COUNTERS.iter().filter_map(|name| Some(((*name).to_owned(), self.count(name)?))).collect()
    }
}

impl Drop for AravisStream {
    fn drop(&mut self) {
        // Aravis' thread must not write into the blocks when `lent` is dropped. Dropping the last reference ends the
        // thread; ending it before that as well makes Aravis 0.8.26 log a failed assertion.
        if self.stream.ref_count() > 1 {
            self.stream.stop_thread(true);
        }
        // Blocks on their way home would otherwise stay in the channel until the last frame is dropped.
        self.returns.try_iter().for_each(drop);
    }
}

#[cfg(test)]
mod tests {
    use super::without_nodes;

    #[test]
    fn messages_have_no_nodes_of_genicam() {
        let trace = "[GevTimestampValue] [GevTimestampReg] GigEVision read_memory timeout";
        assert_eq!(without_nodes(trace), "GigEVision read_memory timeout");
        assert_eq!(without_nodes("Device 'x' not found [1]"), "Device 'x' not found [1]");
        assert_eq!(without_nodes("[Width]"), "[Width]");
        assert_eq!(without_nodes(""), "");
    }
}
