//! TLS, given a certificate and its key.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use cairn::config::Settings;
use rcgen::{CertifiedKey, generate_simple_self_signed};
use rustix::process::{Signal, getpid, kill_process};
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use crate::server::Server;

/// Writes a new certificate for `localhost` and its key to `cert.pem` and `key.pem`, and returns it.
fn issue(folder: &Path) -> CertificateDer<'static> {
    let CertifiedKey { cert, signing_key } = generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    std::fs::write(folder.join("key.pem"), signing_key.serialize_pem()).unwrap();
    std::fs::write(folder.join("cert.pem"), cert.pem()).unwrap();
    cert.der().clone()
}

fn settings(folder: &TempDir) -> Settings {
    let file = |name| Some(folder.path().join(name));
    Settings { tls_cert: file("cert.pem"), tls_key: file("key.pem"), ..Settings::default() }
}

/// Asks for `/healthz` over a connection that only this certificate makes trusted.
async fn ask(server: &Server, trusted: &CertificateDer<'static>) -> std::io::Result<String> {
    let mut roots = RootCertStore::empty();
    roots.add(trusted.clone()).unwrap();
    let config = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let stream = TcpStream::connect(server.url("").strip_prefix("https://").unwrap()).await?;
    let name = ServerName::try_from("localhost").unwrap();
    let mut stream = TlsConnector::from(Arc::new(config)).connect(name, stream).await?;
    stream.write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await?;
    Ok(answer)
}

#[tokio::test(flavor = "multi_thread")]
async fn with_a_certificate_only_encrypted_connections_are_served() {
    let dir = tempfile::tempdir().unwrap();
    let certificate = issue(dir.path());
    let server = Server::with(settings(&dir)).await;
    let answer = ask(&server, &certificate).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("ok\n"), "{answer}");

    let plain = server.url("/healthz").replace("https://", "http://");
    assert!(server.client.get(plain).send().await.is_err(), "what is not encrypted is not answered");
    server.stop().await;

    let data = tempfile::tempdir().unwrap();
    let cert_file = dir.path().join("cert.pem");
    let swapped = Settings {
        data: Some(data.path().to_owned()),
        tls_cert: Some(cert_file.clone()),
        tls_key: Some(cert_file),
        ..Settings::default()
    };
    let error = cairn::app::start(swapped.resolve().unwrap()).await.unwrap_err().to_string();
    assert!(error.contains("cert.pem"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_renewed_certificate_is_shown_after_sighup() {
    let dir = tempfile::tempdir().unwrap();
    let first = issue(dir.path());
    let server = Server::with(settings(&dir)).await;
    ask(&server, &first).await.unwrap();

    let second = issue(dir.path());
    kill_process(getpid(), Signal::HUP).unwrap();
    let mut tries = 0;
    while ask(&server, &second).await.is_err() {
        tries += 1;
        assert!(tries < 200, "the new certificate is not shown");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert!(ask(&server, &first).await.is_err());
    server.stop().await;
}
