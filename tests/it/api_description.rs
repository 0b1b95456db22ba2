// SPDX-License-Identifier: MIT OR Apache-2.0
//! The API's description against the running server: every route is described, every answer is as described, and
//! whatever is sent that fits the description (or nearly) breaks nothing and changes nothing unasked.

use crate::api_node::{ApiNode, Reply};
use crate::lab::fourdbody;
use proptest::prelude::{BoxedStrategy, Just, Strategy, any, prop_oneof};
use proptest::test_runner::{Config, TestRunner};
use serde_json::{Map, Value, json};
use std::path::Path;
use std::time::Duration;

const METHODS: [&str; 5] = ["get", "post", "put", "patch", "delete"];

/// What needs no token.
const OPEN: [&str; 4] = ["/api/v1/login", "/api/v1/login/link", "/api/v1/challenge", "/health"];

fn description(node: &ApiNode) -> Value {
    node.client("vera").get("/api/v1/openapi.json").expect("an answer")
}

/// Path, method and operation of each route in the description.
fn operations(api: &Value) -> Vec<(String, &'static str, Value)> {
    let mut found = Vec::new();
    for (path, item) in api["paths"].as_object().expect("paths") {
        for method in METHODS {
            if let Some(operation) = item.get(method) {
                found.push((path.clone(), method, operation.clone()));
            }
        }
    }
    assert!(found.len() > 10, "{} operations are not the API", found.len());
    found
}

fn resolve<'a>(api: &'a Value, schema: &'a Value) -> &'a Value {
    match schema.get("$ref").and_then(Value::as_str) {
        Some(reference) => {
            let place = reference.strip_prefix('#').expect("a reference into this document");
            resolve(api, api.pointer(place).unwrap_or_else(|| panic!("{reference} leads nowhere")))
        }
        None => schema,
    }
}

/// Why a value is not what a schema says; the part of JSON Schema that the description uses, but `whole` objects have only
/// what is described. Parts of an object (`allOf`) do not describe all of it.
fn violation(api: &Value, schema: &Value, value: &Value, whole: bool) -> Option<String> {
    let schema = resolve(api, schema);
    let told = |what: String| Some(format!("{what}: {value} for {schema}"));
    let list = |key: &str| schema.get(key).and_then(Value::as_array);
    if let Some(allowed) = list("enum").filter(|allowed| !allowed.contains(value)) {
        return told(format!("none of {allowed:?}"));
    }
    for key in ["oneOf", "anyOf"] {
        if let Some(choices) = list(key) {
            let fitting =
                choices.iter().filter(|choice| violation(api, choice, value, whole).is_none()).count();
            if fitting == 0 {
                return told(format!("none of {key}"));
            }
        }
    }
    if let Some(wrong) =
        list("allOf").into_iter().flatten().find_map(|part| violation(api, part, value, false))
    {
        return Some(wrong);
    }
    let is = |kind: &str| match kind {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "string" => value.is_string(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        other => panic!("unknown type {other}"),
    };
    let fits = match schema.get("type") {
        None => true,
        Some(Value::String(kind)) => is(kind),
        Some(Value::Array(kinds)) => kinds.iter().filter_map(Value::as_str).any(is),
        Some(other) => panic!("unknown type {other}"),
    };
    if !fits {
        return told("another type".to_owned());
    }
    if let Some(items) = value.as_array().zip(schema.get("items")) {
        return items.0.iter().find_map(|item| violation(api, items.1, item, true));
    }
    let object = value.as_object()?;
    let required = list("required").into_iter().flatten().filter_map(Value::as_str);
    if let Some(missing) = required.into_iter().find(|name| !object.contains_key(*name)) {
        return told(format!("{missing} is missing"));
    }
    let empty = Map::new();
    let properties = schema.get("properties").and_then(Value::as_object).unwrap_or(&empty);
    for (name, value) in object {
        let wrong = match (properties.get(name), schema.get("additionalProperties")) {
            (Some(property), _) => violation(api, property, value, true),
            (None, Some(Value::Bool(false))) => told(format!("{name} is not described")),
            (None, Some(rest)) if rest.is_object() => violation(api, rest, value, true),
            (None, _) if whole && !properties.is_empty() => told(format!("{name} is not described")),
            _ => None,
        };
        if wrong.is_some() {
            return wrong;
        }
    }
    None
}

/// The answer must be among those described, and of the described shape.
fn check(api: &Value, operation: &Value, what: &str, reply: &Reply) {
    let described = &operation["responses"][reply.status.to_string()];
    assert!(described.is_object(), "{what}: {} is not described; {}", reply.status, reply.body);
    let Some(content) = described.get("content").and_then(Value::as_object) else {
        return assert!(
            reply.body.is_empty(),
            "{what}: {} should have no body: {}",
            reply.status,
            reply.body
        );
    };
    let kind = reply.header("content-type").unwrap_or_default();
    let kind = kind.split(';').next().unwrap_or_default();
    let media = content.get(kind).unwrap_or_else(|| panic!("{what}: {kind:?} is not described"));
    if kind == "application/json" {
        let body: Value = serde_json::from_str(&reply.body).expect("JSON");
        let wrong = violation(api, &media["schema"], &body, true);
        assert!(wrong.is_none(), "{what}: {}", wrong.unwrap_or_default());
    }
}

/// A path with something in its variable parts.
fn concrete(path: &str) -> String {
    let parts = [("{camera}", "h0_up"), ("{name}", "walk-01"), ("{trigger}", "0"), ("{peer}", "b")];
    let path = parts.iter().fold(path.to_owned(), |path, (part, value)| path.replace(part, value));
    assert!(!path.contains('{'), "{path}: a part that this test does not know");
    path
}

/// A list of values is taken by what is derived for a type with fields, and a missing body for an empty one.
#[test]
fn a_body_is_an_object_or_nothing_on_every_route() {
    let node = ApiNode::start();
    let api = description(&node);
    let mut asked = 0;
    for (path, method, operation) in operations(&api) {
        if method != "post" {
            continue;
        }
        let what = format!("POST {}", concrete(&path));
        for body in ["[]", "[null,null]", "[1,\"a\"]", "[{}]", "null", "7", "\"\"", "{\"sudo\":true}"] {
            let reply = node.send(Some("ada"), &what, &[], body);
            assert_eq!(reply.status, 400, "{what} {body}: {reply:?}");
            check(&api, &operation, &what, &reply);
            asked += 1;
        }
    }
    assert!(asked > 100, "{asked} bodies are not those of all routes");
    node.assert_untouched();
}

#[test]
fn every_route_is_described_and_answers_as_described() {
    let node = ApiNode::start();
    let api = description(&node);
    let printed = fourdbody(&["node", "--print-openapi"]);
    let printed: Value = serde_json::from_slice(&printed.stdout).expect("JSON");
    assert_eq!(printed, api, "the binary prints what the node serves");
    let described = operations(&api);
    for (path, method, operation) in &described {
        let what = format!("{} {}", method.to_uppercase(), concrete(path));
        assert!(
            operation["description"].is_string() || operation["summary"].is_string(),
            "{what} says nothing"
        );
        if *method == "get" {
            let reply = node.send(Some("vera"), &what, &[], "");
            check(&api, operation, &what, &reply);
            // A node without devices is not healthy, and one without a calibration has no body; both say so.
            let expected = match path.as_str() {
                "/api/v1/health" | "/health" => 503..=503,
                "/api/v1/live" => 409..=409,
                _ => 200..=404,
            };
            assert!(expected.contains(&reply.status), "{what}: {reply:?}");
        }
        if !OPEN.contains(&path.as_str()) {
            let headers: &[&str] = if *method == "get" { &[] } else { &["content-length: 0"] };
            let reply = node.send(None, &what, headers, "");
            assert!(matches!(reply.status, 401 | 429), "{what} without a token: {reply:?}");
            check(&api, operation, &what, &reply);
        }
    }
    // The other way round: every path that the sources name is described.
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/node/src/control/status.rs");
    let source = std::fs::read_to_string(source).expect("readable");
    let named = source.split('"').filter(|text| text.starts_with("/api/v1/"));
    let missing: Vec<&str> = named.filter(|name| described.iter().all(|(path, ..)| path != name)).collect();
    assert!(missing.is_empty(), "not described: {missing:?}");
    node.assert_untouched();
}

fn any_json() -> BoxedStrategy<Value> {
    let leaf = prop_oneof![
        Just(Value::Null),
        any::<bool>().prop_map(Value::from),
        any::<i64>().prop_map(Value::from),
        any::<f64>().prop_map(Value::from),
        ".{0,20}".prop_map(Value::from),
    ];
    leaf.prop_recursive(4, 32, 5, |inner| {
        prop_oneof![
            proptest::collection::vec(inner.clone(), 0..5).prop_map(Value::from),
            proptest::collection::btree_map("[a-z_]{1,12}", inner, 0..5)
                .prop_map(|map| Value::from(map.into_iter().collect::<Map<_, _>>())),
        ]
    })
    .boxed()
}

/// Values that fit a schema, and some that do not.
fn values(api: &Value, schema: &Value) -> BoxedStrategy<Value> {
    let fitting = fitting(api, schema);
    prop_oneof![9 => fitting, 1 => any_json()].boxed()
}

fn fitting(api: &Value, schema: &Value) -> BoxedStrategy<Value> {
    let schema = resolve(api, schema).clone();
    if let Some(choices) = schema.get("oneOf").or(schema.get("anyOf")).and_then(Value::as_array) {
        let choices: Vec<_> = choices.iter().map(|choice| values(api, choice)).collect();
        return proptest::strategy::Union::new(choices).boxed();
    }
    if let Some(words) = schema.get("enum").and_then(Value::as_array) {
        return proptest::sample::select(words.clone()).boxed();
    }
    let kinds: Vec<String> = match schema.get("type") {
        Some(Value::String(kind)) => vec![kind.clone()],
        Some(Value::Array(kinds)) => kinds.iter().filter_map(|k| k.as_str().map(ToOwned::to_owned)).collect(),
        _ => return any_json(),
    };
    let of = |kind: &String| match kind.as_str() {
        "null" => Just(Value::Null).boxed(),
        "boolean" => any::<bool>().prop_map(Value::from).boxed(),
        "integer" => prop_oneof![any::<u64>(), 0u64..5, Just(u64::MAX)].prop_map(Value::from).boxed(),
        "number" => any::<f64>().prop_map(Value::from).boxed(),
        // Among them: names that leave their directory, and this node's own name.
        "string" => {
            prop_oneof!["[a-zA-Z0-9._-]{1,64}", ".{0,80}", Just("a".to_owned()), Just("../../x".to_owned())]
                .prop_map(Value::from)
                .boxed()
        }
        "array" => {
            let items = schema.get("items").map_or_else(any_json, |items| values(api, items));
            proptest::collection::vec(items, 0..4).prop_map(Value::from).boxed()
        }
        _ => objects(api, &schema),
    };
    proptest::strategy::Union::new(kinds.iter().map(of).collect::<Vec<_>>()).boxed()
}

fn objects(api: &Value, schema: &Value) -> BoxedStrategy<Value> {
    let required: Vec<&str> = schema
        .get("required")
        .and_then(Value::as_array)
        .into_iter()
        .flatten()
        .filter_map(Value::as_str)
        .collect();
    let mut object = Just(Map::new()).boxed();
    for (name, property) in schema.get("properties").and_then(Value::as_object).into_iter().flatten() {
        let share = if required.contains(&name.as_str()) { 0.95 } else { 0.5 };
        let value = proptest::option::weighted(share, values(api, property));
        let name = name.clone();
        object = (object, value)
            .prop_map(move |(mut object, value)| {
                value.map(|value| object.insert(name.clone(), value));
                object
            })
            .boxed();
    }
    object.prop_map(Value::from).boxed()
}

#[test]
fn whatever_is_sent_breaks_nothing_and_changes_nothing_unasked() {
    let node = ApiNode::start();
    let api = description(&node);
    let mut runner = TestRunner::new(Config { cases: 24, max_shrink_iters: 24, ..Config::default() });
    let mut changes = operations(&api);
    changes.retain(|(_, method, _)| *method != "get");
    // A capture that has begun keeps the node busy with cameras that are not there.
    changes.sort_by_key(|(path, ..)| path.starts_with("/api/v1/capture"));
    for (path, method, operation) in &changes {
        let line = format!("{} {}", method.to_uppercase(), concrete(path));
        let schema = operation["requestBody"]["content"]["application/json"]["schema"].clone();
        let bodies = if schema.is_null() { Just(json!({})).boxed() } else { values(&api, &schema) };
        let result = runner.run(&bodies, |body| {
            let body = body.to_string();
            // A view: whatever the body is, nothing comes of it.
            if !OPEN.contains(&path.as_str()) && path != "/api/v1/logout" {
                let reply = patient(|| node.send(Some("vera"), &line, &[], &body));
                assert_eq!(reply.status, 403, "{line} {body}");
                check(&api, operation, &line, &reply);
            }
            let reply = patient(|| node.send(Some("otto"), &line, &[], &body));
            assert!(reply.status < 500 || reply.status == 503, "{line} {body}: {reply:?}");
            check(&api, operation, &line, &reply);
            Ok(())
        });
        result.unwrap_or_else(|error| panic!("{line}: {error}"));
    }
    assert!(!node.log().contains("panicked"), "{}", node.log());
    let status = node.local().status().expect("alive");
    assert!(status.problems().iter().all(|problem| !problem.contains("panicked")));
    // What the viewer sent is in the audit log as refused, if at all.
    let viewer = node
        .audit()
        .into_iter()
        .filter(|line| line.who == "vera" && OPEN.iter().all(|path| !line.what.ends_with(path)));
    assert!(viewer.into_iter().all(|line| line.status == 403));
}

/// Asks again when it was too often.
fn patient(ask: impl Fn() -> Reply) -> Reply {
    loop {
        let reply = ask();
        if reply.status != 429 {
            return reply;
        }
        std::thread::sleep(Duration::from_millis(500));
    }
}
