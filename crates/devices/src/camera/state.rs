// SPDX-License-Identifier: MIT OR Apache-2.0
//! Everything that can be read of a camera, and what two readings differ in.

use std::collections::BTreeMap;

/// A feature that changed: its name, what it was, what it is.
pub type Change = (String, String, String);

/// Features and their values as text.
pub type State = BTreeMap<String, String>;

/// What differs: name, in the first, in the second; `None`: it is not there.
pub fn differences(a: &State, b: &State) -> Vec<(String, Option<String>, Option<String>)> {
    let names: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let pair = |name: &String| (name.clone(), a.get(name).cloned(), b.get(name).cloned());
    names.into_iter().map(pair).filter(|(_, a, b)| a != b).collect()
}
