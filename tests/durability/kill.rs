//! `kill -9` at random moments: two rigs upload, one of them in pieces, jobs run, versions are published, decisions are posted, and readers watch. `CAIRN_KILLS`
//! says how often (10 if it does not).

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cairn::control::Seed;
use cairn::geometry::Pose;
use rand::RngExt;
use reqwest::Client;
use serde_json::{Value, json};
use tokio::task::JoinHandle;

use crate::process::{Process, check};
use crate::subjects::{Subject, subjects};
use crate::tus::Upload;

/// What clients know of a service that lives and dies: where it is just now, and where on it they are at work.
struct World {
    url: Mutex<String>,
    project: String,
    subjects: Arc<Vec<Subject>>,
    /// Ids by subject, as they were acknowledged.
    scans: Mutex<Vec<Option<Value>>>,
    decisions: Mutex<Vec<Value>>,
}

impl World {
    fn at(&self, path: &str) -> String {
        format!("{}{}{path}", self.url.lock().unwrap(), self.project)
    }

    /// Sends a request again and again until it is answered well.
    async fn insist(&self, path: &str, body: impl Fn() -> reqwest::Body, json: bool) -> Value {
        let client = Client::new();
        loop {
            let kind = if json { "application/json" } else { "application/octet-stream" };
            let request = client.post(self.at(path)).header("content-type", kind).body(body());
            if let Ok(response) = request.send().await
                && response.status().is_success()
                && let Ok(answer) = response.json::<Value>().await
            {
                return answer;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// A rig uploads every second scan.
    async fn rig(self: Arc<Self>) {
        for index in (0..self.subjects.len()).step_by(2) {
            let subject = &self.subjects[index];
            let path = format!("/scans?name={}", subject.name);
            let answer = self.insist(&path, || subject.file.clone().into(), false).await;
            self.scans.lock().unwrap()[index] = Some(answer["scan"]["id"].clone());
            tokio::time::sleep(Duration::from_millis(300)).await;
        }
    }

    /// A rig on a bad line uploads the others in pieces, and goes on where the service says.
    async fn slow_rig(self: Arc<Self>) {
        for index in (1..self.subjects.len()).step_by(2) {
            let subject = &self.subjects[index];
            let mut upload = Upload::new(&subject.name, subject.file.clone());
            while upload.scan.is_none() {
                let url = self.url.lock().unwrap().clone();
                let sent = upload.go_on(&url, &self.project, subject.file.len() / 6).await;
                if !sent.is_ok_and(|status| status.is_success()) {
                    tokio::time::sleep(Duration::from_millis(50)).await;
                    let url = self.url.lock().unwrap().clone();
                    // If this fails as well, the next look tells.
                    let _ = upload.look(&url).await;
                }
                tokio::time::sleep(Duration::from_millis(30)).await;
            }
            self.scans.lock().unwrap()[index] = upload.scan.map(Value::from);
        }
    }

    /// Somebody who knows the place says so: every scan belongs to the one before it at its true pose.
    async fn decide(self: Arc<Self>) {
        for index in [1, 4] {
            let known = || {
                let scans = self.scans.lock().unwrap();
                Some([scans[index - 1].clone()?, scans[index].clone()?])
            };
            let pair = loop {
                if let Some(pair) = known() {
                    break pair;
                }
                tokio::time::sleep(Duration::from_millis(50)).await;
            };
            let truth = |i: usize| self.subjects[i].truth;
            let a_from_b = truth(index - 1).inverse() * truth(index);
            let body = json!({ "verdict": "join", "scan_a": pair[0], "scan_b": pair[1], "a_from_b": a_from_b.to_rows() });
            let answer = self.insist("/decisions", || body.to_string().into(), true).await;
            self.decisions.lock().unwrap().push(answer["decision"]["id"].clone());
        }
    }

    /// A reader looks at the model all the time: it is always one of its versions, whole, and never an older one than before.
    async fn read(self: Arc<Self>) {
        let mut newest = 0;
        loop {
            if let Ok(response) = reqwest::get(self.at("/model")).await {
                let status = response.status();
                if let Ok(model) = response.json::<Value>().await {
                    assert!(status.is_success(), "{model}");
                    let version = model["version"].as_u64().unwrap();
                    assert!(version >= newest, "version {version} after {newest}");
                    newest = version;
                    let components = model["components"].as_array().unwrap().iter();
                    let placed: usize = components.map(|c| c["scans"].as_array().unwrap().len()).sum();
                    let scans = model["scans"].as_array().unwrap().iter();
                    let registered = scans.filter(|s| s["outcome"]["status"] == "registered").count();
                    assert_eq!(registered, placed, "{model}");
                }
            }
            tokio::time::sleep(Duration::from_millis(30)).await;
        }
    }

    /// How many scans are in the largest component, and the worst distance (metres) of one of them from its true place.
    async fn quality(&self, service: &Process) -> (usize, f64) {
        let poses = service.json(&format!("{}/poses?component=0", self.project)).await;
        let placed: Vec<(Pose, Pose)> = self
            .subjects
            .iter()
            .filter_map(|s| {
                let pose = &poses["scans"][&s.name]["pose"];
                let rows: [[f64; 4]; 4] = serde_json::from_value(pose.clone()).ok()?;
                Some((Pose::from_rows(&rows).unwrap(), s.truth))
            })
            .collect();
        let Some((first, truth)) = placed.first() else { return (0, 0.0) };
        let truth_from_model = *truth * first.inverse();
        let worst = placed.iter().map(|(pose, truth)| (truth_from_model * *pose).difference(truth).1);
        (placed.len(), worst.fold(0.0, f64::max))
    }

    /// Everything that was acknowledged is there, once, and every job has ended well.
    async fn kept(&self, service: &Process) {
        for job in service.all_ended(&self.project).await {
            assert_eq!(job["status"], "succeeded", "{job}");
        }
        let list = service.json(&format!("{}/scans", self.project)).await;
        let there: Vec<&Value> = list["items"].as_array().unwrap().iter().map(|s| &s["id"]).collect();
        assert_eq!(there.len(), self.subjects.len(), "no scan is there twice");
        let acknowledged = self.scans.lock().unwrap().clone();
        for (subject, id) in self.subjects.iter().zip(acknowledged) {
            let id = id.expect("the rig ended, so it was acknowledged");
            assert!(there.contains(&&id), "{id} of {there:?}");
            let original = format!("{}{}/scans/{}/original", service.url, self.project, id.as_str().unwrap());
            assert_eq!(reqwest::get(original).await.unwrap().bytes().await.unwrap(), subject.file);
        }
        let list = service.json(&format!("{}/decisions", self.project)).await;
        let there: Vec<&Value> = list["items"].as_array().unwrap().iter().map(|d| &d["id"]).collect();
        for id in self.decisions.lock().unwrap().iter() {
            assert!(there.contains(&id), "decision {id} of {there:?}");
        }
    }
}

/// Everybody at work in a new project.
struct Round {
    world: Arc<World>,
    work: Vec<JoinHandle<()>>,
    reader: JoinHandle<()>,
}

impl Round {
    async fn begin(service: &Process, subjects: &Arc<Vec<Subject>>) -> Self {
        let made: Value = Client::new()
            .post(format!("{}/v1/projects", service.url))
            .json(&json!({ "name": "kill" }))
            .send()
            .await
            .unwrap()
            .json()
            .await
            .unwrap();
        let world = Arc::new(World {
            url: Mutex::new(service.url.clone()),
            project: format!("/v1/projects/{}", made["id"].as_str().unwrap()),
            subjects: Arc::clone(subjects),
            scans: Mutex::new(vec![None; subjects.len()]),
            decisions: Mutex::default(),
        });
        let work = vec![
            tokio::spawn(Arc::clone(&world).rig()),
            tokio::spawn(Arc::clone(&world).slow_rig()),
            tokio::spawn(Arc::clone(&world).decide()),
        ];
        let reader = tokio::spawn(Arc::clone(&world).read());
        Self { world, work, reader }
    }

    /// Waits for everybody, then for all jobs, and checks what is there.
    async fn end(self, service: &Process) -> (usize, f64) {
        for work in self.work {
            work.await.unwrap();
        }
        self.world.kept(service).await;
        assert!(!self.reader.is_finished(), "{:?}", self.reader.await);
        self.reader.abort();
        self.world.quality(service).await
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn kills_lose_nothing_that_was_acknowledged_and_leave_as_good_a_model() {
    let kills: u32 = std::env::var("CAIRN_KILLS").map_or(10, |n| n.parse().unwrap());
    let subjects = Arc::new(subjects(2, 8));
    let data = tempfile::tempdir().unwrap();
    let mut rng = Seed(11).derive("kills", 0);
    let mut service = Process::start(data.path());
    let begun = Instant::now();
    let (registered, worst) = Round::begin(&service, &subjects).await.end(&service).await;
    let undisturbed = begun.elapsed();
    assert!(registered >= 6 && worst < 0.3, "the undisturbed run: {registered} scans, {worst} m");
    let (mut left, mut rounds) = (kills, 0);
    while left > 0 {
        let round = Round::begin(&service, &subjects).await;
        // A dozen moments over about the time that the round takes, each of them in a life of its own.
        for _ in 0..left.min(12) {
            let life = rng.random_range(0.01..0.25) * undisturbed.as_secs_f64();
            tokio::time::sleep(Duration::from_secs_f64(life)).await;
            service.kill();
            service = Process::start(data.path());
            round.world.url.lock().unwrap().clone_from(&service.url);
        }
        (left, rounds) = (left - left.min(12), rounds + 1);
        let (after, worst_after) = round.end(&service).await;
        assert!(after >= registered, "{after} scans are registered, {registered} without kills");
        assert!(worst_after < worst + 0.1, "the worst is {worst_after} m off, {worst} m without kills");
    }
    service.kill();
    let (code, report) = check(data.path(), &[]);
    assert_eq!(code, 0, "{report}");
    println!("{kills} kills in {rounds} rounds of {} scans: nothing is lost ({report})", subjects.len());
}
