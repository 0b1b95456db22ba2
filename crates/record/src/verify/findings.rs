// SPDX-License-Identifier: MIT OR Apache-2.0
//! What verification finds: how bad it is, where, and in words.

use crate::base::ids::CameraId;
use serde::Serialize;
use std::fmt;

/// Findings beyond this many are counted, not listed.
const MAX_FINDINGS: usize = 10_000;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Information only: nothing is wrong.
    Note,
    /// Nothing contradicts it, but nothing confirms it: it rests on one source, or frames were not taken as agreed.
    Unconfirmed,
    /// Data is missing, and the recording states what and why.
    Loss,
    /// Data is damaged, contradicts itself, or is missing without a record of it.
    Corrupt,
}

/// One thing that was found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    pub severity: Severity,
    pub node: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub segment: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraId>,
    /// First and last trigger concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub triggers: Option<(u64, u64)>,
    /// What was expected and found.
    pub message: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The serialized name is the name everywhere.
        self.severity.serialize(&mut *f)?;
        write!(f, ": node {}", self.node)?;
        if let Some(segment) = self.segment {
            write!(f, " segment {segment}")?;
        }
        if let Some(camera) = &self.camera {
            write!(f, " camera {camera}")?;
        }
        match self.triggers {
            Some((first, last)) if first == last => write!(f, " trigger {first}")?,
            Some((first, last)) => write!(f, " triggers {first} to {last}")?,
            None => {}
        }
        write!(f, ": {}", self.message)
    }
}

/// Findings while they are collected; those beyond a bound are counted only.
pub struct Notes {
    pub node: String,
    pub findings: Vec<Finding>,
    pub omitted: usize,
    pub worst: Option<Severity>,
}

impl Notes {
    /// None yet; those to come are of this node.
    pub fn new(node: &str) -> Self {
        Self { node: node.to_owned(), findings: Vec::new(), omitted: 0, worst: None }
    }

    /// Adds a finding about a segment, a camera or triggers, as far as they are given.
    pub fn add(
        &mut self,
        severity: Severity,
        segment: Option<u32>,
        camera: Option<&CameraId>,
        triggers: Option<(u64, u64)>,
        message: impl Into<String>,
    ) {
        if severity > Severity::Note {
            self.worst = self.worst.max(Some(severity));
        }
        if self.findings.len() >= MAX_FINDINGS {
            self.omitted += 1;
            return;
        }
        let (node, camera, message) = (self.node.clone(), camera.cloned(), message.into());
        self.findings.push(Finding { severity, node, segment, camera, triggers, message });
    }

    /// Drops the findings that are unconfirmed only.
    pub fn leave_out_unconfirmed(&mut self) {
        self.findings.retain(|finding| finding.severity != Severity::Unconfirmed);
        let found = self.findings.iter().map(|finding| finding.severity);
        self.worst = found.filter(|severity| *severity > Severity::Note).max();
    }

    /// Appends the findings of another one.
    pub fn absorb(&mut self, other: Self) {
        self.worst = self.worst.max(other.worst);
        let room = MAX_FINDINGS.saturating_sub(self.findings.len());
        self.omitted += other.omitted + other.findings.len().saturating_sub(room);
        self.findings.extend(other.findings.into_iter().take(room));
    }
}
