// SPDX-License-Identifier: MIT OR Apache-2.0
//! This node's part in a session: prepare, start, stop, abort.

use crate::api::Shared;
use crate::api::body::Body;
use crate::api::refusal::Refusal;
use crate::base::Fault;
use crate::control::command::Command;
use crate::control::request::{KeepRequest, SessionRequest};
use crate::control::status::{SessionCommand, path};
use axum::extract::State;
use axum::http::StatusCode;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(prepare))
        .routes(routes!(start))
        .routes(routes!(keep))
        .routes(routes!(stop))
        .routes(routes!(abort))
}

#[derive(utoipa::IntoResponses)]
#[expect(dead_code, reason = "the description is made of it")]
enum Outcome {
    /// Done.
    #[response(status = 204)]
    Done,
    /// It does not fit the node's state, or the request is wrong in itself.
    #[response(status = 409)]
    Conflict(Fault),
    /// The node failed at it.
    #[response(status = 500)]
    Failed(Fault),
    /// A device failed, or the node is busy.
    #[response(status = 503)]
    Unavailable(Fault),
}

/// Prepares a session; answers when every camera is armed and verified and the HSU link has armed.
#[utoipa::path(post, path = path::PREPARE, tag = "session", request_body = SessionRequest, responses(Outcome))]
async fn prepare(
    State(shared): State<Shared>,
    Body(request): Body<SessionRequest>,
) -> Result<StatusCode, Refusal> {
    shared.ask(|reply| Command::Prepare(request, reply)).await.map(|()| StatusCode::NO_CONTENT)
}

/// Starts the train of triggers. The HSU refuses unless every node of the session is ready.
#[utoipa::path(post, path = path::START, tag = "session", request_body = SessionCommand, responses(Outcome))]
async fn start(
    State(shared): State<Shared>,
    Body(command): Body<SessionCommand>,
) -> Result<StatusCode, Refusal> {
    shared.ask(|reply| Command::Start(command, reply)).await.map(|()| StatusCode::NO_CONTENT)
}

/// Records what is held from a trigger of the past on: that becomes trigger 0, on all nodes the same.
#[utoipa::path(post, path = path::KEEP, tag = "session", request_body = KeepRequest, responses(Outcome))]
async fn keep(State(shared): State<Shared>, Body(request): Body<KeepRequest>) -> Result<StatusCode, Refusal> {
    shared.ask(|reply| Command::Keep(request, reply)).await.map(|()| StatusCode::NO_CONTENT)
}

/// Ends the train after the current trigger; the recording is closed with its verdict.
#[utoipa::path(post, path = path::STOP, tag = "session", request_body = SessionCommand, responses(Outcome))]
async fn stop(
    State(shared): State<Shared>,
    Body(command): Body<SessionCommand>,
) -> Result<StatusCode, Refusal> {
    shared.ask(|reply| Command::Stop(command, reply)).await.map(|()| StatusCode::NO_CONTENT)
}

/// Gives the session up. What was recorded is kept; a session without a trigger leaves nothing.
#[utoipa::path(post, path = path::ABORT, tag = "session", request_body = SessionCommand, responses(Outcome))]
async fn abort(
    State(shared): State<Shared>,
    Body(command): Body<SessionCommand>,
) -> Result<StatusCode, Refusal> {
    shared.ask(|reply| Command::Abort(command, reply)).await.map(|()| StatusCode::NO_CONTENT)
}
