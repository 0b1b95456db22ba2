// SPDX-License-Identifier: MIT OR Apache-2.0
//! Memory that is used again from frame to frame, by any thread and camera.

use crate::base::image::Plane;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Values that are lent out one at a time. There are as many as were ever lent at once.
#[derive(Debug, Default)]
pub(crate) struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    /// One that was given back, or a new one.
    pub(crate) fn take(&self) -> T {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default()
    }

    pub(crate) fn give(&self, value: T) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(value);
    }
}

/// Planes of all types that stages need.
#[derive(Debug, Default)]
pub(crate) struct PlanePools {
    pub(crate) floats: Planes<f32>,
    pub(crate) words: Planes<u16>,
    pub(crate) bytes: Planes<u8>,
}

impl PlanePools {
    /// From now on planes have room for this many pixels at least, of which memory is taken only as they are used: a
    /// plane that had to grow with each larger object would be copied to new pages.
    pub(crate) fn make_room(&self, pixels: usize) {
        for room in [&self.floats.room, &self.words.room, &self.bytes.room] {
            room.fetch_max(pixels, Ordering::Relaxed);
        }
    }
}

/// Planes that are used again from frame to frame, by whichever stage comes next.
#[derive(Debug, Default)]
pub(crate) struct Planes<T> {
    pool: Pool<Plane<T>>,
    /// Pixels that every plane has room for.
    room: AtomicUsize,
}

impl<T: Copy + Default> Planes<T> {
    /// A plane for a stage that writes every value: its values are undefined.
    pub(crate) fn take(&self, width: usize, height: usize) -> Plane<T> {
        let mut plane = self.pool.take();
        plane.reserve(self.room.load(Ordering::Relaxed).max(width * height), T::default());
        plane.reshape(width, height, T::default());
        plane
    }

    pub(crate) fn give(&self, plane: Plane<T>) {
        self.pool.give(plane);
    }
}
