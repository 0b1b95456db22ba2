// SPDX-License-Identifier: MIT OR Apache-2.0
//! The value that executes a command, and what its register holds afterwards: not every one shows when it is done.

use super::Make;
use super::table::{CommandValue, Feature, Table};

/// The selector whose value some commands write.
const SETS: &str = "UserSetSelector";

/// The content of a command's register after it was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Echo {
    /// What was written, until it is done; 0 from then on.
    UntilDone,
    /// What was written, for ever: a number that was put there, as that of a set of settings.
    ForEver,
}

/// What is written to execute a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Written {
    Always(u32),
    /// The value of this feature, whatever it is now.
    Of(usize),
}

/// The value whose writing executes a command.
pub fn written(table: &Table, feature: &Feature) -> Written {
    match &feature.command_value {
        CommandValue::Fixed(value) => Written::Always(*value),
        CommandValue::Of(names) => {
            let set = names.iter().find(|name| *name == SETS).and_then(|name| table.find(name));
            set.map_or(Written::Always(1), Written::Of)
        }
    }
}

/// The content of a command's register: 0 is what any register holds, and what is no switch of a few bits is a number
/// that stays where it was put.
pub fn echo(table: &Table, feature: &Feature) -> Echo {
    let sets = feature.name.starts_with("UserSet");
    match written(table, feature) {
        Written::Of(_) => Echo::ForEver,
        Written::Always(0) => Echo::ForEver,
        Written::Always(value) if sets && !value.is_power_of_two() => Echo::ForEver,
        Written::Always(_) => Echo::UntilDone,
    }
}

impl Make {
    /// The value whose writing executes a command.
    pub(super) fn written(&self, index: usize) -> Written {
        written(&self.table, &self.table.features[index])
    }

    /// The content of a command's register.
    pub(super) fn echo(&self, index: usize) -> Echo {
        echo(&self.table, &self.table.features[index])
    }
}
