// SPDX-License-Identifier: MIT OR Apache-2.0
//! Slurm's client programs: their arguments, and their output.
//!
//! Their output is requested as delimited columns: those are the same in all versions, which their JSON is not.

use serde::Serialize;
use std::io;
use std::path::Path;
use std::process::Command;

/// Columns of `squeue`, each with its delimiter.
const SQUEUE_COLUMNS: &str = "ArrayJobID:|,ArrayTaskID:|,State:|,Reason:|,TimeUsed:|,RestartCnt:|,NodeList:|";
/// Columns of `sacct`, with `|` between them.
const SACCT_COLUMNS: &str = "JobID,State,ExitCode,Elapsed,NodeList";

/// A task of an array, or a job by itself, as Slurm reports it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Task {
    #[serde(skip)]
    pub job: u64,
    /// Its number in the array.
    #[serde(skip)]
    pub index: Option<u64>,
    /// Slurm's word for its state, for instance `PENDING`.
    pub state: String,
    /// Why it is in that state, where that is known; an exit code where only the accounting knows it.
    pub reason: String,
    /// Time that it has run, as Slurm writes it.
    pub elapsed: String,
    /// Times that it was started anew.
    pub restarts: u64,
    /// Where it runs or ran.
    pub nodes: String,
}

/// What Slurm reports of some jobs.
#[derive(Debug, Clone, Default)]
pub struct Answer {
    /// All tasks that Slurm has, or its accounting.
    pub tasks: Vec<Task>,
    /// Whether the controller answered: then a job that is not among the tasks has ended.
    pub answered: bool,
    /// Sources that did not answer.
    pub notes: Vec<String>,
}

/// Slurm, as this machine reaches it.
#[derive(Debug, Clone, Copy)]
pub struct Slurm(());

impl Slurm {
    /// Looks for the client programs. An error states how to install them.
    pub fn find() -> Result<Self, String> {
        match Command::new("sbatch").arg("--version").output() {
            Ok(output) if output.status.success() => Ok(Self(())),
            Ok(output) => Err(format!("sbatch: {}", message(&output))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Err(
                "sbatch is not installed: expected Slurm's client programs here (Debian: slurm-client) and \
                 its configuration; run \
                 this on a machine of the cluster, or see the scripts with --dry-run"
                    .to_owned(),
            ),
            Err(error) => Err(format!("sbatch: {error}")),
        }
    }

    /// Submits a script from the directory that it is in; returns the job's number. `after`: the job that must be done
    /// before.
    pub fn submit(self, directory: &Path, script: &str, after: Option<u64>) -> Result<u64, String> {
        let mut command = Command::new("sbatch");
        command.current_dir(directory).arg("--parsable");
        command.args(after.map(|job| format!("--dependency=afterok:{job}"))).arg(script);
        let output = command.output().map_err(|e| format!("sbatch: {e}"))?;
        let text = String::from_utf8_lossy(&output.stdout);
        let number = text.trim().split(';').next().and_then(|number| number.parse().ok());
        match number {
            Some(number) if output.status.success() => Ok(number),
            _ => Err(format!("sbatch {}: {}", directory.join(script).display(), message(&output))),
        }
    }

    /// Cancels a job, whether it waits or runs.
    pub fn cancel(self, job: u64) -> Result<(), String> {
        let output =
            Command::new("scancel").arg(job.to_string()).output().map_err(|e| format!("scancel: {e}"))?;
        if output.status.success() { Ok(()) } else { Err(format!("scancel {job}: {}", message(&output))) }
    }

    /// Tasks that one array may have; `None` where the controller does not report it.
    pub fn most_tasks(self) -> Option<u64> {
        let output = Command::new("scontrol").args(["show", "config"]).output().ok()?;
        parse_most_tasks(&String::from_utf8_lossy(&output.stdout))
    }

    /// The tasks of these jobs: by the controller, and by the accounting where the controller has forgotten them.
    pub fn tasks(self, jobs: &[u64]) -> Answer {
        let mut answer = Answer { answered: true, ..Answer::default() };
        if jobs.is_empty() {
            return answer;
        }
        let list = jobs.iter().map(u64::to_string).collect::<Vec<_>>().join(",");
        let columns = [format!("--jobs={list}"), format!("--Format={SQUEUE_COLUMNS}")];
        match ask("squeue", &["--noheader", "--states=all", "--array"], &columns) {
            Ok(text) => answer.tasks = text.lines().filter_map(parse_squeue).collect(),
            // A controller forgets jobs some minutes after their end.
            Err(reason) if reason.contains("Invalid job id") => {}
            Err(reason) => (answer.answered, answer.notes) = (false, vec![reason]),
        }
        let columns = [format!("--jobs={list}"), format!("--format={SACCT_COLUMNS}")];
        match ask("sacct", &["--noheader", "--parsable2", "--allocations", "--array"], &columns) {
            Ok(text) => {
                for task in text.lines().filter_map(parse_sacct) {
                    if !answer.tasks.iter().any(|known| (known.job, known.index) == (task.job, task.index)) {
                        answer.tasks.push(task);
                    }
                }
            }
            // Many clusters have no accounting: the results show what is done.
            Err(reason) if reason.contains("storage is disabled") => {}
            Err(reason) => answer.notes.push(reason),
        }
        answer
    }
}

/// The output of a client program.
fn ask(program: &str, arguments: &[&str], more: &[String]) -> Result<String, String> {
    let output = Command::new(program).args(arguments).args(more).output();
    let output = output.map_err(|e| format!("{program}: {e}"))?;
    let text = || String::from_utf8_lossy(&output.stdout).into_owned();
    if output.status.success() { Ok(text()) } else { Err(format!("{program}: {}", message(&output))) }
}

/// The error message of a program that failed.
fn message(output: &std::process::Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr);
    if text.trim().is_empty() { output.status.to_string() } else { text.trim().to_owned() }
}

fn parse_most_tasks(config: &str) -> Option<u64> {
    let line = config.lines().find(|line| line.trim_start().starts_with("MaxArraySize"))?;
    // The size is one more than the highest index.
    line.split_once('=')?.1.trim().parse().ok()
}

fn parse_squeue(line: &str) -> Option<Task> {
    let mut columns = line.split('|').map(str::trim);
    let mut next = || columns.next().map(str::to_owned);
    let (job, index) = (next()?.parse().ok()?, next()?.parse().ok());
    let (state, reason, elapsed) = (next()?, next()?, next()?);
    let restarts = next()?.parse().unwrap_or(0);
    let reason = if reason == "None" { String::new() } else { reason };
    Some(Task { job, index, state, reason, elapsed, restarts, nodes: next()? })
}

fn parse_sacct(line: &str) -> Option<Task> {
    let mut columns = line.split('|').map(str::trim);
    let id = columns.next()?;
    let (job, index) = id.split_once('_').map_or((id, None), |(job, index)| (job, index.parse().ok()));
    // "CANCELLED by 1000"
    let state = columns.next()?.split(' ').next()?.to_owned();
    let code = columns.next()?;
    let reason = if matches!(code, "" | "0:0") { String::new() } else { format!("exit code {code}") };
    let (elapsed, nodes) = (columns.next()?.to_owned(), columns.next()?.to_owned());
    Some(Task { job: job.parse().ok()?, index, state, reason, elapsed, restarts: 0, nodes })
}

#[cfg(test)]
mod tests {
    use super::{parse_most_tasks, parse_sacct, parse_squeue};
    use proptest::prelude::{any, proptest};

    #[test]
    fn answers_of_slurm_22_05_are_understood() {
        let task = parse_squeue("17|3|PENDING|BeginTime|0:00|1||").expect("a task");
        assert_eq!((task.job, task.index, task.state.as_str(), task.restarts), (17, Some(3), "PENDING", 1));
        assert_eq!(task.reason, "BeginTime");
        let task = parse_squeue("18|N/A|RUNNING|None|1:02:03|0|n[1-2]|").expect("a job");
        assert_eq!((task.index, task.reason.as_str(), task.nodes.as_str()), (None, "", "n[1-2]"));
        let task = parse_sacct("17_3|CANCELLED by 1000|0:15|00:01:02|n1").expect("a task");
        assert_eq!((task.job, task.index, task.state.as_str()), (17, Some(3), "CANCELLED"));
        assert_eq!((task.reason.as_str(), task.elapsed.as_str()), ("exit code 0:15", "00:01:02"));
        assert_eq!(parse_sacct("18|COMPLETED|0:0|00:00:09|n2").expect("a job").reason, "");
        assert_eq!(parse_most_tasks("MaxArrayX = 3\nMaxArraySize            = 1001\nB = 2"), Some(1001));
    }

    proptest! {
        #[test]
        fn no_answer_is_a_panic(line in any::<String>()) {
            let _ = (parse_squeue(&line), parse_sacct(&line), parse_most_tasks(&line));
        }
    }
}
