// SPDX-License-Identifier: MIT OR Apache-2.0
//! The JSON body of a request: an object with the expected fields, and whatever is wrong with it is refused in one way.

use super::refusal::Refusal;
use crate::base::json::Strict;
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::JsonRejection;
use axum::extract::{FromRequest, Request};
use axum::http::StatusCode;
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// A request's body, read from JSON: an object, as is whatever has fields in it. Types that are read like this deny
/// unknown fields; nesting is bounded by `serde_json` (128 levels).
pub struct Body<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Body<T> {
    type Rejection = Refusal;

    async fn from_request(request: Request, state: &S) -> Result<Self, Refusal> {
        match Json::<Strict<T>>::from_request(request, state).await {
            Ok(Json(Strict(value))) => Ok(Self(value)),
            Err(rejection) => {
                let status = match rejection {
                    JsonRejection::MissingJsonContentType(_) => StatusCode::UNSUPPORTED_MEDIA_TYPE,
                    JsonRejection::BytesRejection(_) => rejection.status(),
                    _ => StatusCode::BAD_REQUEST,
                };
                Err(Refusal::new(status, rejection.body_text()))
            }
        }
    }
}

/// The body of a request without arguments: none, or an object without fields.
pub struct NoBody;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoFields {}

impl<S: Send + Sync> FromRequest<S> for NoBody {
    type Rejection = Refusal;

    async fn from_request(request: Request, state: &S) -> Result<Self, Refusal> {
        let refused = |reason: String| Refusal::new(StatusCode::BAD_REQUEST, reason);
        let bytes = Bytes::from_request(request, state).await.map_err(|e| refused(e.body_text()))?;
        if bytes.is_empty() {
            return Ok(Self);
        }
        match crate::base::json::from_slice::<NoFields>(&bytes) {
            Ok(NoFields {}) => Ok(Self),
            Err(error) => {
                Err(refused(format!("expected no body, or an object without fields, found {error}")))
            }
        }
    }
}
