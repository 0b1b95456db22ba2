// SPDX-License-Identifier: MIT OR Apache-2.0
//! The audit log: a line of JSON for every change of state, durable before it is answered, and for refusals, rarely.
//!
//! A thread of its own writes, so that a slow disk delays only the request whose line it is, and that one only for
//! [`PATIENCE`]. A line that cannot be written is reported in the log and in the status; it stops nothing, because a
//! session that cannot be stopped is worse than a missing line.

use super::Shared;
use super::auth::{Caller, only_looks, what_of};
use super::guard::Sent;
use super::limits::{Buckets, Key, Rate};
use super::refusal::Refusal;
use super::transport::Link;
use crate::base::time::host_time_ns;
use crate::base::{Exit, Fault, regular};
use crate::control::request::is_zero;
use crate::control::status::{SessionStatus, Via, path};
use crate::control::tokens::Role;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Longest time that an answer waits for its line.
const PATIENCE: Duration = Duration::from_secs(2);
/// Number of lines that may wait for the disk.
const WAITING_MAX: usize = 256;
/// Size in bytes at which a file becomes `NAME.1`, that one `NAME.2`, and so on.
const FILE_BYTES_MAX: u64 = 8 << 20;
/// Number of files that are kept besides the current one.
const FILES_KEPT: usize = 9;
/// Rate of refusals that get a line; the others are counted in the next one.
const REFUSAL_LINES: Rate = Rate { per_second: 0.2, burst: 20.0 };

/// One line of the audit log.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AuditLine {
    /// When, CLOCK_REALTIME (UTC), ns since 1970.
    pub host_time_ns: u64,
    /// The node that received the request.
    pub node: String,
    /// Who: a token's name, `uid N`, or an address.
    pub who: String,
    /// Their role, once they showed who they are.
    pub role: Option<Role>,
    /// How they showed it: `socket`, `token`, `cookie`, `link` or `nothing`.
    pub via: Option<Via>,
    /// From where: an address, or `uid N` of the Unix socket.
    pub from: String,
    /// Method and path, such as `POST /api/v1/session/start`.
    pub what: String,
    /// The body of the request, without secrets.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub request: Option<serde_json::Value>,
    /// The session that it concerned, in hexadecimal.
    pub session_id: Option<String>,
    pub session: Option<String>,
    /// Triggers that had been reported when it was answered.
    pub trigger: Option<u64>,
    pub status: u16,
    /// Refusals since the last line that got none of their own.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub unlisted: u64,
}

/// The part of the log that requests use: it sends lines to the thread that writes.
pub struct Audit {
    node: String,
    lines: SyncSender<(AuditLine, Option<oneshot::Sender<()>>)>,
    problem: Arc<Mutex<Option<String>>>,
    refusals: Buckets,
    unlisted: AtomicU64,
}

impl Audit {
    /// Opens the log, and starts its thread. A file that cannot be opened now is tried again with every line.
    pub fn start(path: &Path, node: &str) -> io::Result<Self> {
        let (lines, inbox) = sync_channel(WAITING_MAX);
        let problem = Arc::new(Mutex::new(None));
        let mut log = Log { path: path.to_owned(), open: None, problem: Arc::clone(&problem) };
        // The directory is made with the first line.
        if path.parent().is_some_and(Path::is_dir) {
            let opened = log.open_file().map(drop);
            log.note(log_result(opened, path));
        }
        std::thread::Builder::new().name("audit".to_owned()).spawn(move || log.run(&inbox))?;
        let (node, unlisted) = (node.to_owned(), AtomicU64::new(0));
        Ok(Self { node, lines, problem, refusals: Buckets::new(REFUSAL_LINES), unlisted })
    }

    /// Why the last line could not be written.
    pub fn warning(&self) -> Option<String> {
        self.problem.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Writes a line, and waits until it is durable; no longer than [`PATIENCE`].
    pub async fn record(&self, line: AuditLine) {
        let (done, durable) = oneshot::channel();
        if self.send(line, Some(done)) && tokio::time::timeout(PATIENCE, durable).await.is_err() {
            tracing::warn!("the audit log is slow; its line will follow");
        }
    }

    /// A line for an event without a request, such as a signal; does not wait.
    pub fn event(&self, what: &str, session: Option<&SessionStatus>) {
        let mut line = self.line("fourdbody", "this process", what.to_owned());
        line.concerns(session);
        self.send(line, None);
    }

    /// Notes a refusal; every one counts, some get a line.
    pub(super) fn refused(&self, link: &Link, caller: Option<&Caller>, what: &str, status: StatusCode) {
        // One bucket for all: a flood must not fill the disk from many addresses.
        if self.refusals.take(Key::User(0), Instant::now()).is_err() {
            self.unlisted.fetch_add(1, Ordering::Relaxed);
            return;
        }
        let from = from_text(link);
        let who = caller.map_or(from.as_str(), |caller| caller.name.as_str());
        let mut line = self.line(who, &from, what.chars().take(100).collect());
        line.role = caller.map(|caller| caller.role);
        line.status = status.as_u16();
        self.send(line, None);
    }

    fn line(&self, who: &str, from: &str, what: String) -> AuditLine {
        let unlisted = self.unlisted.swap(0, Ordering::Relaxed);
        let (node, who, from) = (self.node.clone(), who.to_owned(), from.to_owned());
        AuditLine { host_time_ns: host_time_ns(), node, who, from, what, unlisted, ..AuditLine::default() }
    }

    fn send(&self, line: AuditLine, done: Option<oneshot::Sender<()>>) -> bool {
        let sent = self.lines.try_send((line, done));
        if let Err(TrySendError::Full((line, _)) | TrySendError::Disconnected((line, _))) = &sent {
            let text = format!("the audit log cannot keep up; not in it: {} by {}", line.what, line.who);
            tracing::error!("{text}");
            *self.problem.lock().unwrap_or_else(PoisonError::into_inner) = Some(text);
        }
        sent.is_ok()
    }
}

impl AuditLine {
    /// Adds session and trigger at which something happened.
    fn concerns(&mut self, session: Option<&SessionStatus>) {
        if let Some(session) = session {
            self.session_id = Some(format!("{:016x}", session.session_id));
            self.session = Some(session.name.clone());
            self.trigger = Some(session.triggers);
        }
    }
}

fn from_text(link: &Link) -> String {
    match link {
        Link::Unix { uid } => format!("uid {uid}"),
        Link::Tcp { from, .. } => from.to_string(),
    }
}

/// Writes a line for every request that may change something, once it is answered.
pub(super) async fn audited(State(shared): State<Shared>, request: Request, next: Next) -> Response {
    let Some(link) = request.extensions().get::<Link>().copied() else { return next.run(request).await };
    if only_looks(request.method()) {
        return next.run(request).await;
    }
    let caller = request.extensions().get::<Caller>().cloned();
    let what = what_of(&request);
    let secret = [path::LOGIN, path::LOGIN_BY_LINK].contains(&request.uri().path());
    let is_preview = request.uri().path() == path::PREVIEW;
    let sent = request.extensions().get::<Sent>().filter(|_| !secret).cloned();
    // On a task of its own: a client that goes away while it waits takes neither the request nor its line along.
    let work = async move {
        let response = next.run(request).await;
        // The caller of a login is known by the answer only.
        let caller = caller.or_else(|| response.extensions().get::<Caller>().cloned());
        // A preview that goes on is no change.
        if !(is_preview && response.status() == StatusCode::NO_CONTENT) {
            write_down(&shared, &link, caller, what, sent, response.status()).await;
        }
        response
    };
    tokio::spawn(work).await.unwrap_or_else(|e| {
        Refusal::from(Fault::new(Exit::Failure, format!("the request failed: {e}"))).into_response()
    })
}

/// The line of a request that was answered.
async fn write_down(
    shared: &Shared,
    link: &Link,
    caller: Option<Caller>,
    what: String,
    sent: Option<Sent>,
    status: StatusCode,
) {
    let from = from_text(link);
    if caller.is_none() {
        // A login that failed is a refusal.
        shared.audit.refused(link, None, &what, status);
        return;
    }
    let mut line = shared.audit.line(caller.as_ref().map_or(&from, |caller| &caller.name), &from, what);
    (line.role, line.via) = caller.map_or((None, None), |caller| (Some(caller.role), Some(caller.via)));
    line.status = status.as_u16();
    line.request = sent.and_then(|sent| serde_json::from_slice(&sent.0).ok());
    let node = shared.status();
    let requested = line.request.as_ref().and_then(|request| request.get("session_id")?.as_u64());
    let concerned = node.session.as_ref().filter(|session| match requested {
        Some(requested) => session.session_id == requested,
        None => !node.is_free(),
    });
    line.concerns(concerned);
    // A session that has just been prepared may not be in the status yet.
    let name = line.request.as_ref().and_then(|request| request.get("name")?.as_str());
    line.session = line.session.or_else(|| requested.and(name).map(|name| name.chars().take(100).collect()));
    line.session_id = line.session_id.or_else(|| requested.map(|id| format!("{id:016x}")));
    line.request = line.request.map(shortened);
    shared.audit.record(line).await;
}

/// Of a request that is longer than 4096 bytes, its beginning as text: one request must not fill the log.
fn shortened(request: serde_json::Value) -> serde_json::Value {
    const LINE: usize = 4096;
    const TEXT: usize = 200;
    let cut = |text: &str, to: usize| {
        let kept: String = text.chars().take(to).collect();
        let all = text.chars().count();
        if kept.len() == text.len() { kept } else { format!("{kept}... ({all} characters)") }
    };
    let whole = request.to_string();
    if whole.len() <= LINE {
        return request;
    }
    let fields = match request {
        serde_json::Value::Object(fields) => fields,
        _ => return serde_json::Value::String(cut(&whole, TEXT)),
    };
    let short = fields.into_iter().take(64).map(|(name, value)| {
        let value = match value {
            serde_json::Value::String(text) => serde_json::Value::String(cut(&text, TEXT)),
            value if value.to_string().len() > TEXT => {
                serde_json::Value::String(cut(&value.to_string(), TEXT))
            }
            value => value,
        };
        (cut(&name, TEXT), value)
    });
    let short = serde_json::Value::Object(short.collect());
    match short.to_string().len() <= 8 * LINE {
        true => short,
        false => serde_json::Value::String(cut(&whole, TEXT)),
    }
}

struct Log {
    path: PathBuf,
    open: Option<(File, u64)>,
    problem: Arc<Mutex<Option<String>>>,
}

fn log_result(result: io::Result<()>, path: &Path) -> Result<(), String> {
    result.map_err(|e| format!("the audit log {} cannot be written: {e}", path.display()))
}

impl Log {
    fn run(mut self, inbox: &Receiver<(AuditLine, Option<oneshot::Sender<()>>)>) {
        while let Ok(first) = inbox.recv() {
            // One sync for all lines that wait.
            let lines: Vec<_> = std::iter::once(first).chain(inbox.try_iter().take(WAITING_MAX)).collect();
            let result = self.write(lines.iter().map(|(line, _)| line));
            if result.is_err() {
                self.open = None;
            }
            self.note(log_result(result, &self.path));
            // The request may have given up waiting.
            for done in lines.into_iter().filter_map(|(_, done)| done) {
                let _ = done.send(());
            }
        }
    }

    fn note(&self, result: Result<(), String>) {
        let mut problem = self.problem.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(text) = &result
            && problem.as_ref() != Some(text)
        {
            tracing::error!("{text}");
        }
        *problem = result.err();
    }

    fn open_file(&mut self) -> io::Result<&mut (File, u64)> {
        if self.open.is_none() {
            if let Some(dir) = self.path.parent() {
                // With the mode of the recordings' directories.
                std::fs::DirBuilder::new().recursive(true).mode(0o750).create(dir)?;
            }
            let file = regular::append(&self.path, 0o640)?;
            let size = file.metadata()?.len();
            self.open = Some((file, size));
        }
        self.open.as_mut().ok_or_else(|| io::Error::other("not open"))
    }

    fn write<'a>(&mut self, lines: impl Iterator<Item = &'a AuditLine>) -> io::Result<()> {
        let mut text = String::new();
        for line in lines {
            text += &serde_json::to_string(line)?;
            text.push('\n');
        }
        let (file, size) = self.open_file()?;
        file.write_all(text.as_bytes())?;
        file.sync_data()?;
        *size += text.len() as u64;
        if *size >= FILE_BYTES_MAX {
            self.rotate()?;
        }
        Ok(())
    }

    fn rotate(&mut self) -> io::Result<()> {
        let numbered = |n: usize| {
            let mut name = self.path.file_name().unwrap_or_default().to_owned();
            name.push(format!(".{n}"));
            self.path.with_file_name(name)
        };
        for n in (1..FILES_KEPT).rev() {
            match std::fs::rename(numbered(n), numbered(n + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        std::fs::rename(&self.path, numbered(1))?;
        self.open = None;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::{Audit, AuditLine, FILE_BYTES_MAX};

    fn block_on<T>(future: impl Future<Output = T>) -> T {
        tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .build()
            .expect("a runtime")
            .block_on(future)
    }

    fn lines(path: &std::path::Path) -> Vec<AuditLine> {
        let text = std::fs::read_to_string(path).expect("readable");
        text.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
    }

    #[test]
    fn lines_are_there_when_record_returns() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("below/audit.jsonl");
        let audit = Audit::start(&path, "a").expect("started");
        block_on(audit.record(audit.line("anna", "uid 7", "POST /x\n\"".to_owned())));
        let found = lines(&path);
        assert_eq!((found.len(), found[0].who.as_str(), found[0].what.as_str()), (1, "anna", "POST /x\n\""));
        assert_eq!(audit.warning(), None);
    }

    #[test]
    fn a_log_that_cannot_be_written_is_told_until_it_can() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("file/audit.jsonl");
        std::fs::write(dir.path().join("file"), "").expect("writable");
        let audit = Audit::start(&path, "a").expect("started");
        block_on(audit.record(audit.line("anna", "uid 7", "one".to_owned())));
        assert!(audit.warning().expect("told").contains("cannot be written"));
        std::fs::remove_file(dir.path().join("file")).expect("mine");
        block_on(audit.record(audit.line("anna", "uid 7", "two".to_owned())));
        assert_eq!(audit.warning(), None);
        assert_eq!(lines(&path).len(), 1);
    }

    #[test]
    fn of_a_long_request_the_beginning_is_kept() {
        let short = serde_json::json!({ "session_id": 7, "note": "n" });
        assert_eq!(super::shortened(short.clone()), short);
        let long = super::shortened(serde_json::json!({ "session_id": 7, "note": "n".repeat(60_000) }));
        assert_eq!(long["session_id"], 7);
        assert!(long["note"].as_str().is_some_and(|note| note.ends_with("(60000 characters)")), "{long}");
        for wild in [serde_json::json!(vec![1; 30_000]), serde_json::json!({ "a": { "b": vec![1; 30_000] } })]
        {
            assert!(super::shortened(wild).to_string().len() < 1000);
        }
    }

    #[test]
    fn files_are_rotated_by_size() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let path = dir.path().join("audit.jsonl");
        std::fs::write(&path, vec![b'\n'; FILE_BYTES_MAX as usize - 10]).expect("writable");
        let audit = Audit::start(&path, "a").expect("started");
        for what in ["one", "two"] {
            block_on(audit.record(audit.line("anna", "uid 7", what.to_owned())));
        }
        assert_eq!(lines(&path).len(), 1);
        assert!(dir.path().join("audit.jsonl.1").exists());
    }
}
