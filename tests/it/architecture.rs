// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tower and the invariants of absence (`ARCHITECTURE.md`), read from the sources: who may name whom.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// What the first line of each file says behind its comment's sign.
const LICENCE: &str = "SPDX-License-Identifier: MIT OR Apache-2.0";

fn rust_files(dir: &Path) -> Vec<PathBuf> {
    files(dir, &[".rs"])
}

/// All files below `dir` whose names end so, apart from build results and hidden directories.
fn files(dir: &Path, ends: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).expect("a directory") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() && name != "target" && !name.starts_with('.') {
            found.extend(files(&path, ends));
        } else if ends.iter().any(|end| name.ends_with(end)) {
            found.push(path);
        }
    }
    found
}

/// The crates of the product by name, each with its sources; the program's is named "".
fn crates() -> Vec<(String, PathBuf)> {
    let entries = std::fs::read_dir(root().join("crates")).expect("the library crates");
    let library = entries.map(|entry| {
        let path = entry.expect("an entry").path();
        (path.file_name().expect("a name").to_string_lossy().into_owned(), path.join("src"))
    });
    library.chain([(String::new(), root().join("src"))]).collect()
}

/// A path below a crate's sources as `crate/path`; below the program's as it is.
fn place(krate: &str, path: &str) -> String {
    [krate, path].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("/")
}

/// The files of the product with their place and their code: no comments, no white space.
fn sources() -> Vec<(String, String)> {
    let mut sources = Vec::new();
    for (krate, src) in crates() {
        for path in rust_files(&src) {
            let text = std::fs::read_to_string(&path).expect("a source file");
            let lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
            let code = lines.map(|line| format!("{line} ")).collect::<String>();
            let below = path.strip_prefix(&src).expect("below its crate's sources").display().to_string();
            sources.push((place(&krate, &below), code));
        }
    }
    assert!(sources.len() > 50, "{} files are not the product", sources.len());
    sources
}

/// What a crate's root calls by a name of its own: modules of other crates, with their places.
fn aliases(krate: &str) -> BTreeMap<String, String> {
    let (_, src) = crates().into_iter().find(|(name, _)| name == krate).expect("a crate");
    let text = std::fs::read_to_string(src.join("lib.rs")).expect("its root");
    let mut aliases = BTreeMap::new();
    for line in text.split(';').filter_map(|line| line.split_once("use fourdbody_")).map(|(_, rest)| rest) {
        let (of, names) = match line.split_once("::") {
            Some((of, names)) => (of, names.trim_matches(['{', '}']).to_owned()),
            None => (line.split_whitespace().next().unwrap_or_default(), line.replacen(' ', " self ", 1)),
        };
        for name in names.split(',').map(str::trim) {
            match name.rsplit_once(" as ") {
                Some((_, alias)) => aliases.insert(alias.to_owned(), of.to_owned()),
                None => aliases.insert(name.to_owned(), place(of, name)),
            };
        }
    }
    aliases
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

/// Paths that the code names from the crate's root, as words: all leaves of `crate::x::{y, z::w}`, and `super::x` as seen
/// from the module `here`. What stands in a module within the file has that file as its `super`.
fn paths_named(code: &str, here: &[&str]) -> Vec<String> {
    let words = words(code);
    let mut named = Vec::new();
    // Modules within the file, by the depth of braces at which they began.
    let (mut depth, mut within) = (0usize, Vec::new());
    let mut i = 0;
    while i < words.len() {
        match (words[i], words.get(i + 1), words.get(i + 2)) {
            ("mod", Some(_), Some(&"{")) => within.push(depth),
            // Of a visibility: it names nothing.
            ("in", ..) if words[..i].ends_with(&["pub", "("]) => i += 1,
            ("{", ..) => depth += 1,
            ("}", ..) => {
                depth = depth.saturating_sub(1);
                within.pop_if(|began| *began == depth);
            }
            ("crate" | "super", Some(&"::"), _) if !words[..i].ends_with(&["::"]) => {
                let mut start: Vec<&str> = here.to_vec();
                start.extend(within.iter().map(|_| "within"));
                if words[i] == "crate" {
                    start.clear();
                    i += 2;
                }
                while words.get(i) == Some(&"super") {
                    start.pop();
                    i += 2;
                }
                i = tree(&words, i, &start, &mut named);
                continue;
            }
            _ => {}
        }
        i += 1;
    }
    named
}

/// Reads a use tree, or a path, from word `i` on; notes its leaves, and returns where it ends.
fn tree(words: &[&str], mut i: usize, start: &[&str], named: &mut Vec<String>) -> usize {
    let mut path: Vec<&str> = start.to_vec();
    loop {
        match words.get(i) {
            Some(&"{") => {
                i += 1;
                while words.get(i).is_some_and(|word| *word != "}") {
                    i = tree(words, i, &path, named);
                    i += usize::from(words.get(i) == Some(&","));
                }
                return i + 1;
            }
            Some(&word) if word.chars().all(|c| c.is_alphanumeric() || c == '_') => path.push(word),
            _ => {}
        }
        i += 1;
        match words.get(i) {
            Some(&"::") => i += 1,
            Some(&"as") => i += 2,
            _ => {}
        }
        if words.get(i - 1) != Some(&"::") {
            named.push(path.join("/"));
            return i;
        }
    }
}

/// The floors of `ARCHITECTURE.md`, from the ground up: places of folders and files.
fn floors() -> Vec<String> {
    let text = std::fs::read_to_string(root().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    let (_, after) = text.split_once("## The tower").expect("a section of that name");
    let block = after.split("```").nth(1).expect("a list of floors").lines().skip(1);
    let floors: Vec<String> =
        block.filter_map(|line| line.split_whitespace().next()).map(str::to_owned).collect();
    assert!(floors.len() > 30, "{floors:?}");
    floors
}

/// The floor on which a module or an item stands: the longest entry that its path begins with.
fn floor_of(floors: &[String], path: &str) -> Option<usize> {
    let on = |floor: &&(usize, &String)| {
        path.strip_prefix(floor.1.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    let all: Vec<(usize, &String)> = floors.iter().enumerate().collect();
    all.iter().filter(on).max_by_key(|floor| floor.1.len()).map(|floor| floor.0)
}

/// Arrows that run up from a file: what it names of floors that stand after its own.
fn arrows_up(floors: &[String], of: &str, code: &str) -> Vec<String> {
    let module = of.trim_end_matches(".rs").trim_end_matches("/mod");
    let Some(own) = floor_of(floors, module) else {
        return vec![format!("{of} stands on no floor of ARCHITECTURE.md")];
    };
    let first = module.split('/').next().unwrap_or_default();
    let krate = if root().join("crates").join(first).is_dir() { first } else { "" };
    let here: Vec<&str> = module.split('/').skip(usize::from(!krate.is_empty())).collect();
    let aliases = aliases(krate);
    let there = |path: String| {
        let (name, rest) = path.split_once('/').unwrap_or((&path, ""));
        match aliases.get(name) {
            Some(other) => place(other, rest),
            None => place(krate, &path),
        }
    };
    let named: Vec<String> = paths_named(code, &here).into_iter().map(there).collect();
    let up = named.iter().filter(|path| floor_of(floors, path).is_some_and(|floor| floor > own));
    let say = |path: &String| {
        let floor = &floors[floor_of(floors, path).expect("found before")];
        format!("{of} names {path}, but {floor} stands after {} in ARCHITECTURE.md", floors[own])
    };
    up.map(say).collect()
}

fn offenders(allowed: impl Fn(&str) -> bool, names: impl Fn(&str) -> bool) -> Vec<String> {
    let wrong = sources().into_iter().filter(|(place, code)| !allowed(place) && names(code));
    wrong.map(|(place, _)| place).collect()
}

/// The Python package is a workspace of its own; its points are those of the program only with the same crates.
#[test]
fn the_python_package_is_built_of_the_same_crates() {
    let versions = |lock: &str| -> BTreeMap<String, BTreeSet<String>> {
        let text = std::fs::read_to_string(root().join(lock)).expect("committed");
        let lock: toml::Table = text.parse().expect("TOML");
        let mut versions = BTreeMap::<String, BTreeSet<String>>::new();
        for package in lock["package"].as_array().expect("packages") {
            let field = |name: &str| package[name].as_str().expect("text").to_owned();
            versions.entry(field("name")).or_default().insert(field("version"));
        }
        versions
    };
    let (program, package) = (versions("Cargo.lock"), versions("python/Cargo.lock"));
    let others: Vec<_> = package
        .iter()
        .filter(|(name, own)| program.get(*name).is_some_and(|versions| !own.is_subset(versions)))
        .collect();
    assert!(others.is_empty(), "run `cargo update --precise` in python/ for {others:?}");
    assert!(package.keys().filter(|name| program.contains_key(*name)).count() > 20, "they share crates");
}

#[test]
fn paths_are_found_in_all_their_forms() {
    let code = "use crate::{camera::{self, hsu}, acquire}; fn f() { super::api::go(); crate::node::x } \
                mod tests { use super::{y, z::w as v}; use crate::batch; } use super::super::data::Cloud;";
    let expected = "camera/self camera/hsu acquire a/api/go node/x a/b/y a/b/z/w batch data/Cloud";
    assert_eq!(paths_named(code, &["a", "b"]).join(" "), expected);
    assert_eq!(paths_named("pub(in crate::base) fn f() {} pub(super) fn g() {}", &["a"]), [""; 0]);
}

#[test]
fn every_folder_names_only_those_above_it_in_the_list() {
    let floors = floors();
    let is_root = |place: &str| place.ends_with("lib.rs") || place == "main.rs";
    let sources = sources().into_iter().filter(|(place, _)| !is_root(place));
    let up: Vec<String> = sources.flat_map(|(place, code)| arrows_up(&floors, &place, &code)).collect();
    assert!(up.is_empty(), "{}", up.join("\n"));
}

#[test]
fn an_arrow_up_and_a_file_on_no_floor_are_told() {
    let floors = floors();
    let told = |place: &str, code: &str| arrows_up(&floors, place, code).join("\n");
    let up =
        "core/base/time.rs names core/data/Cloud, but core/data stands after core/base in ARCHITECTURE.md";
    assert_eq!(told("core/base/time.rs", "use crate::data::Cloud;"), up);
    let up = "reconstruct/mask/opening.rs names reconstruct/pipeline/Method, but reconstruct stands after \
              reconstruct/mask in ARCHITECTURE.md";
    assert_eq!(told("reconstruct/mask/opening.rs", "use crate::pipeline::Method;"), up);
    assert_eq!(told("reconstruct/pipeline.rs", "use super::{mask, kernels::simd};"), "");
    assert_eq!(told("devices/acquire/hold.rs", "use crate::{camera, record::Verdict};"), "");
    assert_eq!(told("tools/x.rs", ""), "tools/x.rs stands on no floor of ARCHITECTURE.md");
}

#[test]
fn every_floor_is_there_and_computing_stands_below_all_devices() {
    let floors = floors();
    for floor in &floors {
        let (krate, below) = floor.split_once('/').unwrap_or((floor, ""));
        let of_library = root().join("crates").join(krate).join("src").join(below);
        let is_there = |path: PathBuf| path.is_dir() || path.with_extension("rs").is_file();
        assert!(is_there(of_library) || is_there(root().join("src").join(floor)), "{floor} is not there");
    }
    let at = |name: &str| floors.iter().position(|floor| floor == name).expect(name);
    let computing = ["reconstruct", "reconstruct/merge", "calibrate", "calibrate/validate"];
    for device in ["record", "devices/hsu", "devices/camera", "devices/acquire", "node/control", "node/api"] {
        assert!(computing.iter().all(|name| at(name) < at(device)), "{device}");
    }
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
    assert_eq!(offenders(|place| place.starts_with("devices/camera/aravis"), names), [""; 0]);
}

#[test]
fn tokio_stays_at_the_edge() {
    let edge = |place: &str| {
        ["node/api/", "cmds/", "node/control/"].iter().any(|folder| place.starts_with(folder))
            || ["node/capture/participant.rs", "node/s3/remote.rs"].contains(&place)
    };
    assert_eq!(offenders(edge, |code| words(code).contains(&"tokio")), [""; 0]);
}

/// The code of a file without its tests, which open what they have made.
fn without_tests(code: &str) -> &str {
    code.split_once("#[cfg(test)]").map_or(code, |(product, _)| product)
}

/// What is opened by itself: files of the kernel, directories, and what is new.
const OPENED_BY_ITSELF: [(&str, &str); 11] = [
    ("core/base/regular.rs", "the one way"),
    ("core/base/atomic_file.rs", "what it has just made"),
    ("doctor/disk.rs", "/proc, and a file that it makes and removes"),
    ("doctor/host.rs", "/proc and /sys"),
    ("doctor/network.rs", "/proc"),
    ("doctor/reverse_path.rs", "/proc"),
    ("doctor/usb.rs", "/sys"),
    ("record/host/memory.rs", "/proc and /sys"),
    ("record/host/run_delay.rs", "/proc"),
    ("devices/network/interface.rs", "/sys"),
    ("record/direct_io.rs", "directories; segments, which are new"),
];

/// Ways to open a file that wait, or read without a bound. Tests are in files of their own, too.
fn opens_by_itself(code: &str) -> Option<&'static str> {
    const WAYS: [&str; 6] =
        ["fs::read(", "fs::read_to_string(", "File::open(", ".read(true)", "fs::copy(", "pem_file_iter("];
    // A segment is opened as the others are.
    let code = without_tests(code).replace("SegmentFile::open(", "");
    WAYS.into_iter().find(|way| code.contains(way))
}

#[test]
fn files_of_others_are_opened_in_one_way() {
    assert_eq!(opens_by_itself("let x = std::fs::read(path);"), Some("fs::read("));
    assert_eq!(
        opens_by_itself("regular::read(path, 7) #[cfg(test)] mod tests { std::fs::read(path) }"),
        None
    );
    let exempt = |place: &str| {
        OPENED_BY_ITSELF.iter().any(|(known, _)| *known == place) || place.ends_with("tests.rs")
    };
    let told = |(place, code): (String, String)| {
        let way = opens_by_itself(&code).filter(|_| !exempt(&place))?;
        Some(format!(
            "{place} names {way}, expected base::regular, which neither waits nor reads without a bound"
        ))
    };
    let wrong: Vec<String> = sources().into_iter().filter_map(told).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    for (place, why) in OPENED_BY_ITSELF {
        let known = sources().into_iter().find(|(known, _)| known == place);
        assert!(
            known.is_some_and(|(_, code)| opens_by_itself(&code).is_some()),
            "{place} ({why}) opens nothing"
        );
    }
}

#[test]
fn json_of_others_is_read_in_one_way() {
    // Messages within recordings, which checksums cover, and what a program of this system prints.
    let own = |place: &str| {
        ["core/base/json.rs", "node/capture/report.rs", "node/worker/run.rs", "node/api/audit.rs"]
            .contains(&place)
            || place.starts_with("record/")
    };
    let reads = |code: &str| {
        [
            "serde_json::from_slice",
            "serde_json::from_str",
            "serde_json::from_value",
            "serde_json::from_reader",
        ]
        .iter()
        .any(|way| without_tests(code).contains(way))
    };
    assert!(reads("serde_json::from_slice(&bytes)") && !reads("json::from_slice(&bytes)"));
    assert_eq!(offenders(|place| own(place) || place.ends_with("tests.rs"), reads), [""; 0]);
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
        let rest = text.strip_prefix(&format!("// {LICENCE}\n"));
        let rest = rest.unwrap_or_else(|| panic!("{}: the first line is not `// {LICENCE}`", path.display()));
        assert!(rest.starts_with("//! "), "{}: the second line is not `//! ...`", path.display());
        assert!(lines <= 600, "{}: {lines} lines, 600 are the limit; split it", path.display());
    }
}

/// A comment of four words or fewer repeats the name below it, or leaves out unit, source or condition.
#[test]
fn comments_of_documentation_are_sentences() {
    let mut short = Vec::new();
    for folder in ["src", "crates", "simulator", "hsu-firmware-proto", "firmware"] {
        for path in rust_files(&root().join(folder)) {
            let text = std::fs::read_to_string(&path).expect("a source file");
            let mut words: Option<usize> = None;
            for (number, line) in text.lines().map(str::trim_start).chain([""]).enumerate() {
                match line.strip_prefix("///").or_else(|| line.strip_prefix("//!")) {
                    Some(comment) => {
                        *words.get_or_insert(0) += comment.split_whitespace().count();
                    }
                    None if words.take().is_some_and(|count| count < 5) => {
                        short.push(format!("{}:{number}", path.display()));
                    }
                    None => {}
                }
            }
        }
    }
    assert!(short.is_empty(), "write five words or more, or none: {}", short.join(", "));
}

#[test]
fn every_script_names_its_licence() {
    let scripts = files(&root(), &[".sh", ".py"]);
    assert!(scripts.len() > 20, "{scripts:?}");
    for path in scripts {
        let text = std::fs::read_to_string(&path).expect("a script");
        let line = text.lines().find(|line| !line.starts_with("#!"));
        assert_eq!(line, Some(&*format!("# {LICENCE}")), "{}", path.display());
    }
}
