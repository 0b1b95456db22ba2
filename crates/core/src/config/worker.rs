// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the worker needs: where the nodes' sessions are, where results go, how much memory and disk it may use
//! (`worker.toml`).

use super::section::Section;
use super::{ConfigError, read_all, read_table};
use crate::base::ids::NodeId;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// A node whose sessions are reconstructed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerNode {
    /// Its name in the rig.
    pub name: NodeId,
    /// Its sessions as they are seen from here: its own disk, or where that is mounted.
    pub sessions_dir: PathBuf,
    /// Its control API, for giving way to its captures; `http://HOST:PORT`, `https://HOST:PORT` or `unix:/PATH`.
    pub url: Option<String>,
    /// The file with the token for its API.
    pub token_file: Option<PathBuf>,
    /// The certificate that signed its own.
    pub ca: Option<PathBuf>,
}

/// Which of the waiting sessions is reconstructed next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// The one that was recorded last: users wait for its results.
    Newest,
    Oldest,
}

/// What is written of each frame set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Output {
    /// Clouds, merged clouds and the sequence.
    Ply,
    /// Phase maps, of which `fourdbody export` makes the same.
    Phase,
}

impl Output {
    /// As `fourdbody reconstruct --format` calls it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Phase => "phase",
        }
    }
}

/// The configuration of the worker, as its file states it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerConfig {
    /// A session is worked on when all of these have recorded it.
    pub nodes: Vec<WorkerNode>,
    /// Results are directories below this one, named as their sessions.
    pub results: PathBuf,
    /// The calibration of sessions whose reconstruction begins from now on.
    pub calibration: PathBuf,
    /// Where the laboratory copies its recordings to; `prune` deletes only what is there.
    pub archive: Option<PathBuf>,
    pub order: Order,
    pub output: Output,
    /// The most threads to use; `None`: one per core.
    pub threads: Option<usize>,
    /// The most memory to use, bytes.
    pub memory_bytes: u64,
    /// Nothing is written when the results' disk has less free, bytes.
    pub reserve_bytes: u64,
    /// How often a session is tried before it is set aside.
    pub attempts: u32,
}

/// The only version of worker files so far.
const FORMAT: u64 = 1;
const MIB: u64 = 1 << 20;

/// Memory of a reconstruction without that of its threads, bytes (measured: docs/benchmarks.md).
const BASE_BYTES: u64 = 400 * MIB;
/// Memory of each thread of a reconstruction, bytes (measured: docs/benchmarks.md).
const THREAD_BYTES: u64 = 500 * MIB;

impl WorkerConfig {
    /// Reads and validates a worker file.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let table = read_table(path)?;
        let base = path.parent().unwrap_or(Path::new("."));
        read_all(&table, |root| read_worker(root, base))
            .map_err(|problems| ConfigError { path: path.to_owned(), problems })
    }

    /// Threads that fit into the memory, at least one.
    pub fn threads(&self) -> usize {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let fit = self.memory_bytes.saturating_sub(BASE_BYTES) / THREAD_BYTES;
        self.threads.unwrap_or(cores).min(usize::try_from(fit).unwrap_or(usize::MAX)).max(1)
    }
}

fn read_worker(root: Section<'_>, base: &Path) -> Option<WorkerConfig> {
    root.integer("format", FORMAT..=FORMAT);
    let (results, calibration) = (base.join(root.text("results")), base.join(root.text("calibration")));
    let archive = root.has("archive").then(|| base.join(root.text("archive")));
    let nodes: Vec<WorkerNode> =
        root.sections("node").into_iter().map(|node| read_node(node, base)).collect();
    for (i, node) in nodes.iter().enumerate() {
        if nodes[..i].iter().any(|other| other.name == node.name) {
            root.problem(&format!("node[{i}].name"), format!("node {} is there twice", node.name));
        }
    }
    if let Some(archive) = &archive {
        for node in nodes.iter().filter(|node| overlap(archive, &node.sessions_dir)) {
            let message = format!(
                "{} and the sessions of node {} ({}) are one directory, or one lies in the other; expected \
                 another place: what is \
                 copied there must outlive what is deleted here",
                archive.display(),
                node.name,
                node.sessions_dir.display()
            );
            root.problem("archive", message);
        }
    }
    let work = root.optional_section("work");
    let number =
        |key, range, default| work.as_ref().map_or(default, |work| work.integer_or(key, range, default));
    let config = WorkerConfig {
        results,
        calibration,
        archive,
        nodes,
        order: work.as_ref().map_or(Order::Newest, |work| {
            work.choice_or_first("order", &[("newest", Order::Newest), ("oldest", Order::Oldest)])
        }),
        output: work.as_ref().map_or(Output::Phase, |work| {
            work.choice_or_first("write", &[("phase", Output::Phase), ("ply", Output::Ply)])
        }),
        threads: Some(number("threads", 0..=1024, 0) as usize).filter(|threads| *threads > 0),
        memory_bytes: number("memory_mib", 900..=1 << 20, 4096) * MIB,
        reserve_bytes: number("reserve_mib", 0..=1 << 30, 10_240) * MIB,
        attempts: number("attempts", 1..=100, 3) as u32,
    };
    if let Some(work) = work {
        work.finish();
    }
    root.finish();
    Some(config)
}

/// Whether one of two directories is the other, or lies in it, behind all links and mounts.
fn overlap(a: &Path, b: &Path) -> bool {
    let [a, b] = [a, b].map(resolved);
    a.starts_with(&b) || b.starts_with(&a) || [(&a, &b), (&b, &a)].into_iter().any(|(a, b)| lies_in(a, b))
}

/// The path behind all links; of the part that does not exist yet, as it is written.
fn resolved(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let there = path.ancestors().find_map(|part| Some((part, part.canonicalize().ok()?)));
    there.map_or_else(
        || path.clone(),
        |(part, leads_to)| leads_to.join(path.strip_prefix(part).unwrap_or(&path)),
    )
}

/// Whether a directory on the way to `inner` is `outer`, by device and inode: it may be mounted at two places.
fn lies_in(inner: &Path, outer: &Path) -> bool {
    let which = |path: &Path| std::fs::metadata(path).ok().map(|found| (found.dev(), found.ino()));
    which(outer).is_some_and(|outer| inner.ancestors().any(|part| which(part) == Some(outer)))
}

fn read_node(section: Section<'_>, base: &Path) -> WorkerNode {
    let path = |key: &'static str| section.has(key).then(|| base.join(section.text(key)));
    let node = WorkerNode {
        name: NodeId(section.name("name")),
        sessions_dir: base.join(section.text("sessions_dir")),
        url: section.has("url").then(|| section.text("url")),
        token_file: path("token_file"),
        ca: path("ca"),
    };
    section.finish();
    node
}

#[cfg(test)]
mod tests {
    use super::{Order, Output, WorkerConfig};

    fn load(text: &str) -> Result<WorkerConfig, String> {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("worker.toml");
        std::fs::write(&path, text).expect("written");
        WorkerConfig::load(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn threads_are_as_many_as_the_memory_holds() {
        let text = |memory_mib: u64| {
            format!(
                "format = 1\nresults = \"r\"\ncalibration = \"c.json\"\n[[node]]\nname = \"a\"\nsessions_dir = \"s\"\n\
                 [work]\nthreads = 8\nmemory_mib = {memory_mib}\norder = \"oldest\"\nwrite = \"phase\"\n"
            )
        };
        let threads = [900, 1400, 1900, 100_000].map(|mib| load(&text(mib)).expect("valid").threads());
        assert_eq!(threads, [1, 2, 3, 8]);
        let config = load(&text(900)).expect("valid");
        assert_eq!((config.order, config.output, config.attempts), (Order::Oldest, Output::Phase, 3));
    }

    #[test]
    fn an_archive_is_another_place_than_the_sessions_whatever_links_lead_there() {
        let dir = tempfile::tempdir().expect("a directory");
        for folder in ["sessions/walk", "elsewhere", "other/sessions"] {
            std::fs::create_dir_all(dir.path().join(folder)).expect("made");
        }
        for (link, to) in [("link", "sessions"), ("elsewhere/link", "../sessions/walk"), ("up", ".")] {
            std::os::unix::fs::symlink(to, dir.path().join(link)).expect("linked");
        }
        let refused = |archive: &str, sessions: &str| {
            let path = dir.path().join("worker.toml");
            let text = format!(
                "format = 1\nresults = \"r\"\ncalibration = \"c.json\"\narchive = \"{archive}\"\n[[node]]\nname = \"a\"\n\
                 sessions_dir = \"{sessions}\"\n"
            );
            std::fs::write(&path, text).expect("written");
            WorkerConfig::load(&path).err().map(|error| error.to_string())
        };
        for archive in [
            "sessions",
            "sessions/",
            "link",
            "sessions/archive",
            "link/archive/2026",
            "up/link",
            "elsewhere/link",
            ".",
            "up",
        ] {
            let error = refused(archive, "sessions").expect(archive);
            assert!(
                error.contains("archive: ") && error.contains("the sessions of node a"),
                "{archive}: {error}"
            );
        }
        assert!(refused("sessions", "link").is_some() && refused("new", "new/sessions").is_some());
        for archive in ["archive", "elsewhere", "elsewhere/new", "sessions-archive", "other"] {
            assert_eq!(refused(archive, "sessions"), None, "{archive}");
        }
    }

    #[test]
    fn all_problems_are_reported_at_once() {
        let node = "[[node]]\nname = \"a\"\nsessions_dir = \"s\"\n";
        let text = format!("format = 1\nresults = \"r\"\n{node}{node}[work]\nwrite = \"e57\"\nspeed = 3\n");
        let error = load(&text).expect_err("wrong");
        for part in ["calibration", "node a is there twice", "work.write", "work.speed"] {
            assert!(error.contains(part), "{part:?} missing in\n{error}");
        }
        assert!(
            load("format = 1\nresults = \"r\"\ncalibration = \"c\"\n")
                .expect_err("none")
                .contains("at least one table")
        );
    }
}
