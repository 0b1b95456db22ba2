// SPDX-License-Identifier: MIT OR Apache-2.0
//! Walking a TOML table while noting every problem under its key path.
//!
//! Getters return a placeholder after noting a problem; the caller builds its structure from them and
//! throws it away when any problem was noted.

use super::Problem;
use crate::base::ids::{check_name, one_line, printable};
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use toml::{Table, Value};

/// One table of a configuration file.
pub struct Section<'a> {
    table: &'a Table,
    path: String,
    seen: RefCell<BTreeSet<&'static str>>,
    problems: &'a RefCell<Vec<Problem>>,
}

impl<'a> Section<'a> {
    /// The outermost table of a file, as a section.
    pub fn root(table: &'a Table, problems: &'a RefCell<Vec<Problem>>) -> Self {
        Self { table, path: String::new(), seen: RefCell::default(), problems }
    }

    /// The full path of `key` in the file.
    pub fn path_of(&self, key: &str) -> String {
        match (self.path.is_empty(), key.is_empty()) {
            (true, _) => key.to_owned(),
            (false, true) => self.path.clone(),
            (false, false) => format!("{}.{key}", self.path),
        }
    }

    /// Notes a problem at `key` (empty: at this table).
    pub fn problem(&self, key: &str, message: impl Into<String>) {
        // A key between quotation marks may hold any character.
        let (key, message) = (one_line(self.path_of(key)), one_line(message.into()));
        self.problems.borrow_mut().push(Problem { key, message });
    }

    /// Whether nothing has been noted in the file so far: checks between values are meaningless before that.
    pub fn problem_free(&self) -> bool {
        self.problems.borrow().is_empty()
    }

    fn get(&self, key: &'static str) -> Option<&'a Value> {
        self.seen.borrow_mut().insert(key);
        self.table.get(key)
    }

    /// The value at `key` as `take` has it. Where the key is missing: `default`, without which that is a problem;
    /// `placeholder` stands in after a problem.
    fn read<T>(
        &self,
        key: &'static str,
        expected: &str,
        default: Option<T>,
        placeholder: T,
        take: impl FnOnce(&'a Value) -> Option<T>,
    ) -> T {
        let value = self.get(key);
        if value.is_none() && default.is_none() {
            self.problem(key, format!("is missing, expected {expected}"));
        }
        let Some(value) = value else { return default.unwrap_or(placeholder) };
        take(value).unwrap_or_else(|| {
            self.wrong(key, expected, value);
            placeholder
        })
    }

    fn wrong(&self, key: &str, expected: &str, found: &Value) {
        self.problem(key, format!("expected {expected}, found {}", one_line(found)));
    }

    /// Whether the key is there at all.
    pub fn has(&self, key: &str) -> bool {
        self.table.contains_key(key)
    }

    /// A required number within `range`; whole numbers are accepted.
    pub fn number(&self, key: &'static str, range: RangeInclusive<f64>) -> f64 {
        self.number_of(key, &range, None)
    }

    /// An optional number within `range`.
    pub fn number_or(&self, key: &'static str, range: RangeInclusive<f64>, default: f64) -> f64 {
        self.number_of(key, &range, Some(default))
    }

    fn number_of(&self, key: &'static str, range: &RangeInclusive<f64>, default: Option<f64>) -> f64 {
        let expected = format!("a number from {} to {}", range.start(), range.end());
        self.read(key, &expected, default, 0.0, |value| number(value).filter(|x| range.contains(x)))
    }

    /// A required whole number within `range`.
    pub fn integer(&self, key: &'static str, range: RangeInclusive<u64>) -> u64 {
        self.integer_of(key, &range, None)
    }

    /// An optional whole number within `range`.
    pub fn integer_or(&self, key: &'static str, range: RangeInclusive<u64>, default: u64) -> u64 {
        self.integer_of(key, &range, Some(default))
    }

    fn integer_of(&self, key: &'static str, range: &RangeInclusive<u64>, default: Option<u64>) -> u64 {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        let whole = |value: &Value| value.as_integer().and_then(|i| u64::try_from(i).ok());
        self.read(key, &expected, default, 0, |value| whole(value).filter(|i| range.contains(i)))
    }

    /// A required text on one line, which is not empty.
    pub fn text(&self, key: &'static str) -> String {
        let is_plain = |text: &&str| !text.is_empty() && printable(text) == **text;
        let Some(value) = self.get(key) else {
            self.problem(key, "is missing, expected a text");
            return String::new();
        };
        let text = value.as_str().filter(is_plain).map(str::to_owned);
        text.unwrap_or_else(|| {
            self.wrong(key, "a text on one line, which is not empty", value);
            String::new()
        })
    }

    /// A required name, as [`check_name`] wants it.
    pub fn name(&self, key: &'static str) -> String {
        let text = self.text(key);
        if !text.is_empty()
            && let Err(reason) = check_name(&text)
        {
            self.problem(key, reason);
        }
        text
    }

    /// An optional truth value, `true` or `false`.
    pub fn flag_or(&self, key: &'static str, default: bool) -> bool {
        self.read(key, "true or false", Some(default), default, Value::as_bool)
    }

    /// A required word out of `choices`, as its paired value; the first choice stands in after a problem.
    pub fn choice<T: Copy>(&self, key: &'static str, choices: &[(&str, T)]) -> T {
        self.choice_of(key, choices, None)
    }

    /// An optional word out of `choices`; the first is the default.
    pub fn choice_or_first<T: Copy>(&self, key: &'static str, choices: &[(&str, T)]) -> T {
        self.choice_of(key, choices, Some(choices[0].1))
    }

    fn choice_of<T: Copy>(&self, key: &'static str, choices: &[(&str, T)], default: Option<T>) -> T {
        let words: Vec<String> = choices.iter().map(|(word, _)| format!("{word:?}")).collect();
        let expected = format!("one of {}", words.join(", "));
        self.read(key, &expected, default, choices[0].1, |value| {
            let text = value.as_str()?;
            choices.iter().find(|(word, _)| *word == text).map(|(_, choice)| *choice)
        })
    }

    /// A required list of exactly `N` finite numbers.
    pub fn vector<const N: usize>(&self, key: &'static str) -> [f64; N] {
        self.vector_of(key, None)
    }

    /// An optional list of exactly `N` finite numbers.
    pub fn vector_or<const N: usize>(&self, key: &'static str, default: [f64; N]) -> [f64; N] {
        self.vector_of(key, Some(default))
    }

    fn vector_of<const N: usize>(&self, key: &'static str, default: Option<[f64; N]>) -> [f64; N] {
        self.read(key, &format!("a list of {N} numbers"), default, [0.0; N], |value| {
            let finite = |value| number(value).filter(|x| x.is_finite());
            value.as_array()?.iter().map(finite).collect::<Option<Vec<f64>>>()?.try_into().ok()
        })
    }

    /// An optional list of any values.
    pub fn list(&self, key: &'static str) -> &'a [Value] {
        self.read(key, "a list", Some(&[]), &[], |value| value.as_array().map(Vec::as_slice))
    }

    /// What `take` makes of each value of an optional list; the others are problems.
    pub fn each<T>(&self, key: &'static str, expected: &str, take: impl Fn(&Value) -> Option<T>) -> Vec<T> {
        let values = self.list(key).iter().enumerate();
        let taken = values.filter_map(|(i, value)| {
            let taken = take(value);
            if taken.is_none() {
                self.problem(&format!("{key}[{i}]"), format!("expected {expected}, found {value}"));
            }
            taken
        });
        taken.collect()
    }

    /// An optional value of any kind.
    pub fn value(&self, key: &'static str) -> Option<&'a Value> {
        self.get(key)
    }

    /// A sub-table that must be there.
    pub fn section(&self, key: &'static str) -> Option<Section<'a>> {
        if !self.has(key) {
            self.problem(key, "is missing, expected a table");
        }
        self.optional_section(key)
    }

    /// A sub-table that may be missing.
    pub fn optional_section(&self, key: &'static str) -> Option<Section<'a>> {
        self.get(key).and_then(|value| self.section_of(key, value))
    }

    fn section_of(&self, key: &str, value: &'a Value) -> Option<Section<'a>> {
        let Some(table) = value.as_table() else {
            self.wrong(key, "a table", value);
            return None;
        };
        Some(Section { table, path: self.path_of(key), seen: RefCell::default(), problems: self.problems })
    }

    /// A required list of at least one table (`[[key]]`).
    pub fn sections(&self, key: &'static str) -> Vec<Section<'a>> {
        let some = |value: &'a Value| value.as_array().map(Vec::as_slice).filter(|list| !list.is_empty());
        let tables = self.read(key, "at least one table", None, &[][..], some).iter().enumerate();
        tables.filter_map(|(i, value)| self.section_of(&format!("{key}[{i}]"), value)).collect()
    }

    /// Notes every key that no getter has read as a problem. Call it last.
    pub fn finish(self) {
        let seen = self.seen.borrow();
        for key in self.table.keys().filter(|key| !seen.contains(key.as_str())) {
            let known: Vec<&str> = seen.iter().copied().collect();
            self.problem(key, format!("is not known here; known: {}", known.join(", ")));
        }
    }
}

/// A number; whole ones are accepted.
pub(super) fn number(value: &Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64))
}
