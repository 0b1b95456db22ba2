// SPDX-License-Identifier: MIT OR Apache-2.0
//! The console: a page for the dark room and what belongs to it, served from the program itself, so that it works
//! without any network but the laboratory's.

use super::Shared;
use axum::Router;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::routing::get;

const HTML: &str = "text/html; charset=utf-8";
const STYLE: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const ICON: &str = "image/svg+xml";

/// Files of `web/` that are served under their own names.
macro_rules! served {
    ($($kind:ident $name:literal),+ $(,)?) => {
        [$((concat!("/", $name), $kind, include_str!(concat!("../../../../web/", $name)))),+]
    };
}

/// The files of `web/` with their paths and content types.
const FILES: [(&str, &str, &str); 29] = served![
    HTML "play.html",
    HTML "subject.html",
    STYLE "console.css",
    STYLE "play.css",
    STYLE "player.css",
    STYLE "tiles.css",
    STYLE "subject.css",
    SCRIPT "calibration-light.js",
    SCRIPT "cloud-view.js",
    SCRIPT "console.js",
    SCRIPT "controls.js",
    SCRIPT "elements.js",
    SCRIPT "exposure.js",
    SCRIPT "header.js",
    SCRIPT "live-body.js",
    SCRIPT "node-client.js",
    SCRIPT "play.js",
    SCRIPT "playable.js",
    SCRIPT "player.js",
    SCRIPT "quick-look.js",
    SCRIPT "sound.js",
    SCRIPT "stage.js",
    SCRIPT "subject.js",
    SCRIPT "takes.js",
    SCRIPT "tiles.js",
    SCRIPT "time-line.js",
    SCRIPT "told.js",
    SCRIPT "verdict.js",
    ICON "icon.svg",
];
/// The page at the path `/`.
const PAGE: (&str, &str, &str) = ("/", HTML, include_str!("../../../../web/index.html"));

/// The routes of all these files.
pub(super) fn pages() -> Router<Shared> {
    FILES.into_iter().chain([PAGE]).fold(Router::new(), |router, (path, kind, text)| {
        let answer = move || async move { file(kind, text) };
        router.route(path, get(answer))
    })
}

fn file(kind: &'static str, text: &'static str) -> Response {
    // That the browser keeps nothing, be it of a node that is gone or of an older version, is a header of every answer.
    ([(header::CONTENT_TYPE, kind)], text).into_response()
}
