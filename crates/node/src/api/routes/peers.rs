// SPDX-License-Identifier: MIT OR Apache-2.0
//! Answers of the other nodes, passed on: a browser may only talk to the node that its page came from.

use crate::api::body::{Body, NoBody};
use crate::api::refusal::Refusal;
use crate::api::services::Peer;
use crate::api::{Caller, Shared};
use crate::base::{Exit, Fault, json};
use crate::control::request::ExposureRequest;
use crate::control::status::{PeerState, path};
use crate::record::remark::Remark;
use axum::Json;
use axum::extract::{Path, RawQuery, State};
use axum::http::{HeaderMap, Method, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Duration;
use utoipa::openapi::{OpenApi, RefOr};
use utoipa::{IntoParams, IntoResponses};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Longest time that a peer may take to answer; a console sends its next request sooner than this.
const PATIENCE: Duration = Duration::from_secs(3);
/// The same for settings: some cameras take seconds to be set up.
const CAMERAS_PATIENCE: Duration = Duration::from_secs(30);
/// The same for frame sets, which are made at idle priority.
const PLAY_PATIENCE: Duration = Duration::from_secs(65);

/// What can be read of another node: the paths of its own API, each with the time that its answer may take.
const READABLE: [(&str, Duration); 10] = [
    (path::PREVIEWS, PATIENCE),
    (path::PICTURE, PATIENCE),
    (path::SESSIONS, PATIENCE),
    (path::QUICK_LOOK, PATIENCE),
    (path::QUICK_LOOK_CLOUD, PATIENCE),
    (path::CALIBRATION_LIGHTS, PATIENCE),
    (path::CALIBRATION_PLOT, PATIENCE),
    (path::PLAYABLE, PATIENCE),
    (path::FRAME_SETS, PLAY_PATIENCE),
    (path::FRAME_SET, PLAY_PATIENCE),
];

/// The variable parts of a path by their names.
type Parts = Path<BTreeMap<String, String>>;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    let described = OpenApiRouter::new()
        .routes(routes!(get_peers))
        .routes(routes!(remark))
        .routes(routes!(expose))
        .routes(routes!(ask_quick_look));
    READABLE.into_iter().fold(described, |router, (own, patience)| {
        let answer = async move |State(shared): State<Shared>, parts: Parts, RawQuery(query): RawQuery| {
            let wanted = query.map_or_else(|| own.to_owned(), |query| format!("{own}?{query}"));
            pass_on(&shared, &parts, (Method::GET, &wanted, None), patience).await
        };
        router.route(&of_peer(own), get(answer))
    })
}

fn of_peer(own: &str) -> String {
    own.replacen("/api/v1", "/api/v1/peers/{peer}", 1)
}

/// Describes the paths that are passed on, from the description of each node's own.
pub(in crate::api) fn describe(api: &mut OpenApi) {
    for (own, _) in READABLE {
        let Some(mut operation) = api.paths.paths.get(own).and_then(|item| item.get.clone()) else {
            continue;
        };
        operation.tags = Some(vec!["peers".to_owned()]);
        operation.operation_id = operation.operation_id.map(|id| format!("{id}_of_peer"));
        operation.summary = Some(format!("The answer of another node to GET {own}, passed on."));
        let peer = PeerName::into_params(|| None).into_iter().map(RefOr::T);
        operation.parameters.get_or_insert_default().extend(peer);
        operation.responses.responses = PassedOn::responses();
        api.paths.paths.entry(of_peer(own)).or_default().get = Some(operation);
    }
}

/// The other nodes, and whether they answer.
#[utoipa::path(get, path = path::PEERS, tag = "peers",
    responses((status = 200, description = "One entry a node.", body = Vec<PeerState>)))]
async fn get_peers(State(shared): State<Shared>) -> Json<Vec<PeerState>> {
    let requested: Vec<_> =
        shared.services.peers.iter().map(|peer| tokio::spawn(state_of(peer.clone()))).collect();
    let mut states = Vec::new();
    for state in requested {
        states.extend(state.await.ok());
    }
    Json(states)
}

async fn state_of(peer: Peer) -> PeerState {
    let answer = peer.client.ask_async(Method::GET, path::STATUS, None, PATIENCE).await;
    let status = match answer {
        Ok(answer) if answer.status.is_success() => {
            json::from_slice(&answer.body).map_err(|e| format!("its answer is not understood: {e}"))
        }
        Ok(answer) => Err(format!("it answered {}", answer.status)),
        Err(fault) => Err(fault.message),
    };
    let url = peer.client.url().to_owned();
    let (status, problem) = match status {
        Ok(status) => (Some(status), None),
        Err(problem) => (None, Some(problem)),
    };
    PeerState { name: peer.name, url, status, problem }
}

/// Stores a rating and a note beside another node's recording.
#[utoipa::path(post, path = path::PEER_REMARK, tag = "peers", params(PeerName, SessionName), request_body = Remark,
    responses(PassedOn))]
async fn remark(
    State(shared): State<Shared>,
    parts: Parts,
    Body(remark): Body<Remark>,
) -> Result<Response, Refusal> {
    pass_on(&shared, &parts, (Method::POST, path::REMARK, Some(encoded(&remark)?)), PATIENCE).await
}

/// Sets exposure and gain of another node's cameras.
#[utoipa::path(post, path = path::PEER_EXPOSURE, tag = "peers", params(PeerName), request_body = ExposureRequest,
    responses(PassedOn))]
async fn expose(
    State(shared): State<Shared>,
    parts: Parts,
    caller: Caller,
    Body(mut request): Body<ExposureRequest>,
) -> Result<Response, Refusal> {
    request.on_behalf_of.get_or_insert(caller.name);
    let post = (Method::POST, path::EXPOSURE, Some(encoded(&request)?));
    pass_on(&shared, &parts, post, CAMERAS_PATIENCE).await
}

/// Requests a quick look at a session from another node.
#[utoipa::path(post, path = path::PEER_QUICK_LOOK, tag = "peers", params(PeerName, SessionName), responses(PassedOn))]
async fn ask_quick_look(State(shared): State<Shared>, parts: Parts, _: NoBody) -> Result<Response, Refusal> {
    pass_on(&shared, &parts, (Method::POST, path::QUICK_LOOK, None), PATIENCE).await
}

#[derive(utoipa::IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "the description is made of it")]
struct PeerName {
    /// The node's name in the rig.
    peer: String,
}

#[derive(utoipa::IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "the description is made of it")]
struct SessionName {
    /// The session's name at that node.
    name: String,
}

/// The answers of another node, which are passed on unchanged.
#[derive(utoipa::IntoResponses)]
#[expect(dead_code, reason = "the description is made of it")]
enum PassedOn {
    /// The answer of the other node.
    #[response(status = 200)]
    Shown,
    /// The other node makes it, or has made it.
    #[response(status = 202)]
    Accepted,
    /// The other node has nothing to show yet.
    #[response(status = 204)]
    Nothing,
    /// The path or the query is not well-formed.
    #[response(status = 400)]
    Malformed,
    /// No such node, or nothing of this name there.
    #[response(status = 404)]
    NotFound(Fault),
    /// The other node refuses it, with its reason.
    #[response(status = 409)]
    Conflict(Fault),
    /// The other node failed at it.
    #[response(status = 500)]
    Failed(Fault),
    /// The other node does not answer.
    #[response(status = 503)]
    Unavailable(Fault),
}

fn encoded(body: &impl Serialize) -> Result<Vec<u8>, Refusal> {
    Ok(serde_json::to_vec(body).map_err(|e| Fault::new(Exit::Failure, e))?)
}

/// Sends a request to the node that the path names, with the other parts of the path filled in.
async fn pass_on(
    shared: &Shared,
    parts: &BTreeMap<String, String>,
    (method, own, body): (Method, &str, Option<Vec<u8>>),
    patience: Duration,
) -> Result<Response, Refusal> {
    let mut wanted = own.to_owned();
    for (name, value) in parts {
        wanted = wanted.replace(&format!("{{{name}}}"), plain(value)?);
    }
    let peer = parts.get("peer").map_or("", String::as_str);
    let known = shared.services.peers.iter().find(|known| known.name.as_str() == peer);
    let known = known
        .ok_or_else(|| Refusal::not_found(format!("no node {peer:?} among api.peers of the node file")))?;
    let answer = known.client.ask_async(method, &wanted, body, patience).await?;
    let mut headers = HeaderMap::new();
    headers.extend(answer.content_type.map(|kind| (header::CONTENT_TYPE, kind)));
    Ok((answer.status, headers, answer.body).into_response())
}

/// Accepts a value that is one component of a path and cannot lead to another one.
fn plain(name: &str) -> Result<&str, Refusal> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
    match !name.is_empty() && !name.starts_with('.') && name.chars().all(is_plain) {
        true => Ok(name),
        false => Err(Refusal::not_found(format!("expected a name, found {name:?}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::{READABLE, of_peer, plain};

    #[test]
    fn what_is_passed_on_is_described_like_the_nodes_own() {
        let api = crate::api::description();
        for (own, _) in READABLE {
            let of =
                |path: &str| api.paths.paths.get(path).and_then(|item| item.get.clone()).expect("described");
            let (own_parts, parts) = (of(own).parameters.unwrap_or_default(), of(&of_peer(own)).parameters);
            assert_eq!(parts.expect("the peer's name").len(), own_parts.len() + 1, "{own}");
        }
        let post = |path: &str| api.paths.paths.get(path).is_some_and(|item| item.post.is_some());
        assert!(
            post("/api/v1/peers/{peer}/sessions/{name}/quick-look"),
            "both methods of one path are described"
        );
    }

    #[test]
    fn names_lead_nowhere_else() {
        for good in ["h2_up", "walk-01", "session-1763743000", "a.b"] {
            assert_eq!(plain(good).ok(), Some(good));
        }
        for bad in ["", ".", "..", "../capture", "a/b", "%2e%2e", "a b", "a?b", "a#b", ".hidden"] {
            assert!(plain(bad).is_err(), "{bad}");
        }
    }
}
