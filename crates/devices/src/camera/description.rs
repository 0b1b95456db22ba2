// SPDX-License-Identifier: MIT OR Apache-2.0
//! The description of a camera's features: names, kinds, entries and bounds, without their values.

use std::fmt;

/// The kind of a feature's value, by its interface in GenICam.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Integer,
    Float,
    Boolean,
    Enumeration,
    Command,
    Text,
    Other,
}

/// Whether a feature can be read, written, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    Read,
    Write,
    ReadWrite,
}

/// Limits of a number in the feature's unit; `None`: not stated, or dependent on other features.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bounds {
    pub min: Option<f64>,
    pub max: Option<f64>,
    /// The step from one value to the next.
    pub step: Option<f64>,
}

impl Bounds {
    /// Whether a number lies outside the stated limits.
    pub fn exclude(&self, number: f64) -> bool {
        self.min.is_some_and(|min| number < min) || self.max.is_some_and(|max| number > max)
    }
}

impl fmt::Display for Bounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let edge = |bound: Option<f64>| bound.map_or_else(|| "any".to_owned(), |bound| bound.to_string());
        write!(f, "{} to {}", edge(self.min), edge(self.max))
    }
}

/// One feature of a camera, as its description has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Feature {
    /// The kind of the feature's value.
    pub kind: Kind,
    /// Whether it can be read, written, or both.
    pub access: Access,
    /// The unit of its number, as the camera spells it.
    pub unit: Option<String>,
    /// Names of the entries of an enumeration; empty for other kinds.
    pub entries: Vec<String>,
}

impl Feature {
    /// Whether the feature can be written.
    pub fn is_writable(&self) -> bool {
        self.access != Access::Read
    }

    /// Whether its value is a number.
    pub fn is_number(&self) -> bool {
        matches!(self.kind, Kind::Integer | Kind::Float)
    }

    /// The first of these entries that the feature has, in any spelling ([`plain`]).
    pub fn entry(&self, wanted: &[&str]) -> Option<&str> {
        let find = |wanted: &&str| self.entries.iter().find(|entry| plain(entry) == plain(wanted));
        wanted.iter().find_map(find).map(String::as_str)
    }
}

/// A camera's features. Implemented by opened cameras, and in tests by tables of published descriptions.
pub trait Description {
    /// The names of all features.
    fn names(&self) -> Vec<String>;

    /// The feature of this name, where the camera implements it.
    fn feature(&self, name: &str) -> Option<Feature>;
}

/// A name in small letters and digits only: vendors differ in case, blanks, hyphens and underscores.
pub fn plain(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

/// Longest list of names in a message.
const LISTED: usize = 24;

/// A list of names for a message, separated by commas.
pub fn list(names: &[impl AsRef<str>]) -> String {
    let mut text = names.iter().take(LISTED).map(AsRef::as_ref).collect::<Vec<_>>().join(", ");
    if names.len() > LISTED {
        text += &format!(" and {} more", names.len() - LISTED);
    }
    if text.is_empty() { "none".to_owned() } else { text }
}

/// Up to three names that are similar to a missing one, the most similar first.
pub fn nearest(wanted: &str, names: &[String]) -> Vec<String> {
    let wanted = plain(wanted);
    let mut near: Vec<(usize, &String)> =
        names.iter().map(|name| (distance(&wanted, &plain(name)), name)).collect();
    // Similar: at least half of the letters are the same, or one name begins with the other.
    near.retain(|(distance, name)| {
        *distance <= wanted.len() / 2 || plain(name).starts_with(&wanted) || wanted.starts_with(&plain(name))
    });
    near.sort();
    near.into_iter().take(3).map(|(_, name)| name.clone()).collect()
}

/// The number of letters that must be changed, added or left out (Levenshtein).
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, letter) in a.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], i + 1);
        for (j, other) in b.iter().enumerate() {
            let changed = diagonal + usize::from(letter != *other);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::{distance, nearest, plain};

    #[test]
    fn names_that_are_alike_are_found() {
        assert_eq!(plain("Line 0"), plain("line_0"));
        assert_eq!((distance("kitten", "sitting"), distance("", "abc"), distance("abc", "")), (3, 3, 3));
        let names: Vec<String> =
            ["ExposureTimeAbs", "ExposureAuto", "Gain", "Width"].map(str::to_owned).into();
        assert_eq!(nearest("ExposureTime", &names)[0], "ExposureTimeAbs");
        assert!(nearest("Qqq", &names).is_empty());
    }
}
