//! The description of the interface, and the little that is not under `/v1`.

use crate::server::Server;

#[test]
fn the_file_in_the_repository_is_what_the_code_describes() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml");
    let kept = std::fs::read_to_string(path).unwrap_or_default();
    let described = cairn::http::openapi_yaml().unwrap();
    assert!(kept == described, "openapi.yaml is out of date: run `cargo run -- openapi > openapi.yaml`");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_service_says_that_it_lives_and_shows_its_page() {
    let server = Server::start().await;
    for path in ["/healthz", "/readyz"] {
        assert_eq!(server.get(path).await.status(), 200, "{path}");
    }
    let yaml = server.get("/openapi.yaml").await.text().await.unwrap();
    assert_eq!(yaml, cairn::http::openapi_yaml().unwrap());
    let page = server.get("/").await;
    assert!(page.headers()["content-security-policy"].to_str().unwrap().starts_with("default-src 'none'"));
    assert!(page.headers().contains_key("x-request-id"));
    let page = page.text().await.unwrap();
    for (_, rest) in page.match_indices("\"/web/").map(|(at, m)| page.split_at(at + m.len())) {
        let name = rest.split('"').next().unwrap();
        assert_eq!(server.get(&format!("/web/{name}")).await.status(), 200, "{name}");
    }
    server.stop().await;
}
