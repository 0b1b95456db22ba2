// SPDX-License-Identifier: MIT OR Apache-2.0
//! The API's client, blocking: what `capture`, `status` and `doctor` use. Over TCP, TLS or a Unix socket.

use super::proof::{self, ProvenRequest};
use super::status::{Challenge, NodeStatus, path};
use super::tokens::{SecretHash, read_secret};
use crate::base::{Exit, Fault, json, regular};
use http_body_util::{BodyExt, Full, Limited};
use hyper::body::Bytes;
use hyper::header::{AUTHORIZATION, CONTENT_TYPE, HOST, HeaderValue};
use hyper::{Method, Request, StatusCode, Uri};
use hyper_util::rt::TokioIo;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt;
use std::net::ToSocketAddrs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, UnixStream};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, RootCertStore, crypto};

/// The address of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Place {
    Unix(PathBuf),
    Tcp { host: String, port: u16, authority: String, tls: bool },
}

/// How a client proves who it is, and which certificates it accepts.
#[derive(Debug, Clone, Default)]
pub struct Credentials {
    /// The file with the secret of its token; only its owner may read it.
    pub token_file: Option<PathBuf>,
    /// Certificates that vouch for the node's (PEM); by default the system's.
    pub ca: Option<PathBuf>,
}

/// One node, by its URL.
#[derive(Clone)]
pub struct NodeClient {
    url: String,
    place: Result<Place, String>,
    secret: Option<String>,
    tls: Option<Arc<ClientConfig>>,
}

/// The secret is not shown.
impl fmt::Debug for NodeClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NodeClient").field("url", &self.url).finish_non_exhaustive()
    }
}

/// Longest time that an answer may take, unless the caller names another one.
pub const TIMEOUT: Duration = Duration::from_secs(10);
/// Longest answer of a node that is read, bytes.
const ANSWER_BYTES_MAX: usize = 64 << 20;
/// The system's certificates, as Debian's `ca-certificates` installs them.
const SYSTEM_CA: &str = "/etc/ssl/certs/ca-certificates.crt";

/// What a node answered, whatever its status.
#[derive(Debug, Clone)]
pub struct Answer {
    pub status: StatusCode,
    pub content_type: Option<HeaderValue>,
    pub body: Bytes,
}

impl NodeClient {
    /// A client without a token, for `http://HOST:PORT` (the scheme may be left out) or `unix:/PATH`.
    pub fn new(url: &str) -> Self {
        let url = url.trim_end_matches('/').to_owned();
        let place = place_of(&url);
        Self { url, place, secret: None, tls: None }
    }

    /// A client that shows a token, and that may use `https://`.
    pub fn with(url: &str, credentials: &Credentials) -> Result<Self, Fault> {
        let mut client = Self::new(url);
        let usage = |message: String| Fault::new(Exit::Usage, message);
        let place = client.place.as_ref().map_err(|problem| usage(problem.clone()))?;
        if matches!(place, Place::Tcp { tls: true, .. }) {
            client.tls = Some(tls_config(credentials.ca.as_deref()).map_err(usage)?);
        }
        if let Some(file) = &credentials.token_file {
            let secret = read_secret(file)?;
            authorization("Bearer ", &secret).map_err(|e| usage(format!("{}: {e}", file.display())))?;
            client.secret = Some(secret);
        }
        Ok(client)
    }

    /// Whether something takes connections there, whatever it answers: a node that is only busy is not gone. Waits for
    /// two seconds at most.
    pub fn is_there(&self) -> bool {
        const PATIENCE: Duration = Duration::from_secs(2);
        match &self.place {
            Ok(Place::Unix(path)) => std::os::unix::net::UnixStream::connect(path).is_ok(),
            Ok(Place::Tcp { host, port, .. }) => {
                let mut addresses = (host.as_str(), *port).to_socket_addrs().into_iter().flatten();
                addresses.any(|address| std::net::TcpStream::connect_timeout(&address, PATIENCE).is_ok())
            }
            Err(_) => false,
        }
    }

    /// The URL that the client was made for.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// The status of the node, as it last published it.
    pub fn status(&self) -> Result<NodeStatus, Fault> {
        self.get(path::STATUS)
    }

    /// Sends a GET request, and parses the JSON of the answer.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, Fault> {
        let answer = self.ask(Method::GET, path, None, TIMEOUT)?;
        if !answer.status.is_success() {
            return Err(self.fault(&answer));
        }
        json::from_slice(&answer.body).map_err(|e| {
            let message = format!(
                "{} gave an answer that is not understood ({e}); does it run the same version?",
                self.url
            );
            Fault::new(Exit::Device, message)
        })
    }

    /// Sends JSON, and wants no more than success.
    pub fn post(&self, path: &str, body: &impl Serialize, timeout: Duration) -> Result<(), Fault> {
        let body = serde_json::to_vec(body).map_err(|e| Fault::new(Exit::Failure, e))?;
        // `()` is a request without a body.
        let answer = self.ask(Method::POST, path, Some(body).filter(|body| body != b"null"), timeout)?;
        if answer.status.is_success() { Ok(()) } else { Err(self.fault(&answer)) }
    }

    /// One request, whatever is answered. Must not be called on a thread that serves a tokio runtime.
    pub fn ask(
        &self,
        method: Method,
        path: &str,
        body: Option<Vec<u8>>,
        timeout: Duration,
    ) -> Result<Answer, Fault> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(|e| Fault::new(Exit::Failure, format!("cannot start the client: {e}")))?;
        runtime.block_on(self.ask_async(method, path, body, timeout))
    }

    /// What a path gives as bytes; `None` where it has nothing yet.
    pub fn fetch(&self, path: &str, timeout: Duration) -> Result<Option<Bytes>, Fault> {
        let answer = self.ask(Method::GET, path, None, timeout)?;
        match answer.status {
            StatusCode::NO_CONTENT => Ok(None),
            status if status.is_success() => Ok(Some(answer.body)),
            _ => Err(self.fault(&answer)),
        }
    }

    /// [`Self::ask`] for callers on a tokio runtime.
    pub async fn ask_async(
        &self,
        method: Method,
        path: &str,
        body: Option<Vec<u8>>,
        timeout: Duration,
    ) -> Result<Answer, Fault> {
        let place = self.place.as_ref().map_err(|problem| Fault::new(Exit::Usage, problem))?;
        match tokio::time::timeout(timeout, self.converse(place, method, path, body)).await {
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(error)) => Err(self.unreachable(error.as_ref())),
            Err(_) => Err(self.unreachable(&format!("no answer within {} s", timeout.as_secs()))),
        }
    }

    async fn converse(
        &self,
        place: &Place,
        method: Method,
        path: &str,
        body: Option<Vec<u8>>,
    ) -> Result<Answer, AnyError> {
        let authority = match place {
            Place::Unix(_) => "localhost",
            Place::Tcp { authority, .. } => authority,
        };
        let mut request = Request::builder().method(method).uri(path).header(HOST, authority);
        // Over plain TCP any program could have bound the port: the secret is proved, and not sent.
        let plain = matches!(place, Place::Tcp { tls: false, .. });
        let prover = self.secret.as_ref().filter(|_| plain).map(|secret| Prover { secret, authority });
        if let Some(secret) = self.secret.as_ref().filter(|_| !plain) {
            request = request.header(AUTHORIZATION, authorization("Bearer ", secret)?);
        }
        if body.is_some() {
            request = request.header(CONTENT_TYPE, "application/json");
        }
        let request = request.body(Full::new(Bytes::from(body.unwrap_or_default())))?;
        match place {
            Place::Unix(path) => exchange(UnixStream::connect(path).await?, request, None).await,
            Place::Tcp { host, port, tls, .. } => {
                let stream = TcpStream::connect((host.as_str(), *port)).await?;
                stream.set_nodelay(true)?;
                if !tls {
                    return exchange(stream, request, prover).await;
                }
                let config = self.tls.clone().ok_or("this client was made without TLS")?;
                let name = ServerName::try_from(host.clone())?;
                exchange(TlsConnector::from(config).connect(name, stream).await?, request, None).await
            }
        }
    }

    fn fault(&self, answer: &Answer) -> Fault {
        json::from_slice(&answer.body).unwrap_or_else(|_| {
            let text = String::from_utf8_lossy(&answer.body[..answer.body.len().min(200)]).into_owned();
            Fault::new(Exit::Failure, format!("{} answered {}: {text}", self.url, answer.status))
        })
    }

    fn unreachable(&self, error: &(impl fmt::Display + ?Sized)) -> Fault {
        Fault::new(
            Exit::Device,
            format!("no node answers at {} ({error}); is `fourdbody node` running there?", self.url),
        )
    }
}

type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// A header that is not printed.
fn authorization(scheme: &str, shown: &str) -> Result<HeaderValue, hyper::header::InvalidHeaderValue> {
    let mut header = HeaderValue::from_str(&format!("{scheme}{shown}"))?;
    header.set_sensitive(true);
    Ok(header)
}

/// Shows a token without sending it.
struct Prover<'a> {
    secret: &'a str,
    authority: &'a str,
}

type Sender = hyper::client::conn::http1::SendRequest<Full<Bytes>>;

impl Prover<'_> {
    /// Requests the connection's nonce, then sends the request itself; the answer of another program is refused.
    async fn ask(&self, sender: &mut Sender, mut request: Request<Full<Bytes>>) -> Result<Answer, AnyError> {
        let challenge = Request::builder().uri(path::CHALLENGE).header(HOST, self.authority);
        let (challenge, _) = answer_to(sender, challenge.body(Full::default())?).await?;
        if !challenge.status.is_success() {
            return Ok(challenge);
        }
        let Challenge { nonce } = json::from_slice(&challenge.body)
            .map_err(|e| format!("it gave no challenge ({e}); does it run the same version?"))?;
        let body = request.body().clone().collect().await?.to_bytes();
        let (method, uri) = (request.method().clone(), request.uri().clone());
        let path = uri.path_and_query().map_or("/", |path| path.as_str());
        let proven = ProvenRequest {
            authority: self.authority,
            nonce: &nonce,
            method: method.as_str(),
            path,
            body: &body,
        };
        let shown = authorization(proof::SCHEME, &proven.prove(self.secret))?;
        request.headers_mut().insert(AUTHORIZATION, shown);
        sender.ready().await?;
        let (answer, proof) = answer_to(sender, request).await?;
        let known = proof.is_some_and(|proof| proof == proven.answer(&SecretHash::of(self.secret)));
        match known || !answer.status.is_success() {
            true => Ok(answer),
            false => {
                Err("something answers there that does not know this token, so it is not the node".into())
            }
        }
    }
}

async fn answer_to(
    sender: &mut Sender,
    request: Request<Full<Bytes>>,
) -> Result<(Answer, Option<HeaderValue>), AnyError> {
    let response = sender.send_request(request).await?;
    let status = response.status();
    let content_type = response.headers().get(CONTENT_TYPE).cloned();
    let proof = response.headers().get(proof::HEADER).cloned();
    let body = Limited::new(response.into_body(), ANSWER_BYTES_MAX).collect().await?.to_bytes();
    Ok((Answer { status, content_type, body }, proof))
}

async fn exchange<S>(
    stream: S,
    request: Request<Full<Bytes>>,
    prover: Option<Prover<'_>>,
) -> Result<Answer, AnyError>
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
    let answer = async {
        match prover {
            Some(prover) => prover.ask(&mut sender, request).await,
            None => answer_to(&mut sender, request).await.map(|(answer, _)| answer),
        }
    };
    tokio::pin!(answer, connection);
    tokio::select! {
        answer = &mut answer => answer,
        ended = &mut connection => {
            ended?;
            // The other side closed after its last byte.
            answer.await
        }
    }
}

fn place_of(url: &str) -> Result<Place, String> {
    if let Some(path) = url.strip_prefix("unix:") {
        let path = path.strip_prefix("//").unwrap_or(path);
        return match path.starts_with('/') {
            true => Ok(Place::Unix(path.into())),
            false => Err(format!("expected unix:/PATH/OF/SOCKET, found {url:?}")),
        };
    }
    let wrong = || format!("expected http://HOST:PORT, https://HOST:PORT or unix:/PATH, found {url:?}");
    let full = if url.contains("://") { url.to_owned() } else { format!("http://{url}") };
    let uri: Uri = full.parse().map_err(|_| wrong())?;
    let tls = match uri.scheme_str() {
        Some("http") => false,
        Some("https") => true,
        _ => return Err(wrong()),
    };
    let authority =
        uri.authority().filter(|authority| !authority.as_str().contains('@')).ok_or_else(wrong)?;
    if !matches!(uri.path(), "" | "/") || uri.query().is_some() {
        return Err(wrong());
    }
    let host = authority.host().trim_start_matches('[').trim_end_matches(']').to_owned();
    let port = authority.port_u16().unwrap_or(if tls { 443 } else { 80 });
    Ok(Place::Tcp { host, port, authority: authority.to_string(), tls })
}

pub(crate) fn tls_config(ca: Option<&Path>) -> Result<Arc<ClientConfig>, String> {
    let path = ca.unwrap_or(Path::new(SYSTEM_CA));
    let wrong =
        |error: &dyn fmt::Display| format!("{}: expected certificates in PEM: {error}", path.display());
    let text = regular::read(path, regular::TEXT_BYTES).map_err(|e| wrong(&e))?;
    let certificates = CertificateDer::pem_slice_iter(&text).collect::<Result<Vec<_>, _>>();
    let certificates = certificates.map_err(|e| wrong(&e))?;
    let mut roots = RootCertStore::empty();
    let (known, _) = roots.add_parsable_certificates(certificates);
    if known == 0 {
        return Err(format!("{}: expected at least one certificate in PEM, found none", path.display()));
    }
    let config = ClientConfig::builder_with_provider(Arc::new(crypto::ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|e| e.to_string())?;
    Ok(Arc::new(config.with_root_certificates(roots).with_no_client_auth()))
}

#[cfg(test)]
mod tests {
    use super::{NodeClient, Place, place_of};

    #[test]
    fn places_are_found_in_urls() {
        assert_eq!(place_of("unix:/run/x.sock"), Ok(Place::Unix("/run/x.sock".into())));
        assert_eq!(place_of("unix:///run/x.sock"), Ok(Place::Unix("/run/x.sock".into())));
        let tcp = |host: &str, port, authority: &str, tls| {
            Ok(Place::Tcp { host: host.to_owned(), port, authority: authority.to_owned(), tls })
        };
        assert_eq!(place_of("127.0.0.1:7401"), tcp("127.0.0.1", 7401, "127.0.0.1:7401", false));
        assert_eq!(place_of("https://node-a.lab"), tcp("node-a.lab", 443, "node-a.lab", true));
        assert_eq!(place_of("http://[::1]:7401"), tcp("::1", 7401, "[::1]:7401", false));
        for bad in ["", "unix:run", "ftp://x", "http://x/y", "http://u:p@x", "http://x?y"] {
            assert!(place_of(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn nobody_there_is_told() {
        let fault = NodeClient::new("unix:/nowhere/at/all.sock").status().expect_err("nobody is there");
        assert!(fault.exit == 5 && fault.message.contains("is `fourdbody node` running there?"), "{fault:?}");
    }
}
