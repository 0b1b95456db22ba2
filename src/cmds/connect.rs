// SPDX-License-Identifier: MIT OR Apache-2.0
//! How commands reach nodes: URLs, a token, and whom to believe.

use crate::base::Fault;
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
    /// The file with your token, mode 0600; by default the one that FOURDBODY_TOKEN_FILE names. A comma between several: one
    /// for each node.
    #[arg(long, value_name = "FILE", value_delimiter = ',')]
    token_file: Vec<PathBuf>,
    /// With https: the certificates to believe (PEM), by default the system's.
    #[arg(long, value_name = "FILE")]
    ca: Option<PathBuf>,
}

/// A client that shows the token of the environment, if there is one.
pub fn by_environment(url: &str) -> Result<NodeClient, Fault> {
    NodeClient::with(url, &Credentials { token_file: token_of_environment(), ca: None })
}

fn token_of_environment() -> Option<PathBuf> {
    std::env::var_os(TOKEN_FILE).map(PathBuf::from)
}

impl Connect {
    /// A client for each node, in the order given.
    pub fn clients(&self) -> Result<Vec<NodeClient>, Fault> {
        let default = token_of_environment();
        let client = |(i, url): (usize, &String)| {
            // One file for all, or one for each.
            let own = self.token_file.get(i).or(self.token_file.last());
            let token_file = own.cloned().or_else(|| default.clone());
            NodeClient::with(url, &Credentials { token_file, ca: self.ca.clone() })
        };
        self.nodes.iter().enumerate().map(client).collect()
    }
}
