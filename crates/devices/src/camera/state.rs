// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera's features with their values, and the differences between two readings.

use std::collections::BTreeMap;

/// A feature that changed: its name, its value before, its value now.
pub type Change = (String, String, String);

/// Names of features and their values as text.
pub type State = BTreeMap<String, String>;

/// The differences: name, value in `a`, value in `b`; `None` where a reading lacks the feature.
pub fn differences(a: &State, b: &State) -> Vec<(String, Option<String>, Option<String>)> {
    let names: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let pair = |name: &String| (name.clone(), a.get(name).cloned(), b.get(name).cloned());
    names.into_iter().map(pair).filter(|(_, a, b)| a != b).collect()
}
