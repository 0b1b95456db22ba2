// SPDX-License-Identifier: MIT OR Apache-2.0
//! Samples of frames for previews and the live body: a quarter of a frame, copied where its set enters the ring.
//!
//! The cost is bounded whatever previews do: a frame is copied only on request, every fourth row of it and at most one
//! small square with all its pixels, into memory that is kept, and nothing waits. Without a request the cost is one load of a flag per frame.

use crate::base::ids::CameraId;
use crate::record::FrameMeta;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError, TryLockError};

/// Distance of the rows that are copied.
pub const ROW_STEP: usize = 4;

/// Longest side of the square that is copied with all its pixels.
pub const DETAIL_PX: usize = 240;

/// Every fourth row of a frame, and a square with all its pixels.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Sample {
    /// Index of the frame's trigger.
    pub trigger: u64,
    /// When the frame arrived, host clock, ns.
    pub host_time_ns: u64,
    /// Number of columns of the frame.
    pub width: usize,
    /// Rows 0, 4, 8, ... of the frame, `width` bytes each.
    pub pixels: Vec<u8>,
    /// The pixels of the square, row by row; empty where none was requested.
    pub detail: Vec<u8>,
    /// Number of columns of the square.
    pub detail_width: usize,
}

impl Sample {
    /// Copies the rows of a frame, and a square about this place ([`Taps::show_detail`]).
    pub fn fill(&mut self, meta: &FrameMeta, pixels: &[u8], detail: Option<[f32; 2]>) {
        self.trigger = meta.trigger.0;
        self.host_time_ns = meta.host_time_ns;
        self.width = meta.width as usize;
        self.pixels.clear();
        let rows = pixels.chunks_exact(self.width.max(1)).step_by(ROW_STEP);
        rows.for_each(|row| self.pixels.extend_from_slice(row));
        self.detail.clear();
        let Some(place) = detail else { return };
        let side = |length: usize| DETAIL_PX.min(length);
        let first = |at: f32, length: usize| {
            ((at * length as f32) as usize).saturating_sub(side(length) / 2).min(length - side(length))
        };
        let (width, height) = (self.width, pixels.len().checked_div(self.width).unwrap_or(0));
        let (left, top) = (first(place[0], width), first(place[1], height));
        self.detail_width = side(width);
        let rows = pixels.chunks_exact(width.max(1)).skip(top).take(side(height));
        rows.for_each(|row| self.detail.extend_from_slice(&row[left..left + self.detail_width]));
    }
}

/// Where the recorder leaves samples, and previews take them.
#[derive(Debug)]
pub struct Taps {
    taps: Vec<Tap>,
}

#[derive(Debug)]
struct Tap {
    camera: CameraId,
    /// One more than the first requested trigger; 0: no request.
    wanted: AtomicU64,
    /// The place of the square that is wanted, or none.
    detail: Mutex<Option<[f32; 2]>>,
    sample: Mutex<Slot>,
}

/// One buffer on its way to previews, one on its way back.
#[derive(Debug, Default)]
struct Slot {
    fresh: Option<Sample>,
    spare: Option<Sample>,
}

impl Taps {
    /// For cameras in the order in which the recorder numbers them.
    pub fn new(cameras: impl IntoIterator<Item = CameraId>) -> Self {
        let tap = |camera| Tap {
            camera,
            wanted: AtomicU64::new(0),
            detail: Mutex::default(),
            sample: Mutex::default(),
        };
        Self { taps: cameras.into_iter().map(tap).collect() }
    }

    /// Taps without cameras, for tests.
    #[cfg(test)]
    pub(super) fn of_nobody() -> [std::sync::Arc<Self>; 2] {
        [(); 2].map(|()| std::sync::Arc::new(Self::new([])))
    }

    /// The cameras, in the recorder's order.
    pub fn cameras(&self) -> impl Iterator<Item = &CameraId> {
        self.taps.iter().map(|tap| &tap.camera)
    }

    /// Requests a sample of the next frame of a camera.
    pub fn ask(&self, camera: usize) {
        self.ask_from(camera, 0);
    }

    /// Requests a sample of the first frame from this trigger on.
    pub fn ask_from(&self, camera: usize, trigger: u64) {
        if let Some(tap) = self.taps.get(camera) {
            tap.wanted.store(trigger.saturating_add(1), Ordering::Release);
        }
    }

    /// From now on samples of a camera have a square with all pixels about this place, as parts of the frame's columns and
    /// rows from 0 to 1; or none.
    pub fn show_detail(&self, camera: usize, place: Option<[f32; 2]>) {
        if let Some(tap) = self.taps.get(camera) {
            *tap.detail.lock().unwrap_or_else(PoisonError::into_inner) = place;
        }
    }

    /// Exchanges the last sample for a used one, whose memory is used again; `None` when there is no new sample.
    pub fn take(&self, camera: usize, done: &mut Option<Sample>) -> Option<Sample> {
        let mut slot = match self.taps.get(camera)?.sample.lock() {
            Ok(slot) => slot,
            Err(poisoned) => poisoned.into_inner(),
        };
        let fresh = slot.fresh.take()?;
        slot.spare = done.take();
        Some(fresh)
    }

    /// Leaves a sample of a frame if one is requested. Never waits: while a preview takes the last one, the next
    /// frame will do.
    pub(super) fn offer(&self, camera: usize, meta: &FrameMeta, pixels: &[u8]) {
        let Some(tap) = self.taps.get(camera) else { return };
        let wanted = tap.wanted.load(Ordering::Acquire);
        if wanted == 0 || meta.trigger.0 < wanted - 1 {
            return;
        }
        let mut slot = match tap.sample.try_lock() {
            Ok(slot) => slot,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return,
        };
        tap.wanted.store(0, Ordering::Release);
        let mut sample = slot.fresh.take().or_else(|| slot.spare.take()).unwrap_or_default();
        let detail = tap.detail.try_lock().ok().and_then(|place| *place);
        sample.fill(meta, pixels, detail);
        slot.fresh = Some(sample);
    }
}

#[cfg(test)]
mod tests {
    use super::{Sample, Taps};
    use crate::base::ids::{BlockId, CameraId, TriggerIndex};
    use crate::record::FrameMeta;

    fn meta(trigger: u64) -> FrameMeta {
        FrameMeta {
            trigger: TriggerIndex(trigger),
            block: BlockId(1),
            camera_time_ns: 0,
            host_time_ns: trigger,
            width: 2,
            height: 5,
            pixels_crc: 0,
        }
    }

    #[test]
    fn only_requested_frames_are_copied_and_the_newest_counts() {
        let taps = Taps::new([CameraId::from("h0_up")]);
        let pixels: Vec<u8> = (0..10).collect();
        taps.offer(0, &meta(0), &pixels);
        assert_eq!(taps.take(0, &mut None), None);
        taps.ask(0);
        taps.offer(0, &meta(1), &pixels);
        taps.offer(0, &meta(2), &pixels);
        let expected =
            Sample { trigger: 1, host_time_ns: 1, width: 2, pixels: vec![0, 1, 8, 9], ..Sample::default() };
        assert_eq!(taps.take(0, &mut None), Some(expected));
        taps.ask(0);
        taps.offer(0, &meta(3), &pixels);
        taps.ask(0);
        taps.offer(0, &meta(4), &pixels);
        assert_eq!(taps.take(0, &mut None).map(|sample| sample.trigger), Some(4));
        assert_eq!(taps.take(0, &mut None), None);
        taps.ask_from(0, 9);
        taps.offer(0, &meta(8), &pixels);
        assert_eq!(taps.take(0, &mut None), None, "too early");
        taps.offer(0, &meta(10), &pixels);
        assert_eq!(taps.take(0, &mut None).map(|sample| sample.trigger), Some(10));
        taps.ask(7);
        taps.offer(7, &meta(5), &pixels);
        assert_eq!(taps.take(7, &mut None), None, "a camera that is not there");
    }

    #[test]
    fn a_square_lies_about_its_place_and_within_the_frame() {
        let (width, height) = (300u32, 250u32);
        let pixels: Vec<u8> =
            (0..height).flat_map(|v| (0..width).map(move |u| (u % 16 * 16 + v % 16) as u8)).collect();
        let square = |place: Option<[f32; 2]>| {
            let mut sample = Sample::default();
            sample.fill(&FrameMeta { width, height, ..meta(0) }, &pixels, place);
            (sample.detail.first().copied(), sample.detail.len(), sample.detail_width)
        };
        let value = |u: usize, v: usize| Some((u % 16 * 16 + v % 16) as u8);
        assert_eq!(square(None).1, 0);
        assert_eq!(square(Some([0.5, 0.5])), (value(30, 5), 240 * 240, 240));
        assert_eq!(square(Some([0.0, 1.0])), (value(0, 10), 240 * 240, 240));
        assert_eq!(square(Some([f32::NAN, 2.0])), (value(0, 10), 240 * 240, 240));
        let mut small = Sample::default();
        small.fill(&meta(0), &[7; 10], Some([1.0, 0.0]));
        assert_eq!((small.detail.len(), small.detail_width), (10, 2), "a frame that is smaller");
    }
}
