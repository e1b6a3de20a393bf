//! Who may do what: the routes are taken from the description, so that a new one cannot forget to ask for a key.

use std::collections::BTreeSet;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use cairn::config::Settings;
use cairn::project::{Key, KeyId, Limits, Name, ProjectId, Reach, Scope, Token};
use cairn::storage::{Keys, NewKey};
use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};
use ulid::Ulid;

use crate::server::{Server, problem, room};

/// Makes a key beside the running service, as `cairn key create` does.
pub async fn key(server: &Server, scope: Scope, reach: Reach, limits: Limits) -> (Key, String) {
    let keys = Keys::open(server.data()).await.unwrap();
    let token = Token::generate(KeyId::generate()).unwrap();
    let new = NewKey { name: Name::parse("test").unwrap(), scope, reach, limits, expires: None };
    let key = keys.create(&new, &token).await.unwrap();
    keys.close().await;
    (key, token.reveal())
}

/// A key without limits.
pub async fn unlimited(server: &Server, scope: Scope, reach: Reach) -> String {
    key(server, scope, reach, Limits::default()).await.1
}

/// The reach of the project with this path.
pub fn only(project: &str) -> Reach {
    Reach::Projects(BTreeSet::from([project.rsplit('/').next().unwrap().parse::<ProjectId>().unwrap()]))
}

/// One operation of the description.
struct Route {
    method: Method,
    template: String,
    /// The scope it needs; `None` if it is open to all.
    scope: Option<Scope>,
}

impl Route {
    /// Whether its address says which project it is about.
    fn in_project(&self) -> bool {
        ["{project}", "{job}", "{upload}"].iter().any(|id| self.template.contains(id))
    }
}

fn routes() -> Vec<Route> {
    let description = serde_json::to_value(cairn::http::description()).unwrap();
    let mut routes = Vec::new();
    for (template, item) in description["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap().iter().filter(|(_, o)| o.is_object()) {
            let scope = operation["x-cairn-scope"].as_str().map(|word| Scope::from_word(word).unwrap());
            assert_eq!(scope.is_none(), operation["security"] == json!([]), "{method} {template}");
            let method = method.to_uppercase().parse().unwrap();
            routes.push(Route { method, template: template.clone(), scope });
        }
    }
    routes
}

/// A project with a scan, a job and a part of an upload, to fill the templates with.
struct Place {
    project: String,
    job: String,
    scan: String,
    upload: String,
}

impl Place {
    async fn new(server: &Server) -> Self {
        let project = server.project().await;
        let answer = server.accepted(&project, "a.ply", room(0.0)).await;
        let id = |what: &str| answer[what]["id"].as_str().unwrap().to_owned();
        let project = project.rsplit('/').next().unwrap().to_owned();
        let upload =
            announce(server, &project, None).await.headers()["location"].to_str().unwrap().to_owned();
        let upload = upload.rsplit('/').next().unwrap().to_owned();
        Self { project, job: id("job"), scan: id("scan"), upload }
    }

    /// One of things that never were.
    fn nowhere() -> Self {
        let id = || Ulid::generate().to_string();
        Self { project: id(), job: id(), scan: id(), upload: id() }
    }

    fn fill(&self, template: &str) -> String {
        let mut path = template.to_owned();
        let ids = [
            ("{project}", &self.project),
            ("{job}", &self.job),
            ("{scan}", &self.scan),
            ("{upload}", &self.upload),
        ];
        for (name, id) in ids {
            path = path.replace(name, id);
        }
        path = path.replace("{version}", "1");
        while let (Some(from), Some(to)) = (path.find('{'), path.find('}')) {
            path.replace_range(from..=to, &self.scan);
        }
        path
    }
}

/// Bytes that [`announce`] announces.
pub const ANNOUNCED: u64 = 1000;

/// Metadata of an upload into a project.
pub fn announcement(project: &str) -> String {
    let encoded = |text: &str| STANDARD.encode(text);
    format!("project {},name {}", encoded(project), encoded("b.ply"))
}

/// Announces an upload into a project.
pub async fn announce(server: &Server, project: &str, token: Option<&str>) -> Response {
    let request = server
        .client
        .post(server.url("/v1/uploads"))
        .header("tus-resumable", "1.0.0")
        .header("upload-length", ANNOUNCED)
        .header("upload-metadata", announcement(project));
    let request =
        token.map_or_else(|| request.try_clone().unwrap(), |t| request.try_clone().unwrap().bearer_auth(t));
    request.send().await.unwrap()
}

async fn ask(server: &Server, method: &Method, path: &str, token: Option<&str>) -> Response {
    let request = server.client.request(method.clone(), server.url(path));
    let request = if *method == Method::POST { request.json(&json!({})) } else { request };
    token
        .map_or_else(|| request.try_clone().unwrap(), |token| request.try_clone().unwrap().bearer_auth(token))
        .send()
        .await
        .unwrap()
}

/// Asserts that a route answers with a problem. An answer to HEAD has no body.
async fn refused(route: &Route, answer: Response, status: u16, word: &str) {
    if route.method == Method::HEAD {
        assert_eq!(answer.status(), status, "{}", route.template);
    } else {
        problem(answer, status, word).await;
    }
}

/// A server with a key for everything, so that nobody comes in without one, and a place in it.
async fn guarded() -> (Server, Place, String) {
    // Every route is asked with many keys that open nothing.
    let settings = Settings { failures_per_minute: Some(0), ..Settings::default() };
    let server = Server::with(settings).await;
    let place = Place::new(&server).await;
    let all = unlimited(&server, Scope::Manage, Reach::Everything).await;
    (server, place, all)
}

/// Status and body, without what is different in every answer.
async fn told(response: Response, place: &Place) -> (StatusCode, String) {
    let status = response.status();
    let mut body = response.text().await.unwrap();
    for id in [&place.project, &place.job, &place.scan, &place.upload] {
        body = body.replace(id, "ID");
    }
    (status, body)
}

#[tokio::test(flavor = "multi_thread")]
async fn no_route_answers_without_a_key_or_with_one_that_opens_nothing() {
    let (server, place, _) = guarded().await;
    let (revoked, revoked_token) = key(&server, Scope::Manage, Reach::Everything, Limits::default()).await;
    let keys = Keys::open(server.data()).await.unwrap();
    keys.revoke(revoked.id).await.unwrap();
    let (live, _) = key(&server, Scope::Manage, Reach::Everything, Limits::default()).await;
    let guessed = Token::generate(live.id).unwrap().reveal();
    for route in routes() {
        let path = place.fill(&route.template);
        for token in [None, Some(revoked_token.as_str()), Some(&guessed), Some("cairn_x_y"), Some("")] {
            let answer = ask(&server, &route.method, &path, token).await;
            if route.scope.is_some() {
                assert_eq!(answer.headers()["www-authenticate"], "Bearer realm=\"cairn\"", "{path}");
                refused(&route, answer, 401, if token.is_none() { "no-key" } else { "bad-key" }).await;
            } else {
                assert!(answer.status().is_success(), "{path}");
            }
        }
    }
    for path in ["/v1", "/v1/nothing", "/V1/projects", "//v1/projects", "/web", "/metrics/x"] {
        assert_eq!(ask(&server, &Method::GET, path, None).await.status(), 401, "{path}");
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_without_the_right_gets_403_on_every_route_that_needs_it() {
    let (server, place, _) = guarded().await;
    for scope in [Scope::Read, Scope::Upload] {
        for reach in [Reach::Everything, only(&place.project)] {
            let token = unlimited(&server, scope, reach.clone()).await;
            for route in routes().iter().filter(|route| route.scope > Some(scope)) {
                let answer = ask(&server, &route.method, &place.fill(&route.template), Some(&token)).await;
                refused(route, answer, 403, "not-allowed").await;
            }
        }
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_for_another_project_sees_what_one_sees_of_a_project_that_never_was() {
    let (server, place, all) = guarded().await;
    let other = {
        let body = json!({ "name": "other" });
        let made = server
            .client
            .post(server.url("/v1/projects"))
            .json(&body)
            .bearer_auth(&all)
            .send()
            .await
            .unwrap();
        made.headers()["location"].to_str().unwrap().to_owned()
    };
    let nowhere = Place::nowhere();
    for scope in Scope::ALL {
        let token = unlimited(&server, scope, only(&other)).await;
        for route in routes().iter().filter(|route| route.scope.is_some()) {
            let (here, there) = (place.fill(&route.template), nowhere.fill(&route.template));
            let here = told(ask(&server, &route.method, &here, Some(&token)).await, &place).await;
            let there = told(ask(&server, &route.method, &there, Some(&token)).await, &nowhere).await;
            if route.in_project() {
                assert_eq!(here, there, "{} {}", route.method, route.template);
                assert_eq!(here.0, 404, "{} {}", route.method, route.template);
            } else if route.template == "/v1/uploads" && scope >= Scope::Upload {
                // What it is about is in its headers.
                let there = announce(&server, &nowhere.project, Some(&token)).await;
                let here = announce(&server, &place.project, Some(&token)).await;
                assert_eq!(here.status(), 404);
                assert_eq!(told(here, &place).await, told(there, &nowhere).await);
            } else if route.template != "/v1/projects" || route.method != Method::GET {
                assert_eq!(here.0, 403, "{} {}", route.method, route.template);
            }
        }
        let listed = ask(&server, &Method::GET, "/v1/projects", Some(&token)).await;
        let listed: Value = listed.json().await.unwrap();
        let names: Vec<_> = listed["items"].as_array().unwrap().iter().map(|p| p["name"].clone()).collect();
        assert_eq!(names, ["other"]);
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_do_what_they_are_for() {
    let (server, place, _) = guarded().await;
    let project = format!("/v1/projects/{}", place.project);
    let [read, upload, manage] = [Scope::Read, Scope::Upload, Scope::Manage];
    let reach = || only(&project);
    let (read, upload) = (unlimited(&server, read, reach()).await, unlimited(&server, upload, reach()).await);
    let manage = unlimited(&server, manage, reach()).await;
    for token in [&read, &upload, &manage] {
        for path in [project.clone(), format!("{project}/scans"), format!("/v1/jobs/{}", place.job)] {
            assert_eq!(ask(&server, &Method::GET, &path, Some(token)).await.status(), 200, "{path}");
        }
    }
    for (token, status) in [(&read, 403), (&upload, 202)] {
        let url = server.url(&format!("{project}/scans?name=b.ply"));
        let sent = server.client.post(url).body(room(0.2)).bearer_auth(token).send().await.unwrap();
        assert_eq!(sent.status(), status);
    }
    for (token, status) in [(&upload, 403), (&manage, 202)] {
        let url = server.url(&format!("{project}/jobs"));
        let body = json!({ "kind": "rebuild" });
        let sent = server.client.post(url).json(&body).bearer_auth(token).send().await.unwrap();
        assert_eq!(sent.status(), status);
    }
    assert_eq!(ask(&server, &Method::DELETE, &project, Some(&manage)).await.status(), 204);
    assert_eq!(ask(&server, &Method::GET, &project, Some(&manage)).await.status(), 404);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn without_keys_only_this_machine_is_served_and_only_until_there_is_one() {
    let server = Server::start().await;
    let listed = || async { server.get("/v1/projects").await.status() };
    assert_eq!(listed().await, 200);
    let from_a_page = server.client.get(server.url("/v1/projects")).header("origin", "https://evil.example");
    problem(from_a_page.send().await.unwrap(), 403, "not-allowed").await;
    let (made, _) = key(&server, Scope::Read, Reach::Everything, Limits::default()).await;
    assert_eq!(listed().await, 401);
    Keys::open(server.data()).await.unwrap().revoke(made.id).await.unwrap();
    assert_eq!(listed().await, 401, "revoking the last key must not open the service");
    server.stop().await;

    let open = Server::with(Settings { allow_anonymous: Some(true), ..Settings::default() }).await;
    unlimited(&open, Scope::Read, Reach::Everything).await;
    assert_eq!(open.get("/v1/projects").await.status(), 200);
    problem(ask(&open, &Method::GET, "/v1/projects", Some("cairn_x")).await, 401, "bad-key").await;
    open.stop().await;
}

#[tokio::test]
async fn an_address_that_strangers_reach_is_not_served_without_a_key_unless_the_operator_says_so() {
    let data = tempfile::tempdir().unwrap();
    let settings = |allow| {
        let listen = Some(([0, 0, 0, 0], 0).into());
        let data = Some(data.path().to_owned());
        Settings { listen, data, allow_anonymous: Some(allow), ..Settings::default() }.resolve().unwrap()
    };
    let refused = cairn::app::start(settings(false)).await.unwrap_err().to_string();
    assert!(refused.contains("cairn key create") && refused.contains("--allow-anonymous"), "{refused}");
    cairn::app::start(settings(true)).await.unwrap().stop().await;

    let keys = Keys::open(data.path()).await.unwrap();
    let name = Name::parse("test").unwrap();
    let new = NewKey {
        name,
        scope: Scope::Read,
        reach: Reach::Everything,
        limits: Limits::default(),
        expires: None,
    };
    let token = Token::generate(KeyId::generate()).unwrap();
    keys.create(&new, &token).await.unwrap();
    cairn::app::start(settings(false)).await.unwrap().stop().await;
    keys.revoke(token.key).await.unwrap();
    assert!(cairn::app::start(settings(false)).await.is_err());
    keys.close().await;
}
