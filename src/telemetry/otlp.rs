//! Spans of requests and jobs to an `OpenTelemetry` collector, by OTLP over HTTP. The variables of `OpenTelemetry` say where
//! (`OTEL_EXPORTER_OTLP_ENDPOINT`, such as `http://127.0.0.1:4318`); without one, nothing is sent. The spans are those of the
//! log, which name no key and no query.

use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{ExporterBuildError, SpanExporter};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::SdkTracerProvider;
use tracing_subscriber::{Layer, Registry};

/// What sends spans in the background. Dropped, it sends the rest.
#[derive(Debug)]
pub(super) struct Spans(SdkTracerProvider);

impl Drop for Spans {
    fn drop(&mut self) {
        if let Err(error) = self.0.shutdown() {
            eprintln!("the last spans could not be sent: {error}");
        }
    }
}

type SpanLayer = Box<dyn Layer<Registry> + Send + Sync>;

/// The layer that collects spans, and what sends them, if the environment names a collector.
pub(super) fn spans() -> Result<Option<(SpanLayer, Spans)>, ExporterBuildError> {
    let named = ["OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT"];
    if !named.iter().any(|name| std::env::var_os(name).is_some()) {
        return Ok(None);
    }
    let exporter = SpanExporter::builder().with_http().build()?;
    let provider = SdkTracerProvider::builder()
        .with_batch_exporter(exporter)
        .with_resource(Resource::builder().with_service_name("cairn").build())
        .build();
    let layer = tracing_opentelemetry::layer::<Registry>().with_tracer(provider.tracer("cairn")).boxed();
    Ok(Some((layer, Spans(provider))))
}
