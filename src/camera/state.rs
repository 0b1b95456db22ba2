//! Everything that can be read of a camera, and what two readings differ in.

use crate::config::FeatureValue;
use std::collections::BTreeMap;

/// A feature that changed: its name, what it was, what it is.
pub type Change = (String, String, String);

/// Features and their values as text.
pub type State = BTreeMap<String, String>;

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

/// What differs: name, in the first, in the second; `None`: it is not there.
pub fn differences(a: &State, b: &State) -> Vec<(String, Option<String>, Option<String>)> {
    let names: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    let pair = |name: &String| (name.clone(), a.get(name).cloned(), b.get(name).cloned());
    names.into_iter().map(pair).filter(|(_, a, b)| a != b).collect()
}
