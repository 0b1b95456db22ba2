// SPDX-License-Identifier: MIT OR Apache-2.0
//! A queue from an interrupt to the main loop: one writer, one reader.

use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

pub struct Ring<T, const N: usize> {
    places: UnsafeCell<[T; N]>,
    written: AtomicU32,
    read: AtomicU32,
    lost: AtomicBool,
}

// SAFETY: a place is written before `written` says so, and read before `read` says so; each has one owner.
unsafe impl<T: Copy, const N: usize> Sync for Ring<T, N> {}

impl<T: Copy, const N: usize> Ring<T, N> {
    pub const fn new(empty: T) -> Self {
        const { assert!(N.is_power_of_two()) };
        Self {
            places: UnsafeCell::new([empty; N]),
            written: AtomicU32::new(0),
            read: AtomicU32::new(0),
            lost: AtomicBool::new(false),
        }
    }

    /// Called by the interrupt only, which is the one writer.
    pub fn push(&self, value: T) {
        let written = self.written.load(Ordering::Relaxed);
        if written.wrapping_sub(self.read.load(Ordering::Acquire)) as usize >= N {
            self.lost.store(true, Ordering::Relaxed);
            return;
        }
        // SAFETY: the reader does not touch this place before `written` is raised.
        unsafe { (*self.places.get())[written as usize % N] = value };
        self.written.store(written.wrapping_add(1), Ordering::Release);
    }

    /// Called by the main loop only, which is the one reader.
    pub fn pop(&self) -> Option<T> {
        let read = self.read.load(Ordering::Relaxed);
        if read == self.written.load(Ordering::Acquire) {
            return None;
        }
        // SAFETY: the writer does not touch this place before `read` is raised.
        let value = unsafe { (*self.places.get())[read as usize % N] };
        self.read.store(read.wrapping_add(1), Ordering::Release);
        Some(value)
    }

    /// Whether there was no room for something since the last call.
    pub fn take_lost(&self) -> bool {
        let lost = self.lost.load(Ordering::Relaxed);
        if lost {
            self.lost.store(false, Ordering::Relaxed);
        }
        lost
    }

    pub fn is_empty(&self) -> bool {
        self.read.load(Ordering::Relaxed) == self.written.load(Ordering::Acquire)
    }
}
