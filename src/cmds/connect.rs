// SPDX-License-Identifier: MIT OR Apache-2.0
//! How commands reach nodes (URLs, tokens, trusted certificates) and cameras.

use crate::base::Fault;
use crate::camera::CameraBackend;
use crate::control::client::{Credentials, NodeClient};
use std::path::PathBuf;

/// The environment variable that names the token files where `--token-file` is not given.
const TOKEN_FILE: &str = "FOURDBODY_TOKEN_FILE";

/// The nodes of a command, and the credentials for them.
#[derive(clap::Args)]
pub struct Connect {
    /// The nodes' URLs (http://HOST:PORT, https://HOST:PORT or unix:/PATH), separated by commas.
    #[arg(long, value_name = "URL,URL", value_delimiter = ',', required = true)]
    pub nodes: Vec<String>,
    #[command(flatten)]
    pub credentials: Shown,
}

/// Credentials for nodes, and the certificates that prove who a node is.
#[derive(clap::Args)]
pub struct Shown {
    /// The file with your token, mode 0600; a comma between several, one for each node in their order. By default what
    /// FOURDBODY_TOKEN_FILE names in the same way.
    #[arg(long, value_name = "FILE,FILE", value_delimiter = ',')]
    token_file: Vec<PathBuf>,
    /// With https: the certificates to trust (PEM), by default the system's.
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
}

impl Connect {
    /// A client for each node, in the order given.
    pub fn clients(&self) -> Result<Vec<NodeClient>, Fault> {
        self.credentials.clients(&self.nodes)
    }
}

impl Shown {
    /// A client for each of these nodes, in the order given.
    pub fn clients(&self, nodes: &[String]) -> Result<Vec<NodeClient>, Fault> {
        let mut files = self.token_file.clone();
        if files.is_empty() {
            let named = std::env::var(TOKEN_FILE).unwrap_or_default();
            files.extend(named.split(',').filter(|file| !file.is_empty()).map(PathBuf::from));
        }
        // One file for all, or one for each.
        if files.len() > 1 && files.len() != nodes.len() {
            let (found, expected) = (files.len(), nodes.len());
            let message =
                format!("{found} token files for {expected} nodes; expected one for all, or one for each");
            return Err(Fault::usage(message));
        }
        let client = |(i, url): (usize, &String)| {
            let token_file = files.get(i).or(files.last()).cloned();
            NodeClient::with(url, &Credentials { token_file, ca: self.ca.clone() })
        };
        nodes.iter().enumerate().map(client).collect()
    }
}

/// The cameras of this host.
#[cfg(feature = "aravis")]
pub(super) fn backend() -> Result<Box<dyn CameraBackend>, Fault> {
    Ok(Box::new(crate::camera::AravisCameras))
}

/// Without Aravis no command sees cameras.
#[cfg(not(feature = "aravis"))]
pub(super) fn backend() -> Result<Box<dyn CameraBackend>, Fault> {
    let message = "this binary was built without the feature `aravis` and cannot see cameras; build it with default \
        features";
    Err(Fault::usage(message))
}
