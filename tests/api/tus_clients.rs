//! Resumable uploads by the clients that rigs really use: tuspy and tus-js-client. Each test says that it is skipped where
//! its client is not installed: `CAIRN_TEST_PYTHON` names a Python that has tuspy (`python3` otherwise), and `NODE_PATH`
//! the folder of modules that holds tus-js-client.

use std::process::Stdio;

use serde_json::Value;
use tokio::process::Command;

use crate::server::{Server, room};

/// Sends half in small pieces, forgets everything but the address, and goes on with checksums.
const PYTHON: &str = r#"
import sys
from tusclient import client
endpoint, project, path, size = sys.argv[1:5]
tus = client.TusClient(endpoint)
metadata = {"project": project, "filename": "rig.ply", "units": "m"}
first = tus.uploader(path, chunk_size=50_000, metadata=metadata)
first.upload(stop_at=int(size) // 2)
second = tus.uploader(path, chunk_size=70_000, url=first.url, upload_checksum=True)
assert 0 < second.offset < int(size), second.offset
second.upload()
print(second.url)
"#;

/// Sends, breaks off after the first piece, and resumes from what it stored.
const NODE: &str = r#"
const tus = require("tus-js-client"), fs = require("fs");
const [endpoint, project, path] = process.argv.slice(1);
const size = fs.statSync(path).size;
const metadata = { project, filename: "rig.ply", filetype: "model/ply" };
const options = { endpoint, metadata, chunkSize: 60000, uploadSize: size, retryDelays: [0, 100] };
const fail = (error) => { console.error(String(error)); process.exit(1); };
const first = new tus.Upload(fs.createReadStream(path), { ...options, onError: fail,
  onChunkComplete: () => first.abort().then(() => {
    const second = new tus.Upload(fs.createReadStream(path), { ...options, uploadUrl: first.url, onError: fail,
      onSuccess: () => console.log(second.url) });
    second.start();
  }) });
first.start();
"#;

async fn works(program: &str, arguments: &[&str]) -> bool {
    let run = Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status();
    run.await.is_ok_and(|status| status.success())
}

/// Lets a client upload a room and checks that the scan is what was sent.
async fn uploads(program: &str, flag: &str, script: &str) {
    let server = Server::start().await;
    let project = server.project().await;
    let dir = tempfile::tempdir().unwrap();
    let (path, bytes) = (dir.path().join("rig.ply"), room(0.0));
    std::fs::write(&path, &bytes).unwrap();
    let run = Command::new(program)
        .args([flag, script, &server.url("/v1/uploads"), project.rsplit('/').next().unwrap()])
        .arg(&path)
        .arg(bytes.len().to_string())
        .output()
        .await
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let address = String::from_utf8(run.stdout).unwrap();
    let upload: Value = server.client.get(address.trim()).send().await.unwrap().json().await.unwrap();
    assert_eq!(upload["scan"]["blake3"], blake3::hash(&bytes).to_hex().as_str(), "{upload}");
    assert_eq!((&upload["scan"]["name"], &upload["duplicate"]), (&"rig.ply".into(), &false.into()));
    assert_eq!(server.ended(&upload["job"]).await["status"], "succeeded");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn tuspy_uploads_resumes_and_sends_checksums() {
    let python = std::env::var("CAIRN_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if works(&python, &["-c", "import tusclient"]).await {
        uploads(&python, "-c", PYTHON).await;
    } else {
        eprintln!("skipped: {python} has no tuspy; set CAIRN_TEST_PYTHON");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn tus_js_client_uploads_and_resumes() {
    if works("node", &["-e", "require('tus-js-client')"]).await {
        uploads("node", "-e", NODE).await;
    } else {
        eprintln!("skipped: node has no tus-js-client; set NODE_PATH");
    }
}
