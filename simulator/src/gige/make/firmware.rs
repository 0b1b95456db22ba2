// SPDX-License-Identifier: MIT OR Apache-2.0
//! The firmware of a make: values of its features, which of them it takes, and what its commands do.

use super::commands::{Echo, Written};
use super::places::{self, AVAILABLE, IMPLEMENTED, LOCKED, Place, STRIDE, Said};
use super::rules::{self, Lock, Range};
use super::table::{Access, Bound, Feature, Kind};
use super::{Make, describe, shared};
use crate::gige::gvcp::Status;
use crate::gige::habits::{Exposures, Habits};
use crate::gige::registers::Effect;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A value of a feature: booleans and entries are their codes.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// A whole number or a code.
    Integer(i64),
    Float(f64),
    Text(String),
}

impl Value {
    /// As a number; text is 0.
    pub fn number(&self) -> f64 {
        match self {
            Self::Integer(value) => *value as f64,
            Self::Float(value) => *value,
            Self::Text(_) => 0.0,
        }
    }
}

/// A feature, and the values of its selectors when it was set.
type Key = (usize, Vec<i64>);

/// The values of all features of one camera, and the rules of its firmware.
#[derive(Debug)]
pub struct Firmware {
    pub(super) make: Arc<Make>,
    pub(super) sensor: (u32, u32),
    habits: Habits,
    /// What differs from the user set `Default`.
    stored: BTreeMap<Key, Value>,
    /// What the user sets hold that were saved, by their place in the selector.
    saved: BTreeMap<i64, BTreeMap<Key, Value>>,
    /// Commands that are not done yet.
    pending: Vec<(usize, Instant)>,
    /// The contents of registers of commands that keep what was written.
    echoes: BTreeMap<usize, u32>,
    acquiring: bool,
    /// Exposure that is used where it is not the one that is read back.
    pub(super) nearest_us: Option<f64>,
}

impl Firmware {
    /// After power-on, with a sensor of (columns, rows): as the last user left it.
    pub fn new(make: Arc<Make>, sensor: (u32, u32), habits: Habits) -> Self {
        let mut firmware = Self {
            make,
            sensor,
            habits,
            stored: BTreeMap::new(),
            saved: BTreeMap::new(),
            pending: Vec::new(),
            echoes: BTreeMap::new(),
            acquiring: false,
            nearest_us: None,
        };
        let make = Arc::clone(&firmware.make);
        for (index, place, value) in &make.left_over {
            for key in firmware.all_keys(*index, *place) {
                let (key, value) = firmware.place(*index, (*index, key), value.clone());
                firmware.stored.insert(key, value);
            }
        }
        firmware
    }

    /// The GenICam description of this camera, XML.
    pub fn description(&self) -> String {
        describe::xml(&self.make)
    }

    /// The content of its register of the manufacturer.
    pub fn vendor(&self) -> String {
        self.make.table.vendor.chars().filter(char::is_ascii_graphic).take(31).collect()
    }

    pub(super) fn feature(&self, index: usize) -> &Feature {
        &self.make.table.features[index]
    }

    /// Every combination of entries of a feature's selectors that are enumerations; of the first one only `place`,
    /// where it is given. Selectors that are integers count as they stand.
    fn all_keys(&self, index: usize, place: Option<usize>) -> Vec<Vec<i64>> {
        const MOST: usize = 10_000;
        let counts =
            self.make.selectors[index].iter().map(|selector| self.feature(*selector).entries.len().max(1));
        if counts.fold(1, usize::saturating_mul) > MOST {
            return vec![self.key(index).1];
        }
        let mut keys = vec![Vec::new()];
        for (number, selector) in self.make.selectors[index].iter().enumerate() {
            let count = self.feature(*selector).entries.len();
            let codes: Vec<i64> = match (place, count) {
                (Some(place), _) if number == 0 => vec![self.make.code(*selector, place)],
                (_, 0) => vec![self.integer(*selector)],
                _ => (0..count).map(|place| self.make.code(*selector, place)).collect(),
            };
            keys =
                keys.iter().flat_map(|key| codes.iter().map(|code| [&key[..], &[*code]].concat())).collect();
        }
        keys
    }

    /// Where a value is kept, and as what: of features that are one number it is that number.
    fn place(&self, index: usize, key: Key, value: Value) -> (Key, Value) {
        match self.make.shared.first() {
            Some(first) if self.make.shared.contains(&index) => {
                let entry = self.entry_of(index, value.number() as i64).unwrap_or_default();
                ((*first, Vec::new()), Value::Integer(shared::number(entry)))
            }
            _ => (key, value),
        }
    }

    /// The code of the entry that stands for the number that several features are.
    fn shared(&self, index: usize) -> Option<i64> {
        if !self.make.shared.contains(&index) {
            return None;
        }
        let first = *self.make.shared.first()?;
        let number = self.stored.get(&(first, Vec::new())).map_or(0, |value| value.number() as i64);
        let entries = &self.feature(index).entries;
        let place = |number: i64| entries.iter().position(|entry| shared::number(entry) == number);
        Some(self.make.code(index, place(number).or_else(|| place(0)).unwrap_or(0)))
    }

    fn key(&self, index: usize) -> Key {
        let selectors = &self.make.selectors[index];
        (index, selectors.iter().map(|selector| self.integer(*selector)).collect())
    }

    fn integer(&self, index: usize) -> i64 {
        match self.plain(index, &self.key(index)) {
            Value::Integer(value) => value,
            other => other.number() as i64,
        }
    }

    /// The value at a key: what is stored, or that of the user set `Default`; within its bounds as they are now.
    fn plain(&self, index: usize, key: &Key) -> Value {
        let feature = self.feature(index);
        if let Some(code) = self.shared(index) {
            return Value::Integer(code);
        }
        if let Some(value) = self.stored.get(key) {
            return match value {
                // A binning that came later has made the picture smaller.
                Value::Integer(number) if matches!(feature.name.as_str(), "Width" | "Height") => {
                    let range = self.range(index);
                    Value::Integer((*number as f64).clamp(range.min, range.max) as i64)
                }
                value => value.clone(),
            };
        }
        match feature.kind {
            Kind::Enumeration => {
                Value::Integer(self.make.code(index, rules::default_entry(&self.make.table, feature)))
            }
            Kind::Boolean | Kind::Command => Value::Integer(0),
            Kind::String => Value::Text(String::new()),
            Kind::Integer | Kind::Float => {
                let range = self.range(index);
                let wanted = match feature.name.as_str() {
                    "Width" | "Height" => range.max,
                    _ => rules::default_number(&self.make.table, feature),
                };
                // `max` and `min` where `clamp` would mind bounds that contradict each other.
                let value = wanted.max(range.min).min(range.max.max(range.min));
                if feature.kind == Kind::Float { Value::Float(value) } else { Value::Integer(value as i64) }
            }
        }
    }

    /// The value of a feature, of the entry that its selectors name at the moment.
    pub fn value(&self, index: usize) -> Value {
        let feature = self.feature(index);
        if let Some(fact) = self.fact(&feature.name) {
            return if feature.kind == Kind::Float {
                Value::Float(fact)
            } else {
                Value::Integer(fact as i64)
            };
        }
        let Some(primary) = self.make.aliases[index] else { return self.plain(index, &self.key(index)) };
        let number = self.plain(primary, &self.key(primary)).number() * rules::alias_scale(&feature.name);
        if feature.kind == Kind::Float { Value::Float(number) } else { Value::Integer(number.round() as i64) }
    }

    /// A number, by the first of these names that the camera has.
    pub(super) fn number(&self, names: &[&str]) -> Option<f64> {
        let index = names.iter().find_map(|name| self.make.table.find(name))?;
        Some(self.value(index).number())
    }

    /// Whether a switch is on, whether it is a boolean or an enumeration.
    pub(super) fn is_on(&self, names: &[&str]) -> bool {
        names.iter().any(|name| match self.make.table.find(name) {
            Some(index) if self.feature(index).kind == Kind::Enumeration => {
                self.entry(name).is_some_and(|entry| entry != "Off")
            }
            Some(index) => self.integer(index) != 0,
            None => false,
        })
    }

    /// The entry of an enumeration.
    pub(super) fn entry(&self, name: &str) -> Option<&str> {
        let index = self.make.table.find(name)?;
        self.entry_of(index, self.integer(index))
    }

    /// The same for an entry of its first selector, whichever is selected.
    pub(super) fn entry_at(&self, name: &str, selected: &str) -> Option<&str> {
        let index = self.make.table.find(name)?;
        self.entry_of(index, self.value_at(name, selected)?.number() as i64)
    }

    /// Whether a feature has a value for each entry of a selector.
    pub(super) fn is_behind(&self, name: &str, selector: &str) -> bool {
        let (index, selector) = (self.make.table.find(name), self.make.table.find(selector));
        index.zip(selector).is_some_and(|(index, selector)| self.make.selectors[index].contains(&selector))
    }

    /// The value of a feature for an entry of its first selector; without a selector its only one.
    pub(super) fn value_at(&self, name: &str, selected: &str) -> Option<Value> {
        let index = self.make.table.find(name)?;
        let mut key = self.key(index);
        if let Some(selector) = self.make.selectors[index].first() {
            let place = self.feature(*selector).entries.iter().position(|entry| entry == selected)?;
            *key.1.first_mut()? = self.make.code(*selector, place);
        }
        Some(self.plain(index, &key))
    }

    fn entry_of(&self, index: usize, code: i64) -> Option<&str> {
        let entries = &self.feature(index).entries;
        let place = (0..entries.len()).find(|place| self.make.code(index, *place) == code)?;
        Some(&entries[place])
    }

    /// Bounds of a number as they are now.
    pub fn range(&self, index: usize) -> Range {
        let feature = self.feature(index);
        let mut range = rules::range(feature);
        if let Some(primary) = self.make.aliases[index] {
            let scale = rules::alias_scale(&feature.name);
            let of = rules::range(self.feature(primary));
            range = Range { min: of.min * scale, max: of.max * scale, ..range };
        }
        let columns = |name: &str| name.ends_with("Width") || name.ends_with('X');
        let name = feature.name.as_str();
        let full = || {
            let (width, height) = self.reduced();
            f64::from(if columns(name) { width } else { height })
        };
        let now = |name: &str| {
            let index = self.make.table.find(name);
            // What is stored, not what is read: bounds must not ask for each other.
            index.and_then(|index| self.stored.get(&self.key(index))).map(Value::number)
        };
        match name {
            "Width" | "Height" => {
                let full = full();
                let offset = now(if name == "Width" { "OffsetX" } else { "OffsetY" }).unwrap_or(0.0);
                range.max = (full - offset).max(1.0);
                range.inc = rules::pixels(feature);
                let least = match feature.min {
                    Bound::Fixed(min) => min.max(1.0),
                    Bound::Absent | Bound::Depends => 4.0 * range.inc,
                };
                // A smallest width is for sensors that have it.
                range.min = if least > range.max { 1.0 } else { least };
            }
            "OffsetX" | "OffsetY" => {
                let full = full();
                let size = now(if name == "OffsetX" { "Width" } else { "Height" }).unwrap_or(full);
                range = Range { min: 0.0, max: (full - size).max(0.0), inc: rules::pixels(feature) };
            }
            _ => {}
        }
        range
    }

    /// Columns and rows after binning and decimation.
    pub(super) fn reduced(&self) -> (u32, u32) {
        let (x, y) = self.reduction();
        ((self.sensor.0 / x).max(1), (self.sensor.1 / y).max(1))
    }

    /// So many pixels of a row, and rows, become one.
    pub(super) fn reduction(&self) -> (u32, u32) {
        let of = |names: [&str; 2]| names.iter().map(|name| self.factor(name)).product::<u32>().clamp(1, 16);
        (of(["BinningHorizontal", "DecimationHorizontal"]), of(["BinningVertical", "DecimationVertical"]))
    }

    /// A factor, which is a number or is named by an entry: `X2`, `On`.
    pub(super) fn factor(&self, name: &str) -> u32 {
        let Some(index) = self.make.table.find(name) else { return 1 };
        if self.feature(index).kind != Kind::Enumeration {
            return (self.integer(index).clamp(1, 16)) as u32;
        }
        let entry = self.entry(name).unwrap_or("Off");
        let digits: String = entry.chars().filter(char::is_ascii_digit).collect();
        digits.parse().unwrap_or(if entry == "On" { 2 } else { 1 }).clamp(1, 16)
    }

    /// Locked, available, implemented: as bits.
    pub fn state(&self, index: usize) -> u32 {
        let feature = self.feature(index);
        let locked = match rules::lock(feature) {
            Lock::Never => false,
            Lock::Acquiring => self.acquiring || self.is_on(&["TLParamsLocked"]),
            Lock::Auto(auto) => self.is_on(&[auto]) || self.is_on(rules::SEQUENCER),
        };
        let available = rules::needs(feature).is_none_or(|(names, values)| {
            let there: Vec<&&str> =
                names.iter().filter(|name| self.make.table.find(name).is_some()).collect();
            there.is_empty()
                || there.iter().any(|name| match self.entry(name) {
                    Some(entry) => values.contains(&entry),
                    None => self.is_on(&[**name]),
                })
        });
        let implemented = rules::implemented(&self.make.table, feature);
        u32::from(locked) * LOCKED + u32::from(available) * AVAILABLE + u32::from(implemented) * IMPLEMENTED
    }

    /// The four bytes at an aligned address.
    ///
    /// # Errors
    /// No register there, or one that only can be written.
    pub fn word(&self, address: u32) -> Result<[u8; 4], Status> {
        let nothing = Status::InvalidAddress;
        let known =
            |index: &usize| *index < self.make.table.features.len() && self.make.links[*index].is_none();
        let (bytes, at) = match places::find(address).ok_or(nothing)? {
            Place::Said(index, what, at) if index < self.make.table.features.len() => {
                (self.said(index, what), at)
            }
            Place::Value(index, at) if known(&index) => {
                // A number that was put into a register can be read, whatever its description states.
                let kept =
                    self.feature(index).kind == Kind::Command && self.make.echo(index) == Echo::ForEver;
                let hidden = match self.feature(index).can_be_read {
                    Some(can_be_read) => !can_be_read,
                    None => rules::access(self.feature(index)) == Access::Wo,
                };
                if hidden && !kept {
                    return Err(Status::AccessDenied);
                }
                (self.encode(index), at)
            }
            _ => return Err(nothing),
        };
        bytes.get(at..at + 4).and_then(|word| word.try_into().ok()).ok_or(nothing)
    }

    fn said(&self, index: usize, what: Said) -> Vec<u8> {
        let feature = self.feature(index);
        let range = self.range(index);
        let number = match what {
            Said::Min => range.min,
            Said::Max => range.max,
            Said::Inc => range.inc,
            Said::State => return self.state(index).to_be_bytes().to_vec(),
        };
        match feature.kind {
            Kind::Float => number.to_be_bytes().to_vec(),
            _ => (number as i64).to_be_bytes().to_vec(),
        }
    }

    fn encode(&self, index: usize) -> Vec<u8> {
        let feature = self.feature(index);
        if feature.kind == Kind::Command {
            // What is not done yet is still what was written.
            let written = self.echoes.get(&index).copied().unwrap_or(0);
            let is_pending = self.pending.iter().any(|(pending, _)| *pending == index);
            let stays = is_pending || self.make.echo(index) == Echo::ForEver;
            return u32::from(stays).saturating_mul(written).to_be_bytes().to_vec();
        }
        match (feature.kind, self.value(index)) {
            (Kind::Float, value) => value.number().to_be_bytes().to_vec(),
            (Kind::Integer, value) => (value.number() as i64).to_be_bytes().to_vec(),
            (Kind::String, Value::Text(text)) => {
                let mut bytes = text.into_bytes();
                bytes.resize(STRIDE as usize, 0);
                bytes
            }
            (_, value) => (value.number() as i64 as u32).to_be_bytes().to_vec(),
        }
    }

    /// Writes the feature that lies at `address`; returns how many bytes it took and what follows.
    ///
    /// # Errors
    /// No feature, or what keeps it from taking the value; it keeps what it had.
    pub fn write(
        &mut self,
        address: u32,
        data: &[u8],
        acquiring: bool,
        now: Instant,
    ) -> Result<(usize, Option<Effect>), Status> {
        self.tick(acquiring, now);
        let index = match places::find(address) {
            Some(Place::Value(index, 0)) if index < self.make.table.features.len() => index,
            Some(Place::Said(..)) => return Err(Status::WriteProtect),
            _ => return Err(Status::InvalidAddress),
        };
        let feature = self.feature(index);
        let state = self.state(index);
        if self.make.links[index].is_some() || state & IMPLEMENTED == 0 {
            return Err(Status::InvalidAddress);
        }
        if rules::access(feature) == Access::Ro {
            return Err(Status::WriteProtect);
        }
        if state & AVAILABLE == 0 || state & LOCKED != 0 {
            return Err(Status::AccessDenied);
        }
        let length = places::length(feature.kind) as usize;
        if feature.kind == Kind::String {
            return self.write_text(index, &data[..data.len().min(length)]);
        }
        let data = data.get(..length).ok_or(Status::InvalidAddress)?;
        let wide = <[u8; 8]>::try_from(data).map(i64::from_be_bytes);
        let code = <[u8; 4]>::try_from(data).map(u32::from_be_bytes);
        let effect = match (feature.kind, wide, code) {
            (Kind::Float, Ok(bits), _) => self.set_number(index, f64::from_bits(bits as u64))?,
            (Kind::Integer, Ok(value), _) => self.set_number(index, value as f64)?,
            (Kind::Command, _, Ok(code)) => return Ok((length, self.command(index, code, now)?)),
            (Kind::Boolean, _, Ok(code)) => {
                accept(code <= 1)?;
                self.store(index, Value::Integer(i64::from(code)))
            }
            (_, _, Ok(code)) => {
                let entry = self.entry_of(index, i64::from(code)).ok_or(Status::InvalidParameter)?;
                accept(rules::entry_implemented(&self.make.table, feature, entry))?;
                self.store(index, Value::Integer(i64::from(code)))
            }
            _ => return Err(Status::InvalidAddress),
        };
        Ok((length, effect))
    }

    fn store(&mut self, index: usize, value: Value) -> Option<Effect> {
        let (key, value) = self.place(index, self.key(index), value);
        self.stored.insert(key, value);
        Some(Effect::Stream)
    }

    fn write_text(&mut self, index: usize, data: &[u8]) -> Result<(usize, Option<Effect>), Status> {
        let end = data.iter().position(|byte| *byte == 0).unwrap_or(data.len()).min(STRIDE as usize - 1);
        let text = std::str::from_utf8(&data[..end]).map_err(|_| Status::InvalidParameter)?.to_owned();
        Ok((data.len(), self.store(index, Value::Text(text))))
    }

    fn set_number(&mut self, index: usize, value: f64) -> Result<Option<Effect>, Status> {
        let range = self.range(index);
        let feature = self.feature(index);
        let exposure = rules::EXPOSURE.contains(&feature.name.as_str());
        accept(value.is_finite())?;
        let mut value = value;
        if exposure && self.habits.exposures == Exposures::Clamped {
            value = value.clamp(range.min, range.max.max(range.min));
        }
        accept(value >= range.min && value <= range.max)?;
        let (kind, name) = (feature.kind, feature.name.clone());
        // Sizes are multiples of their increment, other numbers lie so far above their smallest one.
        let base = if range.min.rem_euclid(range.inc.max(1.0)) == 0.0 || name == "Width" || name == "Height" {
            0.0
        } else {
            range.min
        };
        if kind == Kind::Integer && range.inc > 1.0 {
            accept((value - base).rem_euclid(range.inc) == 0.0)?;
        }
        let target = self.make.aliases[index].unwrap_or(index);
        let mut value = value / if target == index { 1.0 } else { rules::alias_scale(&name) };
        if exposure {
            let step = self.habits.exposure_step.as_secs_f64() * 1e6;
            let nearest = if step > 0.0 { (value / step).round().max(1.0) * step } else { value };
            self.nearest_us = Some(nearest);
            if self.habits.exposures != Exposures::Asked {
                value = nearest;
            }
        }
        let kind = self.feature(target).kind;
        let value =
            if kind == Kind::Float { Value::Float(value) } else { Value::Integer(value.round() as i64) };
        Ok(self.store(target, value))
    }

    fn command(&mut self, index: usize, code: u32, now: Instant) -> Result<Option<Effect>, Status> {
        let executes = match self.make.written(index) {
            Written::Always(value) => i64::from(value),
            Written::Of(of) => self.integer(of),
        };
        accept(i64::from(code) == executes)?;
        self.echoes.insert(index, code);
        match self.feature(index).name.as_str() {
            "AcquisitionStart" => Ok(Some(Effect::Start)),
            "AcquisitionStop" | "AcquisitionAbort" => Ok(Some(Effect::Stop)),
            "TriggerSoftware" => {
                if !self.takes_software_triggers() {
                    return Err(Status::AccessDenied);
                }
                Ok(Some(Effect::SoftwareTrigger))
            }
            _ => {
                self.pending.push((index, now + Duration::from_millis(self.habits.command_ms)));
                self.tick(self.acquiring, now);
                Ok(Some(Effect::Stream))
            }
        }
    }

    /// Does what has become due.
    pub fn tick(&mut self, acquiring: bool, now: Instant) {
        self.acquiring = acquiring;
        let due: Vec<usize> =
            self.pending.iter().filter(|(_, at)| *at <= now).map(|(index, _)| *index).collect();
        self.pending.retain(|(_, at)| *at > now);
        for index in due {
            let set = self.make.table.find("UserSetSelector").map_or(0, |selector| self.integer(selector));
            let default = self.entry("UserSetSelector").is_none_or(|entry| entry == "Default");
            match self.feature(index).name.as_str() {
                "UserSetLoad" => {
                    let selector = self.make.table.find("UserSetSelector").map(|index| self.key(index));
                    let kept = selector.and_then(|key| self.stored.remove_entry(&key));
                    self.stored = if default {
                        BTreeMap::new()
                    } else {
                        self.saved.get(&set).cloned().unwrap_or_default()
                    };
                    self.stored.extend(kept);
                    self.nearest_us = None;
                }
                // The factory's set stays what it is.
                "UserSetSave" if !default => {
                    self.saved.insert(set, self.stored.clone());
                }
                _ => {}
            }
        }
    }
}

fn accept(valid: bool) -> Result<(), Status> {
    if valid { Ok(()) } else { Err(Status::InvalidParameter) }
}
