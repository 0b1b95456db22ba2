// SPDX-License-Identifier: MIT OR Apache-2.0
//! An opened camera's features and registers, for what is decided about them whatever the library.

use super::CameraError;
use super::description::{Access, Bounds, Description, Kind};
use super::state::State;
use crate::config::FeatureValue;

/// Why a feature could not be read or set.
#[derive(Debug)]
pub enum Failed {
    /// The camera does not answer, or does not obey us any more.
    Lost(CameraError),
    /// The camera has no such thing, or refuses.
    Refused(String),
    /// It answers what its own description has no word for.
    Nonsense(String),
}

/// Features and registers of an opened camera.
pub trait Features: Description {
    /// Whether its description names this feature, and this model has it.
    fn has(&self, feature: &str) -> bool;

    /// Whether it is there as the camera is set now.
    fn is_available(&self, feature: &str) -> bool;

    /// Its value, by its own kind. Of an enumeration that stands at no entry it is a text that says so: whoever wants another
    /// value sets it.
    fn read(&self, feature: &str) -> Result<FeatureValue, Failed>;

    /// Sets it; whole numbers, numbers and truth values are taken for each other where the feature's kind asks for it. A
    /// command is executed, whatever the value; one that is locked is refused.
    fn write(&self, feature: &str, value: &FeatureValue) -> Result<(), Failed>;

    /// The limits of a number as the camera is set now.
    fn bounds_now(&self, feature: &str) -> Bounds;

    /// A number.
    fn integer(&self, feature: &str) -> Result<i64, Failed>;

    /// An enumeration's entry or a text; [`Failed::Nonsense`] where an enumeration stands at no entry.
    fn text(&self, feature: &str) -> Result<String, Failed>;

    /// Sets an enumeration.
    fn set_text(&self, feature: &str, value: &str) -> Result<(), Failed>;

    /// Executes a command that is never locked.
    fn execute(&self, feature: &str) -> Result<(), Failed>;

    /// Whether a command that was executed is done: its register says something else than what started it. `None` where
    /// that cannot be read.
    fn is_done(&self, command: &str) -> Option<bool>;

    /// The entries of an enumeration that the camera has now; none where it is not there.
    fn entries(&self, feature: &str) -> Vec<String>;

    /// Whether it has the bootstrap registers of GigE Vision.
    fn has_registers(&self) -> bool;

    /// Reads a bootstrap register.
    fn register(&self, address: u64) -> Result<u32, Failed>;

    /// Writes a bootstrap register.
    fn set_register(&self, address: u64, value: u32) -> Result<(), Failed>;
}

/// What was refused, or has no sense, is not there; a camera that is lost is an error.
pub fn answered<T>(read: Result<T, Failed>) -> Result<Option<T>, CameraError> {
    match read {
        Ok(value) => Ok(Some(value)),
        Err(Failed::Refused(_) | Failed::Nonsense(_)) => Ok(None),
        Err(Failed::Lost(error)) => Err(error),
    }
}

/// No camera has more that matters; what is beyond is left out.
const FEATURES_MAX: usize = 2000;
/// So is what is beyond so many bytes of names and values.
const BYTES_MAX: usize = 64 << 10;

/// Longer texts are cut.
const TEXT_MAX: usize = 200;

/// A value as it is written down.
pub fn value_text(value: &FeatureValue) -> String {
    let text: String = value.to_string().chars().filter(|c| !c.is_control()).collect();
    match text.char_indices().nth(TEXT_MAX) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

/// What can be read now, behind the selectors as they stand.
pub fn read_state(camera: &dyn Features) -> Result<State, CameraError> {
    let mut state = State::new();
    let mut bytes = 0;
    for name in camera.names().into_iter().take(FEATURES_MAX) {
        let readable = camera.feature(&name).is_some_and(|feature| {
            feature.access != Access::Write && !matches!(feature.kind, Kind::Command | Kind::Other)
        });
        if !readable || !camera.is_available(&name) {
            continue;
        }
        let Some(value) = answered(camera.read(&name))? else { continue };
        let text = value_text(&value);
        bytes += name.len() + text.len();
        if bytes > BYTES_MAX {
            break;
        }
        state.insert(name, text);
    }
    Ok(state)
}

#[cfg(test)]
mod tests {
    use super::value_text;
    use crate::config::FeatureValue;

    #[test]
    fn values_are_written_down_short_and_on_one_line() {
        let text = |text: String| value_text(&FeatureValue::Text(text));
        assert_eq!(text("a\u{1b}b\nc".to_owned()), "abc");
        assert_eq!(text("\u{e4}".repeat(1000)), format!("{}...", "\u{e4}".repeat(200)));
        assert_eq!(value_text(&FeatureValue::Float(0.1)), "0.1");
    }
}
