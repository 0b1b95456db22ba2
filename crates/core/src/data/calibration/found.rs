// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a file is that is no calibration, in words for the person who named it.

use serde_json::{Map, Value};

/// Most names of an object that are quoted.
const NAMES: usize = 4;

/// Of bytes that are not JSON.
pub(super) fn not_json(bytes: &[u8], error: &serde_json::Error) -> String {
    let (line, column) = (error.line(), error.column());
    match std::str::from_utf8(bytes) {
        _ if bytes.is_empty() => "an empty file".to_owned(),
        Err(_) => "a file of another kind, which is not text".to_owned(),
        Ok(_) if error.is_eof() => format!("JSON that breaks off at line {line}: the file is not complete"),
        Ok(text) => {
            let start: String = text.trim_start().chars().take(20).take_while(|c| !c.is_control()).collect();
            format!("text that is not JSON from line {line}, column {column} on (it begins with {start:?})")
        }
    }
}

/// Of an object whose `format` is another one.
pub(super) fn another_object(object: &Map<String, Value>) -> String {
    if let Some(Value::String(format)) = object.get("format") {
        return format!("a file of the format {format:?}");
    }
    let mut names: Vec<String> = object.keys().take(NAMES).map(|name| format!("{name:?}")).collect();
    if object.len() > NAMES {
        names.push("...".to_owned());
    }
    format!("JSON of something else, with the fields {}", names.join(", "))
}

/// Of a calibration with a field that is not as it should be.
pub(super) fn misfit(error: &serde_json::Error) -> String {
    let text = error.to_string();
    if let Some(field) = text.strip_prefix("missing field `").and_then(|rest| rest.split('`').next()) {
        return format!("a calibration without the field {field:?}: it is not complete");
    }
    format!("a calibration with a value of the wrong kind ({text})")
}

#[cfg(test)]
mod tests {
    use super::{another_object, misfit, not_json};
    use serde_json::{Value, from_slice, json};

    #[test]
    fn other_files_are_described_without_words_of_the_program() {
        let told = |bytes: &[u8]| not_json(bytes, &from_slice::<Value>(bytes).expect_err("not JSON"));
        assert_eq!(told(b""), "an empty file");
        assert_eq!(told(b"{\"a\": [1,\n 2"), "JSON that breaks off at line 2: the file is not complete");
        assert_eq!(told(&[0x89, 0xff, 0xfe]), "a file of another kind, which is not text");
        let rig = told(b"name = \"rig\"\n");
        assert_eq!(
            rig,
            "text that is not JSON from line 1, column 2 on (it begins with \"name = \\\"rig\\\"\")"
        );
        let object = json!({ "a": 1, "b": 2, "c": 3, "d": 4, "e": 5 });
        let object = another_object(object.as_object().expect("an object"));
        assert_eq!(object, "JSON of something else, with the fields \"a\", \"b\", \"c\", \"d\", ...");
        let error = serde_json::from_value::<super::super::Calibration>(json!({})).expect_err("no field");
        assert!(misfit(&error).contains("without the field \"format\""), "{}", misfit(&error));
    }
}
