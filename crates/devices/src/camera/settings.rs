// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requested against applied GenICam settings.

use super::contract::FrameContract;
use super::state::State;
use crate::config::{FeatureSetting, FeatureValue};
use serde::{Deserialize, Serialize};

/// A feature as configured and as read back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct AppliedSetting {
    /// SFNC name.
    pub feature: String,
    /// As configured.
    pub requested: FeatureValue,
    /// As read back.
    pub actual: FeatureValue,
}

/// How a camera is set.
#[derive(Debug, Clone, PartialEq)]
pub struct SetUp {
    /// What its frames must be.
    pub contract: FrameContract,
    /// What was set, in its order.
    pub settings: Vec<AppliedSetting>,
    /// What an operator should know: what was found otherwise and mended, what the camera rounded.
    pub told: Vec<String>,
    /// What must stay as it is while the session runs.
    pub watched: State,
}

/// Cameras quantize floats (exposure in line times, gain in tenths of a decibel): this share of the
/// requested value, or this absolute amount where that is more, passes as equal.
const FLOAT_TOLERANCE: f64 = 2e-3;

/// Whether a camera took a setting.
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
