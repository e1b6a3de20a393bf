//! `cairn key` as an operator uses it, and what `cairn serve` writes to its log meanwhile.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use reqwest::Client;
use serde_json::Value;

fn cairn(data: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
    command.env("CAIRN_DATA", data).env_remove("CAIRN_CONFIG");
    command
}

fn key(data: &Path, args: &[&str]) -> Output {
    cairn(data).arg("key").args(args).output().unwrap()
}

/// Runs `cairn key` and expects success.
fn told(data: &Path, args: &[&str]) -> String {
    let output = key(data, args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_key_is_printed_once_and_alone_and_listed_without_its_secret() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    let missing = key(&data, &["list"]);
    assert!(!missing.status.success() && !data.exists(), "a wrong path is noticed");
    for bad in
        [&["create", "a", "--scope", "read"][..], &["create", "a", "--scope", "root", "--all-projects"]]
    {
        assert_eq!(key(&data, bad).status.code(), Some(2), "{bad:?}");
    }
    let made = told(&data, &["create", "rig 3", "--scope", "upload", "--all-projects", "--max-scans", "9"]);
    let token = made.trim();
    assert!(token.starts_with("cairn_") && token.lines().count() == 1);
    let (name, secret) = token.rsplit_once('_').unwrap();
    let id = name.trim_start_matches("cairn_");
    let (text, json) = (told(&data, &["list"]), told(&data, &["list", "--json"]));
    assert!(text.contains(id) && text.contains("rig 3") && text.contains("at most 9 scans"), "{text}");
    assert!(!text.contains(secret) && !json.contains(secret));
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json[0]["state"], "valid");
    told(&data, &["revoke", id]);
    assert!(told(&data, &["list"]).contains("revoked"));
    for entry in std::fs::read_dir(&data).unwrap().filter_map(Result::ok).filter(|e| e.path().is_file()) {
        let bytes = std::fs::read(entry.path()).unwrap();
        assert!(!bytes.windows(secret.len()).any(|w| w == secret.as_bytes()), "{:?}", entry.path());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_secret_is_in_the_log_however_much_is_logged() {
    let dir = tempfile::tempdir().unwrap();
    let token = told(dir.path(), &["create", "rig", "--scope", "manage", "--all-projects"]).trim().to_owned();
    let mut serve = cairn(dir.path())
        .args(["serve", "--listen", "127.0.0.1:0", "--log-json", "--webhook-hosts", "hooks.example.com"])
        .env("RUST_LOG", "trace")
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(serve.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let mut stderr = serve.stderr.take().unwrap();
    let log = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        stderr.read_to_end(&mut bytes).map(|_| String::from_utf8_lossy(&bytes).into_owned())
    });
    let url = format!("{}/v1/projects", line.trim().trim_start_matches("listening on "));
    let client = Client::new();
    // Right, made up, and mistyped.
    let almost = format!("{}{}", &token[..token.len() - 8], "00000000");
    for (shown, status) in [(token.as_str(), 200), (&almost, 401), (&token[1..], 401)] {
        assert_eq!(client.get(&url).bearer_auth(shown).send().await.unwrap().status(), status);
    }
    let body = serde_json::json!({ "name": "p" });
    let made = client.post(&url).bearer_auth(&token).json(&body).send().await.unwrap();
    assert_eq!(made.status(), 201);
    let hooks = format!("{url}/{}/webhooks", made.json::<Value>().await.unwrap()["id"].as_str().unwrap());
    let body = serde_json::json!({ "url": "https://hooks.example.com/?receiver=private" });
    let hook = client.post(&hooks).bearer_auth(&token).json(&body).send().await.unwrap();
    assert_eq!(hook.status(), 201);
    let hook: Value = hook.json().await.unwrap();
    let signing = hook["secret"].as_str().unwrap().trim_start_matches("whsec_").to_owned();
    serve.kill().unwrap();
    serve.wait().unwrap();
    let log = log.join().unwrap().unwrap();
    assert!(log.contains("/v1/projects"), "the requests are logged");
    assert!(log.lines().all(|line| serde_json::from_str::<Value>(line).is_ok()), "every line is JSON");
    for part in [&token[token.len() - 64..token.len() - 32], &token[token.len() - 40..token.len() - 8]] {
        assert!(!log.contains(part), "a part of a key is in the log");
    }
    assert!(
        !log.contains(&signing) && !log.contains("receiver=private"),
        "what webhooks keep secret is in the log"
    );
}
