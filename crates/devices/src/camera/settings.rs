// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requested and applied GenICam settings.

use super::contract::FrameContract;
use super::state::State;
use crate::config::{FeatureSetting, FeatureValue};
use serde::{Deserialize, Serialize};

/// A feature's requested value and the value that was read back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct AppliedSetting {
    /// Name of the feature (SFNC).
    pub feature: String,
    /// The value that the node file or the rig requests.
    pub requested: FeatureValue,
    /// The value that the camera reported after it was set.
    pub actual: FeatureValue,
}

/// The outcome of a set-up.
#[derive(Debug, Clone, PartialEq)]
pub struct SetUp {
    /// What each frame of the camera must be.
    pub contract: FrameContract,
    /// All settings, in the order in which they were made.
    pub settings: Vec<AppliedSetting>,
    /// What the operator should know: values that were found different and corrected, or that the camera rounded.
    pub remarks: Vec<String>,
    /// Features that must stay unchanged while the session runs.
    pub watched: State,
}

/// Tolerance of floats, as a share of the requested value and at least this amount: cameras quantize exposures to line
/// times and gains to tenths of a decibel.
const FLOAT_TOLERANCE: f64 = 2e-3;

/// Whether a camera has a requested value, floats within their tolerance.
pub fn matches(setting: &FeatureSetting, actual: &FeatureValue) -> bool {
    use FeatureValue::{Flag, Float, Integer, Text};
    let close = |a: f64, b: f64| (a - b).abs() <= FLOAT_TOLERANCE * a.abs().max(1.0);
    match (&setting.value, actual) {
        (Flag(a), Flag(b)) => a == b,
        (Integer(a), Integer(b)) => a == b,
        (Text(a), Text(b)) => a == b,
        (Float(a), Float(b)) => close(*a, *b),
        (Integer(a), Float(b)) => close(*a as f64, *b),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::matches;
    use crate::config::{FeatureSetting, FeatureValue};

    #[test]
    fn quantized_floats_pass_and_wrong_values_do_not() {
        let exposure =
            FeatureSetting { feature: "ExposureTime".to_owned(), value: FeatureValue::Float(1000.0) };
        assert!(matches(&exposure, &FeatureValue::Float(1000.9)));
        assert!(!matches(&exposure, &FeatureValue::Float(1010.0)));
        let mode =
            FeatureSetting { feature: "TriggerMode".to_owned(), value: FeatureValue::Text("On".to_owned()) };
        assert!(!matches(&mode, &FeatureValue::Text("Off".to_owned())));
    }
}
