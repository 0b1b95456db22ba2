// SPDX-License-Identifier: MIT OR Apache-2.0
//! Programs that the bench starts, and what they cost.

use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// Processor time is counted in ticks of this many a second (`getconf CLK_TCK`, the same on every Linux).
const TICKS: f64 = 100.0;

/// A failure of the bench itself.
pub fn failed(what: impl std::fmt::Display) -> Failure {
    Failure::new(Exit::Failure, what)
}

/// A program that ends with the bench.
pub struct Program {
    name: &'static str,
    child: Child,
}

impl Program {
    /// Starts it; its standard error goes to `NAME.log` in `logs`.
    pub fn start(name: &'static str, command: &mut Command, logs: &Path) -> Result<Self, Failure> {
        let path = logs.join(format!("{name}.log"));
        let log = File::create(&path).map_err(|e| failed(format!("{}: {e}", path.display())))?;
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log).spawn();
        let program = command.get_program().display().to_string();
        let child = child
            .map_err(|e| failed(format!("{program} does not start ({e}); is it built or installed?")))?;
        Ok(Self { name, child })
    }

    /// Its standard output; the first caller gets it.
    pub fn output(&mut self) -> Result<ChildStdout, Failure> {
        self.child.stdout.take().ok_or_else(|| failed(format!("{}: its output is taken already", self.name)))
    }

    /// What it has cost so far; zero once it has ended.
    pub fn usage(&self) -> Usage {
        Usage::of(self.child.id())
    }

    /// Whether the process has ended by itself.
    pub fn ended(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    /// Waits for its end; what it printed, and whether it reported success.
    pub fn finish(mut self) -> Result<(String, std::process::ExitStatus), Failure> {
        let mut text = String::new();
        if let Some(mut output) = self.child.stdout.take() {
            output.read_to_string(&mut text).map_err(|e| failed(format!("{}: {e}", self.name)))?;
        }
        let status = self.child.wait().map_err(|e| failed(format!("{}: {e}", self.name)))?;
        Ok((text, status))
    }

    /// Sends a signal by its name without `SIG`.
    pub fn signal(&self, name: &str) {
        let _ = Command::new("kill").arg(format!("-{name}")).arg(self.child.id().to_string()).status();
    }

    /// Asks it to end (SIGTERM), and gives it ten seconds.
    pub fn stop(mut self) {
        let _ = Command::new("kill").arg(self.child.id().to_string()).status();
        let asked = Instant::now();
        while !self.ended() && asked.elapsed() < Duration::from_secs(10) {
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Processor time so far, seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Usage {
    pub user_s: f64,
    /// In the kernel on its behalf.
    pub system_s: f64,
}

impl Usage {
    fn of(process: u32) -> Self {
        let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
        // The program's name may contain anything, hence from its closing bracket on: fields 14 and 15.
        let fields = stat.rsplit(") ").next().unwrap_or_default().split(' ');
        let mut ticks = fields.skip(11).map(|field| field.parse::<f64>().unwrap_or(0.0));
        let mut next = || ticks.next().unwrap_or(0.0) / TICKS;
        Self { user_s: next(), system_s: next() }
    }

    /// All processors of the host together, by whomever: the first line of `/proc/stat`.
    pub fn of_host() -> Self {
        let stat = std::fs::read_to_string("/proc/stat").unwrap_or_default();
        let ticks: Vec<f64> = stat
            .lines()
            .next()
            .into_iter()
            .flat_map(|line| line.split_whitespace().skip(1))
            .map(|field| field.parse().unwrap_or(0.0))
            .collect();
        let sum = |places: &[usize]| places.iter().filter_map(|i| ticks.get(*i)).sum::<f64>() / TICKS;
        // user, nice | system, irq, softirq, steal
        Self { user_s: sum(&[0, 1]), system_s: sum(&[2, 5, 6, 7]) }
    }

    /// Processor time of user and system together, s.
    pub fn total_s(self) -> f64 {
        self.user_s + self.system_s
    }
}

impl std::ops::Sub for Usage {
    type Output = Usage;

    fn sub(self, before: Usage) -> Usage {
        Usage { user_s: self.user_s - before.user_s, system_s: self.system_s - before.system_s }
    }
}

impl std::iter::Sum for Usage {
    fn sum<I: Iterator<Item = Usage>>(all: I) -> Usage {
        all.fold(Usage::default(), |a, b| Usage {
            user_s: a.user_s + b.user_s,
            system_s: a.system_s + b.system_s,
        })
    }
}

/// What several programs, and the rest of the host, cost between two moments.
#[derive(Debug, Clone)]
pub struct Reading {
    at: Instant,
    host: Usage,
    programs: Vec<Usage>,
}

/// Cores in use on average between two readings.
#[derive(Debug, Clone)]
pub struct Cores {
    pub seconds: f64,
    /// The use of each program, in the order given.
    pub programs: Vec<Usage>,
    /// By everything else on the host.
    pub others: f64,
}

impl Reading {
    /// Reads the processor times of these programs now.
    pub fn of(programs: &[&Program]) -> Self {
        let programs = programs.iter().map(|program| program.usage()).collect();
        Self { at: Instant::now(), host: Usage::of_host(), programs }
    }

    /// Cores from this reading to a later one.
    pub fn until(&self, later: &Reading) -> Cores {
        let seconds = later.at.saturating_duration_since(self.at).as_secs_f64().max(1e-9);
        let per_s = |used: Usage| Usage { user_s: used.user_s / seconds, system_s: used.system_s / seconds };
        let programs: Vec<Usage> = self
            .programs
            .iter()
            .zip(&later.programs)
            .map(|(before, after)| per_s(*after - *before))
            .collect();
        let ours: f64 = programs.iter().map(|cores| cores.total_s()).sum();
        let others = per_s(later.host - self.host).total_s() - ours;
        Cores { seconds, programs, others: others.max(0.0) }
    }
}

/// The host's load average over the last minute.
pub fn load_average() -> f64 {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    text.split(' ').next().and_then(|first| first.parse().ok()).unwrap_or(0.0)
}
