//! The few calls of the REST interface that the demo makes, as any client would make them.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, bail};
use reqwest::{RequestBuilder, Response};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;

/// A project on a running service. Clones share the connections.
#[derive(Debug, Clone)]
pub(super) struct Client {
    http: reqwest::Client,
    base: String,
    project: String,
}

/// A scan in the list of the project.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct ScanRow {
    /// Its name.
    pub name: String,
    /// received, ingested, registered, waiting, failed or dismissed.
    pub state: String,
    /// Where it stands, or why it failed.
    pub outcome: Option<Value>,
}

impl ScanRow {
    /// Whether the service still has to do something about it.
    pub fn is_queued(&self) -> bool {
        matches!(self.state.as_str(), "received" | "ingested")
    }
}

#[derive(Debug, Deserialize)]
struct ScanList {
    items: Vec<ScanRow>,
    next: Option<String>,
}

/// The newest version of the model.
#[derive(Debug, Clone, Default, Deserialize)]
pub(super) struct Model {
    /// Its number.
    pub version: u32,
    /// Largest first.
    pub components: Vec<ModelComponent>,
}

/// A component of the model.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct ModelComponent {
    /// Ids of its scans.
    pub scans: Vec<String>,
    /// Points seen in at least two scans.
    pub landmarks: usize,
}

/// A job.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct Job {
    id: String,
    status: String,
    /// What came of it.
    pub outcome: Option<Value>,
    problem: Option<Value>,
}

impl Client {
    /// Makes a project on the service at this URL.
    pub async fn create_project(url: &str, name: &str) -> anyhow::Result<Self> {
        // The service is on this machine: a proxy has no part in it.
        let http = reqwest::Client::builder().no_proxy().build()?;
        let request = http.post(format!("{url}/v1/projects")).json(&json!({ "name": name }));
        let response = answered(request).await?;
        let location = response.headers().get("location").context("the new project has no location")?;
        let project = location.to_str()?.to_owned();
        Ok(Self { http, base: url.to_owned(), project })
    }

    /// Uploads a file, streamed.
    pub async fn upload(&self, name: &str, path: &Path) -> anyhow::Result<()> {
        let file =
            tokio::fs::File::open(path).await.with_context(|| format!("cannot open {}", path.display()))?;
        let url = self.url("/scans");
        answered(self.http.post(url).query(&[("name", name)]).body(file)).await.map(|_| ())
    }

    /// All scans of the project.
    pub async fn scans(&self) -> anyhow::Result<Vec<ScanRow>> {
        let mut scans = Vec::new();
        let mut cursor: Option<String> = None;
        loop {
            let mut request = self.http.get(self.url("/scans")).query(&[("limit", "200")]);
            if let Some(cursor) = &cursor {
                request = request.query(&[("cursor", cursor)]);
            }
            let part: ScanList = answered(request).await?.json().await?;
            scans.extend(part.items);
            match part.next {
                Some(next) => cursor = Some(next),
                None => return Ok(scans),
            }
        }
    }

    /// The newest version of the model.
    pub async fn model(&self) -> anyhow::Result<Model> {
        Ok(answered(self.http.get(self.url("/model"))).await?.json().await?)
    }

    /// Asks for a job on the model and waits for its end.
    pub async fn run_job(&self, kind: &str) -> anyhow::Result<Job> {
        let request = self.http.post(self.url("/jobs")).json(&json!({ "kind": kind }));
        let mut job: Job = answered(request).await?.json().await?;
        while matches!(job.status.as_str(), "accepted" | "running") {
            let request = self.http.get(format!("{}/v1/jobs/{}", self.base, job.id)).query(&[("wait", "30")]);
            job = answered(request.timeout(Duration::from_mins(1))).await?.json().await?;
        }
        if job.status != "succeeded" {
            let why =
                job.problem.as_ref().and_then(|p| p["detail"].as_str()).unwrap_or("it does not say why");
            bail!("the job {kind} ended as {}: {why}", job.status);
        }
        Ok(job)
    }

    /// Downloads something of the project (a path and a query below it) into a file, which appears when it is complete.
    pub async fn download(&self, what: &str, file: &Path) -> anyhow::Result<()> {
        let mut response = answered(self.http.get(self.url(what))).await?;
        let part = file.with_extension("part");
        let result = async {
            let mut out = tokio::fs::File::create(&part).await?;
            while let Some(bytes) = response.chunk().await? {
                out.write_all(&bytes).await?;
            }
            out.flush().await?;
            anyhow::Ok(tokio::fs::rename(&part, file).await?)
        };
        result.await.with_context(|| format!("cannot download to {}", file.display()))
    }

    fn url(&self, path: &str) -> String {
        format!("{}{}{path}", self.base, self.project)
    }
}

/// Sends a request and takes an answer that is no success for an error, in the words of the service.
async fn answered(request: RequestBuilder) -> anyhow::Result<Response> {
    let response = request.send().await?;
    let status = response.status();
    if status.is_success() {
        return Ok(response);
    }
    let problem: Value = response.json().await.unwrap_or_default();
    match problem["detail"].as_str() {
        Some(detail) => bail!("{status}: {detail}"),
        None => bail!("{status}"),
    }
}
