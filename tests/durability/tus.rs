//! A client of resumable uploads that goes on wherever the service says, and notices when something safe is lost.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use reqwest::{Client, RequestBuilder, Response, StatusCode};

/// One upload, as its client knows it.
pub struct Upload {
    bytes: Vec<u8>,
    name: String,
    /// Its path, once it is announced.
    path: Option<String>,
    /// Bytes that the service has said to be safe.
    safe: usize,
    /// The id of the scan that it has become.
    pub scan: Option<String>,
}

impl Upload {
    /// Nobody knows of it yet.
    pub fn new(name: &str, bytes: Vec<u8>) -> Self {
        Self { bytes, name: name.to_owned(), path: None, safe: 0, scan: None }
    }

    /// Does the next thing: announces it, or sends a piece. Returns the status of the answer.
    pub async fn go_on(&mut self, service: &str, project: &str, piece: usize) -> reqwest::Result<StatusCode> {
        let client = Client::new();
        let request = match &self.path {
            None => client
                .post(format!("{service}/v1/uploads"))
                .header("upload-length", self.bytes.len())
                .header("upload-metadata", self.metadata(project)),
            Some(path) => client
                .patch(format!("{service}{path}"))
                .header("upload-offset", self.safe)
                .header("content-type", "application/offset+octet-stream")
                .body(self.bytes[self.safe..self.bytes.len().min(self.safe + piece)].to_vec()),
        };
        self.send(request).await
    }

    /// Asks where it stands, as clients do after an error. Returns the status of the answer.
    pub async fn look(&mut self, service: &str) -> reqwest::Result<StatusCode> {
        let Some(path) = &self.path else { return Ok(StatusCode::OK) };
        let request = Client::new().head(format!("{service}{path}"));
        self.send(request).await
    }

    async fn send(&mut self, request: RequestBuilder) -> reqwest::Result<StatusCode> {
        let answer = request.header("tus-resumable", "1.0.0").send().await?;
        let status = answer.status();
        assert!(![StatusCode::NOT_FOUND, StatusCode::GONE].contains(&status), "what was announced is lost");
        if status.is_success() {
            self.note(&answer);
        }
        Ok(status)
    }

    fn note(&mut self, answer: &Response) {
        let header = |name: &str| answer.headers().get(name).map(|value| value.to_str().unwrap().to_owned());
        if let Some(location) = header("location") {
            self.path = Some(location);
        }
        if let Some(offset) = header("upload-offset") {
            let offset: usize = offset.parse().unwrap();
            assert!(offset >= self.safe, "{} bytes were safe, {offset} are", self.safe);
            self.safe = offset;
        }
        if let Some(scan) = header("cairn-scan") {
            assert_eq!(self.safe, self.bytes.len());
            self.scan = scan.rsplit('/').next().map(ToOwned::to_owned);
        }
    }

    fn metadata(&self, project: &str) -> String {
        let project = project.rsplit('/').next().unwrap();
        format!("project {},filename {}", STANDARD.encode(project), STANDARD.encode(&self.name))
    }
}
