//! One message over one connection: resolved, checked, connected to the address that was checked, sent once. Redirects are
//! not followed and proxies not used, so nobody else chooses where it goes.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::Full;
use hyper::body::Bytes;
use hyper::{Request, header};
use hyper_util::rt::TokioIo;
use rustls::pki_types::ServerName;
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpStream, lookup_host};
use tokio_rustls::TlsConnector;

use super::sign::signature;
use super::target::{BadTarget, Target, Targets};
use crate::project::{SigningSecret, Timestamp};
use crate::storage::StorageError;

/// Why a message was not sent, or not answered.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// It may not be sent there.
    #[error(transparent)]
    Target(#[from] BadTarget),
    /// The host does not answer, or its name means nothing.
    #[error("no connection: {0}")]
    Connection(#[from] io::Error),
    /// The answer is none of HTTP.
    #[error("no answer: {0}")]
    Http(#[from] hyper::Error),
    /// The request could not be made of the address.
    #[error("the address cannot be asked: {0}")]
    Request(#[from] hyper::http::Error),
    /// It took too long.
    #[error("no answer within {} s", .0.as_secs())]
    TimedOut(Duration),
    /// TLS cannot be set up.
    #[error("TLS: {0}")]
    Tls(#[from] rustls::Error),
    /// What to send cannot be read.
    #[error(transparent)]
    Storage(#[from] StorageError),
}

/// From the first look at the name to the first line of the answer.
const PATIENCE: Duration = Duration::from_secs(15);

/// Sends messages. Clones share everything.
#[derive(Debug, Clone)]
pub(super) struct Sender {
    tls: Arc<ClientConfig>,
}

impl Sender {
    /// Trusts whom the system trusts.
    pub fn new() -> Result<Self, SendError> {
        let mut roots = RootCertStore::empty();
        let found = rustls_native_certs::load_native_certs();
        let (trusted, _) = roots.add_parsable_certificates(found.certs);
        if trusted == 0 {
            tracing::warn!(
                "the system lists no authorities that it trusts: no webhook can be reached by https"
            );
        }
        let config = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
            .with_safe_default_protocol_versions()?
            .with_root_certificates(roots)
            .with_no_client_auth();
        Ok(Self { tls: Arc::new(config) })
    }

    /// Posts a message, signed as of now, and returns the status of the answer.
    pub async fn post(
        &self,
        targets: &Targets,
        url: &str,
        id: &str,
        secret: &SigningSecret,
        body: String,
    ) -> Result<u16, SendError> {
        let target = targets.target(url)?;
        let sent = async {
            let stream = connect(targets, &target).await?;
            let request = request(&target, id, secret, body)?;
            if target.encrypted {
                let name = ServerName::try_from(target.host.clone()).map_err(|_| BadTarget::Malformed)?;
                let stream = TlsConnector::from(Arc::clone(&self.tls)).connect(name, stream).await?;
                exchange(stream, request).await
            } else {
                exchange(stream, request).await
            }
        };
        tokio::time::timeout(PATIENCE, sent).await.unwrap_or(Err(SendError::TimedOut(PATIENCE)))
    }
}

/// Connects to the first address of the host that may be connected to and answers.
async fn connect(targets: &Targets, target: &Target) -> Result<TcpStream, SendError> {
    let found = lookup_host((target.host.as_str(), target.port)).await?;
    let admitted: Vec<SocketAddr> = found.filter(|address| targets.admits_address(address.ip())).collect();
    if admitted.is_empty() {
        return Err(BadTarget::Inside(target.host.clone()).into());
    }
    // Given a list, it tries one after another.
    Ok(TcpStream::connect(admitted.as_slice()).await?)
}

fn request(
    target: &Target,
    id: &str,
    secret: &SigningSecret,
    body: String,
) -> Result<Request<Full<Bytes>>, SendError> {
    let seconds = Timestamp::now().0 / 1000;
    let host = if target.host.contains(':') { format!("[{}]", target.host) } else { target.host.clone() };
    let usual = if target.encrypted { 443 } else { 80 };
    let host = if target.port == usual { host } else { format!("{host}:{}", target.port) };
    Ok(Request::post(target.path.as_str())
        .header(header::HOST, host)
        .header(header::CONTENT_TYPE, "application/json")
        .header(header::USER_AGENT, concat!("cairn/", env!("CARGO_PKG_VERSION")))
        .header("webhook-id", id)
        .header("webhook-timestamp", seconds)
        .header("webhook-signature", signature(secret, id, seconds, &body))
        .body(Full::from(body))?)
}

/// Sends the request and reads the head of the answer; the rest is of no interest.
async fn exchange(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    request: Request<Full<Bytes>>,
) -> Result<u16, SendError> {
    let (mut client, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
    let mut answer = std::pin::pin!(client.send_request(request));
    let answer = tokio::select! {
        biased;
        answer = &mut answer => answer?,
        ended = connection => {
            ended?;
            // The peer closed the connection, as it may: after the answer, or without one.
            answer.await?
        }
    };
    Ok(answer.status().as_u16())
}
