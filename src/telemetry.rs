//! Logs: text for people or JSON for machines, to standard error, chosen by `RUST_LOG`. With the feature `otlp`, spans go to
//! an `OpenTelemetry` collector as well.

#[cfg(feature = "otlp")]
mod otlp;

use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::{SubscriberInitExt, TryInitError};
use tracing_subscriber::{EnvFilter, Layer, Registry, fmt};

/// What is logged unless `RUST_LOG` says otherwise.
const DEFAULT_FILTER: &str = "info,sqlx=warn";

/// Why logging does not start.
#[derive(Debug, thiserror::Error)]
pub enum TelemetryError {
    /// It was started before.
    #[error("logging: {0}")]
    Started(#[from] TryInitError),
    /// The collector's address or protocol cannot be used.
    #[cfg(feature = "otlp")]
    #[error("the exporter of spans: {0}")]
    Exporter(#[from] opentelemetry_otlp::ExporterBuildError),
}

/// Keeps what is sent in the background alive; dropped, it sends the rest.
#[derive(Debug)]
#[must_use = "dropped, nothing more is sent"]
pub struct Telemetry {
    #[cfg(feature = "otlp")]
    _spans: Option<otlp::Spans>,
}

/// Starts logging for the process. Fails if that was done before.
pub fn init(json: bool) -> Result<Telemetry, TelemetryError> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_FILTER));
    let logs = fmt::layer::<Registry>().with_writer(std::io::stderr);
    let logs = if json { logs.json().boxed() } else { logs.boxed() };
    #[cfg(feature = "otlp")]
    let (logs, spans) = match otlp::spans()? {
        Some((layer, spans)) => (logs.and_then(layer).boxed(), Some(spans)),
        None => (logs, None),
    };
    tracing_subscriber::registry().with(logs.with_filter(filter)).try_init()?;
    Ok(Telemetry {
        #[cfg(feature = "otlp")]
        _spans: spans,
    })
}
