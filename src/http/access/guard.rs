//! The layer itself: from a request to its caller, or to a refusal.

use axum::extract::{FromRequestParts, MatchedPath, RawPathParams, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::rules::{Rule, Subject};
use super::{Caller, Source};
use crate::http::extract::no_id;
use crate::http::{Api, Problem};
use crate::project::{JobId, ProjectId, Token, UploadId};
use crate::storage::StorageError;

/// Lets a request through to its handler, with its [`Caller`], or refuses it.
pub(in crate::http) async fn guard(State(api): State<Api>, request: Request, next: Next) -> Response {
    let (mut parts, body) = request.into_parts();
    match caller(&api, &mut parts).await {
        Ok(caller) => {
            if let Some(caller) = caller {
                parts.extensions.insert(caller);
            }
            next.run(Request::from_parts(parts, body)).await
        }
        Err(problem) => refused(&api, &parts, problem).into_response(),
    }
}

/// The refusal of a request; of those with keys that open nothing too many from one address are another one.
fn refused(api: &Api, parts: &Parts, problem: Problem) -> Problem {
    let failed =
        problem.status == StatusCode::UNAUTHORIZED && parts.headers.contains_key(header::AUTHORIZATION);
    match parts.extensions.get::<Source>().filter(|_| failed) {
        Some(source) => api.access.rates.count_failure(*source).err().unwrap_or(problem),
        None => problem,
    }
}

/// Who sent the request, if it may go on; `None` where nobody asks.
async fn caller(api: &Api, parts: &mut Parts) -> Result<Option<Caller>, Problem> {
    let template = parts.extensions.get::<MatchedPath>().map(MatchedPath::as_str);
    let Rule::Key(scope, subject) = Rule::of(&parts.method, template) else { return Ok(None) };
    let caller = identify(api, parts).await?;
    match subject {
        Subject::Own => caller.has(scope)?,
        Subject::Service => caller.admit_everywhere(scope)?,
        Subject::Project => match id::<ProjectId>(parts, "project").await {
            Some(project) => caller.admit(scope, project)?,
            None => caller.has(scope)?,
        },
        // Whoever reaches every project needs no look at which it is.
        Subject::Job | Subject::Upload if caller.granted().is_none() => caller.has(scope)?,
        Subject::Job => {
            let Some(job) = id::<JobId>(parts, "job").await else { return Err(no_id()) };
            let project = api.store.job(job).await?.project;
            caller.admit_to(scope, project, StorageError::NoJob(job))?;
        }
        Subject::Upload => {
            let Some(upload) = id::<UploadId>(parts, "upload").await else { return Err(no_id()) };
            let project = api.store.upload(upload).await?.announced.project;
            caller.admit_to(scope, project, StorageError::NoUpload(upload))?;
        }
    }
    Ok(Some(caller))
}

/// The holder of the key that the request shows, or anyone where none is needed.
async fn identify(api: &Api, parts: &Parts) -> Result<Caller, Problem> {
    let keys = api.store.keys();
    let Some(shown) = shown(&parts.headers)? else {
        if !api.access.openness.admits(&keys).await? {
            return Err(Problem::new(
                StatusCode::UNAUTHORIZED,
                "no-key",
                "this needs a key, sent as `Authorization: Bearer cairn_…`",
            ));
        }
        api.access.openness.check_browser(parts, &api.access.origins)?;
        return Ok(Caller::Anyone);
    };
    let key = keys.opened_by(&shown).await?.ok_or_else(bad_key)?;
    Ok(Caller::Holder(Box::new(key)))
}

/// The token of a request; `None` if it shows none.
fn shown(headers: &HeaderMap) -> Result<Option<Token>, Problem> {
    let mut all = headers.get_all(header::AUTHORIZATION).iter();
    let Some(value) = all.next() else { return Ok(None) };
    let text = value.to_str().ok().filter(|_| all.next().is_none()).ok_or_else(bad_key)?;
    let (scheme, token) = text.split_once(' ').ok_or_else(bad_key)?;
    if !scheme.eq_ignore_ascii_case("bearer") {
        return Err(bad_key());
    }
    token.trim().parse().map(Some).map_err(|_| bad_key())
}

/// One answer for all that is wrong with a key: which it is concerns only who made it.
fn bad_key() -> Problem {
    Problem::new(StatusCode::UNAUTHORIZED, "bad-key", "the key is unknown, malformed, expired or revoked")
}

/// An id of the path. Text that is none names nothing: the handler will say so.
async fn id<T: std::str::FromStr>(parts: &mut Parts, name: &str) -> Option<T> {
    let params = RawPathParams::from_request_parts(parts, &()).await.ok()?;
    params.iter().find(|(found, _)| *found == name)?.1.parse().ok()
}
