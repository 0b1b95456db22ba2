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
    use crate::record::GapCause;
    use std::collections::{BTreeMap, BTreeSet};

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

    fn text_of(path: &str) -> &'static str {
        FILES.into_iter().find(|(other, ..)| *other == path).map(|(_, _, text)| text).expect(path)
    }

    /// The words of a language by their keys: a line each, `  "key": ...`.
    fn words(path: &str) -> BTreeMap<&'static str, &'static str> {
        let lines = text_of(path).lines().filter_map(|line| line.strip_prefix("  \"")?.split_once("\": "));
        lines.fold(BTreeMap::new(), |mut words, (key, said)| {
            assert!(words.insert(key, said).is_none(), "{path} has {key} twice");
            words
        })
    }

    /// What stands between `before` and the next one of `end`, wherever `before` is no part of a longer name.
    fn behind(text: &'static str, before: &str, end: &str) -> Vec<&'static str> {
        let whole = |at: usize| !text[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_');
        let rest =
            text.match_indices(before).filter(|(at, _)| whole(*at)).map(|(at, _)| &text[at + before.len()..]);
        rest.filter_map(|rest| Some(rest.split_once(end)?.0)).collect()
    }

    /// Values that are filled into a word, `{name}`.
    fn filled_in(said: &'static str) -> BTreeSet<&'static str> {
        let names = said.split('{').skip(1).filter_map(|rest| Some(rest.split_once('}')?.0));
        names.filter(|name| name.chars().all(|c| c.is_ascii_lowercase())).collect()
    }

    /// A key that is missing in one language is read by somebody who does not know it.
    #[test]
    fn every_language_has_all_words() {
        let english = words("/words-en.js");
        assert!(english.len() > 200, "{} words", english.len());
        for (path, ..) in FILES.into_iter().filter(|(path, ..)| path.starts_with("/words-")) {
            let other = words(path);
            assert!(english.keys().eq(other.keys()), "{path}: {:?}", {
                let keys = |words: &BTreeMap<&'static str, _>| words.keys().copied().collect::<BTreeSet<_>>();
                keys(&english).symmetric_difference(&keys(&other)).copied().collect::<Vec<_>>()
            });
            for (key, said) in &english {
                assert_eq!(filled_in(said), filled_in(other[key]), "{path}: {key}");
            }
        }
        for cause in GapCause::ALL {
            assert!(english.contains_key(format!("cause-{cause}").as_str()), "no word for {cause}");
        }
    }

    /// Every key that a page or a script names has words, and words that nobody names are gone.
    #[test]
    fn every_word_is_used_and_is_there() {
        let words = words("/words-en.js");
        let (mut keys, mut groups) = (BTreeSet::new(), BTreeSet::new());
        for (_, _, text) in FILES.into_iter().chain([PAGE]) {
            keys.extend(behind(text, "t(\"", "\""));
            for place in ["data-t=\"", "data-t-title=\"", "data-t-placeholder=\"", "data-t-label=\""] {
                keys.extend(behind(text, place, "\""));
            }
            // Keys that are put together: by what stands before the first value, and `wordOf(group, word)`.
            groups.extend(behind(text, "t(`", "${").into_iter().map(str::to_owned));
            groups.extend(behind(text, "wordOf(\"", "\"").into_iter().map(|group| format!("{group}-")));
        }
        let missing: Vec<_> = keys.iter().filter(|key| !words.contains_key(**key)).collect();
        assert!(missing.is_empty(), "no words for {missing:?}");
        let grouped = |key: &str| groups.iter().any(|group| key.starts_with(group.as_str()));
        let unused: Vec<_> = words.keys().filter(|key| !keys.contains(**key) && !grouped(key)).collect();
        assert!(unused.is_empty(), "nobody says {unused:?}");
        let idle: Vec<_> =
            groups.iter().filter(|group| !words.keys().any(|key| key.starts_with(*group))).collect();
        assert!(idle.is_empty(), "no words begin with {idle:?}");
    }

    /// In a page of its own the player has no files of words.
    #[test]
    fn the_player_alone_says_the_same() {
        let (served, alone) = (words("/words-en.js"), words("/player.js"));
        assert!(alone.iter().all(|(key, said)| served.get(key) == Some(said)), "{alone:?}");
        let all = served.keys().filter(|key| key.starts_with("player-"));
        assert!(all.eq(alone.keys()), "{:?}", alone.keys());
    }
}
