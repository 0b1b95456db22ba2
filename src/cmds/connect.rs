// SPDX-License-Identifier: MIT OR Apache-2.0
//! How commands reach nodes: URLs, a token, and whom to believe.

use crate::base::{Exit, Fault};
use crate::control::client::{Credentials, NodeClient};
use std::path::PathBuf;

/// Names the file with a token where `--token-file` is not given.
pub const TOKEN_FILE: &str = "FOURDBODY_TOKEN_FILE";

/// Nodes, and what to show them.
#[derive(clap::Args)]
pub struct Connect {
    /// The nodes' URLs (http://HOST:PORT, https://HOST:PORT or unix:/PATH), separated by commas.
    #[arg(long, value_name = "URL,URL", value_delimiter = ',', required = true)]
    pub nodes: Vec<String>,
    /// What to show them.
    #[command(flatten)]
    pub credentials: Shown,
}

/// What is shown to nodes, and whom to believe.
#[derive(clap::Args)]
pub struct Shown {
    /// The file with your token, mode 0600; a comma between several, one for each node in their order. By default what
    /// FOURDBODY_TOKEN_FILE names in the same way.
    #[arg(long, value_name = "FILE,FILE", value_delimiter = ',')]
    token_file: Vec<PathBuf>,
    /// With https: the certificates to believe (PEM), by default the system's.
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
}

fn tokens_of_environment() -> Vec<PathBuf> {
    let named = std::env::var(TOKEN_FILE).unwrap_or_default();
    named.split(',').filter(|file| !file.is_empty()).map(PathBuf::from).collect()
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
        let files =
            if self.token_file.is_empty() { tokens_of_environment() } else { self.token_file.clone() };
        // One file for all, or one for each.
        if files.len() > 1 && files.len() != nodes.len() {
            let (found, expected) = (files.len(), nodes.len());
            let message =
                format!("{found} token files for {expected} nodes; expected one for all, or one for each");
            return Err(Fault::new(Exit::Usage, message));
        }
        let client = |(i, url): (usize, &String)| {
            let token_file = files.get(i).or(files.last()).cloned();
            NodeClient::with(url, &Credentials { token_file, ca: self.ca.clone() })
        };
        nodes.iter().enumerate().map(client).collect()
    }
}
