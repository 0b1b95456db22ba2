// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the cameras see while they run: their pictures, the body as points, and rows of frames for the other nodes.

use super::bytes;
use crate::api::Shared;
use crate::api::refusal::Refusal;
use crate::base::Fault;
use crate::control::status::path;
use crate::preview::{Part, PictureFacts};
use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use std::time::Duration;
use tokio::time::{Instant, sleep};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(get_previews))
        .routes(routes!(get_picture))
        .routes(routes!(get_live))
        .routes(routes!(get_rows))
}

/// Light and age of each camera's newest picture. The request keeps pictures coming, at most four a second.
#[utoipa::path(get, path = path::PREVIEWS, tag = "preview",
    responses((status = 200, description = "One entry a camera.", body = Vec<PictureFacts>)))]
async fn get_previews(State(shared): State<Shared>) -> Json<Vec<PictureFacts>> {
    Json(shared.services.previews.facts())
}

/// What of a picture the client wants: the whole where nothing is given.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
struct Wanted {
    /// What the light is good for, in place of the picture: green where fringes are strong enough, amber where they are
    /// weak, red where they are overexposed, clear elsewhere. A row of pixels for 24 columns of the frame.
    #[serde(default)]
    light: bool,
    /// With `y`: in place of the picture a square of at most 240 pixels a side at the frame's full size, about this part of
    /// the picture's width from the left, 0 to 1.
    x: Option<f32>,
    /// The same of the picture's height, from the top.
    y: Option<f32>,
}

impl Wanted {
    fn part(&self) -> Result<Part, Refusal> {
        match (self.light, self.x, self.y) {
            (false, None, None) => Ok(Part::Whole),
            (true, None, None) => Ok(Part::Light),
            (false, Some(x), Some(y)) if [x, y].iter().all(|at| (0.0..=1.0).contains(at)) => {
                Ok(Part::Detail([x, y]))
            }
            (light, x, y) => Err(Refusal::new(
                StatusCode::BAD_REQUEST,
                format!(
                    "expected light=true, or x and y from 0 to 1, or nothing; found light={light}, x {x:?}, y {y:?}"
                ),
            )),
        }
    }
}

/// A camera's newest picture: upright, a quarter of the frame's size, saturated pixels red. 204 before the first.
#[utoipa::path(get, path = path::PICTURE, tag = "preview",
    params(("camera" = String, Path, description = "Its name in the rig."), Wanted),
    responses(
        (status = 200, description = "The picture.", content_type = "image/png", body = Vec<u8>),
        (status = 204, description = "The camera has sent nothing yet."),
        (status = 404, description = "This node has no such camera.", body = Fault)))]
async fn get_picture(
    State(shared): State<Shared>,
    Path(camera): Path<String>,
    Query(wanted): Query<Wanted>,
) -> Result<Response, Refusal> {
    let part = wanted.part()?;
    let picture = shared.services.previews.latest(&camera, part).map_err(Refusal::not_found)?;
    let Some(picture) = picture else { return Ok(StatusCode::NO_CONTENT.into_response()) };
    let Some(png) = picture.part(part).map(<[u8]>::to_vec) else {
        return Ok(StatusCode::NO_CONTENT.into_response());
    };
    let number = [(HeaderName::from_static("x-picture"), picture.number.to_string())];
    Ok((number, bytes("image/png", png)).into_response())
}

/// Longest time that a console waits for a frame set that is newer than its last one.
const BODY_PATIENCE: Duration = Duration::from_secs(1);
/// Longest time that another node waits for the rows of a trigger.
const ROWS_PATIENCE: Duration = Duration::from_millis(250);
/// Time between two looks for what a request waits for: short against the 67 ms between two sampled frame sets.
const POLL: Duration = Duration::from_millis(5);

/// Waits until there is something, or the patience ends.
async fn waited<T>(
    patience: Duration,
    mut look: impl FnMut() -> Result<Option<T>, String>,
) -> Result<Option<T>, String> {
    let begin = Instant::now();
    loop {
        let found = look()?;
        if found.is_some() || begin.elapsed() > patience {
            return Ok(found);
        }
        sleep(POLL).await;
    }
}

/// Which frame set the client has already.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
struct After {
    /// The number of the client's newest frame set: the request waits for the next one, up to a second.
    #[serde(default)]
    after: u64,
}

/// The newest frame set of all nodes as points, 12 bytes each as a quick look has them. The request keeps them coming.
/// 204 where there is nothing new; 409 where there never will be.
#[utoipa::path(get, path = path::LIVE, tag = "preview", params(After),
    responses(
        (status = 200, description = "The points. The header `x-live` describes them as JSON.",
            content_type = "application/octet-stream", body = Vec<u8>, headers(("x-live" = crate::live::Facts))),
        (status = 204, description = "Nothing new."),
        (status = 400, description = "The query is not what is described."),
        (status = 409, description = "No calibration is configured, or it cannot be used.", body = Fault)))]
async fn get_live(
    State(shared): State<Shared>,
    Query(After { after }): Query<After>,
) -> Result<Response, Refusal> {
    let newest = waited(BODY_PATIENCE, || shared.services.live.after(after)).await;
    let newest = newest.map_err(|reason| Refusal::new(StatusCode::CONFLICT, reason))?;
    let Some(shown) = newest else { return Ok(StatusCode::NO_CONTENT.into_response()) };
    let facts = serde_json::to_string(&shown.facts_now()).unwrap_or_default();
    let facts = HeaderValue::from_str(&facts).unwrap_or(HeaderValue::from_static("{}"));
    let facts = [(HeaderName::from_static("x-live"), facts)];
    Ok((facts, bytes("application/octet-stream", shown.points.clone())).into_response())
}

/// Every fourth row of this node's frames of a trigger, for the node that shows the body (docs/design/live.md has the
/// bytes). The request keeps rows coming. 204 where there are none, or none any more.
#[utoipa::path(get, path = path::LIVE_ROWS, tag = "preview",
    params(("trigger" = u64, Path, description = "The trigger index.")),
    responses(
        (status = 200, description = "The rows.", content_type = "application/octet-stream", body = Vec<u8>),
        (status = 204, description = "This node has no rows of that trigger."),
        (status = 400, description = "The path is not what is described.")))]
async fn get_rows(State(shared): State<Shared>, Path(trigger): Path<u64>) -> Response {
    match waited(ROWS_PATIENCE, || Ok(shared.services.live.rows(trigger))).await {
        Ok(Some(rows)) => bytes("application/octet-stream", rows),
        _ => StatusCode::NO_CONTENT.into_response(),
    }
}
