// SPDX-License-Identifier: MIT OR Apache-2.0
//! Devices, and how they are set.

use crate::api::Shared;
use crate::config::CameraConfig;
use crate::control::status::{CameraSettings, Devices, Settings, path};
use axum::Json;
use axum::extract::State;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(devices)).routes(routes!(settings))
}

/// Cameras and HSU: who they are, or why they cannot be used.
#[utoipa::path(get, path = path::DEVICES, tag = "devices", responses((status = 200, description = "The node's devices.", body = Devices)))]
async fn devices(State(shared): State<Shared>) -> Json<Devices> {
    let status = shared.status();
    Json(Devices { cameras: status.cameras, hsu: status.hsu })
}

/// What is configured, and what the cameras read back.
#[utoipa::path(get, path = path::SETTINGS, tag = "devices", responses((status = 200, description = "The node's settings.", body = Settings)))]
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
