//! The whole service in a process: wiring, start and shutdown. The command line, the demo and the tests all run
//! exactly this.

use std::net::SocketAddr;
use std::sync::Arc;

use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::config::Config;
use crate::http::{
    self, Access, Api, Certificates, Entrance, Openness, Rates, Readings, TlsError, openapi_yaml, router,
};
use crate::jobs::webhooks::{Courier, SendError};
use crate::jobs::{Compute, Demand, Exports, Intake, Resumable, Workers};
use crate::storage::{StorageError, Store};

/// Why the service does not start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The data directory cannot be used.
    #[error("the data directory {0}: {1}")]
    Data(std::path::PathBuf, StorageError),
    /// The thread pool does not start.
    #[error("the thread pool: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// The address cannot be listened on.
    #[error("cannot listen on {0}: {1}")]
    Listen(SocketAddr, std::io::Error),
    /// Webhooks cannot be reached.
    #[error("webhooks: {0}")]
    Webhooks(#[from] SendError),
    /// Connections cannot be encrypted.
    #[error("TLS: {0}")]
    Tls(#[from] TlsError),
    /// Strangers could reach it, and there is no key.
    #[error(
        "{0} can be reached from other machines, and no key is valid: make one with `cairn key create`, or say \
         `--allow-anonymous` if whoever reaches the address may do everything"
    )]
    Unguarded(SocketAddr),
    /// The interface's description cannot be written.
    #[error("the description of the interface: {0}")]
    Description(String),
}

/// A service that runs.
#[derive(Debug)]
pub struct Running {
    /// Where it listens.
    pub addr: SocketAddr,
    scheme: &'static str,
    stop: CancellationToken,
    server: JoinHandle<()>,
}

impl Running {
    /// Begins to stop when cancelled.
    #[must_use]
    pub fn stopper(&self) -> CancellationToken {
        self.stop.clone()
    }

    /// Where it can be reached from this machine.
    #[must_use]
    pub fn url(&self) -> String {
        format!("{}://{}", self.scheme, self.addr)
    }

    /// Waits until the service has stopped by itself or by its stopper.
    pub async fn wait(self) {
        if let Err(error) = self.server.await {
            tracing::error!(%error, "the service ended badly");
        }
    }

    /// Stops the service: no new requests, running answers end, jobs are given back; returns when all is closed.
    pub async fn stop(self) {
        self.stop.cancel();
        self.wait().await;
    }
}

/// How long running answers, such as downloads, are waited for at a shutdown.
const DRAIN: std::time::Duration = std::time::Duration::from_secs(10);

/// Starts the service. When this returns, it answers.
pub async fn start(config: Config) -> Result<Running, StartError> {
    let store =
        Store::open(&config.data).await.map_err(|error| StartError::Data(config.data.clone(), error))?;
    let tls = config.tls.as_ref().map(|(chain, key)| Certificates::open(chain, key)).transpose()?;
    store.limit_projects(config.project_limits);
    let openness = Openness::of(config.allow_anonymous, config.listen);
    if openness == Openness::Closed
        && !store.keys().any_valid().await.map_err(|error| StartError::Data(config.data.clone(), error))?
    {
        store.close().await;
        return Err(StartError::Unguarded(config.listen));
    }
    let compute = Compute::new(config.threads)?;
    let listener =
        TcpListener::bind(config.listen).await.map_err(|error| StartError::Listen(config.listen, error))?;
    let addr = listener.local_addr().map_err(|error| StartError::Listen(config.listen, error))?;
    let stop = CancellationToken::new();
    let intake = Intake::new(store.clone(), config.intake);
    let metrics = Arc::default();
    let demand = Arc::new(Demand::new(config.spare_core_at));
    let api = Api {
        store: store.clone(),
        resumable: Resumable::new(store.clone(), intake.clone(), config.upload_expiry, stop.clone()),
        intake,
        exports: Exports::new(store.clone(), compute.clone(), config.workers.max_points, config.exports),
        readings: Readings::default(),
        access: Access {
            openness,
            origins: config.origins.into(),
            load: config.load,
            rates: Rates::new(config.rates, config.proxies.clone()),
        },
        webhooks: Arc::new(config.webhooks.targets.clone()),
        metrics: Arc::clone(&metrics),
        demand: Arc::clone(&demand),
        readiness: Arc::default(),
        stop: stop.clone(),
        openapi: Arc::from(openapi_yaml().map_err(|problem| StartError::Description(problem.detail))?),
    };
    let workers = Workers::start(store.clone(), compute, config.workers, Arc::clone(&demand))
        .await
        .map_err(|error| StartError::Data(config.data.clone(), error))?;
    tracing::info!(%addr, data = %config.data.display(), "listening");
    let courier = Courier::new(store.clone(), config.webhooks)?;
    let scheme = if tls.is_some() { "https" } else { "http" };
    let entrance =
        Entrance { listener, limits: config.connections, proxies: config.proxies, tls, metrics, demand };
    let server = tokio::spawn(serve(entrance, api, workers, courier, store, stop.clone()));
    Ok(Running { addr, scheme, stop, server })
}

async fn serve(
    entrance: Entrance,
    api: Api,
    workers: Workers,
    courier: Courier,
    store: Store,
    stop: CancellationToken,
) {
    let courier = tokio::spawn(courier.run(stop.clone()));
    let graceful = http::serve(entrance, router(api), stop.clone());
    let overdue = async {
        stop.cancelled().await;
        tokio::time::sleep(DRAIN).await;
    };
    tokio::select! {
        () = graceful => {}
        () = overdue => tracing::warn!("answers that did not end in time are cut off"),
    }
    stop.cancel();
    workers.stop().await;
    if let Err(error) = courier.await {
        tracing::error!(%error, "the courier of webhooks ended badly");
    }
    store.close().await;
    tracing::info!("stopped");
}
