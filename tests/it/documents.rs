// SPDX-License-Identifier: MIT OR Apache-2.0
//! The documents: a new reader finds the way from the README to a file, and every file that a document names exists.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Paths of all documents, with their texts.
fn documents() -> Vec<(PathBuf, String)> {
    let mut found = Vec::new();
    let of_docs = ["docs", "docs/guide", "docs/design", "docs/reference"];
    for folder in [""].into_iter().chain(of_docs).chain(["hsu-firmware-proto", "simulator", "web", "fuzz"]) {
        for entry in std::fs::read_dir(root().join(folder)).expect(folder) {
            let path = entry.expect("an entry").path();
            if path.extension().is_some_and(|end| end == "md") {
                found.push((path.clone(), std::fs::read_to_string(path).expect("a document")));
            }
        }
    }
    assert!(found.len() > 20, "{} documents", found.len());
    found
}

/// The first sentence of a file's own description.
fn first_sentence(path: &str) -> String {
    let text = read(path);
    // Below the licence.
    let lines = text.lines().skip(1).take_while(|line| line.starts_with("//!"));
    let text: Vec<&str> = lines.map(|line| line.trim_start_matches("//!").trim()).collect();
    text.join(" ").split(". ").next().unwrap_or_default().to_owned()
}

/// The file at a place: `crate/path` below that crate's sources, or a path below the program's.
fn placed(place: &str) -> String {
    let of_library = place.split_once('/').map(|(krate, path)| format!("crates/{krate}/src/{path}"));
    of_library.filter(|file| root().join(file).exists()).unwrap_or_else(|| format!("src/{place}"))
}

/// The README names the map of the code, a line of the map names the file, and the file's first sentence describes it.
#[test]
fn a_new_reader_finds_a_stage_in_two_steps() {
    assert!(read("README.md").contains("ARCHITECTURE.md"));
    let map = read("ARCHITECTURE.md");
    for (question, on_line, file, in_file) in [
        ("what computes Wm", "computes Wm", "reconstruct/phase/demodulate.rs", "Wrapped phase Wm"),
        (
            "what decides a fringe order",
            "get their fringe orders",
            "reconstruct/fringe_order/mod.rs",
            "Fringe orders",
        ),
        ("what writes a frame", "writer", "record/writer.rs", "Writes one node's recording"),
        (
            "what decides which trigger a frame is of",
            "which trigger it is",
            "record/matcher/mod.rs",
            "Which trigger a frame belongs to",
        ),
        ("where the paper's own method is", "to the letter", "reconstruct/paper", ""),
    ] {
        let lines = map.lines().filter(|line| line.contains(file));
        assert!(
            lines.map(str::to_lowercase).any(|line| line.contains(&on_line.to_lowercase())),
            "{question}: {file}"
        );
        assert!(in_file.is_empty() || first_sentence(&placed(file)).contains(in_file), "{file}");
    }
}

/// Words in backticks that look like files, and the targets of links.
fn files_named(text: &str) -> Vec<String> {
    let quoted = text.split('`').skip(1).step_by(2);
    let is_file = |word: &&str| {
        let end = word.rsplit('.').next().unwrap_or_default();
        // Scripts without a folder are those that `cluster submit` writes.
        (end == "rs" || word.contains('/') && ["md", "sh"].contains(&end))
            && !word.contains(['*', ' ', '<', '{', '$', '~'])
    };
    let quoted = quoted.flat_map(|quote| quote.split_whitespace()).filter(is_file);
    let linked = text.split("](").skip(1).filter_map(|rest| rest.split([')', '#']).next());
    let linked = linked.filter(|link| !link.is_empty() && !link.contains(':'));
    quoted.chain(linked).map(str::to_owned).collect()
}

/// Adds the names of all files below a folder, without hidden and build folders.
fn file_names(folder: &Path, names: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.starts_with('.') || name == "target" {
            continue;
        }
        if path.is_dir() {
            file_names(&path, names);
        } else {
            names.insert(name);
        }
    }
}

#[test]
fn every_file_that_a_document_names_is_there() {
    let mut names = BTreeSet::new();
    file_names(&root(), &mut names);
    let mut missing = Vec::new();
    for (document, text) in documents() {
        // A path starts at the document, at the root, at a crate, or at the folder that the document describes.
        let folders =
            ["", "crates/reconstruct/src", "simulator/src", "tests/it"].map(|folder| root().join(folder));
        let from = [document.parent().expect("a folder").to_path_buf()].into_iter().chain(folders);
        let from: Vec<PathBuf> = from.collect();
        for name in files_named(&text) {
            // Output of commands exists only after they have run.
            let made = name.starts_with("target/") || name.starts_with('/');
            let there = made
                || from.iter().any(|from| from.join(&name).exists())
                || root().join(placed(&name)).exists();
            let alone = !name.contains('/') && names.contains(&name);
            if !there && !alone {
                missing.push(format!("{} names {name}", document.display()));
            }
        }
    }
    assert!(missing.is_empty(), "{}", missing.join("\n"));
}

/// Lines of code, tables and links are exempt, because they cannot be broken.
#[test]
fn lines_of_documents_are_short() {
    let mut long = Vec::new();
    for (document, text) in documents() {
        let mut fenced = false;
        for (number, line) in text.lines().enumerate() {
            fenced ^= line.starts_with("```");
            let unbreakable =
                fenced || line.starts_with("    ") || line.starts_with('|') || line.contains("](");
            if !unbreakable && line.chars().count() > 120 {
                long.push(format!("{}:{}", document.display(), number + 1));
            }
        }
    }
    assert!(long.is_empty(), "break these lines at 120 characters: {}", long.join(", "));
}

/// `make TARGET` leaves the summary from which scripts/write_tables.py writes a table.
#[test]
fn tables_name_a_make_target() {
    let (validation, makefile) = (read("docs/validation.md"), read("Makefile"));
    let targets: Vec<&str> = validation
        .lines()
        .filter_map(|line| line.strip_prefix("<!-- table: ")?.split_whitespace().next())
        .collect();
    assert!(targets.len() > 3, "tables of {targets:?} only");
    assert_eq!(targets.len(), validation.matches("<!-- end -->").count(), "each table has an end");
    for target in targets {
        let rule = format!("\n{target}:");
        assert!(
            makefile.contains(&rule),
            "docs/validation.md has a table of `make {target}`, which does not exist"
        );
    }
}

/// Commands that the installation guide runs as the service's user: that user may write to their paths, and they use the
/// rights of its unit. `scripts/try-package.sh` runs the commands in a clean Debian.
#[test]
fn the_guides_commands_have_the_rights_of_the_service() {
    let unit = read("systemd/fourdbody-node.service");
    let value_of = |key: &str| {
        let line = unit.lines().find_map(|line| line.strip_prefix(key)).unwrap_or_else(|| panic!("{key}"));
        line.trim_start_matches('=').to_owned()
    };
    let guide = read("docs/guide/installing.md").replace("\\\n", " ");
    let user = value_of("User");
    let tokens: Vec<&str> = guide.lines().filter(|line| line.contains(" token new ")).collect();
    assert!(!tokens.is_empty(), "the guide makes tokens");
    for line in tokens {
        assert!(line.starts_with(&format!("sudo -u {user} fourdbody token new ")), "{line}");
        for option in ["--tokens", "--file"] {
            let words: Vec<&str> = line.split_whitespace().collect();
            let path = words.iter().position(|word| *word == option).and_then(|place| words.get(place + 1));
            // /etc/fourdbody belongs to root, and the current directory to the administrator.
            let own = format!("/var/lib/{}/", value_of("StateDirectory"));
            assert!(path.is_some_and(|path| path.starts_with(&own)), "{option} in {line}");
        }
    }
    let doctor =
        guide.lines().find(|line| line.contains("fourdbody doctor --config")).expect("is this PC fit");
    let capability = value_of("AmbientCapabilities").trim_start_matches("CAP_").to_lowercase();
    for right in [
        format!("--reuid={user}"),
        format!("--rtprio={}", value_of("LimitRTPRIO")),
        format!("--ambient-caps=+{capability}"),
        format!("--inh-caps=+{capability}"),
    ] {
        assert!(doctor.contains(&right), "{right} in {doctor}");
    }
    assert!(value_of("LimitMEMLOCK") == "infinity" && doctor.contains("--memlock=unlimited"), "{doctor}");
}

/// The versions that tables were measured with, against those of the code. With `FOURDBODY_RELEASE` set all have to be
/// the same, and nothing may be unmeasured; between releases no table may claim a version that does not exist yet.
#[test]
fn tables_are_of_this_version_at_a_release() {
    let is_release = std::env::var_os("FOURDBODY_RELEASE").is_some();
    let versions = [
        ("easured with algorithm ", fourdbody::batch::key::ALGORITHM),
        ("easured with way to the disk ", fourdbody::record::INGEST),
    ];
    let (mut old, mut wrong) = (Vec::new(), Vec::new());
    for (document, text) in documents() {
        let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
        let name = document.display();
        for (words, current) in versions {
            for (_, rest) in text.match_indices(words).map(|(i, _)| text.split_at(i + words.len())) {
                let digits: String = rest.chars().take_while(char::is_ascii_digit).collect();
                match digits.parse::<u32>() {
                    Ok(version) if version > current => wrong.push(format!("{name}: {words}{version}")),
                    Ok(version) if version < current => old.push(format!("{name}: {words}{version}")),
                    // The sentence that explains the words.
                    _ => {}
                }
            }
        }
        let tables = text
            .split("<!-- table: ")
            .skip(1)
            .map(|table| table.split("<!-- end -->").next().unwrap_or(table));
        let bare = tables.filter(|table| !table.contains("easured with"));
        old.extend(
            bare.map(|table| format!("{name}: {} has no version", &table[..table.find(' ').unwrap_or(0)])),
        );
        if text.contains("ot measured with this version.") {
            old.push(format!("{name}: not measured with this version"));
        }
    }
    assert!(wrong.is_empty(), "no such version: {wrong:#?}");
    println!("of earlier versions: {old:#?}");
    assert!(!is_release || old.is_empty(), "`make figures` measures these: {old:#?}");
}
