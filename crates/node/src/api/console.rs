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
const FILES: [(&str, &str, &str); 34] = served![
    HTML "play.html",
    HTML "subject.html",
    STYLE "console.css",
    STYLE "play.css",
    STYLE "player.css",
    STYLE "tiles.css",
    STYLE "subject.css",
    SCRIPT "body-panel.js",
    SCRIPT "calibration-light.js",
    SCRIPT "cloud-view.js",
    SCRIPT "console.js",
    SCRIPT "controls.js",
    SCRIPT "elements.js",
    SCRIPT "exposure.js",
    SCRIPT "form.js",
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
    SCRIPT "words.js",
    SCRIPT "words-de.js",
    SCRIPT "words-en.js",
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

#[cfg(test)]
mod tests {
    use super::{FILES, PAGE};

    /// A page without one of its scripts stays blank.
    #[test]
    fn every_script_that_a_page_imports_is_served() {
        for (path, _, text) in FILES.into_iter().chain([PAGE]) {
            let imported = text.split(" from \"./").skip(1).chain(text.split("src=\"").skip(1));
            for name in
                imported.filter_map(|rest| rest.split('"').next()).filter(|name| name.ends_with(".js"))
            {
                let served = FILES.iter().any(|(other, ..)| other.trim_start_matches('/') == name);
                assert!(served, "{path} imports {name}, which is not among FILES");
            }
        }
    }
}
