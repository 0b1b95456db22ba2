// SPDX-License-Identifier: MIT OR Apache-2.0
//! The checks of every request before its sender is authenticated: it is for this node (DNS rebinding), from one of
//! its own pages or from no page at all (CSRF), small, and sent in one go.

use super::auth::{cookie_of, only_looks, what_of};
use super::refusal::Refusal;
use super::transport::Link;
use super::{Shared, limits};
use crate::config::ApiConfig;
use crate::control::status::path;
use axum::body::{Body, Bytes, to_bytes};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::net::{IpAddr, SocketAddr};

/// The names under which the node may be addressed.
#[derive(Debug, Clone, Default)]
pub struct Names {
    listen: Option<SocketAddr>,
    names: Vec<String>,
}

impl Names {
    /// Of a node that is configured like this.
    pub fn new(config: &ApiConfig) -> Self {
        Self { listen: config.listen, names: config.hosts.clone() }
    }

    /// Whether `authority` (`NAME` or `NAME:PORT`, as in a `Host` header) is this node.
    pub fn are(&self, authority: &str) -> bool {
        let authority = authority.to_ascii_lowercase();
        let Some(listen) = self.listen else { return false };
        let Some((name, port)) = split(&authority) else { return false };
        if self.names.contains(&authority) {
            return true;
        }
        let own = |name: &str| match listen.ip() {
            ip if ip.is_unspecified() => false,
            ip if ip.is_loopback() => name == "localhost" || literal(name).is_some_and(|n| n.is_loopback()),
            ip => literal(name) == Some(ip),
        };
        let known = own(name) || self.names.iter().any(|known| known == name);
        known && port.is_none_or(|port| port == listen.port())
    }
}

/// An address as it stands in a `Host` header: only in its usual form, IPv6 in brackets.
fn literal(name: &str) -> Option<IpAddr> {
    match name.strip_prefix('[') {
        Some(rest) => rest.strip_suffix(']')?.parse().ok().map(IpAddr::V6),
        None => name.parse().ok().map(IpAddr::V4),
    }
}

/// Name and port of an authority; `None` when it is malformed.
fn split(authority: &str) -> Option<(&str, Option<u16>)> {
    let (name, port) = match authority.rfind(':').filter(|colon| authority.rfind(']') < Some(*colon)) {
        Some(colon) => (&authority[..colon], Some(authority[colon + 1..].parse().ok()?)),
        None => (authority, None),
    };
    let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | ':' | '[' | ']');
    (!name.is_empty() && name.chars().all(plain)).then_some((name, port))
}

/// The whole body of a request, for the layers before the handler.
#[derive(Clone)]
pub(super) struct Sent(pub(super) Bytes);

/// Refuses what is not for this node, not from its pages, too big or too slow; adds headers to every answer.
pub(super) async fn guard(State(shared): State<Shared>, request: Request, next: Next) -> Response {
    let mut response = match admit(&shared, request).await {
        Ok(request) => next.run(request).await,
        Err(refusal) => refusal.into_response(),
    };
    if response.status().is_client_error() && !is_json(&response) {
        response = as_fault(response).await;
    }
    for (name, value) in HEADERS {
        response.headers_mut().entry(name).or_insert(HeaderValue::from_static(value));
    }
    response
}

fn is_json(response: &Response) -> bool {
    let kind = response.headers().get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok());
    kind.is_some_and(|kind| kind.starts_with("application/json"))
}

/// What axum refuses by itself (a path's part, a query) is answered in the same form as everything else.
async fn as_fault(response: Response) -> Response {
    const TEXT_BYTES_MAX: usize = 4096;
    let status = response.status();
    let text = to_bytes(response.into_body(), TEXT_BYTES_MAX).await.unwrap_or_default();
    let text = String::from_utf8_lossy(&text);
    Refusal::new(status, if text.is_empty() { status.to_string() } else { text.into_owned() }).into_response()
}

/// Headers of every answer. The console is served by the node alone: scripts, styles, images and connections are its
/// own.
const HEADERS: [(HeaderName, &str); 6] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; form-action 'self'; \
         frame-ancestors 'none'",
    ),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::X_FRAME_OPTIONS, "DENY"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    (header::CACHE_CONTROL, "no-store"),
];

async fn admit(shared: &Shared, request: Request) -> Result<Request, Refusal> {
    let link = request.extensions().get::<Link>().copied();
    let link = link.ok_or_else(|| Refusal::new(StatusCode::BAD_REQUEST, "a request from nowhere"))?;
    let checked =
        check_host(&shared.names, &link, &request).and_then(|()| check_origin(shared, &link, &request));
    checked.inspect_err(|refusal| {
        shared.audit.refused(&link, None, &what_of(&request), refusal.status);
    })?;
    if only_looks(request.method()) {
        return Ok(request);
    }
    let (mut parts, body) = request.into_parts();
    let sent = read_body(&parts.headers, body).await?;
    parts.extensions.insert(Sent(sent.clone()));
    Ok(Request::from_parts(parts, Body::from(sent)))
}

fn check_host(names: &Names, link: &Link, request: &Request) -> Result<(), Refusal> {
    // A browser cannot open a Unix socket.
    if matches!(link, Link::Unix { .. }) {
        return Ok(());
    }
    let mut hosts = request.headers().get_all(header::HOST).into_iter();
    let host = hosts.next().and_then(|host| host.to_str().ok());
    let absolute = request.uri().authority().map(|authority| authority.as_str());
    let one = hosts.next().is_none();
    if one && host.is_some_and(|host| names.are(host)) && absolute.is_none_or(|absolute| names.are(absolute))
    {
        return Ok(());
    }
    let message = format!(
        "expected this node's name or address as Host, found {:?}; other names go into api.hosts of the node file",
        host.unwrap_or("none")
    );
    Err(Refusal::new(StatusCode::MISDIRECTED_REQUEST, message))
}

/// A page of another site must neither change nor read anything.
fn check_origin(shared: &Shared, link: &Link, request: &Request) -> Result<(), Refusal> {
    let headers = request.headers();
    let refused = |message: String| Err(Refusal::new(StatusCode::FORBIDDEN, message));
    let text = |name: &HeaderName| headers.get(name).map(|value| value.to_str().unwrap_or("?"));
    let origins: Vec<&HeaderValue> = headers.get_all(header::ORIGIN).into_iter().collect();
    if let Some(origin) = text(&header::ORIGIN) {
        let authority = origin.split_once("://").filter(|(scheme, _)| matches!(*scheme, "http" | "https"));
        let ours = authority.is_some_and(|(_, authority)| shared.names.are(authority));
        // An origin of ours equals the Host of the request: two names of a node are two origins.
        let same = text(&header::HOST)
            .is_some_and(|host| authority.is_some_and(|(_, a)| a.eq_ignore_ascii_case(host)));
        if origins.len() > 1 || !ours || !same || matches!(link, Link::Unix { .. }) {
            return refused(format!("a page of {origin} must not ask this node"));
        }
    }
    if let Some(site) = text(&HeaderName::from_static("sec-fetch-site"))
        && !matches!(site, "same-origin" | "none")
        && (!only_looks(request.method()) || !is_page(request.uri().path()))
    {
        return refused(format!("a page of another site ({site}) must not ask this node"));
    }
    let by_cookie =
        cookie_of(headers, &shared.cookie).is_some() && !headers.contains_key(header::AUTHORIZATION);
    let upgrade = headers.contains_key(header::UPGRADE);
    if by_cookie && origins.is_empty() && (upgrade || !only_looks(request.method())) {
        return refused("expected an Origin header, as browsers send it, with a cookie".to_owned());
    }
    Ok(())
}

/// Links of other sites may lead to pages and their files; everything else is for our own pages.
fn is_page(wanted: &str) -> bool {
    !wanted.starts_with("/api/") && wanted != path::FITNESS
}

async fn read_body(headers: &HeaderMap, body: Body) -> Result<Bytes, Refusal> {
    let too_large = || {
        let message = format!("expected a body of at most {} bytes", limits::BODY_BYTES_MAX);
        Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, message)
    };
    let announced =
        headers.get(header::CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<u64>().ok());
    if announced.is_some_and(|length| length > limits::BODY_BYTES_MAX as u64) {
        return Err(too_large());
    }
    match tokio::time::timeout(limits::BODY, to_bytes(body, limits::BODY_BYTES_MAX)).await {
        Ok(Ok(bytes)) => Ok(bytes),
        Ok(Err(error)) if is_limit(&error) => Err(too_large()),
        Ok(Err(error)) => Err(Refusal::new(StatusCode::BAD_REQUEST, format!("the body broke off: {error}"))),
        Err(_) => {
            let message = format!("expected the whole body within {} s", limits::BODY.as_secs());
            Err(Refusal::new(StatusCode::REQUEST_TIMEOUT, message))
        }
    }
}

fn is_limit(error: &axum::Error) -> bool {
    let mut causes = std::iter::successors(Some(error as &dyn std::error::Error), |error| error.source());
    causes.any(|error| error.is::<http_body_util::LengthLimitError>())
}

#[cfg(test)]
mod tests {
    use super::Names;
    use crate::config::ApiConfig;
    use proptest::prelude::{prop_assert_eq, proptest};

    fn names(listen: &str, hosts: &[&str]) -> Names {
        let hosts = hosts.iter().map(|name| (*name).to_owned()).collect();
        Names::new(&ApiConfig { listen: listen.parse().ok(), hosts, ..ApiConfig::default() })
    }

    #[test]
    fn a_loopback_node_is_addressed_as_such_and_no_other_way() {
        let node = names("127.0.0.1:7401", &[]);
        for good in ["127.0.0.1:7401", "localhost:7401", "LOCALHOST:7401", "[::1]:7401", "127.0.0.1"] {
            assert!(node.are(good), "{good}");
        }
        for bad in [
            "",
            ":7401",
            "evil.example",
            "evil.example:7401",
            "127.0.0.1.evil.example:7401",
            "127.evil.example",
            "localhost.evil.example",
            "127.0.0.1:7402",
            "127.0.0.1:",
            "127.0.0.1:7401@evil.example",
            "0x7f.0.0.1",
            "127.1",
            "[::1",
            "::1:7401",
            "localhost:7401/evil",
        ] {
            assert!(!node.are(bad), "{bad}");
        }
    }

    #[test]
    fn names_are_configured() {
        let node = names("0.0.0.0:7401", &["node-a.lab", "scan.example:443"]);
        assert!(node.are("node-a.lab:7401") && node.are("node-a.lab") && node.are("Scan.Example:443"));
        for bad in ["scan.example:7401", "scan.example", "node-a.lab:80", "0.0.0.0:7401", "127.0.0.1:7401"] {
            assert!(!node.are(bad), "{bad}");
        }
        assert!(names("192.168.1.5:7401", &[]).are("192.168.1.5:7401"));
        assert!(!names("192.168.1.5:7401", &[]).are("localhost:7401"));
    }

    proptest! {
        #[test]
        fn nothing_else_is_this_node(text in "[a-z0-9.:\\[\\]@/-]{0,24}") {
            let expected = ["localhost", "[::1]"].iter().any(|name| text == *name || text == format!("{name}:7401"))
                || text.strip_suffix(":7401").unwrap_or(&text).parse::<std::net::Ipv4Addr>().is_ok_and(|ip| ip.is_loopback());
            prop_assert_eq!(names("127.0.0.1:7401", &[]).are(&text), expected);
        }
    }
}
