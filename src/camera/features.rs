// SPDX-License-Identifier: MIT OR Apache-2.0
//! An opened camera's features and registers, for what is decided about them whatever the library.

use super::CameraError;

/// Why a feature could not be read or set.
#[derive(Debug)]
pub enum Failed {
    /// The camera does not answer, or does not obey us any more.
    Lost(CameraError),
    /// The camera has no such thing, or refuses.
    Refused(String),
}

/// Features and registers of an opened camera.
pub trait Features {
    /// Whether its description names this feature.
    fn has(&self, feature: &str) -> bool;

    /// A number.
    fn integer(&self, feature: &str) -> Result<i64, Failed>;

    /// An enumeration's entry or a text.
    fn text(&self, feature: &str) -> Result<String, Failed>;

    /// Sets an enumeration.
    fn set_text(&self, feature: &str, value: &str) -> Result<(), Failed>;

    /// Executes a command.
    fn execute(&self, feature: &str) -> Result<(), Failed>;

    /// The entries of an enumeration that the camera has now; none where it is not there.
    fn entries(&self, feature: &str) -> Vec<String>;

    /// Whether it has the bootstrap registers of GigE Vision.
    fn has_registers(&self) -> bool;

    /// Reads a bootstrap register.
    fn register(&self, address: u64) -> Result<u32, Failed>;

    /// Writes a bootstrap register.
    fn set_register(&self, address: u64, value: u32) -> Result<(), Failed>;
}
