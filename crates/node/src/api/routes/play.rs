// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sessions that the worker of this node's machine has reconstructed, frame set by frame set, for a player.

use super::bytes;
use crate::api::Shared;
use crate::api::refusal::Refusal;
use crate::base::{Exit, Fault};
use crate::control::status::{PlayableTakes, path};
use crate::play::Described;
use crate::play::desk::{Made, Wanted};
use axum::Json;
use axum::extract::{Path, State};
use axum::response::Response;
use tokio::sync::oneshot;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(get_playable))
        .routes(routes!(get_frame_sets))
        .routes(routes!(get_frame_set))
}

/// The sessions that can be played: what the worker of this node's machine has reconstructed.
#[utoipa::path(get, path = path::PLAYABLE, tag = "sessions",
    responses((status = 200, description = "What is known.", body = PlayableTakes)))]
async fn get_playable(State(shared): State<Shared>) -> Json<PlayableTakes> {
    Json(shared.services.worker.playable())
}

/// What a player must know before it asks for frame sets: which triggers have a cloud, and why others have none.
#[utoipa::path(get, path = path::FRAME_SETS, tag = "sessions",
    params(("name" = String, Path, description = "The session's name.")),
    responses(
        (status = 200, description = "The session as a sequence.", body = Described),
        (status = 404, description = "No worker of this machine has reconstructed it.", body = Fault),
        (status = 409, description = "The node is in a session: nothing is made.", body = Fault),
        (status = 500, description = "The results cannot be read.", body = Fault),
        (status = 503, description = "Too many ask, or it takes too long.", body = Fault)))]
async fn get_frame_sets(State(shared): State<Shared>, Path(name): Path<String>) -> Result<Response, Refusal> {
    made(&shared, &name, Wanted::Description, "application/json").await
}

/// One merged frame set: a zlib stream of twelve planes of bytes (low and high bytes of x, y and z in tenths of a
/// millimetre, each the difference from the point before; three of the normal, intensity, camera, uncertainty).
#[utoipa::path(get, path = path::FRAME_SET, tag = "sessions",
    params(
        ("name" = String, Path, description = "The session's name."),
        ("trigger" = u64, Path, description = "The frame set.")),
    responses(
        (status = 200, description = "The packed points.", content_type = "application/octet-stream", body = Vec<u8>),
        (status = 400, description = "The trigger is not a number."),
        (status = 404, description = "There is no such frame set, or its files cannot be read.", body = Fault),
        (status = 409, description = "The node is in a session: nothing is made.", body = Fault),
        (status = 500, description = "The results cannot be read.", body = Fault),
        (status = 503, description = "Too many ask, or it takes too long.", body = Fault)))]
async fn get_frame_set(
    State(shared): State<Shared>,
    Path((name, trigger)): Path<(String, u64)>,
) -> Result<Response, Refusal> {
    made(&shared, &name, Wanted::FrameSet(trigger), "application/octet-stream").await
}

async fn made(shared: &Shared, name: &str, wanted: Wanted, kind: &'static str) -> Result<Response, Refusal> {
    // Only sessions that the worker has done: no requested name becomes a path.
    let unknown =
        || Refusal::not_found(format!("no session {name:?} that a worker of this machine has reconstructed"));
    let done = shared.services.worker.done(name).ok_or_else(unknown)?;
    let (reply, answer) = oneshot::channel();
    shared.services.desk.ask(done, wanted, reply)?;
    match answer.await.map_err(|_| Fault::new(Exit::Device, "the node is shutting down"))?? {
        Made::Bytes(made) => Ok(bytes(kind, made.as_ref().clone())),
        Made::Nothing(reason) => Err(Refusal::not_found(reason)),
    }
}
