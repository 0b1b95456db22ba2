// SPDX-License-Identifier: MIT OR Apache-2.0
//! Requests that are refused: a status, and the same [`Fault`] as everywhere else as JSON.

use crate::base::{Exit, Fault};
use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use std::time::Duration;

/// Why a request is refused, and how.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    pub status: StatusCode,
    /// What goes over the wire.
    pub fault: Fault,
    /// Time after which the client may try again.
    pub retry_after: Option<Duration>,
}

impl Refusal {
    /// The client's fault, by status.
    pub fn new(status: StatusCode, message: impl ToString) -> Self {
        Self { status, fault: Fault::new(Exit::Usage, message), retry_after: None }
    }

    /// There is nothing of this name here.
    pub fn not_found(message: impl ToString) -> Self {
        Self::new(StatusCode::NOT_FOUND, message)
    }

    /// More connections than one caller, or all, may hold.
    pub fn too_many_connections() -> Self {
        let message = "too many connections of this caller, or of all; close some";
        let retry_after = Some(Duration::from_secs(5));
        Self { retry_after, ..Self::new(StatusCode::SERVICE_UNAVAILABLE, message) }
    }

    /// A client sends more requests than it may.
    pub fn too_many(message: impl ToString, wait: Duration) -> Self {
        Self { retry_after: Some(wait), ..Self::new(StatusCode::TOO_MANY_REQUESTS, message) }
    }
}

/// The node's answer to a command, by the exit code that it means on the command line.
impl From<Fault> for Refusal {
    fn from(fault: Fault) -> Self {
        let status = match Exit::from_code(fault.exit) {
            Exit::Usage => StatusCode::CONFLICT,
            Exit::Device => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self { status, fault, retry_after: None }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let mut response = (self.status, Json(self.fault)).into_response();
        let headers = response.headers_mut();
        if self.status == StatusCode::UNAUTHORIZED {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"fourdbody\""));
        }
        if let Some(wait) = self.retry_after {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(wait.as_secs() + 1));
        }
        response
    }
}
