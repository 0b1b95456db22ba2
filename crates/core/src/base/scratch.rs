// SPDX-License-Identifier: MIT OR Apache-2.0
//! Directories for work in progress.

use std::path::PathBuf;

/// A directory for work in progress. Its owner creates it where it is needed; dropping this value removes it with all
/// that it holds.
#[derive(Debug)]
pub struct Scratch(pub PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        // It may never have been created, and what cannot be removed changes no result.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
