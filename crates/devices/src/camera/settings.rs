// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requested and applied settings of a camera, its state as text, and how values are compared.

use super::contract::FrameContract;
use crate::config::FeatureValue;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

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

/// A feature that changed: its name, its value before, its value now.
pub type Change = (String, String, String);

/// Names of features and their values as text.
pub type State = BTreeMap<String, String>;

/// The differences: name, value in `a`, value in `b`; `None` where a reading lacks the feature.
pub fn differences(a: &State, b: &State) -> Vec<(String, Option<String>, Option<String>)> {
    let names: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let pair = |name: &String| (name.clone(), a.get(name).cloned(), b.get(name).cloned());
    names.into_iter().map(pair).filter(|(_, a, b)| a != b).collect()
}

/// Tolerance of floats of raw settings, as a share of the wanted value and at least this amount: cameras quantize
/// exposures to line times and gains to tenths of a decibel.
const RAW_TOLERANCE: f64 = 2e-3;

/// Tolerance of floats that were read back before and are read again, in the same measure.
const SAME_TOLERANCE: f64 = 1e-3;

fn is_close(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance * a.abs().max(1.0)
}

/// Whether a camera took a raw setting. Its kind must be the feature's: only a whole number may stand for a float.
pub fn matches(wanted: &FeatureValue, actual: &FeatureValue) -> bool {
    use FeatureValue::{Float, Integer};
    match (wanted, actual) {
        (Float(a), Float(b)) => is_close(*a, *b, RAW_TOLERANCE),
        (Integer(a), Float(b)) => is_close(*a as f64, *b, RAW_TOLERANCE),
        (a, b) => a == b,
    }
}

/// Whether a camera has another value than the one that the program wrote or read before. Numbers of different kinds
/// are compared by their values.
pub fn differs(wanted: &FeatureValue, actual: &FeatureValue) -> bool {
    use FeatureValue::{Flag, Float, Integer};
    match (wanted, actual) {
        (Flag(a), Integer(b)) => i64::from(*a) != *b,
        (Float(a), Integer(b)) | (Integer(b), Float(a)) => (a - *b as f64).abs() > 0.5,
        (Float(a), Float(b)) => !is_close(*a, *b, SAME_TOLERANCE),
        (a, b) => a != b,
    }
}

#[cfg(test)]
mod tests {
    use super::{differs, matches};
    use crate::config::FeatureValue::{Flag, Float, Integer, Text};

    #[test]
    fn quantized_floats_pass_and_wrong_values_do_not() {
        assert!(matches(&Float(1000.0), &Float(1001.5)) && !matches(&Float(1000.0), &Float(1010.0)));
        assert!(matches(&Integer(1000), &Float(1000.9)) && !matches(&Integer(4), &Float(4.4)));
        assert!(!matches(&Flag(true), &Integer(1)));
        assert!(!matches(&Text("On".to_owned()), &Text("Off".to_owned())));
    }

    #[test]
    fn what_was_read_back_is_held_to_a_thousandth() {
        assert!(!differs(&Float(1000.0), &Float(1000.9)) && differs(&Float(1000.0), &Float(1001.5)));
        assert!(!differs(&Integer(4), &Float(4.0)) && !differs(&Flag(true), &Integer(1)));
    }
}
