//! From a listening socket to requests: connections are counted, may be encrypted, and end when they only wait.
//!
//! A stranger can hold a connection, so each costs little and none lasts: at most so many at once, and one on which
//! nothing moves for a while is closed, whether it is silent between requests, dribbles the head of one, or does not
//! read the answer. Bodies have time-outs of their own where they are read. HTTP/1.1 only. `app` starts [`serve`].

mod patient;
mod tls;

use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::Request;
use hyper::body::Incoming;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::{GracefulShutdown, Watcher};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt as _;

use patient::Patient;
pub use tls::{TlsError, acceptor};

/// What connections may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// At most so many at once; more wait until one ends.
    pub most: usize,
    /// How long one may only wait: for a request, for the rest of its head, or for the client to read the answer.
    pub idle: Duration,
}

/// As much of a request's head as is read.
const HEAD_BYTES: usize = 64 * 1024;
/// Pause after a connection could not be taken, such as for want of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(500);

/// Serves until `stop` is cancelled and the answers that were begun have ended.
pub async fn serve(
    listener: TcpListener,
    app: Router,
    limits: ConnectionLimits,
    tls: Option<TlsAcceptor>,
    stop: CancellationToken,
) {
    let slots = Arc::new(Semaphore::new(limits.most));
    let graceful = GracefulShutdown::new();
    loop {
        // A place first: who finds none waits in the queue of the system.
        let connection = async {
            let slot = Arc::clone(&slots).acquire_owned().await;
            (slot, listener.accept().await)
        };
        let (slot, accepted) = tokio::select! {
            connection = connection => connection,
            () = stop.cancelled() => break,
        };
        let (stream, peer) = match accepted {
            Ok(connection) => connection,
            Err(error) => {
                tracing::warn!(%error, "a connection could not be taken");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let (app, tls, watcher) = (app.clone(), tls.clone(), graceful.watcher());
        tokio::spawn(async move {
            if let Err(error) = attend(stream, app, limits, tls, watcher).await {
                tracing::debug!(%peer, error, "a connection ended early");
            }
            drop(slot);
        });
    }
    drop(listener);
    graceful.shutdown().await;
}

/// One connection, until it ends. Errors are the peer's, in words.
async fn attend(
    stream: TcpStream,
    app: Router,
    limits: ConnectionLimits,
    tls: Option<TlsAcceptor>,
    watcher: Watcher,
) -> Result<(), String> {
    // Answers are written whole: waiting for more to send only delays them.
    stream.set_nodelay(true).map_err(|error| error.to_string())?;
    match tls {
        None => requests(stream, app, limits, watcher).await,
        Some(tls) => {
            let handshake = tokio::time::timeout(limits.idle, tls.accept(stream)).await;
            let stream = handshake
                .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
                .map_err(|error| format!("TLS: {error}"))?;
            requests(stream, app, limits, watcher).await
        }
    }
}

async fn requests(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    app: Router,
    limits: ConnectionLimits,
    watcher: Watcher,
) -> Result<(), String> {
    let service =
        TowerToHyperService::new(app.map_request(|request: Request<Incoming>| request.map(Body::new)));
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(limits.idle).max_buf_size(HEAD_BYTES);
    let connection = http.serve_connection(TokioIo::new(Patient::new(stream, limits.idle)), service);
    watcher.watch(connection).await.map_err(|error| error.to_string())
}
