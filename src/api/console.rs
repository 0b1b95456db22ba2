// SPDX-License-Identifier: MIT OR Apache-2.0
//! The console: a page for the dark room and what belongs to it, served from the program itself, so that it works without
//! any network but the laboratory's.

use super::Shared;
use axum::Router;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::routing::get;

/// The files of `web/`, with where they are served and as what.
const FILES: [(&str, &str, &str); 6] = [
    ("/", "text/html; charset=utf-8", include_str!("../../web/index.html")),
    ("/console.css", "text/css; charset=utf-8", include_str!("../../web/console.css")),
    ("/console.js", "text/javascript; charset=utf-8", include_str!("../../web/console.js")),
    ("/node-client.js", "text/javascript; charset=utf-8", include_str!("../../web/node-client.js")),
    ("/cloud-view.js", "text/javascript; charset=utf-8", include_str!("../../web/cloud-view.js")),
    ("/icon.svg", "image/svg+xml", include_str!("../../web/icon.svg")),
];

/// Their routes.
pub(super) fn pages() -> Router<Shared> {
    FILES.into_iter().fold(Router::new(), |router, (path, kind, text)| {
        let answer = move || async move { file(kind, text) };
        router.route(path, get(answer))
    })
}

fn file(kind: &'static str, text: &'static str) -> Response {
    // That the browser keeps nothing, be it of a node that is gone or of an older version, is a header of every answer.
    ([(header::CONTENT_TYPE, kind)], text).into_response()
}
