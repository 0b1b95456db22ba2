// SPDX-License-Identifier: MIT OR Apache-2.0
//! Features and registers of an opened camera, independent of the library that reaches it.

use super::description::{Access, Bounds, Description, Kind};
use super::error::CameraError;
use super::settings::State;
use crate::config::FeatureValue;

/// Why a feature could not be read or set.
#[derive(Debug)]
pub enum Failed {
    /// The camera does not answer, or another program controls it.
    Lost(CameraError),
    /// The camera has no such feature, or refuses; the reason in words.
    Refused(String),
    /// The camera's answer contradicts its own description.
    Nonsense(String),
}

impl From<CameraError> for Failed {
    fn from(error: CameraError) -> Self {
        Self::Lost(error)
    }
}

/// Features and registers of an opened camera. The set-up is written against this trait, and its tests run it on a
/// camera in memory.
pub trait Features: Description {
    /// Whether the description names this feature and this model implements it.
    fn has(&self, feature: &str) -> bool;

    /// Whether the feature is available as the camera is set now.
    fn is_available(&self, feature: &str) -> bool;

    /// Reads a value of the feature's own kind. An enumeration whose register matches no entry gives a text that states
    /// the register's value, so that a caller who wants another value sets it.
    fn read(&self, feature: &str) -> Result<FeatureValue, Failed>;

    /// Sets a feature. Integers, floats and booleans are converted to the feature's kind. A command is executed,
    /// whatever the value; a locked feature is refused.
    fn write(&self, feature: &str, value: &FeatureValue) -> Result<(), Failed>;

    /// The limits of a number as the camera is set now.
    fn bounds_now(&self, feature: &str) -> Bounds;

    /// Reads the value of an integer feature.
    fn integer(&self, feature: &str) -> Result<i64, Failed>;

    /// Reads an enumeration's entry or a text; [`Failed::Nonsense`] where the register matches no entry.
    fn text(&self, feature: &str) -> Result<String, Failed>;

    /// Selects an entry of an enumeration by its name.
    fn set_text(&self, feature: &str, value: &str) -> Result<(), Failed> {
        self.write(feature, &FeatureValue::Text(value.to_owned()))
    }

    /// Executes a command that is never locked, so that a denied access means a lost camera.
    fn execute(&self, feature: &str) -> Result<(), Failed>;

    /// Whether an executed command is done: its register differs from the value that started it. `None` where the
    /// register cannot be read.
    fn is_done(&self, command: &str) -> Option<bool>;

    /// The entries of an enumeration that can be selected now; empty where the feature is missing.
    fn entries(&self, feature: &str) -> Vec<String>;

    /// Whether the camera has the bootstrap registers of GigE Vision.
    fn has_registers(&self) -> bool;

    /// Reads a bootstrap register of GigE Vision.
    fn register(&self, address: u64) -> Result<u32, Failed>;

    /// Writes a bootstrap register of GigE Vision.
    fn set_register(&self, address: u64, value: u32) -> Result<(), Failed>;
}

/// Separates a lost camera (the outer error) from a feature that is refused (the inner error: why).
pub fn or_reason<T>(result: Result<T, Failed>) -> Result<Result<T, String>, CameraError> {
    match result {
        Ok(value) => Ok(Ok(value)),
        Err(Failed::Refused(why) | Failed::Nonsense(why)) => Ok(Err(why)),
        Err(Failed::Lost(error)) => Err(error),
    }
}

/// The value, or `None` where the camera refuses; a lost camera is an error.
pub fn answered<T>(read: Result<T, Failed>) -> Result<Option<T>, CameraError> {
    Ok(or_reason(read)?.ok())
}

/// The value of a feature, or `None` where the camera lacks the feature or refuses to read it.
pub fn value_of(camera: &dyn Features, feature: &str) -> Result<Option<FeatureValue>, CameraError> {
    if camera.is_available(feature) { answered(camera.read(feature)) } else { Ok(None) }
}

/// A number of the kind that a feature has.
pub fn number_of(camera: &dyn Features, feature: &str, number: f64) -> FeatureValue {
    match camera.feature(feature).map(|known| known.kind) {
        Some(Kind::Integer) => FeatureValue::Integer(number.round() as i64),
        _ => FeatureValue::Float(number),
    }
}

/// The bootstrap registers of GigE Vision with the frequency of the camera's clock, Hz, the high word first.
pub const FREQUENCY: [u64; 2] = [0x093c, 0x0940];

/// The frequency of the camera's clock by its feature, Hz; `None` where it states none.
pub fn stated_frequency(camera: &dyn Features) -> Result<Option<u64>, CameraError> {
    const FEATURE: &str = "GevTimestampTickFrequency";
    if !camera.has(FEATURE) {
        return Ok(None);
    }
    Ok(answered(camera.integer(FEATURE))?.and_then(|hz| u64::try_from(hz).ok()).filter(|hz| *hz > 0))
}

/// Most features of a camera's recorded state; no known camera has as many that can be read.
const FEATURES_MAX: usize = 2000;
/// Most bytes of names and values in a camera's recorded state, because it is in the header of each segment.
const BYTES_MAX: usize = 64 << 10;
/// Most characters of a recorded value; longer values are cut.
const TEXT_MAX: usize = 200;

/// A value as text on one line, cut at 200 characters.
pub fn value_text(value: &FeatureValue) -> String {
    let text: String = value.to_string().chars().filter(|c| !c.is_control()).collect();
    match text.char_indices().nth(TEXT_MAX) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

/// All features that can be read now, behind the selectors as they are set, within the bounds above.
pub fn read_state(camera: &dyn Features) -> Result<State, CameraError> {
    let mut state = State::new();
    let mut bytes = 0;
    for name in camera.names().into_iter().take(FEATURES_MAX) {
        let readable = camera.feature(&name).is_some_and(|feature| {
            feature.access != Access::Write && !matches!(feature.kind, Kind::Command | Kind::Other)
        });
        let value = if readable { value_of(camera, &name)? } else { None };
        let Some(value) = value else { continue };
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
