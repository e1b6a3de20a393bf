//! Data of the first schema: a database as the program wrote it that knew `0001_first_schema.sql` only, with a model of two scans, is brought up
//! to date, read, and gone on with.

use std::fs;
use std::path::Path;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, SqliteConnection};

use crate::process::{Process, check, room};

/// The kept data directory: `cairn.sql` is a dump of the database.
const KEPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/durability/first_schema");

async fn kept(data: &Path) {
    copy(&Path::new(KEPT).join("blobs"), &data.join("blobs"));
    let dump = fs::read_to_string(Path::new(KEPT).join("cairn.sql")).unwrap();
    let options = SqliteConnectOptions::new().filename(data.join("cairn.sqlite")).create_if_missing(true);
    let mut database = SqliteConnection::connect_with(&options.foreign_keys(false)).await.unwrap();
    sqlx::raw_sql(sqlx::AssertSqlSafe(dump)).execute(&mut database).await.unwrap();
    database.close().await.unwrap();
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let (path, place) = (entry.as_ref().unwrap().path(), to.join(entry.unwrap().file_name()));
        if path.is_dir() {
            copy(&path, &place);
        } else {
            fs::copy(&path, &place).unwrap();
        }
    }
}

#[tokio::test]
async fn data_of_the_first_schema_is_read_and_gone_on_with() {
    let dir = tempfile::tempdir().unwrap();
    kept(dir.path()).await;
    let service = Process::start(dir.path());
    let projects = service.json("/v1/projects").await;
    let project = format!("/v1/projects/{}", projects["items"][0]["id"].as_str().unwrap());
    let poses = service.json(&format!("{project}/poses")).await;
    assert_eq!(poses["version"], 2);
    let names: Vec<&String> = poses["scans"].as_object().unwrap().keys().collect();
    assert_eq!(names, ["first.ply", "second.ply"]);
    let first = service.json(&format!("{project}/versions/1")).await;
    assert_eq!(first["version"], 1);
    let scans = service.json(&format!("{project}/scans")).await;
    for scan in scans["items"].as_array().unwrap() {
        let at = format!("{}{project}/scans/{}/original", service.url, scan["id"].as_str().unwrap());
        let original = reqwest::get(at).await.unwrap().bytes().await.unwrap();
        assert_eq!(blake3::hash(&original).to_hex().as_str(), scan["blake3"]);
    }
    let jobs = service.all_ended(&project).await;
    assert!(jobs.iter().all(|job| job["status"] == "succeeded"), "{jobs:?}");
    let third = service.accepted(&project, room(0.8)).await;
    assert_eq!(service.ended(&third["job"]).await["status"], "succeeded");
    drop(service);
    assert_eq!(check(dir.path(), &[]).0, 0);
}

#[tokio::test]
async fn data_of_a_newer_program_is_refused_and_left_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    kept(dir.path()).await;
    let options = SqliteConnectOptions::new().filename(dir.path().join("cairn.sqlite"));
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::raw_sql(
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
           VALUES (9999, 'of the future', 1, x'00', 0)",
    )
    .execute(&mut database)
    .await
    .unwrap();
    database.close().await.unwrap();
    let output =
        crate::process::cairn(&["serve", "--listen", "127.0.0.1:0", "--data", dir.path().to_str().unwrap()]);
    assert!(!output.status.success());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(said.contains("9999"), "{said}");
}
