// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody cameras dump` and `cameras diff`: everything that can be read of cameras, and what changed.

use super::connect::backend;
use super::failure::{Failure, unreadable};
use crate::base::ids::printable;
use crate::base::{Exit, json, regular};
use crate::camera::{State, differences};
use crate::config::NodeConfig;
use crate::record::SessionReader;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Print every feature that can be read of one camera, or of all cameras of a node.
#[derive(clap::Args)]
#[command(after_help = "\
Nothing is set. A camera that another program controls, a running node for instance, cannot be opened: what such a
node's cameras were set to is in its recordings, see `fourdbody cameras diff`.

Exit code 0: all were read; 2: no camera is named; 5: one cannot be opened or read.

Examples:
  fourdbody cameras dump 192.168.10.2
  fourdbody cameras dump --config /etc/fourdbody/node.toml --json > monday.json")]
pub struct DumpArgs {
    /// Address or Aravis device id of one camera.
    #[arg(required_unless_present = "config", conflicts_with = "config")]
    address: Option<String>,
    /// Node file: all of its cameras.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON, as `cameras diff` takes it.
    #[arg(long)]
    json: bool,
}

/// Print in which features cameras differ between two sessions, recordings or dumps.
#[derive(clap::Args)]
#[command(after_help = "\
Cameras are compared by their names; where each side has one camera alone, those two are.

Exit code 0: compared; 2: there is no such file, or nothing in it to compare.

Examples:
  fourdbody cameras diff sessions/walk-01 sessions/walk-02
  fourdbody cameras diff --json monday.json sessions/walk-02/node-a")]
pub struct DiffArgs {
    /// A session, a recording, or what `cameras dump --json` printed.
    a: PathBuf,
    /// A second one, which is compared with the first.
    b: PathBuf,
    /// Print JSON instead of text.
    #[arg(long)]
    json: bool,
}

/// A camera of a dump, with its whole state.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Dumped {
    /// Manufacturer, model and serial number in one line.
    device: String,
    state: State,
}

/// What `cameras dump --json` prints.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Dump {
    cameras: BTreeMap<String, Dumped>,
}

pub fn dump(args: &DumpArgs) -> Result<Exit, Failure> {
    let mut backend = backend()?;
    let mut named: Vec<(String, String)> = Vec::new();
    if let Some(file) = &args.config {
        let config = NodeConfig::load(file)?;
        named.extend(config.cameras.iter().map(|camera| (camera.id.to_string(), camera.address.clone())));
    }
    named.extend(args.address.iter().map(|address| (address.clone(), address.clone())));
    let (mut dump, mut failures) = (Dump::default(), Vec::new());
    for (name, address) in named {
        let read = backend.open(&address).and_then(|mut camera| {
            let identity = camera.identity().clone();
            let device = format!("{} {} {}", identity.vendor, identity.model, identity.serial);
            Ok(Dumped { device, state: camera.state()? })
        });
        match read {
            Ok(dumped) => drop(dump.cameras.insert(name, dumped)),
            Err(error) => failures.push(format!("camera {name}: {error}")),
        }
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&dump).unwrap_or_default());
    } else {
        for (name, Dumped { device, state }) in &dump.cameras {
            println!("{name}  {}  {} features", printable(device), state.len());
            for (feature, value) in state {
                println!("  {feature:<40} {}", printable(value));
            }
        }
    }
    match failures.is_empty() {
        true => Ok(Exit::Done),
        false => Err(Failure::device(failures.join("\n"))),
    }
}

/// Reads the states of cameras from a file of `cameras dump --json`, or from a session's recordings.
fn load(path: &Path) -> Result<Dump, Failure> {
    let is_dump = path.extension().is_some_and(|extension| extension == "json");
    let dump = if is_dump {
        let text = regular::read(path, regular::STATEMENT_BYTES)
            .map_err(|e| unreadable(path, format!("{}: cannot be read: {e}", path.display())))?;
        json::from_slice(&text).map_err(|e| {
            let message =
                format!("{}: expected what `fourdbody cameras dump --json` prints: {e}", path.display());
            Failure::corrupt(message)
        })?
    } else {
        let session = SessionReader::open_frames(path)?;
        let cameras = session.recordings().iter().flat_map(|recording| &recording.header.cameras);
        let known = cameras.filter(|camera| !camera.state.is_empty()).map(|camera| {
            let dumped = Dumped { device: camera.device.clone(), state: camera.state.clone() };
            (camera.id.to_string(), dumped)
        });
        Dump { cameras: known.collect() }
    };
    if dump.cameras.is_empty() {
        let message = format!(
            "{}: holds no state of a camera; expected a recording of cameras of this version, or a dump",
            path.display()
        );
        return Err(Failure::usage(message));
    }
    Ok(dump)
}

pub fn diff(args: &DiffArgs) -> Result<Exit, Failure> {
    let (a, b) = (load(&args.a)?.cameras, load(&args.b)?.cameras);
    let mut names: BTreeSet<(&String, &String)> =
        a.keys().filter(|name| b.contains_key(*name)).map(|name| (name, name)).collect();
    if let (1, Some(one), Some(other)) = (a.len().max(b.len()), a.keys().next(), b.keys().next()) {
        names = BTreeSet::from([(one, other)]);
    }
    if names.is_empty() {
        let list = |of: &BTreeMap<String, Dumped>| of.keys().cloned().collect::<Vec<_>>().join(", ");
        let message = format!(
            "no camera is in both: {} has {}, {} has {}",
            args.a.display(),
            list(&a),
            args.b.display(),
            list(&b)
        );
        return Err(Failure::usage(message));
    }
    let compared = names.into_iter().map(|(one, other)| (one, differences(&a[one].state, &b[other].state)));
    if args.json {
        let json = |(feature, a, b)| serde_json::json!({ "feature": feature, "a": a, "b": b });
        let cameras: BTreeMap<&String, Vec<serde_json::Value>> =
            compared.map(|(name, differences)| (name, differences.into_iter().map(json).collect())).collect();
        println!("{}", serde_json::json!({ "cameras": cameras }));
        return Ok(Exit::Done);
    }
    for (name, differences) in compared {
        println!("{name}  {} features differ", differences.len());
        let text = |value: Option<String>| value.map_or_else(|| "-".to_owned(), |value| printable(&value));
        for (feature, a, b) in differences {
            println!("  {feature:<40} {} -> {}", text(a), text(b));
        }
    }
    Ok(Exit::Done)
}
