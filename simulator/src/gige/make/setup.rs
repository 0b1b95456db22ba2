// SPDX-License-Identifier: MIT OR Apache-2.0
//! The entries of a node file for a make, as a user writes them who knows that camera: words, and raw settings for what
//! no rule knows.

use super::{Make, rules};

impl Make {
    /// The lines of a `[[camera]]` table behind its address.
    pub fn session_words(&self) -> String {
        let table = &self.table;
        let (mut said, mut left, mut settings) = (String::new(), Vec::new(), Vec::new());
        match (&self.wire, table.find("TriggerMode").is_some()) {
            (Some(wire), true) => said += &format!("trigger_line = {wire:?}\n"),
            (None, true) => {}
            (_, false) => left.push("trigger_line"),
        }
        let rises = |entry: &String| {
            ["Rising", "Positive", "ActiveHigh"].iter().any(|start| entry.starts_with(start))
        };
        if let Some(edge) = table.feature("TriggerActivation")
            && !edge.entries.iter().any(rises)
            && let Some(entry) = edge.entries.first()
        {
            left.push("trigger_edge");
            settings.push(("TriggerActivation", entry.clone()));
        }
        if !rules::EXPOSURE.iter().any(|name| table.find(name).is_some()) {
            left.push("exposure_us");
        }
        if table.find("TriggerMode").is_none() {
            for (name, starts) in rules::EXTERNAL {
                let entries = table.feature(name).map_or(&[][..], |feature| &feature.entries);
                // Programmable before presets: the rig's exposure is none of theirs.
                let fits = |entry: &&String| starts.iter().any(|start| entry.starts_with(start));
                let best = entries.iter().filter(fits).max_by_key(|entry| entry.ends_with("Programmable"));
                settings.extend(best.map(|entry| (*name, entry.clone())));
            }
        }
        let list = |items: Vec<String>| items.join(", ");
        if !left.is_empty() {
            said += &format!(
                "left_to_settings = [{}]\n",
                list(left.iter().map(|word| format!("{word:?}")).collect())
            );
        }
        if !settings.is_empty() {
            let pairs = settings.iter().map(|(name, entry)| format!("[{name:?}, {entry:?}]"));
            said += &format!("settings = [{}]\n", list(pairs.collect()));
        }
        said
    }
}
