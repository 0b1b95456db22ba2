// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a camera says of its own features: names, kinds, entries and bounds, without their values.

use std::fmt;

/// What kind of value a feature has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A whole number.
    Integer,
    /// A number.
    Float,
    /// On or off.
    Boolean,
    /// One of its entries.
    Enumeration,
    /// Something to do.
    Command,
    /// A text.
    Text,
    /// Anything else.
    Other,
}

/// What may be done with a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// It can be read.
    Read,
    /// It can be written.
    Write,
    /// Both.
    ReadWrite,
}

/// Limits of a number; `None`: none is stated, or it depends on other features.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Bounds {
    /// The least value.
    pub min: Option<f64>,
    /// The largest value.
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
    /// What kind of value it has.
    pub kind: Kind,
    /// What may be done with it.
    pub access: Access,
    /// In what it counts, as the camera writes it.
    pub unit: Option<String>,
    /// Its limits.
    pub bounds: Bounds,
    /// Of an enumeration: the names of its entries.
    pub entries: Vec<String>,
}

impl Feature {
    /// Whether it can be written.
    pub fn is_writable(&self) -> bool {
        self.access != Access::Read
    }

    /// Whether it is a number.
    pub fn is_number(&self) -> bool {
        matches!(self.kind, Kind::Integer | Kind::Float)
    }

    /// The first of these entries that it has, whatever its spelling.
    pub fn entry(&self, wanted: &[&str]) -> Option<&str> {
        let find = |wanted: &&str| self.entries.iter().find(|entry| plain(entry) == plain(wanted));
        wanted.iter().find_map(find).map(String::as_str)
    }
}

/// A camera's features. Implemented for opened cameras and for tables of published ones.
pub trait Description {
    /// All names.
    fn names(&self) -> Vec<String>;

    /// A feature that the camera has.
    fn feature(&self, name: &str) -> Option<Feature>;
}

/// A name without what different vendors write differently: case, blanks, hyphens, underscores.
pub fn plain(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

/// Names are listed up to so many.
const LISTED: usize = 24;

/// Names, separated by commas.
pub fn list(names: &[impl AsRef<str>]) -> String {
    let mut text = names.iter().take(LISTED).map(AsRef::as_ref).collect::<Vec<_>>().join(", ");
    if names.len() > LISTED {
        text += &format!(" and {} more", names.len() - LISTED);
    }
    if text.is_empty() { "none".to_owned() } else { text }
}

/// The names that are most like one that is not there, the nearest first; at most three.
pub fn nearest(wanted: &str, names: &[String]) -> Vec<String> {
    let wanted = plain(wanted);
    let mut near: Vec<(usize, &String)> =
        names.iter().map(|name| (distance(&wanted, &plain(name)), name)).collect();
    // Half of the letters right is like it, or that one begins with the other.
    near.retain(|(distance, name)| {
        *distance <= wanted.len() / 2 || plain(name).starts_with(&wanted) || wanted.starts_with(&plain(name))
    });
    near.sort();
    near.into_iter().take(3).map(|(_, name)| name.clone()).collect()
}

/// How many letters must be changed, added or left out.
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
