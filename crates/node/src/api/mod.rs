// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node's HTTP API: axum on a small tokio runtime; every request becomes a [`Command`] to the node's thread.
//!
//! A request passes [`guard`] (is it for this node, from no foreign page, small, complete?), `auth` (who is the caller,
//! and may they?), `audit` (a line for each change) and reaches a route. Routes know nothing of all that: every request
//! but a GET needs the role `operate` and is audited. To add routes, write a module below `routes` with a function
//! `routes() -> OpenApiRouter<Shared>` and merge it in [`api`]. Pages and their files (outside `/api/`) go into
//! [`console`]; they need no token.

pub mod audit;
pub mod auth;
mod body;
mod connections;
mod console;
mod guard;
pub mod limits;
pub mod listing;
mod logins;
mod openapi;
mod patience;
mod refusal;
mod routes;
pub mod services;
mod transport;

pub use audit::{Audit, AuditLine};
pub use auth::{Auth, Caller};
pub use body::Body;
pub use refusal::Refusal;
pub use services::Services;
pub use transport::{Link, Listeners};

use crate::base::{Exit, Fault};
use crate::config::{NodeConfig, RigCamera};
use crate::control::command::{Command, Reply, SharedStatus};
use crate::control::status::{NodeStatus, WorkerStatus};
use crate::telemetry::{NodeFacts, Telemetry};
use axum::Router;
use axum::http::StatusCode;
use axum::middleware::from_fn_with_state;
use crossbeam_channel::{Sender, TrySendError};
use guard::Names;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use tokio::sync::oneshot;
use utoipa_axum::router::OpenApiRouter;

/// Id of the session whose outcome a client last fetched.
pub type OutcomeRead = Arc<AtomicU64>;

/// What the server knows of the node whose API it is.
pub struct NodeHandle {
    pub commands: Sender<Command>,
    /// What the node's thread publishes.
    pub status: SharedStatus,
    /// Gets the id of every session whose outcome was fetched.
    pub read: OutcomeRead,
    /// What the node's threads count.
    pub telemetry: Arc<Telemetry>,
}

/// What all requests share: the node's handle, its configuration, who may do what, and the services. Made once at the
/// start of the server.
pub struct State {
    pub node: NodeHandle,
    /// As it was read at the start.
    pub config: NodeConfig,
    pub auth: Auth,
    /// What was done by whom.
    pub audit: Audit,
    /// Captures, previews, quick looks, the other nodes.
    pub services: Services,
    names: Names,
    cookie: String,
    transport_warnings: Vec<String>,
}

/// [`State`], as handlers receive it.
pub type Shared = Arc<State>;

impl State {
    /// For a node that is reached through `listeners`. Refuses tokens that cannot be read.
    pub fn new(
        config: NodeConfig,
        node: NodeHandle,
        auth: Auth,
        services: Services,
        listeners: &Listeners,
    ) -> std::io::Result<Shared> {
        let audit = Audit::start(&config.api.audit, config.node.as_str())?;
        let names = Names::new(&config.api);
        // Cookies know no ports: two nodes on one machine must not overwrite each other's.
        let plain: String = config.node.as_str().chars().filter(char::is_ascii_alphanumeric).collect();
        let cookie = format!("fourdbody_{plain}");
        let transport_warnings = listeners.warnings().to_vec();
        Ok(Arc::new(Self { node, config, auth, audit, services, names, cookie, transport_warnings }))
    }

    /// The status as last published, with the API's own warnings.
    pub fn status(&self) -> NodeStatus {
        let mut status = match self.node.status.read() {
            Ok(status) => status.clone(),
            // The writer only assigns: what it left is whole.
            Err(poisoned) => poisoned.into_inner().clone(),
        };
        status.age_s = status.published.map_or(0.0, |at| at.elapsed().as_secs_f64());
        status.warnings.extend(self.transport_warnings.iter().cloned());
        status.warnings.extend(self.auth.warning());
        status.warnings.extend(self.audit.warning());
        status.worker = self.services.worker.state().map(|state| WorkerStatus {
            line: state.line(),
            running: state.is_running(),
            set_aside: state.set_aside,
        });
        status.judgements = self.node.telemetry.judgements(&self.facts(&status));
        status
    }

    /// The facts that telemetry needs of the node.
    fn facts(&self, status: &NodeStatus) -> NodeFacts {
        let config = &self.config;
        let bytes = |(_, camera): (_, &RigCamera)| camera.device.width * camera.device.height;
        let frame_set: usize = config.rig.cameras_of(&config.node).map(bytes).sum();
        NodeFacts {
            cameras: status.cameras.iter().map(|c| (c.id.clone(), c.problem.is_none())).collect(),
            hsu: status.hsu.problem.is_none(),
            free_bytes: status.free_bytes,
            reserve_bytes: config.reserve_bytes,
            bytes_per_second: frame_set as f64 * config.rig.trigger_rate_hz,
        }
    }

    /// Has the node carry a command out; returns when it has, or why it has not.
    pub async fn ask<T>(&self, command: impl FnOnce(Reply<T>) -> Command) -> Result<T, Refusal> {
        let (reply, answer) = oneshot::channel();
        self.node.commands.try_send(command(reply)).map_err(|error| Refusal {
            status: StatusCode::SERVICE_UNAVAILABLE,
            fault: Fault::new(
                Exit::Failure,
                match error {
                    TrySendError::Full(_) => "the node is busy with other commands; try again",
                    TrySendError::Disconnected(_) => "the node is shutting down",
                },
            ),
            retry_after: None,
        })?;
        let dropped = |_| Fault::new(Exit::Failure, "the node dropped the command; see its log");
        Ok(answer.await.map_err(dropped)??)
    }
}

/// All routes of the API with their description. Every one lies below `/api/`, but for the one of `routes::fitness`.
fn api() -> OpenApiRouter<Shared> {
    OpenApiRouter::with_openapi(openapi::base())
        .merge(routes::node::routes())
        .merge(routes::fitness::routes())
        .merge(routes::session::routes())
        .merge(routes::pictures::routes())
        .merge(routes::sessions::routes())
        .merge(routes::play::routes())
        .merge(routes::peers::routes())
        .merge(routes::login::routes())
}

/// The API's description, as JSON for `/api/v1/openapi.json`.
pub fn description() -> utoipa::openapi::OpenApi {
    let mut described = api().into_openapi();
    routes::peers::describe(&mut described);
    openapi::complete(described)
}

/// Everything that the node answers, guarded.
pub fn router(shared: Shared) -> Router {
    let (api, _) = api().split_for_parts();
    api.merge(console::pages())
        .fallback(async || {
            Refusal::new(StatusCode::NOT_FOUND, "there is nothing here; see /api/v1/openapi.json")
        })
        .method_not_allowed_fallback(async || {
            Refusal::new(StatusCode::METHOD_NOT_ALLOWED, "not with this method; see /api/v1/openapi.json")
        })
        .layer(from_fn_with_state(shared.clone(), audit::audited))
        .layer(from_fn_with_state(shared.clone(), auth::authenticate))
        .layer(from_fn_with_state(shared.clone(), guard::guard))
        .with_state(shared)
}
