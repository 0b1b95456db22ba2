// SPDX-License-Identifier: MIT OR Apache-2.0
//! The node's pages behind a proxy that serves them below a path of its own: whatever a page names is found from there.

use crate::api_node::ApiNode;
use std::collections::BTreeSet;
use std::path::Path;

/// Where the proxy serves the node; it takes this away from the path and passes on the rest.
const BELOW: &str = "/scanner";

/// Every text between these and a quotation mark.
fn named(text: &str, before: &[&str]) -> Vec<String> {
    let of = |before: &&str| -> Vec<String> {
        let parts = text.split(before).skip(1);
        parts.filter_map(|part| part.split(['"', '?', '`', '$']).next()).map(str::to_owned).collect()
    };
    before.iter().flat_map(of).collect()
}

/// Where a browser looks for what a page names.
fn resolved(page: &str, name: &str) -> String {
    if name.starts_with('/') {
        return name.to_owned();
    }
    let folder = page.rsplit_once('/').map_or("", |(folder, _)| folder);
    format!("{folder}/{}", name.trim_start_matches("./"))
}

#[test]
fn a_page_names_nothing_from_the_root_of_its_host() {
    let node = ApiNode::start();
    let mut seen = BTreeSet::new();
    let mut wanted: Vec<String> =
        ["/", "/play.html", "/subject.html"].map(|page| format!("{BELOW}{page}")).to_vec();
    while let Some(page) = wanted.pop() {
        if !seen.insert(page.clone()) {
            continue;
        }
        let path = page
            .strip_prefix(BELOW)
            .unwrap_or_else(|| panic!("{page} is not below {BELOW}/: the proxy has no such path"));
        let reply = node.send(None, &format!("GET {path}"), &[], "");
        assert_eq!(reply.status, 200, "{page}: {reply:?}");
        let names =
            named(&reply.body, &["src=\"", "href=\"", "from \"", "window.open(\"", "page = `", "page = \""]);
        wanted.extend(names.iter().map(|name| resolved(&page, name)));
    }
    assert!(seen.len() > 25, "{seen:?} are not the pages and what belongs to them");
    for script in ["console.js", "node-client.js", "icon.svg", "play.css", "play.html", "subject.html"] {
        assert!(seen.contains(&format!("{BELOW}/{script}")), "{script} was not found from a page: {seen:?}");
    }
}

/// Requests of the pages are relative as well.
#[test]
fn no_script_asks_at_the_root_of_its_host() {
    let web = Path::new(env!("CARGO_MANIFEST_DIR")).join("web");
    for entry in std::fs::read_dir(web).expect("a directory") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read_to_string(&path).expect("a text");
        let wrong = ["\"/api", "'/api", "`/api", "url(/"].into_iter().find(|begin| text.contains(begin));
        assert_eq!(wrong, None, "{}", path.display());
    }
}
