//! The clients: some upload, some poll, some download, each at its own pace.

use std::io::Cursor;
use std::sync::{Arc, RwLock};
use std::time::{Duration, Instant};

use anyhow::Context;
use bytes::Bytes;
use rand::RngExt;
use reqwest::{Body, Client};
use serde_json::Value;
use tokio::task::JoinSet;

use super::figures::{Figures, POLL};
use super::service::Service;
use crate::cloud::PlyWriter;
use crate::control::Seed;
use crate::simulate::{BuildingOptions, Sensor, SurveyOptions, simulate};

/// Projects among which the uploads go.
const PROJECTS: usize = 8;

/// What the crowd shares.
struct World {
    url: String,
    client: Client,
    projects: Vec<String>,
    /// Files, each in two parts: between them goes what makes every upload another one.
    files: Vec<(Bytes, Bytes)>,
    /// Jobs and scans that were acknowledged, to be polled and downloaded.
    jobs: RwLock<Vec<String>>,
    scans: RwLock<Vec<String>>,
    pause: Duration,
}

/// Clients that are ready to begin.
pub(super) struct Crowd {
    world: Arc<World>,
    clients: usize,
}

impl Crowd {
    /// Makes projects, simulates scans, and uploads a first one to each project.
    pub async fn gather(service: &Service, clients: usize, pause: Duration) -> anyhow::Result<Self> {
        let mut projects = Vec::new();
        for index in 0..PROJECTS {
            projects.push(service.project(&format!("load {index}")).await?);
        }
        let world = Arc::new(World {
            url: service.url.clone(),
            client: service.client.clone(),
            projects,
            files: files()?,
            jobs: RwLock::default(),
            scans: RwLock::default(),
            pause,
        });
        for index in 0..PROJECTS {
            world.upload(index, index).await.map_err(anyhow::Error::msg)?;
        }
        Ok(Self { world, clients })
    }

    /// All clients at once, for so long.
    pub async fn work(self, time: Duration) -> Figures {
        let end = Instant::now() + time;
        let mut working = JoinSet::new();
        for index in 0..self.clients {
            let world = Arc::clone(&self.world);
            working.spawn(async move { world.work(index, end).await });
        }
        let mut all = Figures::default();
        while let Some(figures) = working.join_next().await {
            match figures {
                Ok(figures) => all.merge(figures),
                Err(error) => all.refuse(error.to_string()),
            }
        }
        all
    }
}

impl World {
    async fn work(&self, index: usize, end: Instant) -> Figures {
        let mut rng = Seed(7).derive("client", index as u128);
        let mut figures = Figures::default();
        let mut turn = index;
        tokio::time::sleep(self.pause.mul_f64(rng.random_range(0.0..1.0))).await;
        while Instant::now() < end {
            let begun = Instant::now();
            turn += 1;
            let (kind, done) = match index % 5 {
                0 => ("upload", self.upload(index, turn).await),
                4 => match turn % 3 {
                    0 => ("poses", self.get(&format!("{}/poses", self.pick(&self.projects, &mut rng))).await),
                    1 => ("model", self.get(&format!("{}/model", self.pick(&self.projects, &mut rng))).await),
                    _ => (
                        "original",
                        self.get(&format!("{}/original", self.known(&self.scans, &mut rng))).await,
                    ),
                },
                _ => (POLL, self.get(&self.known(&self.jobs, &mut rng)).await),
            };
            match done {
                Ok(()) => figures.add(kind, begun.elapsed()),
                Err(what) => figures.refuse(what),
            }
            tokio::time::sleep(self.pause.mul_f64(rng.random_range(0.5..1.5))).await;
        }
        figures
    }

    /// Uploads a file that nobody has uploaded before.
    async fn upload(&self, index: usize, turn: usize) -> Result<(), String> {
        let project = self.projects.get(index % PROJECTS).ok_or("no project")?;
        let (head, tail) = self.files.get(turn % self.files.len().max(1)).ok_or("no file")?;
        let unique = format!("comment upload {turn} of client {index}\n");
        let pieces = [head.clone(), Bytes::from(unique), tail.clone()];
        let length: usize = pieces.iter().map(Bytes::len).sum();
        let body = Body::wrap_stream(futures_util::stream::iter(pieces.map(Ok::<_, std::io::Error>)));
        let request = self
            .client
            .post(format!("{}{project}/scans?name=load.ply", self.url))
            .header("content-length", length)
            .body(body);
        let answer = request.send().await.map_err(|e| e.to_string())?;
        if !answer.status().is_success() {
            return Err(answer.status().to_string());
        }
        let answer: Value = answer.json().await.map_err(|e| e.to_string())?;
        let id = |what: &str| answer[what]["id"].as_str().map(str::to_owned).ok_or("no id");
        let (job, scan) = (id("job")?, id("scan")?);
        if let Ok(mut jobs) = self.jobs.write() {
            jobs.push(format!("/v1/jobs/{job}"));
        }
        if let Ok(mut scans) = self.scans.write() {
            scans.push(format!("{project}/scans/{scan}"));
        }
        Ok(())
    }

    async fn get(&self, path: &str) -> Result<(), String> {
        let answer =
            self.client.get(format!("{}{path}", self.url)).send().await.map_err(|e| e.to_string())?;
        if !answer.status().is_success() {
            return Err(answer.status().to_string());
        }
        answer.bytes().await.map(|_| ()).map_err(|e| e.to_string())
    }

    #[expect(clippy::unused_self, reason = "reads as what it is beside `known`")]
    fn pick<'a>(&self, from: &'a [String], rng: &mut impl RngExt) -> &'a str {
        from.get(rng.random_range(0..from.len().max(1))).map_or("", String::as_str)
    }

    fn known(&self, from: &RwLock<Vec<String>>, rng: &mut impl RngExt) -> String {
        from.read().map_or_else(|_| String::new(), |from| self.pick(&from, rng).to_owned())
    }
}

/// Files of a simulated house, each cut behind the first line of its header.
fn files() -> anyhow::Result<Vec<(Bytes, Bytes)>> {
    let options = SurveyOptions {
        building: BuildingOptions { rooms: 3, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(20_000),
        stations: 12,
        seed: Seed(3),
        ..SurveyOptions::default()
    };
    let mut files = Vec::new();
    for scan in simulate(&options)?.scans {
        let mut file = Cursor::new(Vec::new());
        let mut ply = PlyWriter::new(&mut file, false, &[])?;
        for point in &scan.cloud.points {
            ply.point(*point)?;
        }
        ply.finish()?;
        let bytes = Bytes::from(file.into_inner());
        let second =
            bytes.iter().enumerate().filter(|(_, b)| **b == b'\n').nth(1).context("no header")?.0 + 1;
        files.push((bytes.slice(..second), bytes.slice(second..)));
    }
    Ok(files)
}

/// A file that is large and read in no time: nine points, and bytes behind them.
fn large(mebibytes: usize, round: usize) -> impl Iterator<Item = Bytes> {
    let mut head = format!(
        "ply\nformat ascii 1.0\ncomment round {round}\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    );
    head.extend((0..9).map(|i| format!("{i} {} 1\n", i * i)));
    let piece = Bytes::from(vec![b' '; 1 << 20]);
    std::iter::once(Bytes::from(head)).chain(std::iter::repeat_n(piece, mebibytes))
}

/// Uploads one large file; returns megabytes a second until it is acknowledged.
pub(super) async fn large_upload(
    service: &Service,
    project: &str,
    mebibytes: usize,
    round: usize,
) -> anyhow::Result<f64> {
    let pieces = large(mebibytes, round);
    let body = Body::wrap_stream(futures_util::stream::iter(pieces.map(Ok::<_, std::io::Error>)));
    let begun = Instant::now();
    let at = format!("{}{project}/scans?name=large.ply", service.url);
    service.client.post(at).body(body).send().await?.error_for_status()?;
    Ok((mebibytes << 20) as f64 / 1e6 / begun.elapsed().as_secs_f64())
}

/// The path of a job that has ended.
pub(super) async fn finished_job(service: &Service, project: &str) -> anyhow::Result<String> {
    let body: Vec<u8> = large(0, 0).flatten().collect();
    let at = format!("{}{project}/scans?name=small.ply", service.url);
    let answer: Value = service.client.post(at).body(body).send().await?.error_for_status()?.json().await?;
    let job = format!("/v1/jobs/{}", answer["job"]["id"].as_str().context("a job has no id")?);
    loop {
        let state: Value =
            service.client.get(format!("{}{job}?wait=10", service.url)).send().await?.json().await?;
        if !state["finished"].is_null() {
            return Ok(job);
        }
    }
}
