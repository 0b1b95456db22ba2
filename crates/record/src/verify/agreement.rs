// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recordings of the nodes of a session must agree: one session, one HSU, one trigger table, and no camera twice.

use super::accounting;
use super::findings::{Finding, Notes, Severity};
use super::table::Table;
use crate::layout::NOT_ASKED;
use crate::reader::RecordingReader;
use crate::session::{open_each, parse_rig};
use crate::verdict::Verdict;
use serde::Serialize;
use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;

/// The recordings of two nodes, compared with each other.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Comparison {
    pub nodes: [String; 2],
    pub session_ids: [String; 2],
    /// Triggers, counted from the records.
    pub triggers: [u64; 2],
    /// Triggers that are in both HSU tables.
    pub table_rows: u64,
    /// Triggers in both tables whose rows differ.
    pub rows_that_differ: u64,
    /// Whether nothing differs that has to agree; otherwise findings name it.
    pub agree: bool,
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b] = &self.nodes;
        if !self.agree {
            return write!(f, "nodes {a} and {b} do NOT agree; see above");
        }
        let ([triggers, of_b], [id, _], rows) = (self.triggers, &self.session_ids, self.table_rows);
        write!(f, "nodes {a} and {b} agree: session {id}, {triggers} triggers")?;
        if of_b != triggers {
            write!(f, " on node {a} and {of_b} on node {b}")?;
        }
        write!(f, ", {rows} rows of the HSU's table are equal")
    }
}

/// Compares every recording with the first one.
pub fn check(recordings: &[&RecordingReader], verdicts: &[&Verdict], notes: &mut Notes) -> Vec<Comparison> {
    let mut counted = recordings.iter().copied().zip(verdicts.iter().copied());
    let Some(first) = counted.next() else { return Vec::new() };
    counted.map(|other| pair(first, other, notes)).collect()
}

/// A recording, and the verdict counted from its records.
type Counted<'a> = (&'a RecordingReader, &'a Verdict);

fn pair((first, counted_first): Counted<'_>, (other, counted): Counted<'_>, notes: &mut Notes) -> Comparison {
    let (a, b) = (&first.header, &other.header);
    let mut own = Notes::new(b.node.as_str());
    let mut differs = |what: &str, found: String, expected: String| {
        if found != expected {
            let message = format!("{what} is {found}, but {expected} on node {}", a.node);
            own.add(Severity::Corrupt, None, None, None, message);
        }
    };
    differs("the session's id", b.session_id.clone(), a.session_id.clone());
    differs("the session's name", b.session.to_string(), a.session.to_string());
    differs("the trigger rate", b.trigger_rate_hz.to_string(), a.trigger_rate_hz.to_string());
    let requested = |n: Option<u64>| n.map_or("until stop".to_owned(), |n| n.to_string());
    differs(
        "the number of triggers requested",
        requested(b.expected_triggers),
        requested(a.expected_triggers),
    );
    if let (Some(found), Some(expected)) = (&b.hsu, &a.hsu) {
        differs("the HSU", found.uid.clone(), expected.uid.clone());
    }
    // A count that is missing has been found to be loss.
    if let (Some(found), Some(expected)) = (counted.triggers_emitted, counted_first.triggers_emitted) {
        differs("the HSU's trigger count", found.to_string(), expected.to_string());
    }
    let unknowing = ended_unknowing((first, counted_first), (other, counted));
    if unknowing.is_none() {
        differs("the number of triggers", counted.triggers.to_string(), counted_first.triggers.to_string());
    }
    if a.rig_text != b.rig_text {
        let message = format!("its rig file differs from that of node {}", a.node);
        own.add(Severity::Corrupt, None, None, None, message);
    }
    let (table_rows, rows_that_differ) = Table::compare(first, other, &mut own);
    for camera in b.cameras.iter().filter(|camera| a.cameras.iter().any(|known| known.id == camera.id)) {
        let message = format!("is recorded on node {} as well", a.node);
        own.add(Severity::Corrupt, None, Some(&camera.id), None, message);
    }
    let agree = own.worst.is_none();
    notes.absorb(own);
    unknowing.into_iter().for_each(|unknowing| notes.absorb(unknowing));
    Comparison {
        nodes: [a.node.to_string(), b.node.to_string()],
        session_ids: [a.session_id.clone(), b.session_id.clone()],
        triggers: [counted_first.triggers, counted.triggers],
        table_rows,
        rows_that_differ,
        agree,
    }
}

/// A node that was aborted and never received the HSU's count ends at the last trigger that it knew of, and its verdict
/// states that; the other one has more. Then it is known what is missing, and why: loss, not a contradiction.
fn ended_unknowing(first: Counted<'_>, other: Counted<'_>) -> Option<Notes> {
    let ((short, counted), (longer, counted_longer)) =
        if first.1.triggers < other.1.triggers { (first, other) } else { (other, first) };
    let reason = counted.aborted.as_ref().filter(|_| counted.triggers_emitted.is_none())?;
    let last = counted_longer.triggers.checked_sub(1).filter(|last| *last >= counted.triggers)?;
    let message = format!(
        "no outcomes: it was aborted and does not have the HSU's count ({reason}); node {} has {} triggers",
        longer.header.node, counted_longer.triggers
    );
    let mut notes = Notes::new(short.header.node.as_str());
    notes.add(Severity::Loss, None, None, Some((counted.triggers, last)), message);
    Some(notes)
}

/// Nodes of the rig whose recordings are not here.
pub fn note_absent(recordings: &[&RecordingReader], unreadable: &[&str], notes: &mut Notes) {
    let Some(rig) = recordings.first().and_then(|first| parse_rig(&first.header.rig_text).ok()) else {
        return;
    };
    let here = |node: &str| {
        recordings.iter().any(|recording| recording.header.node.as_str() == node)
            || unreadable.contains(&node)
    };
    let events = recordings.iter().flat_map(|recording| &recording.events);
    let left_out: BTreeSet<&str> =
        events.filter(|event| event.kind == NOT_ASKED).map(|event| event.message.as_str()).collect();
    for node in rig.nodes().iter().filter(|node| !here(node.as_str())) {
        notes.node = node.to_string();
        let message = if left_out.contains(node.as_str()) {
            "does not take part: the session is of a part of the rig, as requested"
        } else {
            "its recording is not here; agreement was not checked"
        };
        notes.add(Severity::Note, None, None, None, message);
    }
}

/// Compares the nodes of sessions whose recordings are at several paths, as when each PC's part was copied to a place
/// of its own. Only paths with one recording each are taken together, and only those of one session (by id or by name)
/// and of different nodes: everything else is another session, or a copy.
pub fn compare(paths: &[PathBuf]) -> (Vec<Comparison>, Vec<Finding>) {
    let mut groups: Vec<Vec<RecordingReader>> = Vec::new();
    // What cannot be opened has been reported where the path was verified by itself.
    for (readers, _) in paths.iter().filter(|path| path.is_dir()).filter_map(|path| open_each(path).ok()) {
        let Ok([reader]) = <[RecordingReader; 1]>::try_from(readers) else { continue };
        let header = &reader.header;
        let same = |known: &RecordingReader| {
            known.header.session_id == header.session_id || known.header.session == header.session
        };
        match groups.iter_mut().find(|group| group.iter().any(same)) {
            Some(group) => group.push(reader),
            None => groups.push(vec![reader]),
        }
    }
    let (mut comparisons, mut notes) = (Vec::new(), Notes::new(""));
    for group in &groups {
        let nodes: BTreeSet<_> = group.iter().map(|reader| &reader.header.node).collect();
        if nodes.len() == group.len() {
            let verdicts: Vec<Verdict> = group.iter().map(accounting::recount).collect();
            let (group, verdicts): (Vec<_>, Vec<_>) = group.iter().zip(&verdicts).unzip();
            comparisons.extend(check(&group, &verdicts, &mut notes));
        }
    }
    (comparisons, notes.findings)
}
