// SPDX-License-Identifier: MIT OR Apache-2.0
//! Features that are one number: older cameras have a number of the trigger's mode, of which a selector, an overlap and
//! the exposure's mode each show a part. To set one of them is to set the others.

use super::table::{Kind, Table};
use std::collections::BTreeSet;

/// The selector that is no selector then.
const SELECTOR: &str = "TriggerSelector";
/// What may be shown of the same number.
const PARTS: [&str; 2] = ["ExposureMode", "TriggerOverlap"];

/// The features of a table that are one number; none where each has its own.
pub fn features(table: &Table) -> BTreeSet<usize> {
    let Some(selector) = table.feature(SELECTOR) else { return BTreeSet::new() };
    let parts = PARTS.iter().filter(|part| selector.same_register_as.iter().any(|same| same == *part));
    let there: BTreeSet<usize> = parts
        .chain([&SELECTOR])
        .filter_map(|name| table.find(name))
        .filter(|index| table.features[*index].kind == Kind::Enumeration)
        .collect();
    if there.len() > 1 { there } else { BTreeSet::new() }
}

/// The number that an entry stands for: IIDC counts an edge as 0, a pulse that exposes as 1, overlapped exposures as
/// 14.
pub fn number(entry: &str) -> i64 {
    match entry {
        "ExposureActive" | "TriggerWidth" => 1,
        "ReadOut" | "PreviousFrame" => 14,
        _ => 0,
    }
}
