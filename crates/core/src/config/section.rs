// SPDX-License-Identifier: MIT OR Apache-2.0
//! Walking a TOML table while noting every problem under its key path.
//!
//! Getters return a placeholder after noting a problem; the caller builds its structure from them and
//! throws it away when any problem was noted.

use super::Problem;
use crate::base::ids::{one_line, printable};
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
    /// The file's outermost table.
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
        // A key is whatever somebody has put between quotation marks.
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

    fn required(&self, key: &'static str, expected: &str) -> Option<&'a Value> {
        let value = self.get(key);
        if value.is_none() {
            self.problem(key, format!("is missing, expected {expected}"));
        }
        value
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
        let expected = format!("a number from {} to {}", range.start(), range.end());
        self.required(key, &expected).map_or(0.0, |value| self.number_of(key, value, &range, &expected))
    }

    /// An optional number within `range`.
    pub fn number_or(&self, key: &'static str, range: RangeInclusive<f64>, default: f64) -> f64 {
        let expected = format!("a number from {} to {}", range.start(), range.end());
        self.get(key).map_or(default, |value| self.number_of(key, value, &range, &expected))
    }

    fn number_of(&self, key: &str, value: &Value, range: &RangeInclusive<f64>, expected: &str) -> f64 {
        let number = value.as_float().or_else(|| value.as_integer().map(|i| i as f64));
        match number.filter(|x| range.contains(x)) {
            Some(x) => x,
            None => {
                self.wrong(key, expected, value);
                0.0
            }
        }
    }

    /// A required whole number within `range`.
    pub fn integer(&self, key: &'static str, range: RangeInclusive<u64>) -> u64 {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        self.required(key, &expected).map_or(0, |value| self.integer_of(key, value, &range, &expected))
    }

    /// An optional whole number within `range`.
    pub fn integer_or(&self, key: &'static str, range: RangeInclusive<u64>, default: u64) -> u64 {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        self.get(key).map_or(default, |value| self.integer_of(key, value, &range, &expected))
    }

    fn integer_of(&self, key: &str, value: &Value, range: &RangeInclusive<u64>, expected: &str) -> u64 {
        match value.as_integer().and_then(|i| u64::try_from(i).ok()).filter(|i| range.contains(i)) {
            Some(i) => i,
            None => {
                self.wrong(key, expected, value);
                0
            }
        }
    }

    /// A required non-empty text.
    pub fn text(&self, key: &'static str) -> String {
        self.required(key, "a text").map_or_else(String::new, |value| self.text_of(key, value))
    }

    /// A required name, as [`crate::base::ids::check_name`] wants it.
    pub fn name(&self, key: &'static str) -> String {
        let text = self.text(key);
        if !text.is_empty()
            && let Err(reason) = crate::base::ids::check_name(&text)
        {
            self.problem(key, reason);
        }
        text
    }

    fn text_of(&self, key: &str, value: &Value) -> String {
        match value.as_str().filter(|text| !text.is_empty()) {
            Some(text) if printable(text) == *text => text.to_owned(),
            _ => {
                self.wrong(key, "a text on one line, which is not empty", value);
                String::new()
            }
        }
    }

    /// An optional truth value.
    pub fn flag_or(&self, key: &'static str, default: bool) -> bool {
        self.get(key).map_or(default, |value| {
            value.as_bool().unwrap_or_else(|| {
                self.wrong(key, "true or false", value);
                default
            })
        })
    }

    /// A required word out of `choices`, as its paired value; the first choice stands in after a problem.
    pub fn choice<T: Copy>(&self, key: &'static str, choices: &[(&str, T)]) -> T {
        let expected = Self::one_of(choices);
        self.required(key, &expected)
            .map_or(choices[0].1, |value| self.choice_of(key, value, choices, &expected))
    }

    /// An optional word out of `choices`; the first is the default.
    pub fn choice_or_first<T: Copy>(&self, key: &'static str, choices: &[(&str, T)]) -> T {
        let expected = Self::one_of(choices);
        self.get(key).map_or(choices[0].1, |value| self.choice_of(key, value, choices, &expected))
    }

    fn one_of<T>(choices: &[(&str, T)]) -> String {
        let words: Vec<String> = choices.iter().map(|(word, _)| format!("{word:?}")).collect();
        format!("one of {}", words.join(", "))
    }

    fn choice_of<T: Copy>(&self, key: &str, value: &Value, choices: &[(&str, T)], expected: &str) -> T {
        let found = value.as_str().and_then(|text| choices.iter().find(|(word, _)| *word == text));
        found.map_or_else(
            || {
                self.wrong(key, expected, value);
                choices[0].1
            },
            |(_, choice)| *choice,
        )
    }

    /// A required list of exactly `N` finite numbers.
    pub fn vector<const N: usize>(&self, key: &'static str) -> [f64; N] {
        let expected = format!("a list of {N} numbers");
        self.required(key, &expected).map_or([0.0; N], |value| self.vector_of(key, value, &expected))
    }

    /// An optional list of exactly `N` finite numbers.
    pub fn vector_or<const N: usize>(&self, key: &'static str, default: [f64; N]) -> [f64; N] {
        let expected = format!("a list of {N} numbers");
        self.get(key).map_or(default, |value| self.vector_of(key, value, &expected))
    }

    fn vector_of<const N: usize>(&self, key: &str, value: &Value, expected: &str) -> [f64; N] {
        let number =
            |v: &Value| v.as_float().or_else(|| v.as_integer().map(|i| i as f64)).filter(|x| x.is_finite());
        let numbers: Option<Vec<f64>> = value.as_array().and_then(|list| list.iter().map(number).collect());
        numbers.and_then(|list| list.try_into().ok()).unwrap_or_else(|| {
            self.wrong(key, expected, value);
            [0.0; N]
        })
    }

    /// An optional list of any values.
    pub fn list(&self, key: &'static str) -> &'a [Value] {
        match self.get(key) {
            None => &[],
            Some(Value::Array(list)) => list,
            Some(other) => {
                self.wrong(key, "a list", other);
                &[]
            }
        }
    }

    /// A required sub-table.
    pub fn section(&self, key: &'static str) -> Option<Section<'a>> {
        self.required(key, "a table").and_then(|value| self.section_of(key, value))
    }

    /// An optional value of any kind.
    pub fn value(&self, key: &'static str) -> Option<&'a Value> {
        self.get(key)
    }

    /// An optional sub-table.
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
        let Some(value) = self.required(key, "at least one table") else { return Vec::new() };
        let Some(list) = value.as_array().filter(|list| !list.is_empty()) else {
            self.wrong(key, "at least one table", value);
            return Vec::new();
        };
        let tables = list.iter().enumerate();
        tables.filter_map(|(i, value)| self.section_of(&format!("{key}[{i}]"), value)).collect()
    }

    /// Notes every key that nobody asked for. Call it last.
    pub fn finish(self) {
        let seen = self.seen.borrow();
        for key in self.table.keys().filter(|key| !seen.contains(key.as_str())) {
            let known: Vec<&str> = seen.iter().copied().collect();
            self.problem(key, format!("is not known here; known: {}", known.join(", ")));
        }
    }
}
