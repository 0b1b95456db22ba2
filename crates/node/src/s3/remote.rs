// SPDX-License-Identifier: MIT OR Apache-2.0
//! The store's client, blocking. Credentials and endpoint come from the environment that other S3 programs read, too:
//! `AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION`, `AWS_ENDPOINT_URL`, `AWS_ALLOW_HTTP`.

use super::Location;
use crate::base::regular;
use async_trait::async_trait;
use http_body_util::BodyExt;
use hyper_util::client::legacy::Client;
use hyper_util::client::legacy::connect::HttpConnector as Plain;
use hyper_util::rt::TokioExecutor;
use object_store::aws::{AmazonS3, AmazonS3Builder};
use object_store::client::{
    HttpClient, HttpConnector, HttpError, HttpErrorKind, HttpRequest, HttpRequestBody, HttpResponse,
    HttpResponseBody, HttpService,
};
use object_store::{BackoffConfig, ClientOptions, ObjectStore, ObjectStoreExt, RetryConfig};
use std::ops::Range;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::time::Duration;
use tokio::runtime::Runtime;

/// Longest time that a store may be silent, or refuse connections, before a request fails.
const PATIENCE: Duration = Duration::from_secs(20);
/// Longest time that one answer may take.
const ANSWER: Duration = Duration::from_secs(120);
/// Size of the pieces in which files are sent and fetched, bytes; a smaller file is one object.
const PIECE: u64 = 16 << 20;

/// The name and size of a stored object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Object {
    /// Its name below the location.
    pub name: String,
    /// Size of the object in bytes.
    pub size: u64,
}

/// The objects at a location.
#[derive(Debug)]
pub struct Remote {
    location: Location,
    store: AmazonS3,
    runtime: Runtime,
}

impl Remote {
    /// A client for this location; no connection is opened yet.
    pub fn new(location: Location) -> Result<Self, String> {
        let failed = |e: &dyn std::fmt::Display| format!("{location}: {e}");
        let retry = RetryConfig {
            backoff: BackoffConfig { max_backoff: Duration::from_secs(2), ..BackoffConfig::default() },
            // The time is what ends it.
            max_retries: 1000,
            retry_timeout: PATIENCE,
        };
        let connector = Connector::new().map_err(|e| failed(&e))?;
        let store = AmazonS3Builder::from_env()
            .with_bucket_name(&location.bucket)
            .with_retry(retry)
            .with_http_connector(connector)
            .build()
            .map_err(|e| failed(&e))?;
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.map_err(|e| failed(&e))?;
        Ok(Self { location, store, runtime })
    }

    /// The location that all names are relative to.
    pub fn location(&self) -> &Location {
        &self.location
    }

    fn failed(&self, name: &str, error: impl std::fmt::Display) -> String {
        format!(
            "s3://{}/{}: {error}; see AWS_ENDPOINT_URL and the credentials in the environment",
            self.location.bucket,
            self.location.key(name)
        )
    }

    fn path(&self, name: &str) -> Result<object_store::path::Path, String> {
        object_store::path::Path::parse(self.location.key(name)).map_err(|e| self.failed(name, e))
    }

    /// Objects directly in a folder (`""`: at the location itself), and the folders in it, by name.
    pub fn list(&self, folder: &str) -> Result<(Vec<Object>, Vec<String>), String> {
        let prefix = self.path(folder)?;
        let listed = self.runtime.block_on(self.store.list_with_delimiter(Some(&prefix)));
        let listed = listed.map_err(|e| self.failed(folder, e))?;
        let name = |path: &object_store::path::Path| {
            let file = path.filename()?;
            Some(if folder.is_empty() { file.to_owned() } else { format!("{folder}/{file}") })
        };
        let object =
            |meta: &object_store::ObjectMeta| Some(Object { name: name(&meta.location)?, size: meta.size });
        Ok((
            listed.objects.iter().filter_map(object).collect(),
            listed.common_prefixes.iter().filter_map(name).collect(),
        ))
    }

    /// Reads a range of an object's bytes.
    pub fn read(&self, name: &str, range: Range<u64>) -> Result<Vec<u8>, String> {
        let path = self.path(name)?;
        let expected = range.end.saturating_sub(range.start);
        let bytes = self.runtime.block_on(self.store.get_range(&path, range));
        let bytes = bytes.map_err(|e| self.failed(name, e))?;
        if bytes.len() as u64 != expected {
            return Err(self.failed(name, format!("{} bytes came, expected {expected}", bytes.len())));
        }
        Ok(bytes.into())
    }

    /// Fetches an object into a file, which has its name when it is whole.
    pub fn fetch(&self, object: &Object, to: &Path) -> Result<(), String> {
        let mut problem = None;
        let written = crate::base::write_whole_cached(to, |file| {
            for start in (0..object.size).step_by(PIECE as usize) {
                let range = start..(start + PIECE).min(object.size);
                match self.read(&object.name, range) {
                    Ok(bytes) => file.write_all_at(&bytes, start)?,
                    Err(reason) => {
                        problem = Some(reason);
                        return Err(std::io::Error::other("not fetched"));
                    }
                }
            }
            Ok(())
        });
        written.map_err(|e| problem.unwrap_or_else(|| format!("{}: {e}", to.display())))
    }

    /// Stores a file. The object appears when all of it is there.
    pub fn put(&self, name: &str, from: &Path) -> Result<(), String> {
        let unreadable = |e: std::io::Error| format!("{}: {e}", from.display());
        let file = regular::open(from).map_err(unreadable)?;
        let size = file.metadata().map_err(unreadable)?.len();
        let piece = |start: u64| {
            let length = PIECE.min(size - start);
            let mut bytes = vec![0; usize::try_from(length).unwrap_or(0)];
            file.read_exact_at(&mut bytes, start).map(|()| bytes)
        };
        let path = self.path(name)?;
        if size <= PIECE {
            let bytes = piece(0).map_err(unreadable)?;
            let put = self.runtime.block_on(self.store.put(&path, bytes.into()));
            return put.map(drop).map_err(|e| self.failed(name, e));
        }
        self.runtime.block_on(async {
            let mut upload = self.store.put_multipart(&path).await.map_err(|e| self.failed(name, e))?;
            let mut sent = Ok(());
            for start in (0..size).step_by(PIECE as usize) {
                sent = match piece(start) {
                    Ok(bytes) => upload.put_part(bytes.into()).await.map_err(|e| self.failed(name, e)),
                    Err(error) => Err(unreadable(error)),
                };
                if sent.is_err() {
                    break;
                }
            }
            match sent {
                Ok(()) => upload.complete().await.map(drop).map_err(|e| self.failed(name, e)),
                Err(reason) => {
                    // The store forgets the pieces by itself, later.
                    let _ = upload.abort().await;
                    Err(reason)
                }
            }
        })
    }
}

/// Connections with the program's own client, over TCP or TLS.
#[derive(Debug, Clone)]
struct Connector(Client<hyper_rustls::HttpsConnector<Plain>, HttpRequestBody>);

impl Connector {
    fn new() -> Result<Self, String> {
        let tls = crate::control::client::tls_config(None)?;
        let https = hyper_rustls::HttpsConnectorBuilder::new()
            .with_tls_config(tls.as_ref().clone())
            .https_or_http()
            .enable_http1()
            .build();
        Ok(Self(Client::builder(TokioExecutor::new()).build(https)))
    }
}

impl HttpConnector for Connector {
    fn connect(&self, _: &ClientOptions) -> object_store::Result<HttpClient> {
        Ok(HttpClient::new(self.clone()))
    }
}

#[async_trait]
impl HttpService for Connector {
    async fn call(&self, request: HttpRequest) -> Result<HttpResponse, HttpError> {
        let answered = tokio::time::timeout(ANSWER, self.0.request(request)).await;
        let answer = answered.map_err(|e| HttpError::new(HttpErrorKind::Timeout, e))?.map_err(|e| {
            let kind = if e.is_connect() { HttpErrorKind::Connect } else { HttpErrorKind::Request };
            HttpError::new(kind, with_causes(&e))
        })?;
        let (parts, body) = answer.into_parts();
        let body = body.map_err(|e| HttpError::new(HttpErrorKind::Interrupted, with_causes(&e)));
        Ok(HttpResponse::from_parts(parts, HttpResponseBody::new(body)))
    }
}

/// An error with the texts of all its causes.
fn with_causes(error: &dyn std::error::Error) -> std::io::Error {
    let causes = std::iter::successors(Some(error), |error| error.source());
    std::io::Error::other(causes.map(ToString::to_string).collect::<Vec<_>>().join(": "))
}
