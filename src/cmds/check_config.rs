// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody check-config`: validates configuration files, all problems at once.

use super::failure::{Failure, print};
use crate::base::{Exit, regular};
use crate::config::{ConfigError, NodeConfig, Rig, WorkerConfig};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Validate rig, node and worker files; every problem is printed with its key path.
#[derive(clap::Args)]
#[command(after_help = "\
Example:
  fourdbody check-config config/rig.toml config/node-a.toml")]
pub struct Args {
    /// Rig, node or worker files; a file with a `node` key is a node file, one with a `results` key a worker file.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Print one JSON object instead of text.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    let results: Vec<(&PathBuf, Option<ConfigError>)> =
        args.files.iter().map(|f| (f, check(f).err())).collect();
    let good = results.iter().all(|(_, error)| error.is_none());
    let files = results.iter().map(|(path, error)| {
        let problems = error.iter().flat_map(|e| &e.problems);
        let problems = problems.map(|p| json!({ "key": p.key, "message": p.message }));
        json!({ "path": path, "problems": problems.collect::<Vec<_>>() })
    });
    let value = json!({ "ok": good, "files": files.collect::<Vec<_>>() });
    print(args.json, &value, || {
        results.iter().for_each(|(path, error)| match error {
            None => println!("{}: ok", path.display()),
            Some(error) => eprintln!("{error}"),
        });
    });
    Ok(if good { Exit::Done } else { Exit::Usage })
}

fn check(path: &Path) -> Result<(), ConfigError> {
    let text = regular::read_text(path, regular::TEXT_BYTES).unwrap_or_default();
    let table: toml::Table = text.parse().unwrap_or_default();
    match (table.get("node"), table.contains_key("results")) {
        (_, true) => WorkerConfig::load(path).map(drop),
        (Some(_), false) => NodeConfig::load(path).map(drop),
        (None, false) => Rig::check(path).map(drop),
    }
}
