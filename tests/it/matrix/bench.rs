// SPDX-License-Identifier: MIT OR Apache-2.0
//! The other implementation of GenICam: EMVA's reference, in a Python beside the tests (`scripts/genicam/bench.py`). It makes a
//! memory behind a description in which its camera could be, and reads what a set-up made of it.

use super::{EXPOSURE_US, SIZE};
use fourdbody_simulator::gige::described::{Described, Facts, Word};
use fourdbody_simulator::gige::registers::{Identity, Registers};
use fourdbody_simulator::gige::{CameraClock, ClockOptions, Habits};
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::Instant;

/// A Python with the package `genicam`; `None`, said by name, where there is none.
pub fn python() -> Option<PathBuf> {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/.venv-genicam/bin/python");
    let known = std::env::var_os("FOURDBODY_GENICAM_PYTHON").map(PathBuf::from);
    let has = |python: &PathBuf| {
        let asked = Command::new(python).args(["-c", "import genicam.genapi"]).stderr(Stdio::null()).status();
        asked.is_ok_and(|status| status.success())
    };
    let found = known.into_iter().chain([own]).find(has);
    if found.is_none() {
        println!(
            "skipped: no Python with the `genicam` package (`make test` and `make matrix` install it into tests/.venv-genicam)"
        );
    }
    found
}

/// What somebody may have left.
#[derive(Deserialize)]
pub struct Left {
    pub name: String,
    pub memory: Vec<Word>,
}

/// Who makes it, and for which network.
#[derive(Deserialize)]
pub struct About {
    #[serde(rename = "VendorName")]
    pub vendor: Option<String>,
    pub kind: String,
}

/// A camera as the other implementation has prepared it.
#[derive(Deserialize)]
pub struct Prepared {
    pub about: About,
    pub facts: Facts,
    pub memory: Vec<Word>,
    pub left: Vec<Left>,
    /// The entry of its trigger's source that the HSU is wired to.
    pub line: Option<String>,
}

/// What GenApi reads of the camera's registers.
#[derive(Deserialize)]
pub struct Judged {
    pub found: BTreeMap<String, Value>,
    pub wrong: Vec<String>,
}

/// One description of a camera on the bench.
pub struct Bench {
    child: Child,
    asks: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Drop for Bench {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Bench {
    /// Opens a description and prepares its camera; else why that cannot be.
    pub fn open(python: &Path, description: &Path) -> Result<(Self, Prepared), String> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/genicam/bench.py");
        let mut child = Command::new(python)
            .arg(script)
            .arg(description)
            .args([SIZE.0.to_string(), SIZE.1.to_string()])
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("Python starts");
        let (asks, answers) = (child.stdin.take().expect("piped"), child.stdout.take().expect("piped"));
        let mut bench = Self { child, asks, answers: BufReader::new(answers) };
        let identity = Identity {
            address: Ipv4Addr::LOCALHOST,
            model: String::new(),
            serial: String::new(),
            user_name: String::new(),
        };
        let clock = CameraClock::new(Instant::now(), ClockOptions::default());
        let described = Arc::new(Described::load(description).map_err(|error| error.to_string())?);
        let sensor = (SIZE.0 as u32, SIZE.1 as u32);
        let registers = Registers::new(identity, sensor, Arc::new(clock), Habits::default());
        drop(registers.behind(Some(Arc::clone(&described))));
        let prepared = bench.ask(&json!({ "bootstrap": described.bootstrap() }))?;
        Ok((bench, prepared))
    }

    /// Reads a memory, and says what of it is not as it was asked for.
    pub fn judge(
        &mut self,
        described: &Described,
        line: Option<&str>,
        packet: Option<u32>,
    ) -> Result<Judged, String> {
        let question = question(described, line, packet);
        self.ask(&question)
    }

    /// The same of what is not left to the camera's own settings.
    pub fn judge_beside(
        &mut self,
        described: &Described,
        line: Option<&str>,
        left: &[String],
    ) -> Result<Judged, String> {
        let mut question = question(described, line, None);
        question["asked"]["left"] = json!(left);
        self.ask(&question)
    }

    /// The same after somebody has left it so.
    pub fn judge_after(
        &mut self,
        described: &Described,
        line: Option<&str>,
        way: &str,
    ) -> Result<Judged, String> {
        let mut question = question(described, line, None);
        question["leave"] = json!(way);
        self.ask(&question)
    }

    fn ask<T: for<'de> Deserialize<'de>>(&mut self, question: &Value) -> Result<T, String> {
        let _ = writeln!(self.asks, "{question}");
        let mut line = String::new();
        let read = self.answers.read_line(&mut line);
        match read.ok().and_then(|_| serde_json::from_str(&line).ok()) {
            Some(answer) => Ok(answer),
            None => Err(self.last_words(&line)),
        }
    }

    /// What it says as it dies.
    fn last_words(&mut self, line: &str) -> String {
        let _ = self.child.kill();
        let mut text = String::new();
        if let Some(mut error) = self.child.stderr.take() {
            let _ = std::io::Read::read_to_string(&mut error, &mut text);
        }
        let last = text.lines().last().unwrap_or_default();
        format!(
            "the other implementation cannot open it: {last} {}",
            line.chars().take(200).collect::<String>()
        )
    }
}

fn question(described: &Described, line: Option<&str>, packet: Option<u32>) -> Value {
    json!({
        "bootstrap": described.bootstrap(),
        "memory": described.memory(),
        "asked": {
            "line": line, "edges": ["risingedge", "rising", "positiveedge", "activehigh"],
            "exposure_us": EXPOSURE_US, "tolerance_us": 20.0, "size": [SIZE.0, SIZE.1], "packet": packet,
        },
    })
}
