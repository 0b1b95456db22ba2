// SPDX-License-Identifier: MIT OR Apache-2.0
//! What this node has recorded, and quick looks at it.

use super::{Done, bytes};
use crate::api::Shared;
use crate::api::body::{Body, NoBody};
use crate::api::listing::LISTED_MAX;
use crate::api::refusal::Refusal;
use crate::base::ids::SessionName;
use crate::base::{Exit, Fault, regular};
use crate::control::status::{CalibrationLights, FreeName, path};
use crate::preview::quick_look::Look;
use crate::record::catalogue::CatalogueEntry;
use crate::record::node_dir;
use crate::record::remark::Remark;
use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::StatusCode;
use axum::response::Response;
use serde::Deserialize;
use std::fmt::Display;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(get_sessions))
        .routes(routes!(get_session))
        .routes(routes!(get_free_name))
        .routes(routes!(remark))
        .routes(routes!(get_quick_look, ask_quick_look))
        .routes(routes!(get_cloud))
        .routes(routes!(get_calibration_lights))
        .routes(routes!(get_calibration_plot))
}

/// Which of the recordings are listed.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
struct Choice {
    /// Length of the list, 1 to 1000: the newest recordings.
    #[serde(default = "fifty")]
    #[param(minimum = 1, maximum = 1000)]
    limit: usize,
    /// Only those with this text in name, subject or notes, in small or capital letters.
    #[serde(default)]
    search: String,
}

/// Sessions in the answer with calibration lights: as many as a console lists.
const LIGHTS_MAX: usize = 200;

fn fifty() -> usize {
    50
}

/// This node's recordings, newest first.
#[utoipa::path(get, path = path::SESSIONS, tag = "sessions", params(Choice),
    responses(
        (status = 200, description = "The recordings.", body = Vec<CatalogueEntry>),
        (status = 400, description = "The query is not what is described."),
        (status = 503, description = "Too many ask at the same time.", body = Fault)))]
async fn get_sessions(
    State(shared): State<Shared>,
    Query(choice): Query<Choice>,
) -> Result<Response, Refusal> {
    let listed = shared.services.listing.newest(choice.limit.clamp(1, LISTED_MAX), &choice.search).await?;
    Ok(bytes("application/json", listed))
}

/// One recording of this node.
#[utoipa::path(get, path = path::SESSION, tag = "sessions",
    params(("name" = String, Path, description = "The session's name.")),
    responses(
        (status = 200, description = "The recording.", body = CatalogueEntry),
        (status = 404, description = "This node has no such session.", body = Fault),
        (status = 503, description = "Too many ask at the same time.", body = Fault)))]
async fn get_session(State(shared): State<Shared>, Path(name): Path<String>) -> Result<Response, Refusal> {
    let found = shared.services.listing.one(name.clone()).await?;
    Ok(bytes("application/json", found.ok_or_else(|| not_found(&name))?))
}

/// This name, or the first number after it under which nothing is recorded here: `walk`, `walk-02`, and so on.
#[utoipa::path(get, path = path::FREE_NAME, tag = "sessions",
    params(("name" = String, Path, description = "The name that is wanted.")),
    responses(
        (status = 200, description = "A free name.", body = FreeName),
        (status = 409, description = "No session can have this name, or all its numbers are taken.", body = Fault),
        (status = 503, description = "Too many ask at the same time.", body = Fault)))]
async fn get_free_name(
    State(shared): State<Shared>,
    Path(wanted): Path<String>,
) -> Result<Json<FreeName>, Refusal> {
    let name = shared.services.listing.free(wanted).await?.map_err(|e| Fault::new(Exit::Usage, e))?;
    Ok(Json(FreeName { name }))
}

/// Stores a rating and a note beside a recording. Those that were stored before are replaced.
#[utoipa::path(post, path = path::REMARK, tag = "sessions", request_body = Remark,
    params(("name" = String, Path, description = "The session's name.")),
    responses(
        (status = 204, description = "It is on the disk."),
        (status = 404, description = "This node has no such session.", body = Fault),
        (status = 409, description = "The note is no line of printable text.", body = Fault),
        (status = 500, description = "It cannot be written.", body = Fault)))]
async fn remark(State(shared): State<Shared>, Path(name): Path<String>, Body(remark): Body<Remark>) -> Done {
    remark.check().map_err(|reason| Fault::new(Exit::Usage, reason))?;
    // A session's name is one component of a path: nothing else is written to.
    let parsed = SessionName::parse(&name).map_err(|_| not_found(&name))?;
    let (sessions_dir, node) = (shared.config.sessions_dir.clone(), shared.config.node.clone());
    let session = sessions_dir.join(parsed.as_str());
    let written = tokio::task::spawn_blocking(move || {
        let there = node_dir(&session, &node).is_dir();
        there.then(|| remark.save(&session, &node))
    });
    let failed = |e: &dyn Display| {
        Fault::new(Exit::Failure, format!("the remark on session {name} cannot be written: {e}"))
    };
    let written = written.await.map_err(|e| failed(&e))?;
    written.ok_or_else(|| not_found(&name))?.map_err(|e| failed(&e))?;
    Ok(StatusCode::NO_CONTENT)
}

/// How far the look at a session is. Every session is looked at when it has been recorded, where that is configured.
#[utoipa::path(get, path = path::QUICK_LOOK, tag = "sessions",
    params(("name" = String, Path, description = "The session's name.")),
    responses((status = 200, description = "The look.", body = Look)))]
async fn get_quick_look(State(shared): State<Shared>, Path(name): Path<String>) -> Json<Look> {
    Json(shared.services.quick_looks.of(&name))
}

/// Asks for a look at a session: a few frame sets, reconstructed at idle priority.
#[utoipa::path(post, path = path::QUICK_LOOK, tag = "sessions",
    params(("name" = String, Path, description = "The session's name.")),
    responses(
        (status = 202, description = "It is made, or was made already."),
        (status = 409, description = "Not configured, no such session, or another one is under way.", body = Fault)))]
async fn ask_quick_look(State(shared): State<Shared>, Path(name): Path<String>, _: NoBody) -> Done {
    shared.services.quick_looks.ask(&name).map_err(|reason| Fault::new(Exit::Usage, reason))?;
    Ok(StatusCode::ACCEPTED)
}

/// The cloud of one frame set of a look, this node's cameras: 12 bytes a point, little-endian: x, y, z (i16, tenths of
/// a millimetre), normal (three i8, 127ths), intensity (u8, 255ths), camera (u8), zero.
#[utoipa::path(get, path = path::QUICK_LOOK_CLOUD, tag = "sessions",
    params(
        ("name" = String, Path, description = "The session's name."),
        ("trigger" = u64, Path, description = "The frame set.")),
    responses(
        (status = 200, description = "The points.", content_type = "application/octet-stream", body = Vec<u8>),
        (status = 400, description = "The trigger is not a number."),
        (status = 404, description = "There is no such cloud (yet).", body = Fault)))]
async fn get_cloud(
    State(shared): State<Shared>,
    Path((name, trigger)): Path<(String, u64)>,
) -> Result<Response, Refusal> {
    let cloud = shared.services.quick_looks.cloud(&name, trigger).ok_or_else(|| {
        Refusal::not_found(format!("no cloud of trigger {trigger} in the quick look at session {name:?}"))
    })?;
    Ok(bytes("application/octet-stream", cloud.as_ref().clone()))
}

/// Whether the calibration held, session by session, the last 200: what the worker of this node's machine has found.
#[utoipa::path(get, path = path::CALIBRATION_LIGHTS, tag = "sessions",
    responses((status = 200, description = "What is known.", body = CalibrationLights)))]
async fn get_calibration_lights(State(shared): State<Shared>) -> Json<CalibrationLights> {
    Json(shared.services.worker.lights(LIGHTS_MAX))
}

/// How far each device has moved what it sees since its calibration, over time: the plot of the worker of this node's
/// machine.
#[utoipa::path(get, path = path::CALIBRATION_PLOT, tag = "sessions",
    responses(
        (status = 200, description = "The plot.", content_type = "image/svg+xml", body = String),
        (status = 404, description = "No worker has checked a session yet.", body = Fault)))]
async fn get_calibration_plot(State(shared): State<Shared>) -> Result<Response, Refusal> {
    let plot = shared.services.worker.plot();
    // The results may lie on a share that takes its time.
    let read = tokio::task::spawn_blocking(move || regular::read(&plot?, regular::TEXT_BYTES).ok()).await;
    let none = || Refusal::not_found("no worker of this machine has checked a session yet");
    Ok(bytes("image/svg+xml", read.ok().flatten().ok_or_else(none)?))
}

fn not_found(name: &str) -> Refusal {
    Refusal::not_found(format!("no session {name:?} at this node"))
}
