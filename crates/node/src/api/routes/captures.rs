// SPDX-License-Identifier: MIT OR Apache-2.0
//! Captures on all nodes, run by this one: begin, follow, stop, abort.

use crate::api::Shared;
use crate::api::auth::Caller;
use crate::api::body::{Body, NoBody};
use crate::api::refusal::Refusal;
use crate::base::{Exit, Fault};
use crate::capture::coordinator::CaptureState;
use crate::capture::series::Series;
use crate::control::command::Command;
use crate::control::status::{AbortReason, CaptureBegun, SessionCommand, path};
use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(get_capture, begin))
        .routes(routes!(record))
        .routes(routes!(stop))
        .routes(routes!(abort))
}

/// The capture that this node runs, or the last one that it ran; `null` before the first.
#[utoipa::path(get, path = path::CAPTURE, tag = "capture",
    responses((status = 200, description = "The capture.", body = Option<CaptureState>)))]
async fn get_capture(State(shared): State<Shared>) -> Json<Option<CaptureState>> {
    Json(shared.services.coordinator.state())
}

/// Begins a capture on this node and its peers: prepares all, counts down, starts the train, and follows it to the verdict.
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

#[derive(utoipa::IntoResponses)]
#[expect(dead_code, reason = "the description is made of it")]
enum Told {
    /// It was told to end.
    #[response(status = 204)]
    Done,
    /// Nothing is under way.
    #[response(status = 409)]
    Idle(Fault),
    /// The node failed at it.
    #[response(status = 500)]
    Failed(Fault),
    /// A device failed, or the node is busy.
    #[response(status = 503)]
    Unavailable(Fault),
}

/// Keeps the seconds that are held, and records: for a capture with `pre_trigger_s` that this node runs.
#[utoipa::path(post, path = path::CAPTURE_RECORD, tag = "capture", responses(Told))]
async fn record(State(shared): State<Shared>, _: NoBody) -> Result<StatusCode, Refusal> {
    shared.services.coordinator.record()?;
    Ok(StatusCode::NO_CONTENT)
}

/// Ends the train after the current trigger, whoever has started it; what was recorded gets its verdict.
#[utoipa::path(post, path = path::CAPTURE_STOP, tag = "capture", responses(Told))]
async fn stop(State(shared): State<Shared>, _: NoBody) -> Result<StatusCode, Refusal> {
    if shared.services.coordinator.stop().is_err() {
        let command = SessionCommand { session_id: session_under_way(&shared)?, reason: None };
        shared.ask(|reply| Command::Stop(command, reply)).await?;
    }
    Ok(StatusCode::NO_CONTENT)
}

/// Gives the session up on all nodes, whoever has started it. What was recorded is kept.
#[utoipa::path(post, path = path::CAPTURE_ABORT, tag = "capture", request_body = AbortReason, responses(Told))]
async fn abort(
    State(shared): State<Shared>,
    caller: Caller,
    Body(request): Body<AbortReason>,
) -> Result<StatusCode, Refusal> {
    let reason = request.reason.unwrap_or_else(|| format!("aborted by {}", caller.name));
    if shared.services.coordinator.abort(&reason).is_err() {
        let command = SessionCommand { session_id: session_under_way(&shared)?, reason: Some(reason) };
        shared.ask(|reply| Command::Abort(command, reply)).await?;
    }
    Ok(StatusCode::NO_CONTENT)
}

/// The session that this node is in without having begun it.
fn session_under_way(shared: &Shared) -> Result<u64, Refusal> {
    let session = shared.status().session.filter(|session| session.outcome.is_none());
    let session = session.map(|session| session.session_id);
    session.ok_or_else(|| Fault::new(Exit::Usage, "no session is under way at this node").into())
}
