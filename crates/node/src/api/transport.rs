// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where requests come in: a Unix socket, and TCP with or without TLS. Connections are counted, and slow ones are
//! closed.

use super::connections::{Connections, Standing};
use super::limits::{self, Key};
use super::patience::Patient;
use crate::base::{Exit, Fault, regular};
use crate::config::{ApiConfig, SocketConfig, TlsConfig};
use axum::Router;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::fs::{File, Permissions, TryLockError};
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, UnixListener};
use tokio::sync::watch;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};

/// How a request came in; every request carries it as an extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    Unix {
        /// The user at the other end, as the kernel reports it.
        uid: u32,
    },
    Tcp {
        from: SocketAddr,
        encrypted: bool,
    },
}

impl Link {
    /// For bounds per client: one user, or one address (of a /64, as one machine has all of it).
    pub(super) fn key(&self) -> Key {
        match self {
            Self::Unix { uid } => Key::User(*uid),
            Self::Tcp { from, .. } => Key::of_address(from.ip()),
        }
    }
}

fn usage(message: String) -> Fault {
    Fault::new(Exit::Usage, message)
}

struct Socket {
    listener: UnixListener,
    path: PathBuf,
    /// Held as long as the socket is ours.
    _lock: File,
}

impl Drop for Socket {
    fn drop(&mut self) {
        // A socket that stays behind is replaced by the next node.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Everything that is listened on.
pub struct Listeners {
    unix: Option<Socket>,
    tcp: Option<TcpListener>,
    tls: Option<TlsAcceptor>,
    warnings: Vec<String>,
}

/// Longest time that a server which ends waits for requests under way.
const DRAIN: Duration = Duration::from_secs(5);
/// After a failed accept (for instance without file descriptors) the next one waits.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
const TOO_MANY: &[u8] =
    b"HTTP/1.1 503 Service Unavailable\r\nretry-after: 5\r\nconnection: close\r\ncontent-length: 0\r\n\r\n";

impl Listeners {
    /// Opens the configured addresses and sockets. Needs a runtime.
    pub async fn bind(config: &ApiConfig) -> Result<Self, Fault> {
        let tls = config.tls.as_ref().map(acceptor).transpose()?;
        let unix = config.socket.as_ref().map(bind_socket).transpose()?;
        let tcp = match config.listen {
            Some(address) => Some(TcpListener::bind(address).await.map_err(|error| {
                usage(format!("cannot listen on {address} (api.listen): {error}; is another node running?"))
            })?),
            None => None,
        };
        let mut warnings = Vec::new();
        if let Some(address) = config.listen.filter(|_| config.is_on_network() && config.tls.is_none()) {
            warnings.push(format!(
                "the API on {address} is not encrypted (api.plain_text_on_network): tokens and images \
                 can be read there"
            ));
        }
        Ok(Self { unix, tcp, tls, warnings })
    }

    /// Warnings about a configuration that is dangerous.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Serves until `shutdown` resolves; answers that are under way are finished.
    pub async fn serve(self, router: Router, shutdown: impl Future<Output = ()>) -> io::Result<()> {
        let (end, ended) = watch::channel(false);
        let server = Server { router, connections: Connections::default(), ended };
        tokio::select! {
            () = server.accept_unix(self.unix.as_ref()) => {}
            () = server.accept_tcp(self.tcp.as_ref(), self.tls.as_ref()) => {}
            () = shutdown => {}
        }
        let Self { unix, tcp, .. } = self;
        drop((unix, tcp));
        // The connections may all be closed already.
        let _ = end.send(true);
        let _ = tokio::time::timeout(DRAIN, server.connections.all_gone()).await;
        Ok(())
    }
}

struct Server {
    router: Router,
    connections: Connections,
    ended: watch::Receiver<bool>,
}

impl Server {
    async fn accept_unix(&self, socket: Option<&Socket>) {
        let Some(socket) = socket else { return std::future::pending().await };
        loop {
            let accepted = socket.listener.accept().await.and_then(|(stream, _)| {
                let uid = stream.peer_cred()?.uid();
                Ok((stream, Link::Unix { uid }))
            });
            match accepted {
                Ok((stream, link)) => self.take(stream, link, None).await,
                Err(error) => pause_after(&error).await,
            }
        }
    }

    async fn accept_tcp(&self, listener: Option<&TcpListener>, tls: Option<&TlsAcceptor>) {
        let Some(listener) = listener else { return std::future::pending().await };
        loop {
            match listener.accept().await {
                Ok((stream, from)) => {
                    // Answers are small, and clients wait for them.
                    let _ = stream.set_nodelay(true);
                    self.take(stream, Link::Tcp { from, encrypted: tls.is_some() }, tls.cloned()).await;
                }
                Err(error) => pause_after(&error).await,
            }
        }
    }

    async fn take<S>(&self, mut stream: S, link: Link, tls: Option<TlsAcceptor>)
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let admitted = match link {
            Link::Unix { .. } => self.connections.admit_known(link.key()),
            Link::Tcp { .. } => self.connections.admit(link.key()).map(Some),
        };
        let admitted = match admitted {
            Ok(admitted) => admitted,
            Err(error) => return pause_after(&error).await,
        };
        let Some(admitted) = admitted else {
            if tls.is_none() {
                // It fits into any socket's buffer: a client that does not read is not waited for.
                let _ = tokio::time::timeout(Duration::from_millis(1), stream.write_all(TOO_MANY)).await;
            }
            return;
        };
        let (router, ended) = (self.router.clone(), self.ended.clone());
        tokio::spawn(async move {
            let (stream, standing) = (Patient::new(stream, limits::STALL), admitted.standing());
            let talk = async {
                match tls {
                    None => converse(stream, link, standing, router, ended).await,
                    Some(tls) => match tokio::time::timeout(limits::HEADER, tls.accept(stream)).await {
                        Ok(Ok(stream)) => converse(stream, link, standing, router, ended).await,
                        Ok(Err(error)) => tracing::debug!(?link, "TLS: {error}"),
                        Err(_) => tracing::debug!(?link, "TLS: no handshake in time"),
                    },
                }
            };
            tokio::select! {
                () = talk => {}
                () = admitted.evicted() => tracing::debug!(?link, "closed for a newer connection"),
            }
        });
    }
}

async fn pause_after(error: &io::Error) {
    tracing::warn!("a connection could not be accepted: {error}");
    tokio::time::sleep(ACCEPT_PAUSE).await;
}

/// One connection, request by request.
async fn converse<S>(
    stream: S,
    link: Link,
    standing: Standing,
    router: Router,
    mut ended: watch::Receiver<bool>,
) where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let router = TowerToHyperService::new(router);
    let service = service_fn(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(link);
        request.extensions_mut().insert(standing.clone());
        router.call(request)
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(limits::HEADER)
        .max_headers(limits::HEADERS_MAX)
        .max_header_size(limits::HEADER_BYTES_MAX)
        .max_buf_size(2 * limits::HEADER_BYTES_MAX)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    // What `wait_for` returns holds a lock.
    let ended = async { drop(ended.wait_for(|ended| *ended).await) };
    tokio::pin!(connection);
    let result = tokio::select! {
        result = connection.as_mut() => result,
        () = ended => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = result {
        tracing::debug!(?link, "connection: {error}");
    }
}

/// Makes the socket under another name with its final mode, then puts it in its place: every client that can connect
/// may.
fn bind_socket(config: &SocketConfig) -> Result<Socket, Fault> {
    let path = &config.path;
    let failed = |problem: String| usage(format!("api.socket {}: {problem}", path.display()));
    let io_failed = |what: &str| {
        let what = what.to_owned();
        move |e: io::Error| failed(format!("{what}: {e}"))
    };
    if let Some(dir) = path.parent() {
        std::fs::create_dir_all(dir).map_err(io_failed("its directory cannot be made"))?;
    }
    let lock =
        regular::lock_file(&beside(path, ".lock")).map_err(io_failed("its lock file cannot be made"))?;
    match lock.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let place = path.display();
            return Err(usage(format!("cannot listen on {place} (api.socket): another node uses it")));
        }
        Err(TryLockError::Error(error)) => return Err(failed(format!("its lock file: {error}"))),
    }
    // With the lock held, a socket that is there was left behind; anything else is not ours to remove.
    if let Ok(found) = std::fs::symlink_metadata(path)
        && !found.file_type().is_socket()
    {
        return Err(failed("expected a socket or nothing, found another kind of file".to_owned()));
    }
    let temporary = beside(path, ".new");
    let _ = std::fs::remove_file(&temporary);
    let listener = UnixListener::bind(&temporary).map_err(io_failed("cannot be bound"))?;
    let finish = || {
        if let Some(group) = &config.group {
            let gid = group_id(group).ok_or_else(|| failed(format!("there is no group {group}")))?;
            let has = std::fs::symlink_metadata(&temporary).map_err(io_failed("cannot be read"))?.gid();
            if has != gid {
                std::os::unix::fs::chown(&temporary, None, Some(gid))
                    .map_err(io_failed(&format!("cannot be given to the group {group}")))?;
            }
        }
        std::fs::set_permissions(&temporary, Permissions::from_mode(0o660))
            .map_err(io_failed("its mode cannot be set"))?;
        std::fs::rename(&temporary, path).map_err(io_failed("cannot be put in its place"))
    };
    finish().inspect_err(|_| drop(std::fs::remove_file(&temporary)))?;
    Ok(Socket { listener, path: path.clone(), _lock: lock })
}

fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(suffix);
    path.with_file_name(name)
}

/// The id of a group of this host.
fn group_id(name: &str) -> Option<u32> {
    let name = std::ffi::CString::new(name).ok()?;
    // SAFETY: all zero is a valid `group`: null pointers and numbers.
    let mut group: libc::group = unsafe { std::mem::zeroed() };
    let mut buffer = vec![0; 64 << 10];
    let mut found = std::ptr::null_mut();
    // SAFETY: the name ends with NUL, the buffer has the given length, and all pointers are valid during the call.
    let failed =
        unsafe { libc::getgrnam_r(name.as_ptr(), &mut group, buffer.as_mut_ptr(), buffer.len(), &mut found) };
    (failed == 0 && !found.is_null()).then_some(group.gr_gid)
}

fn acceptor(files: &TlsConfig) -> Result<TlsAcceptor, Fault> {
    let wrong =
        |path: &Path, error: &dyn std::fmt::Display| usage(format!("api.tls: {}: {error}", path.display()));
    let text = regular::read(&files.certificate, regular::TEXT_BYTES);
    let text = text.map_err(|e| wrong(&files.certificate, &format!("expected certificates in PEM: {e}")))?;
    let certificates = CertificateDer::pem_slice_iter(&text)
        .collect::<Result<Vec<_>, _>>()
        .map_err(|e| wrong(&files.certificate, &format!("expected certificates in PEM: {e}")))?;
    let key = crate::control::tokens::read_private(&files.key)
        .map_err(|fault| usage(format!("api.tls: {}", fault.message)))?;
    let key = PrivateKeyDer::from_pem_slice(key.as_bytes())
        .map_err(|e| wrong(&files.key, &format!("expected a private key in PEM: {e}")))?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .and_then(|builder| builder.with_no_client_auth().with_single_cert(certificates, key))
        .map_err(|e| wrong(&files.certificate, &e))?;
    Ok(TlsAcceptor::from(Arc::new(config)))
}
