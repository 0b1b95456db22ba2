// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the API offers beside the node's own session: captures on all nodes, previews, the live body, quick looks,
//! sessions that are played, the other nodes.

use super::listing::Listing;
use crate::acquire::preview::Taps;
use crate::base::Fault;
use crate::base::ids::NodeId;
use crate::capture::coordinator::{Coordinator, Participants};
use crate::capture::participant::{LocalNode, Participant};
use crate::capture::peer_watch::PeerWatch;
use crate::config::NodeConfig;
use crate::control::client::{Credentials, NodeClient};
use crate::control::command::{Command, SharedStatus};
use crate::live::LiveBody;
use crate::play::desk::Desk;
use crate::preview::Previews;
use crate::preview::quick_look::QuickLooks;
use crate::worker::watch::WorkerWatch;
use crossbeam_channel::Sender;
use std::sync::Arc;

/// The services of a node. They start with the server, and their threads end with it.
pub struct Services {
    /// Captures that this node runs.
    pub coordinator: Coordinator,
    /// Pictures of this node's cameras.
    pub previews: Previews,
    /// The body as all nodes see it now.
    pub live: LiveBody,
    /// What this node has recorded.
    pub listing: Listing,
    /// Clouds of what this node has recorded.
    pub quick_looks: QuickLooks,
    /// Frame sets of what was reconstructed.
    pub desk: Desk,
    pub peers: Arc<Vec<Peer>>,
    /// The worker of this machine.
    pub worker: WorkerWatch,
    _watch: PeerWatch,
}

/// Another node of the rig, with a client for it.
#[derive(Debug, Clone)]
pub struct Peer {
    /// Its name in the rig.
    pub name: NodeId,
    pub client: NodeClient,
}

impl Services {
    /// Starts the services with their threads.
    pub fn start(
        config: &NodeConfig,
        commands: Sender<Command>,
        status: SharedStatus,
        [previews, live]: [Arc<Taps>; 2],
    ) -> Result<Self, Fault> {
        let thread =
            |e: std::io::Error| Fault::new(crate::base::Exit::Failure, format!("cannot start a thread: {e}"));
        let peer = |peer: &crate::config::PeerConfig| {
            let credentials = Credentials { token_file: peer.token_file.clone(), ca: peer.ca.clone() };
            let client = NodeClient::with(&peer.url, &credentials)?;
            Ok(Peer { name: NodeId(peer.name.clone()), client })
        };
        let peers = Arc::new(config.api.peers.iter().map(peer).collect::<Result<Vec<Peer>, Fault>>()?);
        let here = LocalNode::new(commands, Arc::clone(&status));
        let cast: Participants = {
            let (here, peers) = (here.clone(), Arc::clone(&peers));
            Arc::new(move || {
                let others = peers.iter().map(|peer| Box::new(peer.client.clone()) as Box<dyn Participant>);
                std::iter::once(Box::new(here.clone()) as Box<dyn Participant>).chain(others).collect()
            })
        };
        let watched = peers.iter().map(|peer| (peer.name.clone(), peer.client.clone())).collect();
        let watch = PeerWatch::start(watched, here).map_err(thread)?;
        // A peer provides no camera of this node, whatever api.peers call the peer.
        let cameras_of = |node: &NodeId| {
            let cameras = config.rig.cameras_of(node).filter(|_| *node != config.node);
            cameras.map(|(_, camera)| camera.id.clone()).collect()
        };
        let others = peers
            .iter()
            .map(|peer| crate::live::Peer { client: peer.client.clone(), cameras: cameras_of(&peer.name) })
            .collect();
        let calibration = config.quick_look.as_ref().map(|quick_look| quick_look.calibration.clone());
        Ok(Self {
            live: LiveBody::start(live, config.rig.trigger_rate_hz, calibration, others).map_err(thread)?,
            coordinator: Coordinator::new(cast),
            previews: Previews::start(previews).map_err(thread)?,
            listing: Listing::start(config.sessions_dir.clone(), config.node.clone()).map_err(thread)?,
            desk: Desk::start(Arc::clone(&status), config.rig.trigger_rate_hz).map_err(thread)?,
            quick_looks: QuickLooks::start(config.quick_look.clone(), status).map_err(thread)?,
            peers,
            worker: WorkerWatch::start(config.worker_results.clone()).map_err(thread)?,
            _watch: watch,
        })
    }
}
