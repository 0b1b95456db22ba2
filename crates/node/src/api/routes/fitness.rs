// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether the node's own parts are fit, for monitors that have no token. It is open to all who can reach the node, so it
//! says how many devices are missing, and neither which nor where; nothing of sessions, people or paths.

use crate::api::Shared;
use crate::control::status::{Fitness, NodeStatus, path};
use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// A status that is older, s: the node's thread hangs, and systemd's watchdog is about to end the process.
const STALE_S: f64 = 30.0;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(fitness))
}

/// Whether cameras, HSU and disk are fit; needs no token, and names nothing.
#[utoipa::path(get, path = path::FITNESS, tag = "node", responses(
    (status = 200, description = "The node's parts are fit.", body = Fitness),
    (status = 503, description = "They are not.", body = Fitness),
))]
async fn fitness(State(shared): State<Shared>) -> (StatusCode, Json<Fitness>) {
    let reasons = reasons(&shared.status(), shared.config.reserve_bytes);
    let code = if reasons.is_empty() { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (code, Json(Fitness { fit: reasons.is_empty(), reasons }))
}

/// A sentence for each part that is not fit, made of numbers alone.
fn reasons(status: &NodeStatus, reserve_bytes: u64) -> Vec<String> {
    if status.published.is_none() {
        return vec!["the node is starting".to_owned()];
    }
    let (all, missing) =
        (status.cameras.len(), status.cameras.iter().filter(|camera| camera.problem.is_some()).count());
    let (free_mib, reserve_mib) = (status.free_bytes >> 20, reserve_bytes >> 20);
    let cameras = (missing > 0).then(|| format!("{missing} of {all} cameras cannot be used"));
    let hsu = status.hsu.problem.is_some().then(|| "the HSU cannot be used".to_owned());
    let disk = (status.free_bytes <= reserve_bytes)
        .then(|| format!("{free_mib} MiB are free on the disk, of which {reserve_mib} MiB are kept free"));
    let thread = (status.age_s > STALE_S)
        .then(|| format!("the node's thread has reported nothing for {:.0} s", status.age_s));
    [cameras, hsu, disk, thread].into_iter().flatten().collect()
}
