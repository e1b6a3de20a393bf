//! From a listening socket to requests: connections are counted, may be encrypted, and end when they only wait.
//!
//! A stranger can hold a connection, so each costs little and none lasts: at most so many at once, fewer from one address, and one on which
//! nothing moves for a while is closed, whether it is silent between requests, dribbles the head of one, or reads
//! next to nothing of the answer. Bodies have time-outs of their own where they are read. HTTP/1.1 only. `app` starts [`serve`].

mod patient;
mod places;
mod tls;

use std::io;
use std::net::IpAddr;
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

use super::Metrics;
use super::access::{Peer, Proxies, Source};
use crate::jobs::Demand;
use patient::Patient;
use places::Places;
pub use tls::{Certificates, TlsError};

/// What connections may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// At most so many at once; more wait until one ends.
    pub most: usize,
    /// At most so many from one address that is no trusted proxy; more are closed.
    pub most_per_address: usize,
    /// How long one may only wait: for a request, for the rest of its head, or for the client to read the next kilobyte of
    /// the answer.
    pub idle: Duration,
}

/// As much of a request's head as is read.
const HEAD_BYTES: usize = 64 * 1024;
/// Pause after a connection could not be taken, such as for want of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(500);

/// Where requests come in.
#[derive(Debug)]
pub struct Entrance {
    /// The address.
    pub listener: TcpListener,
    /// What connections may do.
    pub limits: ConnectionLimits,
    /// Who may hold any number of connections, since many clients are behind them.
    pub proxies: Proxies,
    /// With what connections are encrypted, if they are.
    pub tls: Option<Certificates>,
    /// Where those are counted that are turned away.
    pub metrics: Arc<Metrics>,
    /// Where those are counted that are let in.
    pub demand: Arc<Demand>,
}

/// Serves until `stop` is cancelled and the answers that were begun have ended.
pub async fn serve(entrance: Entrance, app: Router, stop: CancellationToken) {
    let Entrance { listener, limits, proxies, tls, metrics, demand } = entrance;
    let (slots, places) = (Arc::new(Semaphore::new(limits.most)), Places::default());
    let acceptor = tls.as_ref().map(Certificates::acceptor);
    let renewal = tls.map(|certificates| tokio::spawn(certificates.renew(stop.clone())));
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
        let most = if proxies.trust(peer.ip()) { usize::MAX } else { limits.most_per_address };
        let Some(place) = places.take(Source::of(peer.ip()), most) else {
            tracing::debug!(%peer, "a connection is closed: its address has as many as it may");
            metrics.turned_away();
            continue;
        };
        let (app, tls, watcher) = (app.clone(), acceptor.clone(), graceful.watcher());
        let connected = demand.connected();
        tokio::spawn(async move {
            if let Err(error) = attend(stream, peer.ip(), app, limits, tls, watcher).await {
                tracing::debug!(%peer, error, "a connection ended early");
            }
            drop((slot, place, connected));
        });
    }
    drop(listener);
    graceful.shutdown().await;
    if let Some(renewal) = renewal {
        renewal.abort();
    }
}

/// One connection, until it ends. Errors are the peer's, in words.
async fn attend(
    stream: TcpStream,
    peer: IpAddr,
    app: Router,
    limits: ConnectionLimits,
    tls: Option<TlsAcceptor>,
    watcher: Watcher,
) -> Result<(), String> {
    // Answers are written whole: waiting for more to send only delays them.
    stream.set_nodelay(true).map_err(|error| error.to_string())?;
    match tls {
        None => requests(stream, peer, app, limits, watcher).await,
        Some(tls) => {
            let handshake = tokio::time::timeout(limits.idle, tls.accept(stream)).await;
            let stream = handshake
                .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
                .map_err(|error| format!("TLS: {error}"))?;
            requests(stream, peer, app, limits, watcher).await
        }
    }
}

async fn requests(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: IpAddr,
    app: Router,
    limits: ConnectionLimits,
    watcher: Watcher,
) -> Result<(), String> {
    let service = TowerToHyperService::new(app.map_request(move |request: Request<Incoming>| {
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(Peer(peer));
        request
    }));
    let mut http = hyper::server::conn::http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(limits.idle).max_buf_size(HEAD_BYTES);
    let connection = http.serve_connection(TokioIo::new(Patient::new(stream, limits.idle)), service);
    watcher.watch(connection).await.map_err(|error| error.to_string())
}
