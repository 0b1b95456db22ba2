// SPDX-License-Identifier: MIT OR Apache-2.0
//! Configuration files, read and validated with all problems at once.
//!
//! Three files: the rig (`rig.toml`: heads, pattern, board, nominal geometry; the same on every machine), the node
//! (`node-X.toml`: what one acquisition PC needs) and the worker (`worker.toml`). All go through [`Section`], which
//! notes every problem under its key path, so that a user can repair a file at once.

mod api;
mod node;
mod pixel;
mod rig;
mod section;
mod trigger;
mod words;
mod worker;

pub use api::{ApiConfig, PeerConfig, SocketConfig, TlsConfig};
pub use node::{
    CameraConfig, FeatureSetting, FeatureValue, NodeConfig, OnLoss, QuickLookConfig, Realtime, SocketMode,
    WhenFull,
};
pub use pixel::{Mosaic, Pixel};
pub use rig::{Board, Channel, Head, Rig, RigCamera};
pub use section::Section;
pub use trigger::{ACTION_COMMANDS, ActionConfig, TriggerSource};
pub use words::{AUTO, CameraWords, Edge, FEATURES_OF_WORDS, PacketDelay, word_of};
pub use worker::{Order, Output, WorkerConfig, WorkerNode};

use crate::base::{Fault, regular};
use std::cell::RefCell;
use std::fmt;
use std::path::{Path, PathBuf};

/// One thing wrong in a configuration file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Where: a key path such as `head[1].camera[0].id`; empty for the file as a whole.
    pub key: String,
    /// What was expected, what was found.
    pub message: String,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.key.is_empty() {
            f.write_str(&self.message)
        } else {
            write!(f, "{}: {}", self.key, self.message)
        }
    }
}

/// A configuration file that cannot be used, with everything that is wrong in it.
#[derive(Debug, Clone)]
pub struct ConfigError {
    pub path: PathBuf,
    /// All that is wrong in it: at least one problem.
    pub problems: Vec<Problem>,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = self.problems.len();
        write!(f, "{}: {count} problem{}", self.path.display(), if count == 1 { "" } else { "s" })?;
        for problem in &self.problems {
            write!(f, "\n  {problem}")?;
        }
        Ok(())
    }
}

impl std::error::Error for ConfigError {}

impl From<ConfigError> for Fault {
    fn from(error: ConfigError) -> Self {
        Self::usage(error)
    }
}

/// Reads a TOML file into a table.
pub fn read_table(path: &Path) -> Result<toml::Table, ConfigError> {
    let text = regular::read_text(path, regular::TEXT_BYTES);
    let text = text.map_err(|e| as_a_whole(path, format!("cannot be read: {e}")))?;
    parse_table(&text, path)
}

/// A TOML file's text as a table.
fn parse_table(text: &str, path: &Path) -> Result<toml::Table, ConfigError> {
    text.parse().map_err(|e: toml::de::Error| as_a_whole(path, format!("not valid TOML: {e}")))
}

/// A problem with a whole file.
fn as_a_whole(path: &Path, message: String) -> ConfigError {
    ConfigError { path: path.to_owned(), problems: vec![Problem { key: String::new(), message }] }
}

/// The value that `read` makes of a file's outermost table, or all problems that it noted.
fn read_all<T>(table: &toml::Table, read: impl FnOnce(Section<'_>) -> Option<T>) -> Result<T, Vec<Problem>> {
    let problems = RefCell::default();
    let config = read(Section::root(table, &problems));
    let problems = problems.into_inner();
    config.filter(|_| problems.is_empty()).ok_or(problems)
}
