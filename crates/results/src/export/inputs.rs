// SPDX-License-Identifier: MIT OR Apache-2.0
//! When edges came on the HSU's input lines, as a table of comma-separated values (RFC 4180): a row an edge.
//!
//! | column | is |
//! |---|---|
//! | `number` | consecutive since the HSU was switched on; a hole is an edge that no recording has |
//! | `input`, `edge` | the line, and `rising` or `falling` |
//! | `hsu_time_ns` | when it came, the HSU's clock |
//! | `trigger` | index of the last trigger before it |
//! | `after_trigger_ns` | how long after that trigger it came |
//! | `skipped` | edges before it that were too many to be kept |
//!
//! Before the first trigger the last two of time are empty.

use crate::record::{InputEdge, SessionReader};
use std::collections::BTreeMap;
use std::io::{self, Write};

/// The first line of the table: the names of its columns.
pub const HEADER: &str = "number,input,edge,hsu_time_ns,trigger,after_trigger_ns,skipped";

/// The edges of a session, by number: all nodes have the reports of the same HSU, and one may have an edge that
/// another lacks.
pub fn edges(session: &SessionReader) -> BTreeMap<u64, InputEdge> {
    let events = session.recordings().iter().flat_map(|recording| &recording.events);
    events.filter_map(InputEdge::of).map(|edge| (edge.number, edge)).collect()
}

/// Writes the table of these edges.
pub fn write(
    mut out: impl Write,
    session: &SessionReader,
    edges: &BTreeMap<u64, InputEdge>,
) -> io::Result<()> {
    let rows = session.recordings().iter().flat_map(|recording| recording.triggers.values());
    let triggers: BTreeMap<u64, u64> = rows.map(|row| (row.hsu_time_ns, row.index.0)).collect();
    writeln!(out, "{HEADER}")?;
    for edge in edges.values() {
        let way = if edge.rising { "rising" } else { "falling" };
        let last = triggers.range(..=edge.hsu_time_ns).next_back();
        let (trigger, after) = last.map_or_else(Default::default, |(time_ns, index)| {
            (index.to_string(), (edge.hsu_time_ns - time_ns).to_string())
        });
        let InputEdge { number, line, hsu_time_ns, skipped, .. } = edge;
        writeln!(out, "{number},{line},{way},{hsu_time_ns},{trigger},{after},{skipped}")?;
    }
    Ok(())
}
