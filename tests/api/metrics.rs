//! What an operator sees: metrics and readiness.

use cairn::config::Settings;
use cairn::project::{Reach, Scope};

use crate::access::{only, unlimited};
use crate::server::{Server, problem, room};

/// The value of a line of metrics.
fn value(text: &str, line: &str) -> Option<f64> {
    let rest = text.lines().find_map(|found| found.strip_prefix(line)?.strip_prefix(' '))?;
    rest.parse().ok()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_id_of_a_request_is_the_services_own() {
    let server = Server::start().await;
    let id = async || {
        let request = server.client.get(server.url("/healthz")).header("x-request-id", "theirs");
        request.send().await.unwrap().headers()["x-request-id"].to_str().unwrap().to_owned()
    };
    let (first, next) = (id().await, id().await);
    assert!(first != "theirs" && next != "theirs" && first != next, "{first} {next}");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_tell_of_requests_refusals_uploads_jobs_and_what_there_is() {
    let server = Server::start().await;
    let project = server.project().await;
    let bytes = room(0.0);
    let size = bytes.len() as f64;
    server.registered(&project, "a.ply", bytes.clone()).await;
    server.upload(&project, "name=again.ply", bytes).await;
    server.get(&format!("{project}/scans/nothing")).await;
    server.get("/v1/nowhere/at/all").await;
    for _ in 0..2 {
        let answer = server.get("/metrics").await;
        assert!(
            answer.headers()["content-type"].to_str().unwrap().starts_with("application/openmetrics-text")
        );
        let text = answer.text().await.unwrap();
        assert!(text.ends_with("# EOF\n"));
        let shown = |line: &str| value(&text, line).unwrap_or_else(|| panic!("{line} is not in\n{text}"));
        let scans = "route=\"/v1/projects/{project}/scans\"";
        assert_eq!(
            shown(&format!("cairn_http_requests_total{{method=\"POST\",{scans},status=\"202\"}}")),
            1.0
        );
        assert_eq!(
            shown(&format!("cairn_http_requests_total{{method=\"POST\",{scans},status=\"200\"}}")),
            1.0
        );
        assert_eq!(shown("cairn_rejections_total{reason=\"not-found\"}"), 2.0);
        assert_eq!(shown("cairn_uploads_total{outcome=\"accepted\"}"), 1.0);
        assert_eq!(shown("cairn_uploads_total{outcome=\"duplicate\"}"), 1.0);
        assert_eq!(shown("cairn_upload_bytes_total"), 2.0 * size);
        let ended = "kind=\"registration\",status=\"succeeded\"";
        assert_eq!(
            shown(&format!("cairn_job_seconds_count{{{ended}}}")),
            1.0,
            "counted once, however often one looks"
        );
        assert_eq!(shown("cairn_job_wait_seconds_count{kind=\"registration\"}"), 1.0);
        assert_eq!(shown("cairn_queue_jobs{lane=\"map\",status=\"accepted\"}"), 0.0);
        assert_eq!(shown("cairn_scans{state=\"waiting\"}"), 1.0);
        assert_eq!((shown("cairn_projects"), shown("cairn_stored_scans_bytes")), (1.0, size));
        assert!(shown("cairn_disk_free_bytes") > 0.0);
        assert!(!text.contains(project.rsplit('/').next().unwrap()), "labels name routes, not addresses");
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_are_for_keys_that_reach_everything() {
    let server = Server::start().await;
    let project = server.project().await;
    let all = unlimited(&server, Scope::Read, Reach::Everything).await;
    let one = unlimited(&server, Scope::Manage, only(&project)).await;
    let ask = |token: &str| server.client.get(server.url("/metrics")).bearer_auth(token).send();
    assert_eq!(ask(&all).await.unwrap().status(), 200);
    problem(ask(&one).await.unwrap(), 403, "not-allowed").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_without_disk_lives_but_is_not_ready() {
    let server = Server::with(Settings { min_free_bytes: Some(u64::MAX), ..Settings::default() }).await;
    assert_eq!(server.get("/healthz").await.status(), 200);
    problem(server.get("/readyz").await, 503, "low-disk").await;
    server.stop().await;
}
