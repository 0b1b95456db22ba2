// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pictures of the cameras while they run.

use crate::api::Shared;
use crate::api::refusal::Refusal;
use crate::control::status::path;
use crate::preview::PictureFacts;
use axum::Json;
use axum::extract::{Path, State};
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(get_previews)).routes(routes!(get_picture))
}

/// What is known of each camera's newest picture: its light and its age. Asking keeps pictures coming, at most four a second.
#[utoipa::path(get, path = path::PREVIEWS, tag = "preview",
    responses((status = 200, description = "One entry a camera.", body = Vec<PictureFacts>)))]
async fn get_previews(State(shared): State<Shared>) -> Json<Vec<PictureFacts>> {
    Json(shared.services.previews.facts())
}

/// A camera's newest picture: upright, a quarter of the frame's size, saturated pixels red. 204 before the first.
#[utoipa::path(get, path = path::PICTURE, tag = "preview", params(("camera" = String, Path, description = "Its name in the rig.")),
    responses(
        (status = 200, description = "The picture.", content_type = "image/png", body = Vec<u8>),
        (status = 204, description = "The camera has sent nothing yet."),
        (status = 404, description = "This node has no such camera.", body = crate::base::Fault)))]
async fn get_picture(State(shared): State<Shared>, Path(camera): Path<String>) -> Result<Response, Refusal> {
    let picture = shared.services.previews.latest(&camera);
    match picture.map_err(|e| Refusal::new(StatusCode::NOT_FOUND, e))? {
        None => Ok(StatusCode::NO_CONTENT.into_response()),
        Some(picture) => {
            let number = picture.number.to_string();
            let headers = [
                (header::CONTENT_TYPE, "image/png"),
                (HeaderName::from_static("x-picture"), number.as_str()),
            ];
            Ok((headers, picture.png.clone()).into_response())
        }
    }
}
