// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files of other programs as one tree of values. A matrix is an object with `rows`, `cols` and `data`, as OpenCV has
//! it, or a list of rows.

use crate::base::{json as strict, regular};
use crate::formats::npz::NpzReader;
use saphyr::{LoadableYamlNode, Scalar, Yaml};
use serde_json::{Map, Value, json};
use std::path::Path;

/// No array of a calibration has more numbers.
const NUMBERS_MAX: u64 = 64;
/// No file nests lists and objects as deep; readers that call themselves for each have a stack that ends.
const DEPTH_MAX: usize = 32;

/// The values of a file by their names.
///
/// # Errors
/// What the file is instead of YAML, XML, JSON or NPZ, and what to do.
pub fn read(path: &Path) -> Result<Map<String, Value>, String> {
    let bytes = regular::read(path, regular::STATEMENT_BYTES).map_err(|e| e.to_string())?;
    if bytes.starts_with(b"PK\x03\x04") {
        return npz(path);
    }
    if bytes.starts_with(b"MATLAB") || bytes.starts_with(b"\x89HDF") {
        return Err("expected a text, found a MATLAB file; write it in MATLAB as JSON: \
             fid = fopen('stereo.json', 'w'); fprintf(fid, '%s', jsonencode(toStruct(stereoParams))); fclose(fid)"
            .to_owned());
    }
    let kinds = "YAML, XML or JSON of OpenCV, NPZ of NumPy, JSON of MATLAB, or TOML of Anipose";
    let text =
        String::from_utf8(bytes).map_err(|_| format!("expected {kinds}, found bytes that are no text"))?;
    if deepest(&text) > DEPTH_MAX {
        return Err(format!("expected {kinds}, found lists in lists, more than {DEPTH_MAX} deep"));
    }
    let wrong = |e: &dyn std::fmt::Display| format!("expected {kinds}, found a text with an error: {e}");
    let value = match text.trim_start().as_bytes().first() {
        Some(b'<') => xml(&text).map_err(|e| wrong(&e))?,
        Some(b'{') => strict::from_slice(text.as_bytes()).map_err(|e| wrong(&e))?,
        _ if path.extension().is_some_and(|x| x == "toml") => {
            toml::from_str(&text).map_err(|e| wrong(&e.message()))?
        }
        _ => yaml(&text).map_err(|e| wrong(&e))?,
    };
    match value {
        Value::Object(map) => Ok(map),
        _ => Err(format!("expected {kinds}, found a text without names")),
    }
}

/// How deep brackets and lists of YAML are nested at most.
fn deepest(text: &str) -> usize {
    let (mut depth, mut most) = (0usize, 0);
    for byte in text.bytes() {
        match byte {
            b'[' | b'{' => depth += 1,
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        most = most.max(depth);
    }
    let dashes = |line: &str| line.matches("- ").count() + line.matches("? ").count();
    let indented = |line: &str| (line.len() - line.trim_start().len()) / 2;
    most.max(text.lines().map(|line| dashes(line).max(indented(line).min(DEPTH_MAX + 1))).max().unwrap_or(0))
}

fn yaml(text: &str) -> Result<Value, String> {
    // OpenCV's first line is no directive of YAML.
    let text = text.trim_start_matches('\u{feff}');
    let text = if text.starts_with("%YAML:") { text.split_once('\n').map_or("", |x| x.1) } else { text };
    // A text of some lines may repeat itself a billion times.
    if text.contains(": *") || text.contains("- *") || text.contains("[*") || text.contains(", *") {
        return Err("an alias (*), which is not read".to_owned());
    }
    let documents = Yaml::load_from_str(text).map_err(|e| e.to_string())?;
    Ok(documents.into_iter().next().map_or(Value::Null, |first| value_of(&first)))
}

fn value_of(yaml: &Yaml<'_>) -> Value {
    match yaml {
        Yaml::Value(Scalar::Boolean(x)) => json!(x),
        Yaml::Value(Scalar::Integer(x)) => json!(x),
        Yaml::Value(Scalar::FloatingPoint(x)) => json!(x.into_inner()),
        Yaml::Value(Scalar::String(x)) => json!(x),
        Yaml::Sequence(list) => list.iter().map(value_of).collect(),
        Yaml::Mapping(map) => {
            let entry =
                |(key, value): (&Yaml<'_>, &Yaml<'_>)| Some((key.as_str()?.to_owned(), value_of(value)));
            Value::Object(map.iter().filter_map(entry).collect())
        }
        Yaml::Tagged(_, inner) => value_of(inner),
        _ => Value::Null,
    }
}

fn xml(text: &str) -> Result<Value, roxmltree::Error> {
    let document = roxmltree::Document::parse(text)?;
    Ok(value_of_node(document.root_element()))
}

/// An element with others in it is an object, one without a list of its numbers, or its text.
fn value_of_node(node: roxmltree::Node<'_, '_>) -> Value {
    let mut inner = node.children().filter(roxmltree::Node::is_element).peekable();
    if inner.peek().is_some() {
        let named = inner.map(|child| (child.tag_name().name().to_owned(), value_of_node(child)));
        return Value::Object(named.collect());
    }
    let text = node.text().unwrap_or_default().trim();
    let numbers: Result<Vec<f64>, _> = text.split_whitespace().map(str::parse).collect();
    match numbers {
        Ok(numbers) if node.tag_name().name() != "data" && numbers.len() == 1 => json!(numbers[0]),
        Ok(numbers) => json!(numbers),
        Err(_) => json!(text),
    }
}

fn npz(path: &Path) -> Result<Map<String, Value>, String> {
    let mut file = NpzReader::open(path).map_err(|e| {
        format!("expected NPZ of NumPy (numpy.savez), found a zip archive that is none: {e}; unpack it")
    })?;
    let mut all = Map::new();
    for name in file.names() {
        // Lists of views and texts beside the matrices are of other types and sizes.
        let whole = |(shape, numbers): (Vec<u64>, Vec<i64>)| {
            (shape, numbers.into_iter().map(|x| x as f64).collect::<Vec<f64>>())
        };
        let single = |(shape, numbers): (Vec<u64>, Vec<f32>)| {
            (shape, numbers.into_iter().map(f64::from).collect::<Vec<f64>>())
        };
        let array = file.array::<f64>(&name);
        let array = array.or_else(|_| file.array::<f32>(&name).map(single));
        let array = array.or_else(|_| file.array::<i64>(&name).map(whole));
        let Ok((shape, numbers)) = array else { continue };
        if numbers.len() as u64 <= NUMBERS_MAX {
            let rows = shape.first().copied().unwrap_or(1);
            let cols = numbers.len() as u64 / rows.max(1);
            all.insert(name, json!({ "rows": rows, "cols": cols, "data": numbers }));
        }
    }
    Ok(all)
}
