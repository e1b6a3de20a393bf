//! TLS, given a certificate and its key.

use std::sync::Arc;

use cairn::config::Settings;
use rcgen::{CertifiedKey, generate_simple_self_signed};
use rustls::pki_types::ServerName;
use rustls::{ClientConfig, RootCertStore};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;

use crate::server::Server;

#[tokio::test(flavor = "multi_thread")]
async fn with_a_certificate_only_encrypted_connections_are_served() {
    let CertifiedKey { cert, signing_key } = generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let (cert_file, key_file) = (dir.path().join("cert.pem"), dir.path().join("key.pem"));
    std::fs::write(&cert_file, cert.pem()).unwrap();
    std::fs::write(&key_file, signing_key.serialize_pem()).unwrap();
    let settings =
        Settings { tls_cert: Some(cert_file.clone()), tls_key: Some(key_file), ..Settings::default() };
    let server = Server::with(settings).await;
    let address = server.url("").strip_prefix("https://").unwrap().to_owned();

    let mut roots = RootCertStore::empty();
    roots.add(cert.der().clone()).unwrap();
    let config = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let stream = TcpStream::connect(&address).await.unwrap();
    let name = ServerName::try_from("localhost").unwrap();
    let mut stream = TlsConnector::from(Arc::new(config)).connect(name, stream).await.unwrap();
    stream.write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("ok\n"), "{answer}");

    let plain = server.client.get(format!("http://{address}/healthz")).send().await;
    assert!(plain.is_err(), "what is not encrypted is not answered");
    server.stop().await;

    let data = tempfile::tempdir().unwrap();
    let swapped = Settings {
        data: Some(data.path().to_owned()),
        tls_cert: Some(cert_file.clone()),
        tls_key: Some(cert_file),
        ..Settings::default()
    };
    let error = cairn::app::start(swapped.resolve().unwrap()).await.unwrap_err().to_string();
    assert!(error.contains("cert.pem"), "{error}");
}
