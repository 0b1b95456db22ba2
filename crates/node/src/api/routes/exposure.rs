// SPDX-License-Identifier: MIT OR Apache-2.0
//! Exposure and gain of the cameras of a head.

use crate::api::Shared;
use crate::api::body::Body;
use crate::api::refusal::Refusal;
use crate::base::Fault;
use crate::control::command::Command;
use crate::control::request::ExposureRequest;
use crate::control::status::{ExposureSet, path};
use axum::Json;
use axum::extract::State;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(expose))
}

/// Sets exposure and gain of this node's cameras of some heads, and reads them back: of all these cameras, or of none. Only
/// between sessions. It holds until they are set again or the node is started anew; the node file stays as it is.
#[utoipa::path(post, path = path::EXPOSURE, tag = "devices", request_body = ExposureRequest,
    responses(
        (status = 200, description = "What was asked for, and what the cameras took; none: the heads are other nodes'.", body = ExposureSet),
        (status = 409, description = "The node is in a session, or neither the rig nor the cameras allow it.", body = Fault),
        (status = 500, description = "The node failed at it.", body = Fault),
        (status = 503, description = "A camera failed, or the node is busy.", body = Fault)))]
async fn expose(
    State(shared): State<Shared>,
    Body(request): Body<ExposureRequest>,
) -> Result<Json<ExposureSet>, Refusal> {
    shared.ask(|reply| Command::Expose(request, reply)).await.map(Json)
}
