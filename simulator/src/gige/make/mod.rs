// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera of any make: description, registers and firmware made from a table of its features.
//!
//! [`table`] is what descriptions show, [`rules`] what firmware does besides, [`places`] where registers lie.
//! [`describe`] writes the GenICam description; [`firmware`] holds values and refuses them; [`working`] derives their
//! effect.

mod commands;
mod describe;
pub mod firmware;
mod formats;
mod places;
mod rules;
mod setup;
mod shared;
pub mod table;
mod working;

pub use firmware::Firmware;
pub use table::{Table, TableError};

use super::habits::ClockHabit;
use places::Link;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use table::Kind;

/// A make of camera, and how this one of it was left and wired.
#[derive(Debug, Clone)]
pub struct Make {
    table: Table,
    /// By feature: its selectors, as the description names them.
    declared: Vec<Vec<usize>>,
    /// By feature: its selectors behind which there are several values.
    selectors: Vec<Vec<usize>>,
    /// The features that are one number: an entry of each stands for it.
    shared: BTreeSet<usize>,
    /// By feature: the register of the standard that it shows.
    links: Vec<Option<Link>>,
    /// By feature: the feature that holds its value, and what that is multiplied by.
    aliases: Vec<Option<usize>>,
    /// The entry of `TriggerSource` that is the HSU's wire.
    wire: Option<String>,
    /// What the last user left: feature, the entry of its selector if one is named, and value.
    left_over: Vec<(usize, Option<usize>, firmware::Value)>,
}

impl Make {
    /// From a table.
    ///
    /// # Errors
    /// A table with more features than there is room for.
    pub fn new(table: Table) -> Result<Self, TableError> {
        let count = table.features.len();
        if count > places::MOST {
            return Err(TableError(format!("{count} features, expected {} at the most", places::MOST)));
        }
        let mut selectors = vec![Vec::new(); count];
        for (index, feature) in table.features.iter().enumerate() {
            for selected in feature.selects.iter().filter_map(|name| table.find(name)) {
                selectors[selected].push(index);
            }
        }
        for known in &mut selectors {
            known.retain(|selector| selects(&table, *selector));
        }
        break_chains(&mut selectors);
        let declared = selectors.clone();
        let shared = shared::features(&table);
        // Who selects by a number of the trigger's own selects nothing: there is one value for all entries.
        for known in &mut selectors {
            known.retain(|selector| !shared.contains(selector));
        }
        let mut aliases = vec![None; count];
        for names in [rules::EXPOSURE, rules::GAIN] {
            let there: Vec<usize> = names.iter().filter_map(|name| table.find(name)).collect();
            for other in there.iter().skip(1) {
                aliases[*other] = there.first().copied();
            }
        }
        let links = table.features.iter().map(places::link).collect();
        let wire = rules::wired_line(&table);
        Ok(Self { table, declared, selectors, shared, links, aliases, wire, left_over: Vec::new() })
    }

    /// From a table's file.
    ///
    /// # Errors
    /// A file that cannot be read, or is no table.
    pub fn load(path: &Path) -> Result<Self, TableError> {
        Self::new(Table::load(path)?).map_err(|e| TableError(format!("{}: {e}", path.display())))
    }

    /// Reads the tables `[[habit]]` of a TOML text that say which camera is like which table's; files are relative to
    /// `dir`.
    ///
    /// # Errors
    /// Text that is no TOML, and what is wrong with a table, a line or what was left over.
    pub fn parse_all(text: &str, dir: &Path) -> Result<BTreeMap<String, Arc<Self>>, TableError> {
        let file: File = toml::from_str(text).map_err(|e| TableError(format!("[[habit]] {e}")))?;
        let mut makes = BTreeMap::new();
        for Row { camera, like, wired_to, left_over, without } in file.habit {
            let wrong = |e: TableError| TableError(format!("[[habit]] camera {camera:?}: {e}"));
            let Some(like) = like else {
                if wired_to.is_some() || !left_over.is_empty() || !without.is_empty() {
                    return Err(wrong(TableError(
                        "wired_to, left_over and without belong to a camera with like".to_owned(),
                    )));
                }
                continue;
            };
            let mut table = Table::load(&dir.join(like)).map_err(wrong)?;
            for name in &without {
                table = table.without(name).map_err(wrong)?;
            }
            let mut make = Self::new(table).map_err(wrong)?;
            if let Some(line) = wired_to {
                make = make.wired_to(&line).map_err(wrong)?;
            }
            for (name, value) in left_over {
                let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
                make = make.left_over(&name, &text).map_err(wrong)?;
            }
            makes.insert(camera, Arc::new(make));
        }
        Ok(makes)
    }

    /// Connects the HSU's wire to this entry of `TriggerSource`.
    ///
    /// # Errors
    /// An entry that the camera does not have.
    pub fn wired_to(mut self, line: &str) -> Result<Self, TableError> {
        let entries =
            self.table.feature("TriggerSource").map(|feature| &feature.entries[..]).unwrap_or_default();
        if !entries.iter().any(|entry| entry == line) {
            let known = entries.join(", ");
            return Err(TableError(format!(
                "wired_to {line:?}: expected an entry of TriggerSource: {known}"
            )));
        }
        self.wire = Some(line.to_owned());
        Ok(self)
    }

    /// Leaves a feature set, as a user before may have done: until `UserSetLoad`, and again after power-on. A name with
    /// an entry of its selector in brackets, `TriggerMode[AcquisitionStart]`, sets that one value, a plain name all.
    ///
    /// # Errors
    /// A feature, an entry or a value that the camera does not have.
    pub fn left_over(mut self, name: &str, value: &str) -> Result<Self, TableError> {
        let wrong = |what: String| TableError(format!("left_over {name} = {value:?}: {what}"));
        let (feature, entry) = match name.strip_suffix(']').and_then(|name| name.split_once('[')) {
            Some((feature, entry)) => (feature, Some(entry)),
            None => (name, None),
        };
        let index =
            self.table.find(feature).ok_or_else(|| wrong("this camera has no such feature".to_owned()))?;
        let mut place = None;
        if let Some(entry) = entry {
            let selector = self.selectors[index].first().map(|selector| &self.table.features[*selector]);
            let found = selector.and_then(|selector| selector.entries.iter().position(|e| e == entry));
            place =
                Some(found.ok_or_else(|| wrong(format!("no selector of {feature} has the entry {entry}")))?);
        }
        if self.links[index].is_some() {
            return Err(wrong("a register of the network, which no user leaves behind".to_owned()));
        }
        let value = self.parse(index, value).map_err(wrong)?;
        self.left_over.push((index, place, value));
        Ok(self)
    }

    fn parse(&self, index: usize, text: &str) -> Result<firmware::Value, String> {
        use firmware::Value;
        let feature = &self.table.features[index];
        match feature.kind {
            Kind::Integer => text.parse().map(Value::Integer).map_err(|_| "expected an integer".to_owned()),
            Kind::Float => match text.parse::<f64>() {
                Ok(value) if value.is_finite() => Ok(Value::Float(value)),
                _ => Err("expected a number".to_owned()),
            },
            Kind::Boolean => match text {
                "true" | "On" | "1" => Ok(Value::Integer(1)),
                "false" | "Off" | "0" => Ok(Value::Integer(0)),
                _ => Err("expected true or false".to_owned()),
            },
            Kind::Enumeration => match feature.entries.iter().position(|entry| entry == text) {
                Some(place) => Ok(Value::Integer(self.code(index, place))),
                None => Err(format!("expected one of {}", feature.entries.join(", "))),
            },
            Kind::Command => Err("a command leaves nothing".to_owned()),
            Kind::String => Ok(Value::Text(text.to_owned())),
        }
    }

    /// Vendor and model, as its registers have them.
    pub fn names(&self) -> (&str, &str) {
        (&self.table.vendor, &self.table.model)
    }

    /// How its clock counts: cameras of SFNC 2 in ns, others in ticks of 8 ns, unless a habit sets something else.
    pub fn clock(&self, habit: ClockHabit) -> ClockHabit {
        let nanoseconds =
            ["TimestampLatchValue", "Timestamp"].iter().any(|name| self.table.find(name).is_some());
        match habit {
            ClockHabit::Ticks if !nanoseconds => ClockHabit::Bootstrap,
            habit => habit,
        }
    }

    /// The table with the features of this make.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Address and length of the register in which a feature lies.
    pub fn register(&self, name: &str) -> Option<(u32, u32)> {
        let index = self.table.find(name)?;
        Some(match self.links[index] {
            Some(link) => (link.address, link.length),
            None => (places::value(index), places::length(self.table.features[index].kind)),
        })
    }

    /// The bytes of a value in the register of a feature that is the camera's own.
    ///
    /// # Errors
    /// What was expected.
    pub fn bytes(&self, name: &str, text: &str) -> Result<Vec<u8>, String> {
        let index = self.table.find(name).ok_or_else(|| format!("no feature {name}"))?;
        let kind = self.table.features[index].kind;
        Ok(match (kind, self.parse(index, text)?) {
            (Kind::Float, value) => value.number().to_be_bytes().to_vec(),
            (Kind::Integer, value) => (value.number() as i64).to_be_bytes().to_vec(),
            (_, firmware::Value::Text(text)) => {
                let mut bytes = text.into_bytes();
                bytes.resize(bytes.len().next_multiple_of(4), 0);
                bytes
            }
            (_, value) => (value.number() as i64 as u32).to_be_bytes().to_vec(),
        })
    }

    /// The code in the register of an enumeration for an entry.
    fn code(&self, index: usize, place: usize) -> i64 {
        let feature = &self.table.features[index];
        match (feature.name.as_str(), feature.entries.get(place)) {
            ("PixelFormat", Some(entry)) => i64::from(formats::code(entry, place)),
            _ => i64::try_from(place).unwrap_or(0),
        }
    }
}

/// Whether a feature can select: sizes, whose bounds follow from others, cannot.
fn selects(table: &Table, index: usize) -> bool {
    let feature = &table.features[index];
    let named = feature.name.ends_with("Selector") || feature.name.ends_with("Index");
    match feature.kind {
        Kind::Enumeration => feature.name != "PixelFormat" && !feature.name.starts_with("Binning") || named,
        Kind::Integer => named,
        _ => false,
    }
}

/// Most selectors of a feature, and most levels of selectors of selectors: twice what any camera has.
const MOST_SELECTORS: usize = 4;

/// Leaves out selectors by which a value would be looked for without end: of what selects them, and beyond the limits.
fn break_chains(selectors: &mut [Vec<usize>]) {
    for index in 0..selectors.len() {
        let known = std::mem::take(&mut selectors[index]);
        let fitting = known.into_iter().filter(|selector| {
            let above = levels(selectors, *selector, MOST_SELECTORS);
            above.is_some_and(|above| !above.contains(&index)) && *selector != index
        });
        let fitting: Vec<usize> = fitting.take(MOST_SELECTORS).collect();
        selectors[index] = fitting;
    }
}

/// All that select a feature, directly or not; `None` where there are more levels than `most`.
fn levels(selectors: &[Vec<usize>], index: usize, most: usize) -> Option<BTreeSet<usize>> {
    let (mut all, mut level) = (BTreeSet::new(), BTreeSet::from([index]));
    for _ in 0..most {
        level = level.iter().flat_map(|selected| selectors[*selected].iter().copied()).collect();
        if level.is_empty() {
            return Some(all);
        }
        all.extend(&level);
    }
    None
}

#[derive(Deserialize)]
struct File {
    #[serde(default)]
    habit: Vec<Row>,
}

/// The rest of its keys is read by `Habits::parse`.
#[derive(Deserialize)]
struct Row {
    camera: String,
    like: Option<String>,
    wired_to: Option<String>,
    #[serde(default)]
    left_over: toml::Table,
    #[serde(default)]
    without: Vec<String>,
}
