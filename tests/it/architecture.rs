//! The invariants of absence (ARCHITECTURE.md), read from the sources: who may name whom.

use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// All Rust files below `dir`, apart from build results and hidden directories.
fn rust_files(dir: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).expect("a directory") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() && name != "target" && !name.starts_with('.') {
            files.extend(rust_files(&path));
        } else if name.ends_with(".rs") {
            files.push(path);
        }
    }
    files
}

/// The files of the product with their path below `src` and their code: no comments, no white space.
fn sources() -> Vec<(String, String)> {
    let src = root().join("src");
    let code = |path: &PathBuf| {
        let text = std::fs::read_to_string(path).expect("a source file");
        let lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
        let code = lines.map(|line| format!("{line} ")).collect::<String>();
        let place = path.strip_prefix(&src).expect("below src").display().to_string();
        (place, code)
    };
    let sources: Vec<_> = rust_files(&src).iter().map(code).collect();
    assert!(sources.len() > 50, "{} files are not the product", sources.len());
    sources
}

/// The words of a piece of code, with `::`, `{`, `}` and `,` as words of their own.
fn words(code: &str) -> Vec<&str> {
    let mut words = Vec::new();
    let mut rest = code;
    while let Some(first) = rest.chars().next() {
        let is_name = |c: char| c.is_alphanumeric() || c == '_';
        let length = match first {
            c if is_name(c) => rest.find(|c| !is_name(c)).unwrap_or(rest.len()),
            ':' if rest.starts_with("::") => 2,
            c => c.len_utf8(),
        };
        if !first.is_whitespace() {
            words.push(&rest[..length]);
        }
        rest = &rest[length..];
    }
    words
}

/// Modules of the product that the code names from the root: `crate::x`, `super::x` and `crate::{x, y}`.
fn modules_named(code: &str) -> Vec<&str> {
    let words = words(code);
    let mut named = Vec::new();
    for (i, pair) in words.windows(2).enumerate() {
        if !matches!(pair, ["crate" | "super" | "fourdbody", "::"]) {
            continue;
        }
        let mut depth = 0;
        for (before, word) in words[i + 1..].iter().zip(&words[i + 2..]) {
            match *word {
                "{" => depth += 1,
                "}" => depth -= 1,
                name if depth == 0 => named.push(name),
                name if depth == 1 && matches!(*before, "{" | ",") => named.push(name),
                _ => {}
            }
            if depth == 0 {
                break;
            }
        }
    }
    named
}

fn offenders(allowed: impl Fn(&str) -> bool, names: impl Fn(&str) -> bool) -> Vec<String> {
    let wrong = sources().into_iter().filter(|(place, code)| !allowed(place) && names(code));
    wrong.map(|(place, _)| place).collect()
}

#[test]
fn paths_are_found_in_all_their_forms() {
    let code = "use crate::{camera::{self, hsu}, acquire}; fn f() { super :: api::go(); crate::session::x }";
    assert_eq!(modules_named(code), ["camera", "acquire", "api", "session"]);
    assert_eq!(modules_named("use crate::ids::camera;"), ["ids"]);
}

#[test]
fn computing_knows_no_devices() {
    let pure = ["reconstruct/", "calibrate/", "export/", "geometry/", "pattern.rs", "image.rs", "ids.rs"];
    let outside = ["camera", "acquire", "hsu", "session", "api", "cmds", "cluster"];
    let mut found = 0;
    for (place, code) in sources() {
        if !pure.iter().any(|start| place.starts_with(start)) {
            continue;
        }
        found += 1;
        let named = modules_named(&code);
        let wrong: Vec<_> = named.iter().filter(|name| outside.contains(name)).collect();
        assert!(wrong.is_empty(), "src/{place} names {wrong:?}; hand it what it needs instead");
        for name in ["tokio", "aravis", "aravis_sys"] {
            assert!(!words(&code).contains(&name), "src/{place} names {name}");
        }
    }
    assert!(found > pure.len(), "{found} files");
}

#[test]
fn aravis_is_named_in_one_place() {
    // `self::aravis` is our own module of that name.
    let names = |code: &str| {
        let words = words(code);
        let ours = |i: usize| i > 1 && words[i - 1] == "::" && words[i - 2] == "self";
        let path = |i: usize| words[i] == "aravis" && words.get(i + 1) == Some(&"::") && !ours(i);
        words.contains(&"aravis_sys") || (0..words.len()).any(path)
    };
    assert!(names("use aravis::prelude;") && !names("use self::aravis::AravisCameras;"));
    assert_eq!(offenders(|place| place.starts_with("camera/aravis"), names), [""; 0]);
}

#[test]
fn tokio_stays_at_the_edge() {
    let edge = |place: &str| {
        place.starts_with("api/")
            || place.starts_with("cmds/")
            || ["capture/participant.rs", "s3/remote.rs"].contains(&place)
    };
    assert_eq!(offenders(edge, |code| words(code).contains(&"tokio")), [""; 0]);
}

#[test]
fn the_product_does_not_know_the_simulator() {
    assert_eq!(offenders(|_| false, |code| code.contains("fourdbody_simulator")), [""; 0]);
    let manifest = std::fs::read_to_string(root().join("Cargo.toml")).expect("Cargo.toml");
    let manifest: toml::Table = manifest.parse().expect("TOML");
    assert!(manifest["dependencies"].get("fourdbody-simulator").is_none());
    assert!(manifest["dev-dependencies"].get("fourdbody-simulator").is_some());
}

#[test]
fn every_file_says_what_it_is_for_and_is_short() {
    for path in rust_files(&root()) {
        let text = std::fs::read_to_string(&path).expect("a source file");
        let lines = text.lines().count();
        assert!(text.starts_with("//! "), "{}: the first line is not `//! ...`", path.display());
        assert!(lines <= 600, "{}: {lines} lines, 600 are the limit; split it", path.display());
    }
}
