// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node file before its cameras are known: read, or begun.

use super::node_file::{Given, begin};
use super::options::Options;
use crate::base::ids::{CameraId, NodeId};
use crate::base::{Fault, regular};
use crate::config::Rig;
use std::path::Path;

/// The node file before its cameras are known.
pub struct Begun {
    pub text: String,
    pub node: NodeId,
    pub rig: Rig,
    /// The cameras that the file has already, with their addresses.
    pub in_file: Vec<(CameraId, String)>,
}

/// Reads or begins the file.
///
/// # Errors
/// The file cannot be read, or does not name the rig and the node of it that this computer is.
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
    let text_of = |key: &str| table.get(key).and_then(toml::Value::as_str).unwrap_or_default().to_owned();
    let rig_path = path.parent().unwrap_or(Path::new(".")).join(text_of("rig"));
    let rig =
        Rig::load(&rig_path).map_err(|error| Fault::usage(format!("{error}\n(--rig FILE names the rig)")))?;
    let nodes = rig.nodes();
    let named: Vec<String> = nodes.iter().map(ToString::to_string).collect();
    let node = match (text_of("node"), nodes.first()) {
        (name, _) if !name.is_empty() => NodeId(name),
        (_, Some(only)) if nodes.len() == 1 => only.clone(),
        _ => {
            return Err(Fault::usage(format!(
                "the node that this computer is cannot be known: give --node with one of {}",
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
