// SPDX-License-Identifier: MIT OR Apache-2.0
//! This node's part in a session, step by step; and captures on all nodes, which this one runs.

use super::Done;
use crate::api::Shared;
use crate::api::auth::Caller;
use crate::api::body::{Body, NoBody};
use crate::api::refusal::Refusal;
use crate::base::{Exit, Fault};
use crate::capture::coordinator::CaptureState;
use crate::capture::series::Series;
use crate::control::command::{Command, Reply};
use crate::control::request::{KeepRequest, SessionRequest};
use crate::control::status::{AbortReason, CaptureBegun, SessionCommand, path};
use axum::Json;
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
        .routes(routes!(get_capture, begin))
        .routes(routes!(preview))
        .routes(routes!(record))
        .routes(routes!(stop_capture))
        .routes(routes!(abort_capture))
}

#[derive(utoipa::IntoResponses)]
#[expect(dead_code, reason = "the description is made of it")]
enum Outcome {
    /// The node has carried it out.
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

/// Has the node's thread carry out a command that has no other answer than success.
async fn carry_out(shared: &Shared, command: impl FnOnce(Reply) -> Command) -> Done {
    shared.ask(command).await.map(|()| StatusCode::NO_CONTENT)
}

/// Prepares a session; answers when every camera is armed and verified and the HSU link has armed.
#[utoipa::path(post, path = path::PREPARE, tag = "session", request_body = SessionRequest, responses(Outcome))]
async fn prepare(State(shared): State<Shared>, Body(request): Body<SessionRequest>) -> Done {
    carry_out(&shared, |reply| Command::Prepare(request, reply)).await
}

/// Starts the train of triggers. The HSU refuses unless every node of the session is ready.
#[utoipa::path(post, path = path::START, tag = "session", request_body = SessionCommand, responses(Outcome))]
async fn start(State(shared): State<Shared>, Body(command): Body<SessionCommand>) -> Done {
    carry_out(&shared, |reply| Command::Start(command, reply)).await
}

/// Records the held frames from a trigger of the past on: that becomes trigger 0, on all nodes the same.
#[utoipa::path(post, path = path::KEEP, tag = "session", request_body = KeepRequest, responses(Outcome))]
async fn keep(State(shared): State<Shared>, Body(request): Body<KeepRequest>) -> Done {
    carry_out(&shared, |reply| Command::Keep(request, reply)).await
}

/// Ends the train after the current trigger; the recording is closed with its verdict.
#[utoipa::path(post, path = path::STOP, tag = "session", request_body = SessionCommand, responses(Outcome))]
async fn stop(State(shared): State<Shared>, Body(command): Body<SessionCommand>) -> Done {
    carry_out(&shared, |reply| Command::Stop(command, reply)).await
}

/// Gives the session up. What was recorded is kept; a session without a trigger leaves nothing.
#[utoipa::path(post, path = path::ABORT, tag = "session", request_body = SessionCommand, responses(Outcome))]
async fn abort(State(shared): State<Shared>, Body(command): Body<SessionCommand>) -> Done {
    carry_out(&shared, |reply| Command::Abort(command, reply)).await
}

/// The capture that this node runs, or the last one that it ran; `null` before the first.
#[utoipa::path(get, path = path::CAPTURE, tag = "capture",
    responses((status = 200, description = "The capture.", body = Option<CaptureState>)))]
async fn get_capture(State(shared): State<Shared>) -> Json<Option<CaptureState>> {
    Json(shared.services.coordinator.state())
}

/// Begins a capture on this node and its peers: prepares all, counts down, starts the train, and follows it to the
/// verdict.
#[utoipa::path(post, path = path::CAPTURE, tag = "capture", request_body = Series, responses(
    (status = 202, description = "It has begun.", body = CaptureBegun),
    (status = 409, description = "A capture is under way, or the request is wrong in itself.", body = Fault),
    (status = 500, description = "The node failed at it.", body = Fault)))]
async fn begin(
    State(shared): State<Shared>,
    caller: Caller,
    Body(series): Body<Series>,
) -> Result<(StatusCode, Json<CaptureBegun>), Refusal> {
    let number = shared.services.coordinator.begin(series, caller.name)?;
    Ok((StatusCode::ACCEPTED, Json(CaptureBegun { number })))
}

/// Somebody looks at the pictures: while no session runs, the cameras run without recording, until two seconds after the
/// last request. Whatever else a node is asked for ends the preview first.
#[utoipa::path(post, path = path::PREVIEW, tag = "preview", responses(
    (status = 202, description = "The cameras are started."),
    (status = 204, description = "The preview goes on, or a session keeps the cameras busy, or they are not ready."),
    (status = 500, description = "The node failed at it.", body = Fault)))]
async fn preview(State(shared): State<Shared>, caller: Caller, _: NoBody) -> Done {
    let begins = shared.services.coordinator.preview(caller.name)?;
    Ok(if begins { StatusCode::ACCEPTED } else { StatusCode::NO_CONTENT })
}

/// Keeps the seconds that are held, and records: for a capture with `pre_trigger_s` that this node runs.
#[utoipa::path(post, path = path::CAPTURE_RECORD, tag = "capture", responses(Outcome))]
async fn record(State(shared): State<Shared>, _: NoBody) -> Done {
    shared.services.coordinator.record()?;
    Ok(StatusCode::NO_CONTENT)
}

/// Ends the train after the current trigger, no matter who started it; what was recorded gets its verdict.
#[utoipa::path(post, path = path::CAPTURE_STOP, tag = "capture", responses(Outcome))]
async fn stop_capture(State(shared): State<Shared>, _: NoBody) -> Done {
    if shared.services.coordinator.stop().is_ok() {
        return Ok(StatusCode::NO_CONTENT);
    }
    let command = SessionCommand { session_id: session_under_way(&shared)?, reason: None };
    carry_out(&shared, |reply| Command::Stop(command, reply)).await
}

/// Gives the session up on all nodes, no matter who started it. What was recorded is kept.
#[utoipa::path(post, path = path::CAPTURE_ABORT, tag = "capture", request_body = AbortReason, responses(Outcome))]
async fn abort_capture(
    State(shared): State<Shared>,
    caller: Caller,
    Body(request): Body<AbortReason>,
) -> Done {
    let reason = request.reason.unwrap_or_else(|| format!("aborted by {}", caller.name));
    if shared.services.coordinator.abort(&reason).is_ok() {
        return Ok(StatusCode::NO_CONTENT);
    }
    let command = SessionCommand { session_id: session_under_way(&shared)?, reason: Some(reason) };
    carry_out(&shared, |reply| Command::Abort(command, reply)).await
}

/// The session that this node is in without having begun it.
fn session_under_way(shared: &Shared) -> Result<u64, Refusal> {
    let session = shared.status().session.filter(|session| session.outcome.is_none());
    let session = session.map(|session| session.session_id);
    session.ok_or_else(|| Fault::new(Exit::Usage, "no session is under way at this node").into())
}
