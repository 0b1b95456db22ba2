// SPDX-License-Identifier: MIT OR Apache-2.0
//! The body while cameras run: points for a console, rows of frames for the other nodes.

use crate::api::Shared;
use crate::api::refusal::Refusal;
use crate::control::status::path;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use std::time::Duration;
use tokio::time::{Instant, sleep};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new().routes(routes!(get_live)).routes(routes!(get_rows))
}

/// How long a console waits for something new.
const BODY_PATIENCE: Duration = Duration::from_secs(1);
/// How long another node waits for the rows of a trigger.
const ROWS_PATIENCE: Duration = Duration::from_millis(250);
const POLL: Duration = Duration::from_millis(5);
const FACTS: HeaderName = HeaderName::from_static("x-live");

/// Which frame set.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
struct After {
    /// The number of the frame set that is known already: the next one is waited for, up to a second.
    #[serde(default)]
    after: u64,
}

/// The newest frame set of all nodes as points, 12 bytes each as a quick look has them. Asking keeps them coming. 204 where
/// there is nothing new; 409 where there never will be.
#[utoipa::path(get, path = path::LIVE, tag = "preview", params(After),
    responses(
        (status = 200, description = "The points. The header `x-live` has what is told of them, as JSON.",
            content_type = "application/octet-stream", body = Vec<u8>, headers(("x-live" = crate::live::Facts))),
        (status = 204, description = "Nothing new."),
        (status = 400, description = "The query is not what is described."),
        (status = 409, description = "No calibration is configured, or it is of no use.", body = crate::base::Fault)))]
async fn get_live(
    State(shared): State<Shared>,
    Query(After { after }): Query<After>,
) -> Result<Response, Refusal> {
    let begin = Instant::now();
    loop {
        let newest = shared.services.live.after(after).map_err(|e| Refusal::new(StatusCode::CONFLICT, e))?;
        if let Some(shown) = newest {
            let facts = serde_json::to_string(&shown.facts_now()).unwrap_or_default();
            let facts = HeaderValue::from_str(&facts).unwrap_or(HeaderValue::from_static("{}"));
            let kind = HeaderValue::from_static("application/octet-stream");
            let headers = [(header::CONTENT_TYPE, kind), (FACTS, facts)];
            return Ok((headers, shown.points.clone()).into_response());
        }
        if begin.elapsed() > BODY_PATIENCE {
            return Ok(StatusCode::NO_CONTENT.into_response());
        }
        sleep(POLL).await;
    }
}

/// Every fourth row of this node's frames of a trigger, for the node that shows the body (docs/design/live.md has the
/// bytes). Asking keeps rows coming. 204 where there are none, or none any more.
#[utoipa::path(get, path = path::LIVE_ROWS, tag = "preview",
    params(("trigger" = u64, Path, description = "The trigger index.")),
    responses(
        (status = 200, description = "The rows.", content_type = "application/octet-stream", body = Vec<u8>),
        (status = 204, description = "This node has no rows of that trigger."),
        (status = 400, description = "The path is not what is described.")))]
async fn get_rows(State(shared): State<Shared>, Path(trigger): Path<u64>) -> Response {
    let begin = Instant::now();
    loop {
        if let Some(rows) = shared.services.live.rows(trigger) {
            return ([(header::CONTENT_TYPE, "application/octet-stream")], rows).into_response();
        }
        if begin.elapsed() > ROWS_PATIENCE {
            return StatusCode::NO_CONTENT.into_response();
        }
        sleep(POLL).await;
    }
}
