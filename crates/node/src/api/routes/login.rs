// SPDX-License-Identifier: MIT OR Apache-2.0
//! Browsers: a token, or the code of a link, is exchanged for a cookie that no script can read.

use crate::api::Shared;
use crate::api::auth::{Caller, cookie_of};
use crate::api::body::{Body, NoBody};
use crate::api::connections::Standing;
use crate::api::limits::Key;
use crate::api::logins::LIFETIME;
use crate::api::refusal::Refusal;
use crate::api::transport::Link;
use crate::base::{Exit, Fault};
use crate::control::status::{Challenge, Identity, Login, LoginByLink, Via, path};
use crate::control::tokens::{Role, Token};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

pub(in crate::api) fn routes() -> OpenApiRouter<Shared> {
    OpenApiRouter::new()
        .routes(routes!(challenge))
        .routes(routes!(login))
        .routes(routes!(login_by_link))
        .routes(routes!(logout))
        .routes(routes!(identity))
}

/// What a proof of a token is made for: open to all, and good for this connection alone.
#[utoipa::path(get, path = path::CHALLENGE, tag = "login",
    responses((status = 200, description = "The connection's nonce.", body = Challenge)))]
async fn challenge(Extension(standing): Extension<Standing>) -> Json<Challenge> {
    Json(Challenge { nonce: standing.nonce.as_ref().to_owned() })
}

/// Exchanges a token for a cookie (HttpOnly, SameSite=Strict), for browsers.
#[utoipa::path(post, path = path::LOGIN, tag = "login", request_body = Login, responses(
    (status = 200, description = "Logged in; the cookie is set.", body = Identity),
    (status = 409, description = "This node has no tokens: no login is needed.", body = Fault),
))]
async fn login(
    State(shared): State<Shared>,
    Extension(link): Extension<Link>,
    Body(Login { token }): Body<Login>,
) -> Result<Response, Refusal> {
    needs_login(&shared)?;
    let message = "this node does not know the token: check that all of it was copied, and that it belongs to this node. \
                   Your administrator can make another one with `fourdbody token new`";
    let token = shared.auth.bearer(token.trim()).ok_or_else(|| shared.auth.refused_login(&link, message))?;
    logged_in(&shared, &link, token, Via::Token)
}

/// Exchanges the code of a link (`fourdbody token link`) for the same cookie. A code works once, whatever comes of it.
#[utoipa::path(post, path = path::LOGIN_BY_LINK, tag = "login", request_body = LoginByLink, responses(
    (status = 200, description = "Logged in; the cookie is set.", body = Identity),
    (status = 409, description = "This node has no tokens: no login is needed.", body = Fault),
))]
async fn login_by_link(
    State(shared): State<Shared>,
    Extension(link): Extension<Link>,
    Body(LoginByLink { code }): Body<LoginByLink>,
) -> Result<Response, Refusal> {
    needs_login(&shared)?;
    let message = "this link does not log in: it works once and for some minutes, at the node that it was made for. Your \
                   administrator can make another one with `fourdbody token link`";
    let token = shared.auth.by_link(code.trim()).ok_or_else(|| shared.auth.refused_login(&link, message))?;
    logged_in(&shared, &link, token, Via::Link)
}

fn needs_login(shared: &Shared) -> Result<(), Refusal> {
    if shared.auth.has_tokens() {
        return Ok(());
    }
    let message = "this node has no tokens (api.tokens): no login is needed";
    Err(Refusal::new(StatusCode::CONFLICT, message))
}

/// Sets the cookie of a new login for the bearer of a token.
fn logged_in(shared: &Shared, link: &Link, token: Token, via: Via) -> Result<Response, Refusal> {
    let Token { name, role, hash } = token;
    if role == Role::Peer {
        return Err(Refusal::new(
            StatusCode::FORBIDDEN,
            "this is the token of a node; people have their own",
        ));
    }
    let id = shared.auth.logins.begin(hash).map_err(|e| {
        Refusal::from(Fault::new(Exit::Failure, format!("the system gives no random numbers: {e}")))
    })?;
    let secure = if matches!(link, Link::Tcp { encrypted: true, .. }) { "; Secure" } else { "" };
    let (cookie, seconds) = (&shared.cookie, LIFETIME.as_secs());
    let cookie = format!("{cookie}={id}; Path=/; Max-Age={seconds}; HttpOnly; SameSite=Strict{secure}");
    let identity = Identity { name: name.clone(), role, via: Via::Cookie };
    let mut response = ([(header::SET_COOKIE, cookie)], Json(identity)).into_response();
    // For the audit log.
    response.extensions_mut().insert(Caller { key: Key::Token(name.clone()), name, role, via });
    Ok(response)
}

/// Ends the login; the cookie is taken back.
#[utoipa::path(post, path = path::LOGOUT, tag = "login", responses((status = 204, description = "Logged out.")))]
async fn logout(State(shared): State<Shared>, headers: HeaderMap, _: NoBody) -> Response {
    if let Some(id) = cookie_of(&headers, &shared.cookie) {
        shared.auth.logins.end(id);
    }
    let cookie = format!("{}=; Path=/; Max-Age=0; HttpOnly; SameSite=Strict", shared.cookie);
    (StatusCode::NO_CONTENT, [(header::SET_COOKIE, cookie)]).into_response()
}

/// Who the node takes the caller for.
#[utoipa::path(get, path = path::IDENTITY, tag = "login",
    responses((status = 200, description = "The caller.", body = Identity)))]
async fn identity(caller: Caller) -> Json<Identity> {
    Json(Identity { name: caller.name, role: caller.role, via: caller.via })
}
