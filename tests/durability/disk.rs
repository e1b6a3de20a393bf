//! Disks that fill up and fail: what was acknowledged is there, what was not is refused with 507 or 503, and the service works again
//! when the disk does.

use std::collections::BTreeMap;

use reqwest::StatusCode;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, SqliteConnection};

use crate::process::{Faults, Process, check, room, speck, until};
use crate::tus::Upload;

#[tokio::test]
async fn a_full_disk_refuses_uploads_and_works_again_when_there_is_space() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &["--poll-seconds", "1"], Some(&faults));
    let project = service.project().await;
    // More than can be done before the disk is full: claimed or waiting, there is work that workers come back to.
    let mut uploads = Vec::new();
    for shift in 0..3 {
        uploads.push(service.accepted(&project, room(0.2 * f64::from(shift))).await);
    }
    faults.set("write enospc 0 /data/");
    for seed in 0..3 {
        let refused = service.upload(&project, speck(seed)).await.unwrap();
        assert_eq!(refused.status(), StatusCode::INSUFFICIENT_STORAGE);
        assert!(refused.headers().contains_key("retry-after"));
    }
    let scans = service.json(&format!("{project}/scans")).await;
    assert_eq!(scans["items"].as_array().unwrap().len(), 3, "readers are served, and nothing half is there");
    // More often than all attempts of a job that is to blame itself.
    let before = faults.struck();
    until("workers try again and again", || faults.struck() >= before + 40).await;
    assert!(!service.has_died());
    faults.set("");
    uploads.push(service.accepted(&project, room(0.6)).await);
    for upload in uploads {
        assert_eq!(service.ended(&upload["job"]).await["status"], "succeeded");
    }
    service.kill();
    assert_eq!(check(&data, &[]).0, 0);
}

#[test]
fn a_data_directory_whose_name_cannot_be_synced_is_not_begun() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("above/data"), Faults::new(dir.path()));
    faults.set("sync eio 0 /above");
    let output = Process::refused(&data, &faults);
    assert!(output.contains("syncing the name of a directory"), "{output}");
    assert!(!dir.path().join("above").exists(), "the next start makes it, and syncs it");
}

#[tokio::test]
async fn whichever_write_sync_or_rename_fails_what_was_acknowledged_is_there() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &[], Some(&faults));
    let project = service.project().await;
    let (mut acknowledged, mut refused, mut seed) = (Vec::new(), BTreeMap::<u16, usize>::new(), 0);
    let kinds =
        [("write enospc", 14), ("write eio", 14), ("write short", 4), ("sync eio", 10), ("rename eio", 1)];
    for (kind, calls) in kinds {
        for n in 0..calls {
            seed += 1;
            faults.set(&format!("{kind} {n} /data/"));
            let answer = service.upload(&project, speck(seed)).await.unwrap();
            match answer.status() {
                StatusCode::ACCEPTED => {
                    let body: serde_json::Value = answer.json().await.unwrap();
                    acknowledged.push((body["scan"]["id"].as_str().unwrap().to_owned(), seed));
                }
                status => *refused.entry(status.as_u16()).or_default() += 1,
            }
            faults.set("");
        }
    }
    assert!(refused.keys().all(|status| [503, 507].contains(status)), "{refused:?}");
    assert!(
        refused.values().sum::<usize>() > 10 && acknowledged.len() > 5,
        "{refused:?} {}",
        acknowledged.len()
    );
    service.kill();
    let mut service = Process::start(&data);
    for (id, seed) in &acknowledged {
        let original = reqwest::get(format!("{}{project}/scans/{id}/original", service.url)).await.unwrap();
        assert_eq!(original.bytes().await.unwrap(), speck(*seed), "scan {id}");
    }
    for job in service.all_ended(&project).await {
        assert_ne!(job["problem"]["type"], "urn:cairn:problem:storage", "{job}");
    }
    service.kill();
    assert_eq!(check(&data, &[]), (0, check(&data, &[]).1));
}

#[tokio::test]
async fn a_resumable_upload_on_a_full_disk_keeps_what_is_safe_and_goes_on_when_there_is_space() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &[], Some(&faults));
    let project = service.project().await;
    let bytes = room(0.0);
    let (mut upload, third) = (Upload::new("a.ply", bytes.clone()), bytes.len() / 3 + 1);
    let mut go_on = async || upload.go_on(&service.url, &project, third).await.unwrap();
    assert_eq!(go_on().await, StatusCode::CREATED);
    assert_eq!(go_on().await, StatusCode::NO_CONTENT);
    // The bytes themselves, then the note that they are there.
    for full in ["write enospc 0 /data/uploads/", "write enospc 0 /data/cairn"] {
        faults.set(full);
        assert_eq!(go_on().await, StatusCode::INSUFFICIENT_STORAGE, "{full}");
    }
    faults.set("");
    assert_eq!(go_on().await, StatusCode::NO_CONTENT);
    assert_eq!(go_on().await, StatusCode::NO_CONTENT);
    let scan = upload.scan.unwrap();
    let original = reqwest::get(format!("{}{project}/scans/{scan}/original", service.url)).await.unwrap();
    assert_eq!(original.bytes().await.unwrap(), bytes);
    service.kill();
    assert_eq!(check(&data, &[]).0, 0);
}

#[tokio::test]
async fn whichever_write_sync_or_rename_fails_a_resumable_upload_loses_nothing_safe_and_ends_once() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &[], Some(&faults));
    let project = service.project().await;
    let (mut ended, mut refused) = (Vec::new(), BTreeMap::<u16, usize>::new());
    let kinds =
        [("write enospc", 14), ("write eio", 14), ("write short", 4), ("sync eio", 12), ("rename eio", 1)];
    for (kind, calls) in kinds {
        for n in 0..calls {
            let bytes = speck(1000 + ended.len());
            let mut upload = Upload::new("speck.ply", bytes.clone());
            faults.set(&format!("{kind} {n} /data/"));
            while upload.scan.is_none() {
                let status = upload.go_on(&service.url, &project, bytes.len() / 3 + 1).await.unwrap();
                if !status.is_success() {
                    *refused.entry(status.as_u16()).or_default() += 1;
                    faults.set("");
                    assert!(upload.look(&service.url).await.unwrap().is_success());
                }
            }
            faults.set("");
            ended.push((upload.scan.unwrap(), bytes));
        }
    }
    assert!(refused.keys().all(|status| [503, 507].contains(status)), "{refused:?}");
    assert!(refused.values().sum::<usize>() > 20, "{refused:?}");
    service.kill();
    let mut service = Process::start(&data);
    for (scan, bytes) in &ended {
        let original = reqwest::get(format!("{}{project}/scans/{scan}/original", service.url)).await.unwrap();
        assert_eq!(original.bytes().await.unwrap(), bytes, "scan {scan}");
    }
    let list = service.json(&format!("{project}/scans?limit=200")).await;
    assert_eq!(list["items"].as_array().unwrap().len(), ended.len(), "each is there once");
    service.all_ended(&project).await;
    service.kill();
    assert_eq!(check(&data, &[]).0, 0);
}

#[tokio::test]
async fn a_database_that_another_process_holds_is_told_as_busy_and_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    let service = Process::start(&data);
    let project = service.project().await;
    let options = SqliteConnectOptions::new().filename(data.join("cairn.sqlite"));
    let mut other = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::raw_sql("BEGIN IMMEDIATE").execute(&mut other).await.unwrap();
    let refused = service.upload(&project, speck(1)).await.unwrap();
    assert_eq!(refused.status(), StatusCode::SERVICE_UNAVAILABLE);
    service.json(&project).await;
    sqlx::raw_sql("ROLLBACK").execute(&mut other).await.unwrap();
    service.accepted(&project, speck(1)).await;
}
