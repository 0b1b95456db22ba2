// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node itself: its status and health, its devices and their settings, its metrics, the description of its API.

use crate::api::body::Body;
use crate::api::refusal::Refusal;
use crate::api::{Shared, description};
use crate::base::Fault;
use crate::config::CameraConfig;
use crate::control::command::Command;
use crate::control::request::ExposureRequest;
use crate::control::status::{
    CameraSettings, Devices, ExposureSet, Health, Metrics, NodeStatus, Settings, path,
};
use crate::telemetry::{Family, exposition};
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderName, StatusCode, header};
use std::sync::atomic::Ordering;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(get_status))
        .routes(routes!(health))
        .routes(routes!(devices))
        .routes(routes!(settings))
        .routes(routes!(expose))
        .routes(routes!(metrics_text))
        .routes(routes!(metrics))
        .routes(routes!(get_description))
}

/// The node's state: devices, disk, warnings, and the session in progress or the last one.
#[utoipa::path(get, path = path::STATUS, tag = "node",
    responses((status = 200, description = "The node's state.", body = NodeStatus)))]
async fn get_status(State(shared): State<Shared>) -> Json<NodeStatus> {
    let status = shared.status();
    if let Some(session) = status.session.as_ref().filter(|session| session.outcome.is_some()) {
        shared.node.read.store(session.session_id, Ordering::Release);
    }
    Json(status)
}

/// Whether a session could start now, and why not.
#[utoipa::path(get, path = path::HEALTH, tag = "node", responses(
    (status = 200, description = "It could.", body = Health),
    (status = 503, description = "It could not.", body = Health),
))]
async fn health(State(shared): State<Shared>) -> (StatusCode, Json<Health>) {
    let (status, reserve_bytes) = (shared.status(), shared.config.reserve_bytes);
    let mut reasons = status.problems();
    if status.free_bytes <= reserve_bytes {
        reasons.push(format!(
            "{} MiB are free in {}, of which {} MiB are kept free (storage.reserve_mib); delete or move sessions",
            status.free_bytes >> 20,
            status.sessions_dir.display(),
            reserve_bytes >> 20
        ));
    }
    let healthy = reasons.is_empty();
    let code = if healthy { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (code, Json(Health { healthy, reasons }))
}

/// Cameras and HSU: their identities, or why they cannot be used.
#[utoipa::path(get, path = path::DEVICES, tag = "devices",
    responses((status = 200, description = "The node's devices.", body = Devices)))]
async fn devices(State(shared): State<Shared>) -> Json<Devices> {
    let status = shared.status();
    Json(Devices { cameras: status.cameras, hsu: status.hsu })
}

/// The configured settings, and the values that the cameras read back.
#[utoipa::path(get, path = path::SETTINGS, tag = "devices",
    responses((status = 200, description = "The node's settings.", body = Settings)))]
async fn settings(State(shared): State<Shared>) -> Json<Settings> {
    let config = &shared.config;
    let camera = |camera: &CameraConfig| CameraSettings {
        id: camera.id.clone(),
        address: camera.address.clone(),
        size: config
            .rig
            .cameras()
            .find(|(_, known)| known.id == camera.id)
            .map_or([0, 0], |(_, known)| [known.device.width, known.device.height]),
        configured: camera.words.spoken().into_iter().chain(camera.settings.iter().cloned()).collect(),
        read_back: shared.node.telemetry.applied_to(&camera.id),
    };
    Json(Settings {
        node: config.node.to_string(),
        rig: config.rig.name.clone(),
        trigger_rate_hz: config.rig.trigger_rate_hz,
        sessions_dir: config.sessions_dir.display().to_string(),
        reserve_bytes: config.reserve_bytes,
        segment_bytes: config.segment_bytes,
        buffers_per_camera: config.buffers_per_camera,
        packet_bytes: config.packet_bytes,
        socket: config.socket,
        silence_gate_ms: u64::try_from(config.silence_gate.as_millis()).unwrap_or(u64::MAX),
        when_full: config.when_full,
        on_camera_lost: config.on_camera_lost,
        on_link_lost: config.on_link_lost,
        cameras: config.cameras.iter().map(camera).collect(),
    })
}

/// Sets exposure and gain of this node's cameras of some heads, and reads them back: of all these cameras, or of none.
/// Only between sessions. It holds until they are set again or the node is restarted; the node file stays as it is.
#[utoipa::path(post, path = path::EXPOSURE, tag = "devices", request_body = ExposureRequest,
    responses(
        (status = 200, description = "The requested values, and those that the cameras took; none on other nodes.",
            body = ExposureSet),
        (status = 409, description = "The node is in a session, or the rig or the cameras refuse it.", body = Fault),
        (status = 500, description = "The node failed at it.", body = Fault),
        (status = 503, description = "A camera failed, or the node is busy.", body = Fault)))]
async fn expose(
    State(shared): State<Shared>,
    Body(request): Body<ExposureRequest>,
) -> Result<Json<ExposureSet>, Refusal> {
    shared.ask(|reply| Command::Expose(request, reply)).await.map(Json)
}

fn families(shared: &Shared) -> Vec<Family> {
    shared.node.telemetry.metrics(&shared.facts(&shared.status()))
}

/// All metrics in Prometheus' text format 0.0.4.
#[utoipa::path(get, path = path::METRICS, tag = "metrics",
    responses((status = 200, description = "Metrics.", body = String, content_type = "text/plain")))]
async fn metrics_text(State(shared): State<Shared>) -> ([(HeaderName, &'static str); 1], String) {
    let kind = [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")];
    (kind, exposition::text(&families(&shared)))
}

/// The same metrics as JSON.
#[utoipa::path(get, path = path::METRICS_JSON, tag = "metrics",
    responses((status = 200, description = "Metrics.", body = Metrics)))]
async fn metrics(State(shared): State<Shared>) -> Json<Metrics> {
    Json(Metrics { families: families(&shared) })
}

/// This description of the API.
#[utoipa::path(get, path = path::OPENAPI, tag = "node",
    responses((status = 200, description = "OpenAPI 3.1", body = serde_json::Value)))]
async fn get_description() -> Json<utoipa::openapi::OpenApi> {
    Json(description())
}
