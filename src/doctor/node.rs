// SPDX-License-Identifier: MIT OR Apache-2.0
//! A node that runs on this host: it has the API's port and the devices, and reports their condition.

use super::finding::{Check, Finding, Grade};
use crate::config::ApiConfig;
use crate::control::client::NodeClient;
use crate::control::status::NodeStatus;
use std::net::{SocketAddr, TcpListener};

/// Which program listens on the API's port.
#[derive(Debug)]
pub enum PortUse {
    Free,
    /// A running node, with the status that it reports.
    Node(Box<NodeStatus>),
    /// A program that requires a token or TLS: probably a running node.
    Closed,
    /// Another program, or the port cannot be bound at all: the system's error message.
    Taken(String),
}

impl PortUse {
    /// Whether a node runs here, or probably does: the disk and the devices are its own then.
    pub fn is_held(&self) -> bool {
        matches!(self, Self::Node(_) | Self::Closed)
    }
}

/// Asks the API's socket, then its port. A node answers on its socket without a token, on its port perhaps not.
pub fn look_at_api(api: &ApiConfig) -> PortUse {
    let status_of = |url: &str| NodeClient::new(url).status().map(|status| PortUse::Node(Box::new(status)));
    if let Some(socket) = &api.socket
        && let Ok(node) = status_of(&format!("unix:{}", socket.path.display()))
    {
        return node;
    }
    let Some(listen) = api.listen else { return PortUse::Free };
    let Err(error) = TcpListener::bind(listen) else { return PortUse::Free };
    status_of(&listen.to_string()).unwrap_or_else(|_| match api.tokens.is_some() || api.tls.is_some() {
        true => PortUse::Closed,
        false => PortUse::Taken(error.to_string()),
    })
}

/// The verdict on the API's port, which is free unless a node or another program runs here.
pub fn judge_port(port: &PortUse, listen: Option<SocketAddr>) -> Finding {
    let check = Check::host(listen.map_or("API port".to_owned(), |listen| format!("API port {listen}")));
    let (grade, found, advice) = match port {
        PortUse::Free => return check.ok("free"),
        PortUse::Node(status) => (
            Grade::Warning,
            format!("node {} runs here ({:?}) and has the devices", status.node, status.phase),
            "the verdicts on devices are those of that node; stop it first to have them examined",
        ),
        PortUse::Closed => (
            Grade::Warning,
            "a program that requires a token has it: probably the node, with the devices".to_owned(),
            "run this as a user of the node's socket (api.socket), or stop the node first",
        ),
        PortUse::Taken(error) => (
            Grade::Failed,
            format!("cannot be bound ({error})"),
            "`ss -ltnp` shows which program has it; end that program or change api.listen",
        ),
    };
    check.graded(grade, found, "a free port", advice)
}

/// The verdicts of a running node on the devices that it holds.
pub fn judge_status(status: &NodeStatus) -> Vec<Finding> {
    let judge = |name: String, known: Option<String>, problem: &Option<String>| {
        let check = Check::device(name);
        let Some(problem) = problem else { return check.ok(known.unwrap_or_else(|| "in use".to_owned())) };
        let (found, advice) = problem.split_once("; ").unwrap_or((problem, "see the node's log"));
        check.failed(found, "a device that the node can use", advice)
    };
    let cameras = status.cameras.iter().map(|camera| {
        let known = camera.identity.as_ref();
        let known = known.map(|i| format!("{} {}, serial number {}", i.vendor, i.model, i.serial));
        judge(format!("camera {}", camera.id), known, &camera.problem)
    });
    let hsu = judge("HSU".to_owned(), status.hsu.identity.clone(), &status.hsu.problem);
    cameras.chain([hsu]).collect()
}

#[cfg(test)]
mod tests {
    use super::{PortUse, judge_port};
    use crate::doctor::finding::Grade;

    #[test]
    fn another_program_on_the_port_is_a_failure() {
        let taken = PortUse::Taken("Address already in use".to_owned());
        let finding = judge_port(&taken, Some(([127, 0, 0, 1], 7401).into()));
        assert_eq!((finding.check.as_str(), finding.grade), ("API port 127.0.0.1:7401", Grade::Failed));
        assert_eq!(judge_port(&PortUse::Free, None).grade, Grade::Ok);
    }
}
