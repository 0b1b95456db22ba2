// SPDX-License-Identifier: MIT OR Apache-2.0
//! The list of constants in `docs/design/fringe-order.md` against the sources.

use std::fs::read_to_string;
use std::path::{Path, PathBuf};

const FOLDERS: [&str; 7] = ["fringe_order", "refine", "marker", "phase", "mask", "triangulate", "merge"];

fn rust_files(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).expect("a folder").map(|entry| entry.expect("an entry").path());
    let files = entries.flat_map(|path| if path.is_dir() { rust_files(&path) } else { vec![path] });
    files.filter(|file| !file.ends_with("tests.rs")).collect()
}

/// Name and value of a line that begins the definition of a constant number.
fn constant(line: &str) -> Option<(&str, &str)> {
    let line = line.trim_start();
    let line =
        line.split_once("const ").filter(|(before, _)| before.is_empty() || before.starts_with("pub"))?.1;
    let (name, rest) = line.split_once(": ")?;
    let (kind, value) = rest.split_once(" =")?;
    let is_name = name.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_');
    let is_number = kind != "&str" && kind != "Self";
    (is_name && is_number).then_some((name, value.trim().trim_end_matches(';')))
}

#[test]
fn every_constant_is_listed_with_its_file_and_value() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = read_to_string(root.join("../../docs/design/fringe-order.md")).expect("the document");
    let (mut missing, mut found) = (Vec::new(), 0);
    for folder in FOLDERS {
        let section = text.split(&format!("\n### {folder}\n")).nth(1).expect("a section for each folder");
        let section = section.split("\n### ").next().unwrap_or_default();
        for file in rust_files(&root.join("src").join(folder)) {
            let source = read_to_string(&file).expect("a source file");
            let product = source.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
            let product = product.split("#[cfg(test)]\npub(crate) mod tests").next().unwrap_or_default();
            let file = file.file_name().expect("a name").to_string_lossy().into_owned();
            for (name, value) in product.lines().filter_map(constant) {
                let rows = section.lines().filter(|row| row.starts_with(&format!("| `{name}` | ")));
                let mut rows = rows.filter(|row| row.contains(&format!("| `{file}` |")));
                let plain = value.replace('_', "").parse::<f64>().is_ok();
                let value = value.replace('_', "");
                let is_listed = rows.any(|row| !plain || row.contains(&format!("| {value} |")));
                found += 1;
                if !is_listed {
                    missing.push(format!("{folder}/{file}: {name} = {value}"));
                }
            }
        }
    }
    assert!(missing.is_empty(), "expected a row in docs/design/fringe-order.md for {missing:#?}");
    assert!(found > 150, "only {found} constants were found");
}
