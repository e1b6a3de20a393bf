//! Files that rot, and the commands of an operator.

use std::fs;
use std::path::Path;

use reqwest::StatusCode;
use serde_json::Value;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, Row as _, SqliteConnection};

use crate::process::{Process, blob, cairn, check, room};

/// A project with two registered scans: the service, its path, and the uploads.
async fn filled(data: &Path) -> (Process, String, Vec<Value>) {
    let service = Process::start(data);
    let project = service.project().await;
    let mut uploads = Vec::new();
    for shift in [0.0, 0.4] {
        let upload = service.accepted(&project, room(shift)).await;
        assert_eq!(service.ended(&upload["job"]).await["status"], "succeeded");
        uploads.push(upload);
    }
    (service, project, uploads)
}

/// Spoils a file in place, as a failing disk does.
fn spoil(file: &Path) {
    let mut bytes = fs::read(file).unwrap();
    let at = bytes.len() / 2;
    bytes[at] ^= 0x10;
    fs::write(file, bytes).unwrap();
}

/// Every file in the folder of blobs.
fn files(data: &Path) -> Vec<std::path::PathBuf> {
    let inside = |folder: std::path::PathBuf| {
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect::<Vec<_>>()
    };
    let folders = inside(data.join("blobs")).into_iter().filter(|f| !f.ends_with("partial")).flat_map(inside);
    folders.flat_map(inside).collect()
}

/// Marks a scan as deleted that no job is to remove, which is what a removal that failed leaves behind.
async fn half_deleted(data: &Path, scan: &Value) -> SqliteConnection {
    let options = SqliteConnectOptions::new().filename(data.join("cairn.sqlite"));
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::query("UPDATE scans SET deleted_ms = 1 WHERE id = ?")
        .bind(scan["id"].as_str().unwrap())
        .execute(&mut database)
        .await
        .unwrap();
    database
}

#[tokio::test]
async fn a_deletion_whose_job_failed_is_carried_out_by_the_next_job_or_at_the_next_start() {
    let dir = tempfile::tempdir().unwrap();
    let (mut service, project, uploads) = filled(dir.path()).await;
    let placed = async |service: &Process| -> Vec<String> {
        let model = service.json(&format!("{project}/model")).await;
        let scans = model["scans"].as_array().unwrap().iter();
        scans.map(|scan| scan["scan"].as_str().unwrap().to_owned()).collect()
    };
    let id = |upload: &Value| upload["scan"]["id"].as_str().unwrap().to_owned();
    let mut database = half_deleted(dir.path(), &uploads[0]["scan"]).await;
    let third = service.accepted(&project, room(0.8)).await;
    assert_eq!(service.ended(&third["job"]).await["status"], "succeeded");
    let [second, third] = [id(&uploads[1]), id(&third)];
    assert_eq!(placed(&service).await, [second.clone(), third.clone()]);
    let forgotten = "SELECT COUNT(*) FROM scans WHERE forgotten_ms IS NOT NULL";
    let row = sqlx::query(forgotten).fetch_one(&mut database).await.unwrap();
    assert_eq!(row.get::<i64, _>(0), 1);

    half_deleted(dir.path(), &uploads[1]["scan"]).await.close().await.unwrap();
    service.kill();
    let service = Process::start(dir.path());
    let begun = std::time::Instant::now();
    while sqlx::query(forgotten).fetch_one(&mut database).await.unwrap().get::<i64, _>(0) < 2 {
        assert!(begun.elapsed() < std::time::Duration::from_mins(1), "the second is never removed");
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    assert!(!placed(&service).await.contains(&second));
    let jobs = service.all_ended(&project).await;
    assert_eq!(jobs.last().unwrap()["kind"], "removal");
    drop(service);
    assert_eq!(check(dir.path(), &[]).0, 0);
}

#[tokio::test]
async fn everything_but_the_uploads_may_rot_and_is_made_again() {
    let dir = tempfile::tempdir().unwrap();
    let (mut service, project, uploads) = filled(dir.path()).await;
    let poses = service.json(&format!("{project}/poses")).await;
    let cloud = reqwest::get(format!("{}{project}/cloud", service.url)).await.unwrap().bytes().await.unwrap();
    service.kill();
    let originals: Vec<_> =
        uploads.iter().map(|u| blob(dir.path(), u["scan"]["blake3"].as_str().unwrap())).collect();
    let mut spoiled = 0;
    for file in files(dir.path()) {
        if !originals.contains(&file) {
            spoil(&file);
            spoiled += 1;
        }
    }
    assert!(spoiled >= 5, "two prepared scans, a snapshot, two versions: {spoiled}");
    let (code, report) = check(dir.path(), &[]);
    assert_eq!(code, 2, "{report}");

    let service = Process::start(dir.path());
    let answer = reqwest::get(format!("{}{project}/poses", service.url)).await.unwrap();
    assert_eq!(answer.status(), StatusCode::INTERNAL_SERVER_ERROR, "the version cannot be read …");
    let jobs = service.all_ended(&project).await;
    assert_eq!(jobs.last().unwrap()["kind"], "rebuild", "… but is made again");
    assert_eq!(jobs.last().unwrap()["status"], "succeeded", "{jobs:?}");
    let again = service.json(&format!("{project}/poses")).await;
    assert_eq!(again["scans"], poses["scans"], "the same scans at the same seed");
    let made = reqwest::get(format!("{}{project}/cloud", service.url)).await.unwrap();
    assert_eq!(made.bytes().await.unwrap(), cloud);
}

#[tokio::test]
async fn a_rotten_upload_is_told_and_repaired_by_the_same_file_or_from_a_backup() {
    let dir = tempfile::tempdir().unwrap();
    let [data, copy] = ["data", "copy"].map(|name| dir.path().join(name));
    let (mut service, project, uploads) = filled(&data).await;
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    let made = cairn(&["backup", &text(&copy), "--copy", "--data", &text(&data)]);
    assert!(made.status.success(), "while the service runs: {made:?}");
    let scan = &uploads[0]["scan"];
    let file = blob(&data, scan["blake3"].as_str().unwrap());
    let original = format!("{}{project}/scans/{}/original", service.url, scan["id"].as_str().unwrap());

    spoil(&file);
    let answer = reqwest::get(&original).await.unwrap();
    assert_eq!(answer.status(), StatusCode::INTERNAL_SERVER_ERROR, "wrong bytes are never given");
    let told = async {
        while !reqwest::get(format!("{}/readyz", service.url))
            .await
            .unwrap()
            .text()
            .await
            .unwrap()
            .contains("1 stored")
        {
            tokio::time::sleep(std::time::Duration::from_millis(200)).await;
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(30), told).await.expect("operators are told");
    let again = service.upload(&project, room(0.0)).await.unwrap();
    assert_eq!(again.status(), StatusCode::OK, "the project has this scan");
    assert_eq!(reqwest::get(&original).await.unwrap().bytes().await.unwrap(), room(0.0));

    fs::remove_file(&file).unwrap();
    service.kill();
    assert_eq!(check(&data, &["--repair"]).0, 2, "it cannot be made of nothing");
    let (code, report) = check(&data, &["--repair", "--from", &text(&copy)]);
    assert_eq!((code, &report["files"][0]["repaired"]), (0, &"taken from the backup".into()), "{report}");
    assert_eq!(check(&data, &[]).0, 0);
}

#[tokio::test]
async fn a_backup_that_was_made_under_load_is_restored_and_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let [data, copy, restored] = ["data", "copy", "restored"].map(|name| dir.path().join(name));
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    let (service, project, _) = filled(&data).await;
    let later = service.accepted(&project, room(0.8)).await;
    let made = cairn(&["backup", &text(&copy), "--data", &text(&data)]);
    assert!(made.status.success(), "{made:?}");
    assert_eq!(service.ended(&later["job"]).await["status"], "succeeded");
    let made = cairn(&["restore", &text(&copy), "--data", &text(&restored)]);
    assert!(made.status.success(), "{made:?}");
    assert_eq!(check(&restored, &[]).0, 0);
    let service = Process::start(&restored);
    let jobs = service.all_ended(&project).await;
    assert_eq!(jobs.len(), 3, "the job that ran at that moment is done now");
    assert!(jobs.iter().all(|job| job["status"] == "succeeded"), "{jobs:?}");
}
