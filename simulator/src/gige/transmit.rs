// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frames to packets to the socket, and packets sent again from the frames kept.

use super::gvcp::ResendRequest;
use super::gvsp::{self, IdMode, Layout, PayloadHeaders, Status};
use super::inject;
use super::net::Batch;
use super::packing;
use super::picture::Picture;
use super::{PacketFilter, Statistics};
use crate::faults::{Fault, Resend};
use crate::images::ImageSource;
use std::borrow::Cow;
use std::collections::VecDeque;
use std::net::UdpSocket;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// One image as it was or will be sent; its pixels stay with the image source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    pub block_id: u64,
    /// Camera clock at the start of the exposure, ticks.
    pub timestamp: u64,
    /// Which light fell on the sensor.
    pub instant: i64,
    /// How it is cut into packets.
    pub layout: Layout,
    /// What becomes of the light.
    pub picture: Picture,
}

impl Frame {
    /// Its Mono8 pixels and how many a row has: where the image source keeps them, or made.
    fn pixels<'a>(&self, source: &'a dyn ImageSource) -> (Cow<'a, [u8]>, usize) {
        let pixels = source.pixels(self.instant);
        if self.picture.is_plain() {
            return (Cow::Borrowed(pixels), source.size().0);
        }
        (Cow::Owned(self.picture.image(pixels, source.size(), &self.layout)), self.layout.width as usize)
    }
}

/// The image bytes `range` of the top-left crop of `layout`'s size, appended to `bytes`.
fn crop(
    (pixels, stride): (&[u8], usize),
    layout: &Layout,
    range: std::ops::Range<usize>,
    bytes: &mut Vec<u8>,
) {
    let width = layout.width as usize;
    if !layout.form.is_plain() {
        return bytes.extend(range.map(|at| formed(pixels, stride, layout, at)));
    }
    if stride == width {
        bytes.extend_from_slice(pixels.get(range).unwrap_or(&[]));
        return;
    }
    let mut at = range.start;
    while at < range.end {
        let (row, column) = (at / width, at % width);
        let length = (width - column).min(range.end - at);
        let start = row * stride + column;
        bytes.extend_from_slice(pixels.get(start..start + length).unwrap_or(&[]));
        at += length;
    }
}

/// A byte of a payload that is not the light's 8 bits alone; what fills is not 0.
fn formed(pixels: &[u8], stride: usize, layout: &Layout, at: usize) -> u8 {
    const FILL: u8 = 0xa5;
    let image = layout.image_bytes() - layout.form.appended as usize;
    if let Some(behind) = at.checked_sub(image) {
        return layout.form.behind(behind, image);
    }
    let line = layout.form.line(layout.width);
    let row_bytes = line + usize::from(layout.form.padding);
    let (row, offset) = (at / row_bytes, at % row_bytes);
    if offset >= line {
        return FILL;
    }
    let grey = |column: usize| pixels.get(row * stride + column).copied().unwrap_or(0);
    packing::byte(layout.form.format, offset, (row, layout.width as usize, line), grey)
}

/// The last frames sent, for resend requests. No pixels are kept: the source still has them.
#[derive(Debug)]
pub struct History {
    frames: Mutex<VecDeque<(Frame, Resend)>>,
    capacity: usize,
}

impl History {
    /// Room for a number of frames.
    pub fn new(capacity: usize) -> Self {
        Self { frames: Mutex::new(VecDeque::with_capacity(capacity + 1)), capacity }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, VecDeque<(Frame, Resend)>> {
        self.frames.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, frame: Frame, resend: Resend) {
        let mut frames = self.lock();
        frames.push_back((frame, resend));
        while frames.len() > self.capacity {
            frames.pop_front();
        }
    }

    /// Forgets everything: a new acquisition starts its block ids anew.
    pub fn clear(&self) {
        self.lock().clear();
    }

    fn find(&self, block_id: u64) -> Option<Frame> {
        self.lock().iter().rev().find(|(f, _)| f.block_id == block_id).map(|(frame, _)| *frame)
    }

    /// Whether requests for this block's packets are answered: yes, unless a fault prevents it.
    pub fn policy(&self, block_id: u64) -> Resend {
        let frames = self.lock();
        frames
            .iter()
            .rev()
            .find(|(f, _)| f.block_id == block_id)
            .map_or(Resend::Answered, |(_, resend)| *resend)
    }
}

fn request_ids(request: &ResendRequest) -> IdMode {
    if request.extended { IdMode::Extended } else { IdMode::Standard }
}

/// Answers a resend request with "not available".
pub fn refuse(request: &ResendRequest, socket: &UdpSocket, statistics: &Statistics) {
    let _ = socket.send(&gvsp::unavailable(request_ids(request), request.block_id, request.first));
    statistics.resends_unavailable.fetch_add(1, Relaxed);
}

/// Answers a resend request on the stream's socket.
pub fn resend(
    request: &ResendRequest,
    history: &History,
    source: &dyn ImageSource,
    socket: &UdpSocket,
    statistics: &Statistics,
) {
    let ids = request_ids(request);
    let frame = history.find(request.block_id).filter(|f| f.layout.ids == ids);
    let valid = |frame: &Frame| request.first <= request.last && request.first <= frame.layout.trailer_id();
    let Some(frame) = frame.filter(valid) else {
        return refuse(request, socket, statistics);
    };
    let mut pixels = Vec::with_capacity(frame.layout.chunk);
    let (image, stride) = frame.pixels(source);
    for id in request.first..=request.last.min(frame.layout.trailer_id()) {
        let packet = if id == 0 {
            gvsp::leader(&frame.layout, Status::Resent, frame.block_id, frame.timestamp)
        } else if id == frame.layout.trailer_id() {
            gvsp::trailer(&frame.layout, Status::Resent, frame.block_id)
        } else {
            pixels.clear();
            crop((&image, stride), &frame.layout, frame.layout.range(id), &mut pixels);
            gvsp::resent_payload(&frame.layout, frame.block_id, id, &pixels)
        };
        match socket.send(&packet) {
            Ok(_) => statistics.packets_resent.fetch_add(1, Relaxed),
            Err(_) => statistics.send_errors.fetch_add(1, Relaxed),
        };
    }
}

/// Sends whole frames: headers are built once per layout, pixels go out from where they lie.
pub struct Transmitter {
    source: Arc<dyn ImageSource>,
    socket: Arc<UdpSocket>,
    history: Arc<History>,
    statistics: Arc<Statistics>,
    lose: Option<PacketFilter>,
    headers: Option<(Layout, PayloadHeaders)>,
    cropped: Vec<u8>,
    segmented: bool,
}

impl Transmitter {
    /// A transmitter on a socket that is connected before frames are sent.
    pub fn new(
        source: Arc<dyn ImageSource>,
        socket: Arc<UdpSocket>,
        history: Arc<History>,
        statistics: Arc<Statistics>,
        lose: Option<PacketFilter>,
    ) -> Self {
        let (headers, cropped, segmented) = (None, Vec::new(), false);
        Self { source, socket, history, statistics, lose, headers, cropped, segmented }
    }

    /// From now on, hands runs of packets to the kernel as one, or does not (see [`super::segmentation`]).
    pub fn set_segmented(&mut self, segmented: bool) {
        self.segmented = segmented;
    }

    /// Sends one frame with a fault, packet by packet.
    pub fn send_with(&mut self, frame: &Frame, fault: Fault) {
        let frame = &Frame { layout: inject::layout(frame.layout, fault), ..*frame };
        self.history.push(*frame, inject::resend_policy(fault));
        let layout = &frame.layout;
        let mut headers = PayloadHeaders::new(layout);
        headers.stamp(frame.block_id);
        let mut packets = Vec::with_capacity(layout.trailer_id() as usize + 1);
        packets.push(gvsp::leader(layout, Status::Ok, frame.block_id, frame.timestamp));
        let (image, stride) = frame.pixels(&*self.source);
        for id in 1..=layout.payload_packets() {
            let mut packet = headers.get(id).to_vec();
            crop((&image, stride), layout, layout.range(id), &mut packet);
            packets.push(packet);
        }
        packets.push(gvsp::trailer(layout, Status::Ok, frame.block_id));
        for packet in inject::datagrams(packets, fault, layout.ids.header_size()) {
            match self.socket.send(&packet) {
                Ok(_) => self.statistics.packets_sent.fetch_add(1, Relaxed),
                Err(_) => self.statistics.send_errors.fetch_add(1, Relaxed),
            };
        }
    }

    /// Sends one frame, `delay` between its packets (0: as fast as possible).
    pub fn send(&mut self, frame: &Frame, delay: Duration) {
        self.history.push(*frame, Resend::Answered);
        let layout = &frame.layout;
        if self.headers.as_ref().is_none_or(|(built, _)| built != layout) {
            self.headers = Some((*layout, PayloadHeaders::new(layout)));
        }
        let Some((_, headers)) = &mut self.headers else { return };
        headers.stamp(frame.block_id);
        let (image, stride) = frame.pixels(&*self.source);
        let pixels = if layout.form.is_plain() && stride == layout.width as usize {
            image.get(..layout.image_bytes()).unwrap_or(&[])
        } else {
            self.cropped.clear();
            crop((&image, stride), layout, 0..layout.image_bytes(), &mut self.cropped);
            &self.cropped
        };
        let leader = gvsp::leader(layout, Status::Ok, frame.block_id, frame.timestamp);
        let trailer = gvsp::trailer(layout, Status::Ok, frame.block_id);
        let packet = |id: u32| -> (&[u8], &[u8]) {
            if id == 0 {
                (&leader, &[])
            } else if id == layout.trailer_id() {
                (&trailer, &[])
            } else {
                (headers.get(id), pixels.get(layout.range(id)).unwrap_or(&[]))
            }
        };
        let mut pacer = Pacer { start: Instant::now(), delay };
        let (mut batch, mut sent) = (Batch::new(self.segmented), 0);
        for id in 0..=layout.trailer_id() {
            if batch.is_full() || pacer.must_wait(id) {
                match batch.send(&self.socket) {
                    Ok(count) => sent += count,
                    Err(_) => {
                        self.statistics.send_errors.fetch_add(1, Relaxed);
                        return;
                    }
                }
                pacer.wait_for(id);
            }
            if self.lose.as_ref().is_none_or(|lose| !lose(frame.block_id, id)) {
                let (header, body) = packet(id);
                batch.push(header, body);
            }
        }
        match batch.send(&self.socket) {
            Ok(count) => {
                self.statistics.packets_sent.fetch_add((sent + count) as u64, Relaxed);
                self.statistics.frames_sent.fetch_add(1, Relaxed);
            }
            Err(_) => {
                self.statistics.send_errors.fetch_add(1, Relaxed);
            }
        }
    }
}

/// Keeps the mean distance between packets; what a sleep overshoots is caught up by a short burst.
struct Pacer {
    start: Instant,
    delay: Duration,
}

impl Pacer {
    fn due(&self, packet: u32) -> Instant {
        self.start + self.delay.saturating_mul(packet)
    }

    fn must_wait(&self, packet: u32) -> bool {
        !self.delay.is_zero() && Instant::now() < self.due(packet)
    }

    fn wait_for(&mut self, packet: u32) {
        if !self.delay.is_zero() {
            std::thread::sleep(self.due(packet).saturating_duration_since(Instant::now()));
        }
    }
}
