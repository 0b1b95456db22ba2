//! A session that ended on every node, for the person and the script that asked for it.

use super::state::Fault;
use crate::api::dto::{CameraProgress, Outcome, SessionStatus};
use crate::cmds::Exit;
use std::path::PathBuf;

/// A session that ended on every node.
#[derive(Debug, Clone)]
pub struct Captured {
    name: String,
    dry_run: bool,
    /// Nodes of the rig that were not asked.
    absent: Vec<String>,
    /// Per node: its name, and its session as it ended.
    nodes: Vec<(String, SessionStatus)>,
}

impl Captured {
    pub(super) fn new(
        name: String,
        dry_run: bool,
        absent: Vec<String>,
        nodes: Vec<(String, SessionStatus)>,
    ) -> Self {
        Self { name, dry_run, absent, nodes }
    }

    /// The session's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub(super) fn nodes(&self) -> &[(String, SessionStatus)] {
        &self.nodes
    }

    /// 0 when every frame of every camera that was asked is there, 3 otherwise.
    pub fn exit(&self) -> Exit {
        if self.nodes.iter().all(|(_, session)| status_word(session) == "complete") {
            Exit::Done
        } else {
            Exit::DataLoss
        }
    }

    /// The recordings; none of a dry run.
    pub fn directories(&self) -> Vec<PathBuf> {
        let kept = self.nodes.iter().filter(|_| !self.dry_run);
        kept.map(|(_, session)| session.directory.clone()).collect()
    }

    /// For people.
    pub fn lines(&self) -> Vec<String> {
        let kind = if self.dry_run { "dry run" } else { "session" };
        let mut lines = vec![format!("{kind} {}: {}", self.name, self.verdict())];
        lines.extend(self.absent.iter().map(|node| format!("  partial: node {node} not asked")));
        for (node, session) in &self.nodes {
            lines.push(format!("  node {node}: {}, {} triggers", status_word(session), session.triggers));
            match &session.outcome {
                Some(Outcome::Recorded(verdict)) => lines.extend(camera_lines(verdict)),
                _ => lines.extend(last_heard(session, self.dry_run)),
            }
            if let Some(reason) = ended_early(session) {
                lines.push(format!("    ended early: {reason}"));
            }
        }
        if self.dry_run {
            lines.push("nothing was written: a dry run".to_owned());
        }
        lines
    }

    /// For scripts.
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

    /// `complete`, `incomplete` or `aborted`; `partial` where all is there that was asked of a part of the rig.
    pub fn verdict(&self) -> &'static str {
        let words: Vec<&str> = self.nodes.iter().map(|(_, session)| status_word(session)).collect();
        let is = |word| words.contains(&word);
        if is("failed") || is("aborted") {
            "aborted"
        } else if is("incomplete") {
            "incomplete"
        } else if !self.absent.is_empty() {
            "partial"
        } else {
            "complete"
        }
    }
}

/// One line a camera of a node's verdict, with the causes of its gaps.
fn camera_lines(verdict: &serde_json::Value) -> Vec<String> {
    let line = |camera: &serde_json::Value| {
        let causes = camera["gaps"].as_object().into_iter().flatten();
        let causes: Vec<String> = causes.map(|(cause, count)| format!("{count} {cause}")).collect();
        let gaps =
            if causes.is_empty() { "no gaps".to_owned() } else { format!("gaps: {}", causes.join(", ")) };
        format!("    {}: {} frames, {gaps}", camera["camera"].as_str().unwrap_or("?"), camera["frames"])
    };
    verdict["cameras"].as_array().into_iter().flatten().map(line).collect()
}

/// What a node without a verdict had written when it was last heard of, and where that is.
fn last_heard(session: &SessionStatus, dry_run: bool) -> Vec<String> {
    let written: u64 = session.cameras.iter().map(|camera| camera.frames + camera.gaps).sum();
    if dry_run || (written == 0 && session.triggers == 0) {
        return vec!["    nothing recorded".to_owned()];
    }
    let camera = |camera: &CameraProgress| {
        format!("    {}: {} frames and {} gaps when last heard of", camera.id, camera.frames, camera.gaps)
    };
    let mut lines: Vec<String> = session.cameras.iter().map(camera).collect();
    let directory = session.directory.display();
    lines.push(format!(
        "    without a verdict; what is on its disk: `fourdbody info {directory}` there, and `fourdbody recover` to complete it"
    ));
    lines
}

fn status_word(session: &SessionStatus) -> &str {
    match &session.outcome {
        Some(Outcome::Recorded(verdict)) => verdict["status"].as_str().unwrap_or("incomplete"),
        Some(Outcome::Failed(_)) | None => "failed",
    }
}

/// Why a session ended before it should have.
pub(super) fn ended_early(session: &SessionStatus) -> Option<&str> {
    match &session.outcome {
        Some(Outcome::Recorded(verdict)) => verdict["aborted"].as_str(),
        Some(Outcome::Failed(fault)) => Some(&fault.message),
        None => None,
    }
}

/// A session that recorded nothing anywhere is a failure, not a verdict. Every node's reason is told: one of them may
/// only know that the train was empty, which is what the failure of another looks like from there.
pub(super) fn failure_of_all(nodes: &[(String, SessionStatus)]) -> Option<Fault> {
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
