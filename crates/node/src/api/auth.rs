// SPDX-License-Identifier: MIT OR Apache-2.0
//! Authentication and authorization: tokens, browser sessions, users of the Unix socket.

use super::Shared;
use super::connections::Standing;
use super::guard::Sent;
use super::limits::{self, Buckets, Key};
use super::logins::Logins;
use super::refusal::Refusal;
use super::transport::Link;
use crate::base::Fault;
use crate::base::time::host_time_ns;
use crate::config::ApiConfig;
use crate::control::links;
use crate::control::proof::{self, ProvenRequest};
pub use crate::control::status::Via;
use crate::control::status::path;
use crate::control::tokens::{Role, Token, TokenList};
use axum::extract::{FromRequestParts, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The sender of a request; a request that reaches a handler carries it as an extension.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// The token's name, or `uid N` of the Unix socket, or the address.
    pub name: String,
    pub role: Role,
    pub via: Via,
    /// Whose rate it counts against.
    pub(super) key: Key,
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Refusal;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Refusal> {
        parts.extensions.get::<Self>().cloned().ok_or_else(unauthenticated)
    }
}

/// Tokens and logins of a node.
pub struct Auth {
    tokens: Option<Tokens>,
    pub(super) logins: Logins,
    own_uid: u32,
    requests: Buckets,
    refusals: Buckets,
}

/// Time between two looks at the token file: a revoked token works no longer than that.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);

struct Tokens {
    path: PathBuf,
    known: Mutex<Known>,
}

struct Known {
    list: Arc<TokenList>,
    problem: Option<String>,
    looked: Instant,
    stamp: Option<Stamp>,
}

/// What changes when the file does.
type Stamp = (u64, u64, i64, i64, u64);

fn stamp(path: &Path) -> Option<Stamp> {
    let data = std::fs::metadata(path).ok()?;
    Some((
        data.ino(),
        u64::from(data.mode()),
        data.mtime(),
        data.ctime_nsec() ^ data.mtime_nsec(),
        data.size(),
    ))
}

impl Auth {
    /// Reads the token file, if there is one.
    pub fn new(config: &ApiConfig) -> Result<Self, Fault> {
        let load = |path: &PathBuf| {
            let stamp = stamp(path);
            let list = TokenList::load(path)
                .map_err(|fault| Fault { message: format!("api.tokens: {}", fault.message), ..fault })?;
            let known = Known { list: Arc::new(list), problem: None, looked: Instant::now(), stamp };
            Ok::<_, Fault>(Tokens { path: path.clone(), known: Mutex::new(known) })
        };
        let tokens = config.tokens.as_ref().map(load).transpose()?;
        Ok(Self {
            tokens,
            logins: Logins::default(),
            // SAFETY: it only reads the process's user id.
            own_uid: unsafe { libc::geteuid() },
            requests: Buckets::new(limits::REQUESTS),
            refusals: Buckets::new(limits::REFUSALS),
        })
    }

    /// Whether callers over TCP must show a token.
    pub fn has_tokens(&self) -> bool {
        self.tokens.is_some()
    }

    /// Why the token file cannot be used now; then every token is refused.
    pub fn warning(&self) -> Option<String> {
        let tokens = self.tokens.as_ref()?;
        tokens.current();
        tokens.known.lock().unwrap_or_else(PoisonError::into_inner).problem.clone()
    }

    /// The token with this secret.
    pub(super) fn bearer(&self, secret: &str) -> Option<Token> {
        let list = self.tokens.as_ref()?.current();
        list.bearer(secret).cloned()
    }

    /// The token that a link logs in with; using it up is its proof. `None` with a line in the log.
    pub(super) fn by_link(&self, code: &str) -> Option<Token> {
        let tokens = self.tokens.as_ref()?;
        let hash = match links::redeem(&tokens.path, code, host_time_ns()) {
            Ok(hash) => hash,
            Err(why) => {
                tracing::warn!("a login by a link is refused: {why}");
                return None;
            }
        };
        let list = tokens.current();
        let token = list.0.iter().find(|token| token.hash.is(&hash)).cloned();
        if token.is_none() {
            tracing::warn!("a login by a link is refused: its token was revoked or renewed");
        }
        token
    }

    /// Counts a refusal; the answer is another one where there were too many.
    pub(super) fn refused(&self, link: &Link) -> Refusal {
        match self.refusals.take(link.key(), Instant::now()) {
            Ok(()) => unauthenticated(),
            Err(wait) => Refusal::too_many("too many requests without a valid token; wait", wait),
        }
    }

    /// The same for a login, in words for a person.
    pub(super) fn refused_login(&self, link: &Link, message: &str) -> Refusal {
        let refusal = self.refused(link);
        if refusal.status != StatusCode::UNAUTHORIZED {
            return refusal;
        }
        Refusal::new(StatusCode::UNAUTHORIZED, message)
    }

    /// The caller; and the answer to their proof, by which this node shows that it knows their token.
    fn identify(&self, link: &Link, request: &Request, cookie: &str) -> Option<(Caller, Option<String>)> {
        let headers = request.headers();
        if let (Some(tokens), Some(proof)) = (&self.tokens, proof_of(headers)) {
            let standing = request.extensions().get::<Standing>()?;
            let body = request.extensions().get::<Sent>().map_or(&[][..], |sent| &sent.0);
            let proven = ProvenRequest {
                authority: headers.get(header::HOST)?.to_str().ok()?,
                nonce: &standing.nonce,
                method: request.method().as_str(),
                path: request.uri().path_and_query()?.as_str(),
                body,
            };
            let list = tokens.current();
            let shown = list.0.iter().find(|token| proven.secret_of(proof, &token.hash).is_some())?;
            let (name, role) = (shown.name.clone(), shown.role);
            let caller = Caller { key: Key::Token(name.clone()), name, role, via: Via::Token };
            return Some((caller, Some(proven.answer(&shown.hash))));
        }
        Some((self.identify_plainly(link, headers, cookie)?, None))
    }

    fn identify_plainly(&self, link: &Link, headers: &HeaderMap, cookie: &str) -> Option<Caller> {
        let token = |name: String, role, via| Caller { key: Key::Token(name.clone()), name, role, via };
        if let Some(tokens) = &self.tokens {
            // A request with a token is judged by it, wherever it comes from.
            if let Some(shown) = headers.get(header::AUTHORIZATION) {
                let secret = shown.to_str().ok().and_then(|text| text.strip_prefix("Bearer "))?;
                let found = self.bearer(secret.trim())?;
                return Some(token(found.name, found.role, Via::Token));
            }
            if let Some(id) = cookie_of(headers, cookie) {
                let (name, role) = self.logins.who(id, &tokens.current())?;
                return Some(token(name, role, Via::Cookie));
            }
        }
        match link {
            Link::Unix { uid } => {
                let role = if *uid == 0 || *uid == self.own_uid { Role::Admin } else { Role::Operate };
                Some(Caller { name: format!("uid {uid}"), role, via: Via::Socket, key: link.key() })
            }
            // The configuration allows a node without tokens only on a loopback address.
            Link::Tcp { from, .. } if self.tokens.is_none() => Some(Caller {
                name: from.ip().to_string(),
                role: Role::Admin,
                via: Via::Nothing,
                key: link.key(),
            }),
            Link::Tcp { .. } => None,
        }
    }
}

impl Tokens {
    /// The list, read again when the file has changed. A file that cannot be read is an empty list: every token is
    /// refused.
    fn current(&self) -> Arc<TokenList> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if known.looked.elapsed() < LOOK_INTERVAL {
            return Arc::clone(&known.list);
        }
        known.looked = Instant::now();
        let stamp = stamp(&self.path);
        if stamp != known.stamp || known.problem.is_some() {
            match TokenList::load(&self.path) {
                Ok(list) => {
                    tracing::info!(tokens = list.0.len(), "the token file was read again");
                    (known.list, known.problem) = (Arc::new(list), None);
                }
                Err(fault) => {
                    let problem = format!("api.tokens: {}; every token is refused", fault.message);
                    if known.problem.as_ref() != Some(&problem) {
                        tracing::warn!("{problem}");
                    }
                    (known.list, known.problem) = (Arc::default(), Some(problem));
                }
            }
            known.stamp = stamp;
        }
        Arc::clone(&known.list)
    }
}

fn proof_of(headers: &HeaderMap) -> Option<&str> {
    headers.get(header::AUTHORIZATION)?.to_str().ok()?.strip_prefix(proof::SCHEME)
}

/// The value of a cookie.
pub(super) fn cookie_of<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    let cookies = headers.get_all(header::COOKIE).into_iter().filter_map(|value| value.to_str().ok());
    let mut pairs = cookies.flat_map(|text| text.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(found, _)| *found == name).map(|(_, value)| value)
}

fn unauthenticated() -> Refusal {
    let message = "expected a login, or `Authorization: Bearer TOKEN` with a token of this node; \
                   see `fourdbody token --help`";
    Refusal::new(StatusCode::UNAUTHORIZED, message)
}

/// Method and path of a request, for the audit log.
pub(super) fn what_of(request: &Request) -> String {
    format!("{} {}", request.method(), request.uri().path())
}

/// Whether a request only reads.
pub(super) fn only_looks(method: &Method) -> bool {
    matches!(*method, Method::GET | Method::HEAD | Method::OPTIONS)
}

/// What needs no token: the console's page, `/health` and a login. Everything else below `/api/` is closed.
fn is_open(request: &Request) -> bool {
    let wanted = request.uri().path();
    [path::LOGIN, path::LOGIN_BY_LINK].contains(&wanted)
        || (!wanted.starts_with("/api/") && only_looks(request.method()))
}

/// Every request passes through here: reading takes [`Role::View`], everything else [`Role::Operate`].
pub(super) async fn authenticate(State(shared): State<Shared>, mut request: Request, next: Next) -> Response {
    let Some(link) = request.extensions().get::<Link>().copied() else {
        return unauthenticated().into_response();
    };
    // Not counted: a flood from an address must not keep other clients there from authenticating.
    if request.uri().path() == path::CHALLENGE {
        return next.run(request).await;
    }
    if is_open(&request) {
        return match shared.auth.requests.take(link.key(), Instant::now()) {
            Ok(()) => next.run(request).await,
            Err(wait) => too_fast(wait).into_response(),
        };
    }
    let Some((caller, answer)) = shared.auth.identify(&link, &request, &shared.cookie) else {
        shared.audit.refused(&link, None, &what_of(&request), StatusCode::UNAUTHORIZED);
        return shared.auth.refused(&link).into_response();
    };
    if let Err(wait) = shared.auth.requests.take(caller.key.clone(), Instant::now()) {
        return too_fast(wait).into_response();
    }
    let standing = request.extensions().get::<Standing>();
    if standing.is_some_and(|standing| !standing.is_of(&caller.key, caller.role == Role::View)) {
        return Refusal::too_many_connections().into_response();
    }
    let needed = if only_looks(request.method()) { Role::View } else { Role::Operate };
    if !caller.role.may(needed) && request.uri().path() != path::LOGOUT {
        shared.audit.refused(&link, Some(&caller), &what_of(&request), StatusCode::FORBIDDEN);
        return forbidden(&caller, needed).into_response();
    }
    request.extensions_mut().insert(caller);
    let mut response = next.run(request).await;
    if let Some(answer) = answer.and_then(|answer| HeaderValue::try_from(answer).ok()) {
        response.headers_mut().insert(proof::HEADER, answer);
    }
    response
}

fn forbidden(caller: &Caller, needed: Role) -> Refusal {
    let message = format!("this needs the role {needed}; {} has {}", caller.name, caller.role);
    Refusal::new(StatusCode::FORBIDDEN, message)
}

fn too_fast(wait: Duration) -> Refusal {
    let per_second = limits::REQUESTS.per_second;
    Refusal::too_many(format!("too many requests, expected at most {per_second} a second"), wait)
}
