//! What there is right now.

use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use crate::project::{JobState, Lane};
use crate::storage::{StorageError, Store};

/// Gauges with the values of this moment.
pub(super) async fn registry(store: &Store) -> Result<Registry, StorageError> {
    let figures = store.figures().await?;
    let mut registry = Registry::with_prefix("cairn");

    let jobs = Family::<[(&str, &str); 2], Gauge>::default();
    // A lane without jobs says so, instead of saying nothing.
    for lane in [Lane::Ingest, Lane::Map] {
        for state in [JobState::Accepted, JobState::Running] {
            let found = figures.jobs.iter().find(|(l, s, _)| (*l, *s) == (lane, state));
            let labels = [("lane", lane.as_str()), ("status", state.as_str())];
            jobs.get_or_create(&labels).set(found.map_or(0, |(_, _, n)| n.cast_signed()));
        }
    }
    registry.register("queue_jobs", "Jobs that wait (accepted) or run, by lane", jobs);

    let scans = Family::<[(&str, String); 1], Gauge>::default();
    for (state, n) in figures.scans {
        scans.get_or_create(&[("state", state)]).set(n.cast_signed());
    }
    registry.register("scans", "Scans that were not deleted, by state", scans);
    let disk = store.free_bytes()?;
    for (name, help, unit, value) in [
        (
            "stored_scans",
            "Bytes of the uploads of scans that were not deleted",
            Some(Unit::Bytes),
            figures.scan_bytes,
        ),
        ("disk_free", "Bytes that are free where the data are", Some(Unit::Bytes), disk),
        (
            "open_uploads",
            "Resumable uploads that are neither complete nor expired",
            None,
            figures.open_uploads,
        ),
        (
            "open_uploads_received",
            "Bytes of open resumable uploads that have come",
            Some(Unit::Bytes),
            figures.open_upload_bytes,
        ),
        ("projects", "Projects", None, figures.projects),
        ("models", "Projects whose model is not empty", None, figures.models),
        ("model_versions", "Versions of models that can be read", None, figures.versions),
        ("webhook_deliveries_pending", "Messages to webhooks that wait to be sent", None, figures.deliveries),
    ] {
        let gauge = Gauge::<i64>::default();
        gauge.set(i64::try_from(value).unwrap_or(i64::MAX));
        match unit {
            Some(unit) => registry.register_with_unit(name, help, unit, gauge),
            None => registry.register(name, help, gauge),
        }
    }
    Ok(registry)
}
