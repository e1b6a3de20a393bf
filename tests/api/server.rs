//! A service for one test, and the few calls that most tests make.

use std::path::Path;
use std::time::Duration;

use cairn::app::{Running, start};
use cairn::config::Settings;
use reqwest::{Client, Response, StatusCode};
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, SqliteConnection};
use tempfile::TempDir;

pub use crate::room::room;

/// A running service with its own data directory.
pub struct Server {
    pub client: Client,
    running: Running,
    data: TempDir,
}

impl Server {
    /// Starts with settings that suit tests.
    pub async fn start() -> Self {
        Self::with(Settings::default()).await
    }

    /// Starts with some settings of its own.
    pub async fn with(settings: Settings) -> Self {
        Self::on(tempfile::tempdir().unwrap(), settings).await
    }

    async fn on(data: TempDir, settings: Settings) -> Self {
        let ours = Settings {
            listen: Some(([127, 0, 0, 1], 0).into()),
            data: Some(data.path().to_owned()),
            threads: Some(2),
            ..Settings::default()
        };
        let running = start(settings.or(ours).resolve().unwrap()).await.unwrap();
        Self { client: Client::new(), running, data }
    }

    /// Stops softly and starts again on the same data.
    pub async fn restart(self) -> Self {
        self.restart_with(Settings::default()).await
    }

    /// Stops softly and starts again on the same data with some settings of its own.
    pub async fn restart_with(self, settings: Settings) -> Self {
        self.running.stop().await;
        Self::on(self.data, settings).await
    }

    /// Stops, makes every version look as if another engine had made it, and starts again.
    pub async fn restart_with_a_model_of_another_engine(self) -> Self {
        self.running.stop().await;
        let options = SqliteConnectOptions::new().filename(self.data.path().join("cairn.sqlite"));
        let mut database = SqliteConnection::connect_with(&options).await.unwrap();
        sqlx::query("UPDATE versions SET engine = 'engine/0'").execute(&mut database).await.unwrap();
        database.close().await.unwrap();
        Self::on(self.data, Settings::default()).await
    }

    /// Changes the database behind the service's back.
    pub async fn sql(&self, statement: &'static str) {
        let options = SqliteConnectOptions::new().filename(self.data.path().join("cairn.sqlite"));
        let mut database = SqliteConnection::connect_with(&options).await.unwrap();
        sqlx::query(statement).execute(&mut database).await.unwrap();
        database.close().await.unwrap();
    }

    /// The word that a query finds in the database.
    pub async fn word(&self, query: &'static str) -> String {
        let options = SqliteConnectOptions::new().filename(self.data.path().join("cairn.sqlite"));
        let mut database = SqliteConnection::connect_with(&options).await.unwrap();
        let word = sqlx::query_scalar(query).fetch_one(&mut database).await.unwrap();
        database.close().await.unwrap();
        word
    }

    /// Removes the file of a blob behind the service's back.
    pub fn lose(&self, blob: &str) {
        let folder = self.data.path().join("blobs").join(&blob[..2]).join(&blob[2..4]);
        std::fs::remove_file(folder.join(blob)).unwrap();
    }

    /// Files in a folder of the data directory.
    pub fn files(&self, folder: &str) -> usize {
        std::fs::read_dir(self.data.path().join(folder)).unwrap().count()
    }

    pub async fn stop(self) {
        self.running.stop().await;
    }

    /// Its data directory.
    pub fn data(&self) -> &Path {
        self.data.path()
    }

    pub fn url(&self, path: &str) -> String {
        format!("{}{path}", self.running.url())
    }

    pub async fn get(&self, path: &str) -> Response {
        self.client.get(self.url(path)).send().await.unwrap()
    }

    /// GET, 200, JSON.
    pub async fn json(&self, path: &str) -> Value {
        let response = self.get(path).await;
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        response.json().await.unwrap()
    }

    /// Makes a project and returns its path.
    pub async fn project(&self) -> String {
        let body = json!({ "name": "test", "resolution": 0.1 });
        let response = self.client.post(self.url("/v1/projects")).json(&body).send().await.unwrap();
        assert_eq!(response.status(), StatusCode::CREATED);
        response.headers()["location"].to_str().unwrap().to_owned()
    }

    pub async fn upload(&self, project: &str, query: &str, bytes: impl Into<reqwest::Body>) -> Response {
        let url = self.url(&format!("{project}/scans?{query}"));
        self.client.post(url).body(bytes).send().await.unwrap()
    }

    /// Uploads, expects 202, and returns the answer.
    pub async fn accepted(&self, project: &str, name: &str, bytes: Vec<u8>) -> Value {
        let response = self.upload(project, &format!("name={name}"), bytes).await;
        assert_eq!(response.status(), StatusCode::ACCEPTED);
        response.json().await.unwrap()
    }

    /// Waits for the end of a job.
    pub async fn ended(&self, job: &Value) -> Value {
        let id = job["id"].as_str().unwrap();
        let polled = async {
            loop {
                let job = self.json(&format!("/v1/jobs/{id}?wait=30")).await;
                if !matches!(job["status"].as_str(), Some("accepted" | "running")) {
                    return job;
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(100), polled).await.expect("the job should end")
    }

    /// Uploads a scan and waits for the end of its job.
    pub async fn registered(&self, project: &str, name: &str, bytes: Vec<u8>) -> (Value, Value) {
        let answer = self.accepted(project, name, bytes).await;
        let job = self.ended(&answer["job"]).await;
        (answer["scan"].clone(), job)
    }
}

/// Asserts that an answer is a problem of this kind and returns it.
pub async fn problem(response: Response, status: u16, word: &str) -> Value {
    assert_eq!(response.headers()["content-type"], "application/problem+json");
    let found = response.status();
    let body: Value = response.json().await.unwrap();
    assert_eq!(found, status, "{body}");
    assert_eq!(body["type"], format!("urn:cairn:problem:{word}"), "{body}");
    assert_eq!(body["status"], status);
    body
}
