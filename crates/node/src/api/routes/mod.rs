// SPDX-License-Identifier: MIT OR Apache-2.0
//! The API's routes, a file per resource; each has `routes()` with handlers and their description.

pub(super) mod fitness;
pub(super) mod login;
pub(super) mod node;
pub(super) mod peers;
pub(super) mod pictures;
pub(super) mod play;
pub(super) mod session;
pub(super) mod sessions;

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

/// An answer with a body of this type.
fn bytes(kind: &'static str, body: impl Into<axum::body::Body>) -> Response {
    ([(header::CONTENT_TYPE, kind)], body.into()).into_response()
}

/// Either 204 or a refusal: the answer of a handler that has nothing to show.
type Done = Result<StatusCode, super::refusal::Refusal>;
