// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a node may be reached (`[api]` of the node file): socket, address, TLS, names, tokens, the other nodes.

use super::section::Section;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// How a node can be reached: `[api]` of its file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ApiConfig {
    /// A Unix socket for local users.
    pub socket: Option<SocketConfig>,
    /// Where TCP connections are accepted.
    pub listen: Option<SocketAddr>,
    /// Certificate and key of the TCP side.
    pub tls: Option<TlsConfig>,
    /// Whether a network may get plain text: another program encrypts, or none does.
    pub plain_text_on_network: bool,
    /// Names under which browsers and programs reach the TCP side, each with or without a port.
    pub hosts: Vec<String>,
    /// The file of tokens with their roles; without it every program that can connect may do everything.
    pub tokens: Option<PathBuf>,
    /// The log of all requests that change something.
    pub audit: PathBuf,
    /// The other nodes, as this one reaches them.
    pub peers: Vec<PeerConfig>,
}

/// A Unix socket, mode 0660.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SocketConfig {
    pub path: PathBuf,
    /// The group that may connect; by default that of the process.
    pub group: Option<String>,
}

/// Certificate and private key of the TCP side, as PEM files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsConfig {
    /// The certificate, followed by the ones that vouch for it.
    pub certificate: PathBuf,
    /// Its private key, which only its owner may read.
    pub key: PathBuf,
}

/// Another node of the rig, as this one reaches it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PeerConfig {
    /// Its name in the rig.
    pub name: String,
    /// `http://HOST:PORT`, `https://HOST:PORT` or `unix:/PATH` of its API.
    pub url: String,
    /// The secret that this node shows it.
    pub token_file: Option<PathBuf>,
    /// The certificate of the authority that signed its certificate (PEM).
    pub ca: Option<PathBuf>,
}

impl ApiConfig {
    /// Whether other machines can connect.
    pub fn is_on_network(&self) -> bool {
        self.listen.is_some_and(|address| !address.ip().is_loopback())
    }
}

/// Reads the section. Paths are relative to `base`; `audit_default` is the audit log's place when none is given.
pub(super) fn read_api(section: Section<'_>, base: &Path, audit_default: Option<PathBuf>) -> ApiConfig {
    let path = |key| section.has(key).then(|| base.join(section.text(key)));
    let socket = path("socket")
        .map(|path| SocketConfig { path, group: section.has("group").then(|| section.text("group")) });
    let listen = section.has("listen").then(|| read_listen(&section)).flatten();
    if socket.is_none() && !section.has("listen") {
        section
            .problem("", "expected `socket`, `listen` or both: without them no program can reach the node");
    }
    if socket.is_none() && section.has("group") {
        section.problem("group", "is the group of `socket`, which is not given");
        section.text("group");
    }
    let tls = section.optional_section("tls").map(|tls| {
        let files =
            TlsConfig { certificate: base.join(tls.text("certificate")), key: base.join(tls.text("key")) };
        tls.finish();
        files
    });
    let config = ApiConfig {
        socket,
        listen,
        tls,
        plain_text_on_network: section.flag_or("plain_text_on_network", false),
        hosts: read_hosts(&section),
        tokens: path("tokens"),
        audit: path("audit").or(audit_default).unwrap_or_default(),
        peers: read_peers(&section, base),
    };
    check_network(&section, &config);
    section.finish();
    config
}

fn read_listen(section: &Section<'_>) -> Option<SocketAddr> {
    let text = section.text("listen");
    let address = text.parse().ok();
    if address.is_none() && !text.is_empty() {
        section.problem("listen", format!("expected ADDRESS:PORT such as 127.0.0.1:7401, found {text:?}"));
    }
    address
}

/// A network is dangerous: the file must state what is open to it.
fn check_network(section: &Section<'_>, config: &ApiConfig) {
    let Some(address) = config.listen else { return };
    if config.is_on_network() {
        if config.tokens.is_none() {
            section.problem(
                "listen",
                format!(
                    "{address} is reachable from a network, expected a loopback address, or \
                     authentication by `tokens` (see `fourdbody token --help`)"
                ),
            );
        }
        if config.tls.is_none() && !config.plain_text_on_network {
            section.problem(
                "tls",
                format!(
                    "is missing: {address} is reachable from a network; give certificate and key, or \
                     ask for plain text with plain_text_on_network = true"
                ),
            );
        }
    }
    if address.ip().is_unspecified() && config.hosts.is_empty() {
        section.problem(
            "hosts",
            format!(
                "is missing: with {address} expected the names by which the node is reached, such as [\"node-a.lab\"]"
            ),
        );
    }
}

fn read_hosts(section: &Section<'_>) -> Vec<String> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | ':' | '[' | ']');
    section.each("hosts", "NAME or NAME:PORT", |value| {
        let text = value.as_str().filter(|text| !text.is_empty() && text.chars().all(is_plain))?;
        Some(text.to_ascii_lowercase())
    })
}

fn read_peers(section: &Section<'_>, base: &Path) -> Vec<PeerConfig> {
    let tables = if section.has("peers") { section.sections("peers") } else { Vec::new() };
    let peer = |peer: Section<'_>| {
        let path = |key| peer.has(key).then(|| base.join(peer.text(key)));
        let read = PeerConfig {
            name: peer.text("name"),
            url: peer.text("url"),
            token_file: path("token_file"),
            ca: path("ca"),
        };
        if !read.url.is_empty() && !["http://", "https://", "unix:"].iter().any(|s| read.url.starts_with(s)) {
            peer.problem("url", format!("expected http://, https:// or unix:/path, found {:?}", read.url));
        }
        peer.finish();
        read
    };
    tables.into_iter().map(peer).collect()
}
