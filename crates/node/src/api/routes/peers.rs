// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the other nodes tell, passed on: a browser may only talk to the node that its page came from.

use super::sessions::Choice;
use crate::api::body::{Body, NoBody};
use crate::api::refusal::Refusal;
use crate::api::services::Peer;
use crate::api::{Caller, Shared};
use crate::base::{Exit, Fault, json};
use crate::control::request::ExposureRequest;
use crate::control::status::{PeerState, path};
use crate::record::remark::Remark;
use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use std::time::Duration;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(get_peers))
        .routes(routes!(get_previews))
        .routes(routes!(get_picture))
        .routes(routes!(get_sessions))
        .routes(routes!(remark))
        .routes(routes!(get_quick_look, ask_quick_look))
        .routes(routes!(get_cloud))
        .routes(routes!(get_calibration_lights))
        .routes(routes!(get_calibration_plot))
        .routes(routes!(get_playable))
        .routes(routes!(get_frame_sets))
        .routes(routes!(get_frame_set))
        .routes(routes!(expose))
}

/// A console asks again sooner than this.
const PATIENCE: Duration = Duration::from_secs(3);
/// Some cameras take seconds to be set up.
const CAMERAS_PATIENCE: Duration = Duration::from_secs(30);
/// Frame sets are made when nobody else wants the processor.
const PLAY_PATIENCE: Duration = Duration::from_secs(65);

/// The other nodes, and whether they answer.
#[utoipa::path(get, path = path::PEERS, tag = "peers",
    responses((status = 200, description = "One entry a node.", body = Vec<PeerState>)))]
async fn get_peers(State(shared): State<Shared>) -> Json<Vec<PeerState>> {
    let mut asked = Vec::new();
    for peer in shared.services.peers.iter().cloned() {
        asked.push(tokio::spawn(state_of(peer)));
    }
    let mut states = Vec::new();
    for state in asked {
        states.extend(state.await.ok());
    }
    Json(states)
}

async fn state_of(peer: Peer) -> PeerState {
    let answer = peer.client.ask_async(Method::GET, path::STATUS, None, PATIENCE).await;
    let url = peer.client.url().to_owned();
    let (status, problem) = match answer {
        Ok(answer) if answer.status.is_success() => match json::from_slice(&answer.body) {
            Ok(status) => (Some(status), None),
            Err(e) => (None, Some(format!("its answer is not understood: {e}"))),
        },
        Ok(answer) => (None, Some(format!("it answered {}", answer.status))),
        Err(fault) => (None, Some(fault.message)),
    };
    PeerState { name: peer.name, url, status, problem }
}

/// What another node tells of its cameras' pictures.
#[utoipa::path(get, path = path::PEER_PREVIEWS, tag = "peers", params(PeerName), responses(PassedOn))]
async fn get_previews(State(shared): State<Shared>, Path(peer): Path<String>) -> Result<Response, Refusal> {
    ask(&shared, &peer, Method::GET, path::PREVIEWS).await
}

/// A picture of another node's camera.
#[utoipa::path(get, path = path::PEER_PICTURE, tag = "peers",
    params(PeerName, ("camera" = String, Path, description = "Its name in the rig.")), responses(PassedOn))]
async fn get_picture(
    State(shared): State<Shared>,
    Path((peer, camera)): Path<(String, String)>,
) -> Result<Response, Refusal> {
    let wanted = path::PICTURE.replace("{camera}", plain(&camera)?);
    ask(&shared, &peer, Method::GET, &wanted).await
}

/// What another node has recorded.
#[utoipa::path(get, path = path::PEER_SESSIONS, tag = "peers", params(PeerName, Choice), responses(PassedOn))]
async fn get_sessions(
    State(shared): State<Shared>,
    Path(peer): Path<String>,
    Query(choice): Query<Choice>,
) -> Result<Response, Refusal> {
    let wanted = format!("{}?limit={}&search={}", path::SESSIONS, choice.limit, encoded(&choice.search));
    ask(&shared, &peer, Method::GET, &wanted).await
}

/// Keeps what somebody thinks of another node's recording.
#[utoipa::path(post, path = path::PEER_REMARK, tag = "peers", params(PeerName, SessionName), request_body = Remark,
    responses(PassedOn))]
async fn remark(
    State(shared): State<Shared>,
    Path((peer, name)): Path<(String, String)>,
    Body(remark): Body<Remark>,
) -> Result<Response, Refusal> {
    let wanted = path::REMARK.replace("{name}", plain(&name)?);
    let body = serde_json::to_vec(&remark).map_err(|e| Fault::new(Exit::Failure, e))?;
    tell(&shared, &peer, Method::POST, &wanted, Some(body)).await
}

/// Sets exposure and gain of another node's cameras.
#[utoipa::path(post, path = path::PEER_EXPOSURE, tag = "peers", params(PeerName), request_body = ExposureRequest,
    responses(PassedOn))]
async fn expose(
    State(shared): State<Shared>,
    Path(peer): Path<String>,
    caller: Caller,
    Body(mut request): Body<ExposureRequest>,
) -> Result<Response, Refusal> {
    request.on_behalf_of.get_or_insert(caller.name);
    let body = serde_json::to_vec(&request).map_err(|e| Fault::new(Exit::Failure, e))?;
    let asked = (Method::POST, path::EXPOSURE, Some(body));
    pass_on(&shared, &peer, asked, CAMERAS_PATIENCE).await
}

/// How far another node's look at a session is.
#[utoipa::path(get, path = path::PEER_QUICK_LOOK, tag = "peers", params(PeerName, SessionName), responses(PassedOn))]
async fn get_quick_look(
    State(shared): State<Shared>,
    Path((peer, name)): Path<(String, String)>,
) -> Result<Response, Refusal> {
    let wanted = path::QUICK_LOOK.replace("{name}", plain(&name)?);
    ask(&shared, &peer, Method::GET, &wanted).await
}

/// Asks another node for a quick look at a session.
#[utoipa::path(post, path = path::PEER_QUICK_LOOK, tag = "peers", params(PeerName, SessionName), responses(PassedOn))]
async fn ask_quick_look(
    State(shared): State<Shared>,
    Path((peer, name)): Path<(String, String)>,
    _: NoBody,
) -> Result<Response, Refusal> {
    let wanted = path::QUICK_LOOK.replace("{name}", plain(&name)?);
    ask(&shared, &peer, Method::POST, &wanted).await
}

/// A cloud of another node's look.
#[utoipa::path(get, path = path::PEER_QUICK_LOOK_CLOUD, tag = "peers",
    params(PeerName, SessionName, ("trigger" = u64, Path, description = "The frame set.")), responses(PassedOn))]
async fn get_cloud(
    State(shared): State<Shared>,
    Path((peer, name, trigger)): Path<(String, String, u64)>,
) -> Result<Response, Refusal> {
    let wanted = path::QUICK_LOOK_CLOUD.replace("{name}", plain(&name)?);
    ask(&shared, &peer, Method::GET, &wanted.replace("{trigger}", &trigger.to_string())).await
}

/// What another node's worker has found of the calibration.
#[utoipa::path(get, path = path::PEER_CALIBRATION_LIGHTS, tag = "peers", params(PeerName), responses(PassedOn))]
async fn get_calibration_lights(
    State(shared): State<Shared>,
    Path(peer): Path<String>,
) -> Result<Response, Refusal> {
    ask(&shared, &peer, Method::GET, path::CALIBRATION_LIGHTS).await
}

/// The plot of another node's worker.
#[utoipa::path(get, path = path::PEER_CALIBRATION_PLOT, tag = "peers", params(PeerName), responses(PassedOn))]
async fn get_calibration_plot(
    State(shared): State<Shared>,
    Path(peer): Path<String>,
) -> Result<Response, Refusal> {
    ask(&shared, &peer, Method::GET, path::CALIBRATION_PLOT).await
}

/// What another node's worker has reconstructed.
#[utoipa::path(get, path = path::PEER_PLAYABLE, tag = "peers", params(PeerName), responses(PassedOn))]
async fn get_playable(State(shared): State<Shared>, Path(peer): Path<String>) -> Result<Response, Refusal> {
    ask(&shared, &peer, Method::GET, path::PLAYABLE).await
}

/// What a player must know of a session that another node's worker has reconstructed.
#[utoipa::path(get, path = path::PEER_FRAME_SETS, tag = "peers", params(PeerName, SessionName), responses(PassedOn))]
async fn get_frame_sets(
    State(shared): State<Shared>,
    Path((peer, name)): Path<(String, String)>,
) -> Result<Response, Refusal> {
    let wanted = path::FRAME_SETS.replace("{name}", plain(&name)?);
    pass_on(&shared, &peer, (Method::GET, &wanted, None), PLAY_PATIENCE).await
}

/// A frame set of a session that another node's worker has reconstructed.
#[utoipa::path(get, path = path::PEER_FRAME_SET, tag = "peers",
    params(PeerName, SessionName, ("trigger" = u64, Path, description = "The frame set.")), responses(PassedOn))]
async fn get_frame_set(
    State(shared): State<Shared>,
    Path((peer, name, trigger)): Path<(String, String, u64)>,
) -> Result<Response, Refusal> {
    let wanted = path::FRAME_SET.replace("{name}", plain(&name)?).replace("{trigger}", &trigger.to_string());
    pass_on(&shared, &peer, (Method::GET, &wanted, None), PLAY_PATIENCE).await
}

/// Parts of these paths.
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
    /// The session's name.
    name: String,
}

/// What another node answered is passed on as it is.
#[derive(utoipa::IntoResponses)]
#[expect(dead_code, reason = "the description is made of it")]
enum PassedOn {
    /// What the other node answered.
    #[response(status = 200)]
    Shown,
    /// The other node makes it, or has made it.
    #[response(status = 202)]
    Accepted,
    /// The other node has nothing to show yet.
    #[response(status = 204)]
    Nothing,
    /// What the path says is not well-formed.
    #[response(status = 400)]
    Malformed,
    /// No such node, or nothing of this name there.
    #[response(status = 404)]
    NotFound(Fault),
    /// What the other node said to it.
    #[response(status = 409)]
    Conflict(Fault),
    /// The other node failed at it.
    #[response(status = 500)]
    Failed(Fault),
    /// The other node does not answer.
    #[response(status = 503)]
    Unavailable(Fault),
}

async fn ask(shared: &Shared, peer: &str, method: Method, wanted: &str) -> Result<Response, Refusal> {
    tell(shared, peer, method, wanted, None).await
}

async fn tell(
    shared: &Shared,
    peer: &str,
    method: Method,
    wanted: &str,
    body: Option<Vec<u8>>,
) -> Result<Response, Refusal> {
    pass_on(shared, peer, (method, wanted, body), PATIENCE).await
}

async fn pass_on(
    shared: &Shared,
    peer: &str,
    (method, wanted, body): (Method, &str, Option<Vec<u8>>),
    patience: Duration,
) -> Result<Response, Refusal> {
    let known = shared.services.peers.iter().find(|known| known.name.as_str() == peer);
    let known = known.ok_or_else(|| {
        Refusal::new(StatusCode::NOT_FOUND, format!("no node {peer:?} among api.peers of the node file"))
    })?;
    let answer = known.client.ask_async(method, wanted, body, patience).await?;
    let mut headers = HeaderMap::new();
    headers.extend(answer.content_type.map(|kind| (header::CONTENT_TYPE, kind)));
    Ok((answer.status, headers, answer.body).into_response())
}

/// A text as a value of a query.
fn encoded(text: &str) -> String {
    let byte = |byte: u8| match byte.is_ascii_alphanumeric() {
        true => char::from(byte).to_string(),
        false => format!("%{byte:02X}"),
    };
    text.bytes().map(byte).collect()
}

/// A name that is one part of a path and leads nowhere else.
fn plain(name: &str) -> Result<&str, Refusal> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
    match !name.is_empty() && !name.starts_with('.') && name.chars().all(is_plain) {
        true => Ok(name),
        false => Err(Refusal::new(StatusCode::NOT_FOUND, format!("expected a name, found {name:?}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::{encoded, plain};

    #[test]
    fn a_search_is_one_value_of_a_query() {
        assert_eq!(encoded("a&limit=1 ä"), "a%26limit%3D1%20%C3%A4");
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
