// SPDX-License-Identifier: MIT OR Apache-2.0
//! A short list in one message: triggers or edges that a host has asked for.

use crate::MAX_RECORDS;
use crate::codec::{DecodeError, Put, Take};

/// Up to [`MAX_RECORDS`] of one kind, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Records<T> {
    records: [T; MAX_RECORDS],
    length: u8,
}

impl<T: Copy + Default> Records<T> {
    /// Adds one; `false` if full.
    pub fn push(&mut self, record: T) -> bool {
        match self.records.get_mut(usize::from(self.length)) {
            Some(place) => {
                *place = record;
                self.length += 1;
                true
            }
            None => false,
        }
    }

    /// What was added, in order.
    pub fn as_slice(&self) -> &[T] {
        &self.records[..usize::from(self.length)]
    }

    pub(crate) fn put(&self, put: &mut Put<'_>, one: fn(&T, &mut Put<'_>)) {
        put.u8(self.length);
        self.as_slice().iter().for_each(|record| one(record, put));
    }

    pub(crate) fn take(
        take: &mut Take<'_>,
        one: fn(&mut Take<'_>) -> Result<T, DecodeError>,
    ) -> Result<Self, DecodeError> {
        let mut records = Self::default();
        for _ in 0..take.u8()? {
            if !records.push(one(take)?) {
                return Err(DecodeError::Value);
            }
        }
        Ok(records)
    }
}
