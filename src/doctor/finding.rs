// SPDX-License-Identifier: MIT OR Apache-2.0
//! What an examination results in: a verdict a line, and the exit code of all of them.

use crate::base::Exit;
use serde::Serialize;

/// What a finding is about: decides the exit code.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Subject {
    /// This computer: its kernel, network interfaces and disk.
    Host,
    /// A camera or the HSU.
    Device,
}

/// How severe a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    Ok,
    /// Works, but not at its best, or could not be examined.
    Warning,
    /// A session at the configured rate will lose frames or not start.
    Failed,
}

/// One verdict: what was examined, what was found, and what to do about it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was examined, for instance `net.core.rmem_max` or `camera h0_up: packet size`.
    pub check: String,
    pub subject: Subject,
    pub grade: Grade,
    pub found: String,
    /// What was expected; empty when the grade is `ok`.
    pub expected: String,
    /// What to do; empty when the grade is `ok`.
    pub advice: String,
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let grade = match self.grade {
            Grade::Ok => "ok",
            Grade::Warning => "warning",
            Grade::Failed => "failed",
        };
        write!(f, "{grade:<8} {}: {}", self.check, self.found)?;
        if !self.expected.is_empty() {
            write!(f, "; expected {}", self.expected)?;
        }
        if !self.advice.is_empty() {
            write!(f, "; {}", self.advice)?;
        }
        Ok(())
    }
}

/// A subject under examination: its methods make the verdict on it.
pub(super) struct Check {
    subject: Subject,
    name: String,
}

impl Check {
    pub(super) fn host(name: impl Into<String>) -> Self {
        Self { subject: Subject::Host, name: name.into() }
    }

    pub(super) fn device(name: impl Into<String>) -> Self {
        Self { subject: Subject::Device, name: name.into() }
    }

    pub(super) fn ok(self, found: impl Into<String>) -> Finding {
        self.graded(Grade::Ok, found, "", "")
    }

    pub(super) fn warning(
        self,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Finding {
        self.graded(Grade::Warning, found, expected, advice)
    }

    pub(super) fn failed(
        self,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Finding {
        self.graded(Grade::Failed, found, expected, advice)
    }

    /// A verdict of this grade: what was expected and what to do is left out where all is well.
    pub(super) fn graded(
        self,
        grade: Grade,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Finding {
        let (expected, advice) = match grade {
            Grade::Ok => (String::new(), String::new()),
            _ => (expected.into(), advice.into()),
        };
        Finding { check: self.name, subject: self.subject, grade, found: found.into(), expected, advice }
    }
}

/// The exit code of all findings: 5 if a device failed, else 1 if the host is unfit; warnings alone exit with 0.
pub fn exit_of(findings: &[Finding]) -> Exit {
    let failed = |subject| findings.iter().any(|f| f.grade == Grade::Failed && f.subject == subject);
    match (failed(Subject::Device), failed(Subject::Host)) {
        (true, _) => Exit::Device,
        (false, true) => Exit::Failure,
        (false, false) => Exit::Done,
    }
}

/// A number of bytes in the largest unit of which it has one at least.
pub(super) fn bytes(count: u64) -> String {
    const UNITS: [(u64, &str); 3] = [(1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")];
    match UNITS.iter().find(|(size, _)| count >= *size) {
        Some((size, unit)) => format!("{:.1} {unit}", count as f64 / *size as f64),
        None => format!("{count} B"),
    }
}

#[cfg(test)]
mod tests {
    use super::{Check, Finding, bytes, exit_of};
    use crate::base::Exit;

    #[test]
    fn a_failed_device_counts_before_an_unfit_host_and_warnings_do_not_count() {
        let ok = || Check::host("a").ok("1");
        let warning = || Check::device("b").warning("1", "2", "3");
        let unfit = || Check::host("c").failed("1", "2", "3");
        let broken = || Check::device("d").failed("1", "2", "3");
        assert_eq!(exit_of(&[ok(), warning()]), Exit::Done);
        assert_eq!(exit_of(&[ok(), warning(), unfit()]), Exit::Failure);
        assert_eq!(exit_of(&[unfit(), broken(), ok()]), Exit::Device);
    }

    #[test]
    fn a_verdict_is_one_line_with_all_that_is_known() {
        let line = |finding: Finding| finding.to_string();
        assert_eq!(line(Check::host("mtu").ok("9000")), "ok       mtu: 9000");
        let failed = Check::host("mtu").failed("1500", "9000", "ip link set eth0 mtu 9000");
        assert_eq!(line(failed), "failed   mtu: 1500; expected 9000; ip link set eth0 mtu 9000");
        assert_eq!(
            [bytes(12), bytes(8 << 20), bytes(3 << 29)],
            ["12 B", "8.0 MiB", "1.5 GiB"].map(str::to_owned)
        );
    }
}
