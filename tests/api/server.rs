//! A service for one test, and the few calls that most tests make.

use std::fmt::Write as _;
use std::path::Path;
use std::time::Duration;

use cairn::app::{Running, start};
use cairn::config::Settings;
use reqwest::{Client, Response, StatusCode};
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, SqliteConnection};
use tempfile::TempDir;

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
        self.running.stop().await;
        Self::on(self.data, Settings::default()).await
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

/// A corner of a furnished room as an ascii PLY file: a floor and two walls with boxes, seen from a corner that `shift`
/// (metres) moves, so that different shifts are overlapping, different scans.
pub fn room(shift: f64) -> Vec<u8> {
    let mut points: Vec<[f64; 3]> = Vec::new();
    let mut patch = |corner: [f64; 3], u: [f64; 3], v: [f64; 3]| {
        for i in 0..40 {
            for j in 0..40 {
                let (a, b) = (f64::from(i) / 40.0, f64::from(j) / 40.0);
                points.push(std::array::from_fn(|k| corner[k] + a * u[k] + b * v[k]));
            }
        }
    };
    patch([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]);
    patch([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 2.5]);
    patch([0.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 2.5]);
    for [x, y, size] in [[1.0, 1.2, 0.5], [2.7, 0.9, 0.8], [1.9, 2.8, 0.35], [3.2, 3.1, 0.6]] {
        patch([x, y, size], [size, 0.0, 0.0], [0.0, size * 1.3, 0.0]);
        patch([x, y, 0.0], [size, 0.0, 0.0], [0.0, 0.0, size]);
        patch([x, y, 0.0], [0.0, size * 1.3, 0.0], [0.0, 0.0, size]);
    }
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        points.len()
    );
    for [x, y, z] in points {
        let _ = writeln!(text, "{:.4} {:.4} {:.4}", x - 2.0 - shift, y - 2.0 + 0.3 * shift, z - 1.3);
    }
    text.into_bytes()
}
