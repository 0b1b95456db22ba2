// SPDX-License-Identifier: MIT OR Apache-2.0
//! A table of what a camera's GenICam description shows: its features as facts, read from JSON.

use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// What kind of feature it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    Integer,
    Float,
    Enumeration,
    Boolean,
    Command,
    String,
}

/// Whether a feature can be read and written, where its description states it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Access {
    Ro,
    Rw,
    Wo,
}

/// A limit or an increment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    Absent,
    Depends,
    Fixed(f64),
}

/// What is written to execute a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CommandValue {
    Fixed(u32),
    /// What follows from these features; none: from something that is no feature.
    Of(Vec<String>),
}

/// A feature of a make, as its table states it.
#[derive(Debug, Clone)]
pub struct Feature {
    pub name: String,
    pub kind: Kind,
    pub unit: Option<String>,
    pub min: Bound,
    pub max: Bound,
    pub inc: Bound,
    /// Entries of an enumeration, in order.
    pub entries: Vec<String>,
    /// Features of which it selects one of several values; all are in the table.
    pub selects: Vec<String>,
    pub access: Option<Access>,
    /// Another feature or state can lock it.
    pub locked_by: bool,
    /// Whether it is there depends on other features.
    pub available_if: bool,
    /// Some models of the family do not have it.
    pub implemented_if: bool,
    /// Of a command: what is written.
    pub command_value: CommandValue,
    /// Of a command: whether its register can be read; `None` where the table does not state it.
    pub can_be_read: Option<bool>,
    /// Features that lie in the same register.
    pub same_register_as: Vec<String>,
    /// Features that share a register with what makes this one come and go.
    pub available_with: Vec<String>,
}

/// The table of a make: all features of its description.
#[derive(Debug, Clone)]
pub struct Table {
    /// Vendor, as the description names it.
    pub vendor: String,
    /// Model, as the description names it.
    pub model: String,
    pub features: Vec<Feature>,
}

/// Features without which there are no frames.
const NEEDED: [&str; 5] = ["Width", "Height", "PixelFormat", "AcquisitionStart", "AcquisitionStop"];

/// Why a table cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct TableError(pub(super) String);

impl Table {
    /// Reads a file.
    ///
    /// # Errors
    /// A file that cannot be read, or is no table.
    pub fn load(path: &Path) -> Result<Self, TableError> {
        let wrong = |e: &dyn std::fmt::Display| TableError(format!("{}: {e}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|e| wrong(&e))?;
        Self::parse(&text).map_err(|e| wrong(&e))
    }

    /// Reads a table's text.
    ///
    /// # Errors
    /// What is wrong with it, by feature.
    pub fn parse(text: &str) -> Result<Self, TableError> {
        let file: File = serde_json::from_str(text)
            .map_err(|e| TableError(format!("expected a table of a camera's features: {e}")))?;
        let names: Vec<String> = file.features.keys().cloned().collect();
        let mut features = Vec::with_capacity(names.len());
        for (name, row) in file.features {
            features.push(row.feature(name, &names)?);
        }
        let table = Self { vendor: file.vendor, model: file.model, features };
        for needed in NEEDED {
            if table.find(needed).is_none() {
                return Err(TableError(format!("expected a feature {needed}, which every camera has")));
            }
        }
        Ok(table)
    }

    /// The same camera without a feature, or without an entry of one, `PixelFormat[Mono8]`.
    ///
    /// # Errors
    /// What it does not have, or cannot do without.
    pub fn without(mut self, name: &str) -> Result<Self, TableError> {
        let wrong = |what: &str| TableError(format!("without {name:?}: {what}"));
        let (feature, entry) = match name.strip_suffix(']').and_then(|name| name.split_once('[')) {
            Some((feature, entry)) => (feature, Some(entry)),
            None => (name, None),
        };
        let index = self.find(feature).ok_or_else(|| wrong("this camera has no such feature"))?;
        match entry {
            Some(entry) => {
                let entries = &mut self.features[index].entries;
                let count = entries.len();
                entries.retain(|known| known != entry);
                if entries.len() == count || entries.is_empty() {
                    return Err(wrong("expected one of several entries"));
                }
            }
            None if NEEDED.contains(&feature) => return Err(wrong("every camera has it")),
            None => {
                self.features.remove(index);
                self.features.iter_mut().for_each(|other| other.selects.retain(|name| name != feature));
            }
        }
        Ok(self)
    }

    /// Where a feature is in the list.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.features.binary_search_by(|feature| feature.name.as_str().cmp(name)).ok()
    }

    /// A feature by its name.
    pub fn feature(&self, name: &str) -> Option<&Feature> {
        self.find(name).and_then(|index| self.features.get(index))
    }
}

#[derive(Deserialize)]
struct File {
    vendor: String,
    model: String,
    features: BTreeMap<String, Row>,
}

#[derive(Deserialize)]
struct Row {
    #[serde(rename = "type")]
    kind: Kind,
    unit: Option<String>,
    min: Option<Value>,
    max: Option<Value>,
    inc: Option<Value>,
    #[serde(default)]
    entries: Vec<String>,
    #[serde(default)]
    selects: Vec<String>,
    access: Option<Access>,
    #[serde(default)]
    locked_by: bool,
    #[serde(default)]
    available_if: bool,
    #[serde(default)]
    implemented_if: bool,
    command_value: Option<Value>,
    can_be_read: Option<bool>,
    #[serde(default)]
    same_register_as: Vec<String>,
    #[serde(default)]
    available_with: Vec<String>,
}

impl Row {
    fn feature(self, name: String, all: &[String]) -> Result<Feature, TableError> {
        let wrong = |what: &str| TableError(format!("feature {name:?}: {what}"));
        // Names become names of nodes.
        let proper = |name: &str| {
            name.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        };
        if !proper(&name) {
            return Err(wrong("expected a name of letters, digits and underscores"));
        }
        if self
            .entries
            .iter()
            .any(|e| e.is_empty() || !e.chars().all(|c| c.is_ascii_alphanumeric() || c == '_'))
        {
            return Err(wrong("expected entries of letters, digits and underscores"));
        }
        if self.kind == Kind::Enumeration && self.entries.is_empty() {
            return Err(wrong("expected entries"));
        }
        let bound = |value: Option<Value>| match value {
            None => Ok(Bound::Absent),
            Some(Value::String(text)) if text == "depends" => Ok(Bound::Depends),
            Some(Value::Number(number)) => number
                .as_f64()
                .filter(|n| n.is_finite())
                .map(Bound::Fixed)
                .ok_or_else(|| wrong("expected a finite bound")),
            Some(_) => Err(wrong("expected a bound that is a number or \"depends\"")),
        };
        let (min, max, inc) = (bound(self.min)?, bound(self.max)?, bound(self.inc)?);
        if let (Bound::Fixed(min), Bound::Fixed(max)) = (min, max)
            && min > max
        {
            return Err(wrong("expected a smallest value below the largest"));
        }
        if matches!(inc, Bound::Fixed(inc) if inc <= 0.0) {
            return Err(wrong("expected an increment above 0"));
        }
        let command_value = match self.command_value {
            None => CommandValue::Fixed(1),
            Some(Value::Number(number)) => CommandValue::Fixed(
                number
                    .as_u64()
                    .and_then(|number| u32::try_from(number).ok())
                    .ok_or_else(|| wrong("expected a command_value that fits into a register"))?,
            ),
            Some(Value::Object(of)) => CommandValue::Of(
                serde_json::from_value(of.get("of").cloned().unwrap_or_default())
                    .map_err(|_| wrong("expected a command_value {\"of\": [features]}"))?,
            ),
            Some(_) => {
                return Err(wrong("expected a command_value that is a number or {\"of\": [features]}"));
            }
        };
        // Descriptions also name registers and parts of features; those are not in a table.
        let selects =
            self.selects.into_iter().filter(|other| *other != name && all.contains(other)).collect();
        Ok(Feature {
            name,
            kind: self.kind,
            unit: self.unit,
            min,
            max,
            inc,
            entries: self.entries,
            selects,
            access: self.access,
            locked_by: self.locked_by,
            available_if: self.available_if,
            implemented_if: self.implemented_if,
            command_value,
            can_be_read: self.can_be_read,
            same_register_as: self.same_register_as,
            available_with: self.available_with,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{Bound, Kind, Table};

    pub const LEAST: &str = r#"{"vendor": "V", "model": "M", "features": {
        "AcquisitionStart": {"type": "command"}, "AcquisitionStop": {"type": "command"},
        "Width": {"type": "integer", "min": 16, "max": "depends"}, "Height": {"type": "integer"},
        "PixelFormat": {"type": "enumeration", "entries": ["Mono8"]}ROW}}"#;

    #[test]
    fn tables_are_read_and_wrong_ones_refused() {
        let table = Table::parse(&LEAST.replace("ROW", "")).expect("a table");
        let width = table.feature("Width").expect("there");
        assert_eq!((width.kind, width.min, width.max), (Kind::Integer, Bound::Fixed(16.0), Bound::Depends));
        for wrong in [
            r#", "Gain dB": {"type": "float"}"#,
            r#", "Gain": {"type": "number"}"#,
            r#", "Gain": {"type": "float", "min": "maybe"}"#,
            r#", "Gain": {"type": "float", "min": 3, "max": 1}"#,
            r#", "Gain": {"type": "integer", "inc": 0}"#,
            r#", "GainAuto": {"type": "enumeration"}"#,
            r#", "GainAuto": {"type": "enumeration", "entries": ["<x>"]}"#,
        ] {
            assert!(Table::parse(&LEAST.replace("ROW", wrong)).is_err(), "{wrong}");
        }
        assert!(Table::parse(r#"{"vendor": "V", "model": "M", "features": {}}"#).is_err());
        assert!(Table::parse("[]").is_err());
    }
}
