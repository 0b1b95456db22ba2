//! The API's server: axum on a small tokio runtime; every request becomes a [`Command`] to the node's thread.

use super::dto::{NodeStatus, SessionCommand, path};
use crate::cmds::Exit;
use crate::session::state::{Fault, SessionRequest};
use axum::extract::{DefaultBodyLimit, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use crossbeam_channel::{Sender, TrySendError};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, RwLock};
use tokio::net::TcpListener;
use tokio::sync::oneshot;

/// Answers a command.
pub type Reply = oneshot::Sender<Result<(), Fault>>;

/// What the API asks of the node.
#[derive(Debug)]
pub enum Command {
    /// Prepare a session; answered when the node is ready.
    Prepare(SessionRequest, Reply),
    /// Start the train.
    Start(SessionCommand, Reply),
    /// End the train after the current trigger.
    Stop(SessionCommand, Reply),
    /// Give the session up.
    Abort(SessionCommand, Reply),
}

/// The node's status as last published by its thread.
pub type SharedStatus = Arc<RwLock<NodeStatus>>;

/// Id of the session whose outcome a client last fetched.
pub type OutcomeRead = Arc<AtomicU64>;

#[derive(Clone)]
struct Node {
    commands: Sender<Command>,
    status: SharedStatus,
    read: OutcomeRead,
}

const BODY_BYTES_MAX: usize = 64 << 10;

/// Serves until `shutdown` resolves; answers that are under way are finished. Notes in `read` whose outcome was
/// fetched.
pub async fn serve(
    listener: TcpListener,
    commands: Sender<Command>,
    status: SharedStatus,
    read: OutcomeRead,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> std::io::Result<()> {
    let router = Router::new()
        .route(path::STATUS, get(get_status))
        .route(path::PREPARE, post(prepare))
        .route(path::START, post(start))
        .route(path::STOP, post(stop))
        .route(path::ABORT, post(abort))
        .layer(DefaultBodyLimit::max(BODY_BYTES_MAX))
        .with_state(Node { commands, status, read });
    axum::serve(listener, router).with_graceful_shutdown(shutdown).await
}

async fn get_status(State(node): State<Node>) -> Json<NodeStatus> {
    let status = match node.status.read() {
        Ok(status) => status.clone(),
        // The writer only assigns: what it left is whole.
        Err(poisoned) => poisoned.into_inner().clone(),
    };
    if let Some(session) = status.session.as_ref().filter(|session| session.outcome.is_some()) {
        node.read.store(session.session_id, Ordering::Release);
    }
    Json(status)
}

async fn prepare(State(node): State<Node>, Json(request): Json<SessionRequest>) -> Response {
    ask(&node, |reply| Command::Prepare(request, reply)).await
}

async fn start(State(node): State<Node>, Json(command): Json<SessionCommand>) -> Response {
    ask(&node, |reply| Command::Start(command, reply)).await
}

async fn stop(State(node): State<Node>, Json(command): Json<SessionCommand>) -> Response {
    ask(&node, |reply| Command::Stop(command, reply)).await
}

async fn abort(State(node): State<Node>, Json(command): Json<SessionCommand>) -> Response {
    ask(&node, |reply| Command::Abort(command, reply)).await
}

async fn ask(node: &Node, command: impl FnOnce(Reply) -> Command) -> Response {
    let (reply, answer) = oneshot::channel();
    let fault = match node.commands.try_send(command(reply)) {
        Ok(()) => match answer.await {
            Ok(Ok(())) => return StatusCode::NO_CONTENT.into_response(),
            Ok(Err(fault)) => fault,
            Err(_) => Fault::new(Exit::Failure, "the node dropped the command; look into its log"),
        },
        Err(TrySendError::Full(_)) => {
            Fault::new(Exit::Failure, "the node is busy with other commands; try again")
        }
        Err(TrySendError::Disconnected(_)) => Fault::new(Exit::Failure, "the node is shutting down"),
    };
    let status = match fault.exit {
        code if code == Exit::Usage as u8 => StatusCode::CONFLICT,
        code if code == Exit::Device as u8 => StatusCode::SERVICE_UNAVAILABLE,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    };
    (status, Json(fault)).into_response()
}
