// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is known of a node file before its cameras: read, or begun.

use super::node_file::{Given, begin};
use super::options::Options;
use crate::base::ids::{CameraId, NodeId};
use crate::base::{Fault, regular};
use crate::config::Rig;
use std::path::Path;

/// What is known of the file before its cameras.
pub struct Begun {
    /// The file's text.
    pub text: String,
    /// This node.
    pub node: NodeId,
    /// The rig.
    pub rig: Rig,
    /// Cameras of the file, with their addresses.
    pub in_file: Vec<(CameraId, String)>,
}

/// Reads or begins the file.
///
/// # Errors
/// It cannot be read, or does not say which node of which rig this is.
pub fn begin_file(options: &Options) -> Result<Begun, Fault> {
    let path = &options.path;
    let problem = |what: String| Fault::usage(format!("{}: {what}", path.display()));
    let text = match regular::read_text(path, regular::TEXT_BYTES) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
        Err(error) => return Err(problem(format!("cannot be read: {error}"))),
    };
    let begun = begin(&text, &options.given).map_err(problem)?;
    let table: toml::Table = begun.parse().map_err(|e| problem(format!("not valid TOML: {e}")))?;
    let said = |key: &str| table.get(key).and_then(toml::Value::as_str).unwrap_or_default().to_owned();
    let rig_path = path.parent().unwrap_or(Path::new(".")).join(said("rig"));
    let rig =
        Rig::load(&rig_path).map_err(|error| Fault::usage(format!("{error}\n(--rig FILE names the rig)")))?;
    let nodes = rig.nodes();
    let named: Vec<String> = nodes.iter().map(ToString::to_string).collect();
    let node = match (said("node"), nodes.first()) {
        (said, _) if !said.is_empty() => NodeId(said),
        (_, Some(only)) if nodes.len() == 1 => only.clone(),
        _ => {
            return Err(Fault::usage(format!(
                "which node is this computer: say --node with one of {}",
                named.join(", ")
            )));
        }
    };
    if !nodes.contains(&node) {
        return Err(Fault::usage(format!(
            "node {node} is not in the rig, expected one of {}",
            named.join(", ")
        )));
    }
    let text =
        begin(&text, &Given { node: Some(node.to_string()), ..options.given.clone() }).map_err(problem)?;
    let cameras = table.get("camera").and_then(toml::Value::as_array).map_or(&[][..], Vec::as_slice);
    let of = |camera: &toml::Value| {
        let text = |key: &str| Some(camera.get(key)?.as_str()?.to_owned());
        Some((CameraId(text("id")?), text("address")?))
    };
    let in_file = cameras.iter().filter_map(of).collect();
    Ok(Begun { text, node, rig, in_file })
}
