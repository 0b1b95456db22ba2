// SPDX-License-Identifier: MIT OR Apache-2.0
//! Configuration files: rig, node, scenario.

use fourdbody::config::{NodeConfig, Problem, Rig};
use fourdbody::doctor::Load;
use fourdbody::hsu::HsuTiming;
use fourdbody_simulator::scenario::Scenario;
use std::path::PathBuf;
use tempfile::TempDir;

thread_local! {
    static DIRECTORY: TempDir = directory();
}

/// Holds the shipped rig, which node files and scenarios refer to.
fn directory() -> TempDir {
    let dir = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a directory");
    std::fs::write(dir.path().join("rig.toml"), include_str!("../../config/rig.toml")).expect("writable");
    dir
}

/// The first byte says which kind of file (r, n or s), the rest is its text.
///
/// Holds: a file that is refused has a problem with words; one that is accepted can be used.
pub fn files(data: &[u8]) {
    let Some((kind, text)) = data.split_first() else { return };
    let Ok(text) = std::str::from_utf8(text) else { return };
    let Ok(table) = text.parse::<toml::Table>() else { return };
    // Files elsewhere on this machine are none of the fuzzer's business.
    if table.values().any(names_a_path) {
        return;
    }
    let directory: PathBuf = DIRECTORY.with(|dir| dir.path().to_owned());
    let problems = match kind {
        b'r' => Rig::from_table(&table).map(|rig| use_rig(&rig)).err(),
        b'n' => {
            let file = directory.join("node.toml");
            std::fs::write(&file, text).expect("writable");
            NodeConfig::load(&file).map(|config| use_node(&config)).map_err(|error| error.problems).err()
        }
        _ => Scenario::from_table(&table, &directory).map(|scenario| use_scenario(&scenario)).err(),
    };
    let told = |problem: &Problem| !problem.message.is_empty();
    assert!(problems.is_none_or(|problems| !problems.is_empty() && problems.iter().all(told)));
}

fn names_a_path(value: &toml::Value) -> bool {
    match value {
        toml::Value::String(text) => text.contains('/') || text.contains(".."),
        toml::Value::Array(values) => values.iter().any(names_a_path),
        toml::Value::Table(table) => table.values().any(names_a_path),
        _ => false,
    }
}

fn use_rig(rig: &Rig) {
    let names: Vec<_> = rig.cameras().map(|(_, camera)| camera.id.clone()).collect();
    assert!(!names.is_empty() && !rig.nodes().is_empty());
    assert_eq!(rig.nodes().iter().map(|node| rig.cameras_of(node).count()).sum::<usize>(), names.len());
    let _ = HsuTiming::from_rig(rig);
}

fn use_node(config: &NodeConfig) {
    let load = Load::of(config);
    assert_eq!(load.frames.len(), config.cameras.len());
    assert!(load.bytes_per_s().is_finite() && load.pool_bytes() > 0 && load.packets_per_trigger() > 0);
}

fn use_scenario(scenario: &Scenario) {
    let _ = (scenario.light_at(0), scenario.has_truth(0));
}
