// SPDX-License-Identifier: MIT OR Apache-2.0
//! The result of a session that ended on every node, for people and for scripts.

use crate::base::ids::one_line;
use crate::base::{Exit, Fault};
use crate::control::status::{CameraProgress, Outcome, SessionStatus};
use crate::record::Status;
use serde::Deserialize;
use std::path::PathBuf;

/// A session that ended on every node.
#[derive(Debug, Clone)]
pub struct Captured {
    /// The name under which the session is recorded.
    pub name: String,
    pub(super) dry_run: bool,
    /// Nodes of the rig that took no part.
    pub(super) absent: Vec<String>,
    /// Per node: its name, and its session as it ended.
    pub(super) nodes: Vec<(String, SessionStatus)>,
}

impl Captured {
    /// 0 when every frame of every camera that took part is there, 3 otherwise.
    pub fn exit(&self) -> Exit {
        if self.worst() == Status::Complete { Exit::Done } else { Exit::DataLoss }
    }

    /// The recordings; none of a dry run.
    pub fn directories(&self) -> Vec<PathBuf> {
        let kept = self.nodes.iter().filter(|_| !self.dry_run);
        kept.map(|(_, session)| session.directory.clone()).collect()
    }

    /// The verdict of every node in lines of text.
    pub fn lines(&self) -> Vec<String> {
        let kind = if self.dry_run { "dry run" } else { "session" };
        let mut lines = vec![format!("{kind} {}: {}", self.name, self.verdict())];
        lines.extend(self.absent.iter().map(|node| format!("  partial: node {node} took no part")));
        for (node, session) in &self.nodes {
            lines.push(format!(
                "  node {node}: {}, {} triggers",
                status(session).map_or("failed", Status::word),
                session.triggers
            ));
            match &session.outcome {
                Some(Outcome::Recorded(verdict)) => lines.extend(camera_lines(verdict)),
                _ => lines.extend(last_heard(session, self.dry_run)),
            }
            let remarks = session.outcome.as_ref().map(Outcome::remarks).unwrap_or_default();
            lines.extend(remarks.iter().map(|remark| format!("    {}", one_line(remark))));
            lines.extend(session.notices.iter().map(|notice| format!("    {notice}")));
            if let Some(reason) = ended_early(session) {
                lines.push(format!("    ended early: {reason}"));
            }
        }
        if self.dry_run {
            lines.push("nothing was written: a dry run".to_owned());
        }
        lines
    }

    /// The same as JSON, for scripts.
    pub fn to_json(&self) -> serde_json::Value {
        let nodes =
            self.nodes.iter().map(|(node, session)| serde_json::json!({ "node": node, "session": session }));
        serde_json::json!({
            "name": self.name,
            "dry_run": self.dry_run,
            "verdict": self.verdict(),
            "not_asked": self.absent,
            "nodes": nodes.collect::<Vec<_>>(),
        })
    }

    /// The worst of the nodes' verdicts; `partial` where a part of the rig was meant and all of that is there.
    pub fn verdict(&self) -> &'static str {
        match self.worst() {
            Status::Complete if !self.absent.is_empty() => "partial",
            worst => worst.word(),
        }
    }

    /// What the worst of the nodes has; a node without a recording has what an aborted one has.
    fn worst(&self) -> Status {
        let statuses = self.nodes.iter().map(|(_, session)| status(session).unwrap_or(Status::Aborted));
        statuses.max().unwrap_or(Status::Aborted)
    }
}

/// One line a camera of a node's verdict, with the causes of its gaps, and what their pattern shows.
fn camera_lines(verdict: &serde_json::Value) -> Vec<String> {
    let line = |camera: &serde_json::Value| {
        let causes = camera["gaps"].as_object().into_iter().flatten();
        let causes: Vec<String> = causes.map(|(cause, count)| format!("{count} {cause}")).collect();
        let gaps =
            if causes.is_empty() { "no gaps".to_owned() } else { format!("gaps: {}", causes.join(", ")) };
        format!("    {}: {} frames, {gaps}", camera["camera"].as_str().unwrap_or("?"), camera["frames"])
    };
    let advice = verdict["advice"].as_array().into_iter().flatten().filter_map(|line| line.as_str());
    let cameras = verdict["cameras"].as_array().into_iter().flatten().map(line);
    cameras.chain(advice.map(|line| format!("    {line}"))).collect()
}

/// What a node without a verdict had written at its last status, and where that is.
fn last_heard(session: &SessionStatus, dry_run: bool) -> Vec<String> {
    let written: u64 = session.cameras.iter().map(|camera| camera.frames + camera.gaps).sum();
    if dry_run || (written == 0 && session.triggers == 0) {
        return vec!["    nothing recorded".to_owned()];
    }
    let camera = |camera: &CameraProgress| {
        format!("    {}: {} frames and {} gaps at the last status", camera.id, camera.frames, camera.gaps)
    };
    let mut lines: Vec<String> = session.cameras.iter().map(camera).collect();
    let directory = session.directory.display();
    lines.push(format!(
        "    no verdict; see its disk with `fourdbody info {directory}` there, and complete it with `fourdbody recover`"
    ));
    lines
}

/// What a node's recording amounts to; `None` where there is none.
fn status(session: &SessionStatus) -> Option<Status> {
    match &session.outcome {
        // A word that this version does not know promises nothing.
        Some(Outcome::Recorded(verdict)) => {
            Some(Status::deserialize(&verdict["status"]).unwrap_or(Status::Incomplete))
        }
        Some(Outcome::Failed(_)) | None => None,
    }
}

/// Why a session ended before it should have.
pub(crate) fn ended_early(session: &SessionStatus) -> Option<&str> {
    match &session.outcome {
        Some(Outcome::Recorded(verdict)) => verdict["aborted"].as_str(),
        Some(Outcome::Failed(fault)) => Some(&fault.message),
        None => None,
    }
}

/// A session that recorded nothing anywhere is a failure, not a verdict. Every node's reason is in it: one of them may
/// only know that the train was empty, which is the effect of another node's failure.
pub(crate) fn failure_of_all(nodes: &[(String, SessionStatus)]) -> Option<Fault> {
    let failure = |(node, session): &(String, SessionStatus)| match &session.outcome {
        Some(Outcome::Failed(fault)) => Some((fault.exit, format!("node {node}: {}", fault.message))),
        _ => None,
    };
    let (exits, messages): (Vec<u8>, Vec<String>) =
        nodes.iter().map(failure).collect::<Option<Vec<_>>>()?.into_iter().unzip();
    let device = Exit::Device as u8;
    let first = exits.first().copied()?;
    let exit = exits.into_iter().find(|exit| *exit != device).unwrap_or(first);
    Some(Fault { exit, message: messages.join("; ") })
}

#[cfg(test)]
mod tests {
    use super::Captured;
    use crate::base::Exit;
    use crate::control::status::{Outcome, SessionStatus};

    /// A session with this verdict on each node (`failed`: it has no recording), and of a rig with these nodes more.
    fn captured(words: &[&str], absent: &[&str]) -> Captured {
        let node = |word: &&str| {
            let recorded = || Outcome::Recorded(serde_json::json!({ "status": word }));
            let session = serde_json::json!({
                "session_id": 1, "name": "walk", "directory": "/walk", "triggers_asked": 0, "triggers": 0,
                "cameras": [], "ring_high_water_frames": 0, "outcome": (*word != "failed").then(recorded),
            });
            ("a".to_owned(), serde_json::from_value::<SessionStatus>(session).expect("a status"))
        };
        let absent = absent.iter().map(|node| (*node).to_owned()).collect();
        Captured { name: "walk".to_owned(), dry_run: false, absent, nodes: words.iter().map(node).collect() }
    }

    #[test]
    fn a_session_is_what_its_worst_node_is() {
        for (words, verdict) in [
            (["complete", "complete"], "complete"),
            (["complete", "unconfirmed"], "unconfirmed"),
            (["unconfirmed", "incomplete"], "incomplete"),
            (["incomplete", "a word of a later version"], "incomplete"),
            (["complete", "a word of a later version"], "incomplete"),
            (["aborted", "unconfirmed"], "aborted"),
            (["complete", "failed"], "aborted"),
        ] {
            let session = captured(&words, &[]);
            assert_eq!(session.verdict(), verdict, "{words:?}");
            assert_eq!(session.exit() == Exit::Done, verdict == "complete", "{words:?}");
            assert_eq!(session.lines()[0], format!("session walk: {verdict}"));
            assert_eq!(session.to_json()["verdict"], verdict);
        }
    }

    #[test]
    fn what_the_gaps_tell_is_printed_behind_the_cameras() {
        let mut session = captured(&["incomplete"], &[]);
        session.nodes[0].1.outcome = Some(Outcome::Recorded(serde_json::json!({
            "status": "incomplete",
            "cameras": [{ "camera": "h0_up", "frames": 20, "gaps": { "not_triggered": 20 } }],
            "advice": ["h0_up takes every second trigger only"],
        })));
        let lines = session.lines();
        assert_eq!(lines[2], "    h0_up: 20 frames, gaps: 20 not_triggered");
        assert_eq!(lines[3], "    h0_up takes every second trigger only");
    }

    #[test]
    fn what_is_in_doubt_is_printed_behind_the_cameras() {
        let mut session = captured(&["unconfirmed"], &[]);
        session.nodes[0].1.outcome = Some(Outcome::Recorded(serde_json::json!({
            "status": "unconfirmed", "triggers": 20, "triggers_expected": 20, "triggers_emitted": 20,
            "cameras": [{ "camera": "h0_up", "frames": 20, "gaps": {} }], "refused": 0, "untimed": 2, "aborted": null,
            "changed": ["h0_up: Gain was 0, is 6"],
            "not_simultaneous": ["h0_up, triggers 3 to 7: it came late"],
        })));
        let lines = session.lines();
        assert_eq!(lines[3], "    the times of 2 triggers are lost", "without a gap nothing else shows why");
        assert_eq!(lines[4], "    settings changed while it ran: h0_up: Gain was 0, is 6");
        assert_eq!(lines[5], "    not simultaneous with the others: h0_up, triggers 3 to 7: it came late");
    }

    #[test]
    fn a_part_of_a_rig_is_partial_only_where_all_of_it_is_witnessed() {
        for (word, verdict) in
            [("complete", "partial"), ("unconfirmed", "unconfirmed"), ("incomplete", "incomplete")]
        {
            assert_eq!(captured(&[word], &["b"]).verdict(), verdict);
        }
        assert_eq!(captured(&[], &[]).verdict(), "aborted", "nothing is not success");
    }
}
