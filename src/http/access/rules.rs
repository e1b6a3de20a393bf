//! What each route asks of a key. Whatever is not named here reads by GET and HEAD, manages by every other method, and
//! concerns the whole service unless its address has a project, a job or an upload.

use axum::http::Method;

use crate::project::Scope;

/// What a request to a route needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Rule {
    /// No key at all.
    Open,
    /// A key with this scope that reaches what the route is about.
    Key(Scope, Subject),
}

/// What a route is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Subject {
    /// The project `{project}` of the address.
    Project,
    /// The project of the job `{job}` of the address.
    Job,
    /// The project of the upload `{upload}` of the address.
    Upload,
    /// Any project: the handler shows only what the caller reaches, or asks [`super::Caller::admit`] itself.
    Own,
    /// The service as a whole: only a key for every project will do.
    Service,
}

impl Rule {
    /// The rule of a method at an address, given as its template; `None` is an address that has no route.
    pub(super) fn of(method: &Method, template: Option<&str>) -> Self {
        let looks = matches!(*method, Method::GET | Method::HEAD);
        let Some(template) = template else { return Self::Key(Scope::Read, Subject::Own) };
        match template {
            "/healthz" | "/readyz" | "/openapi.yaml" | "/" | "/web/{name}" if looks => return Self::Open,
            // Says what the protocol of uploads is like, before a client shows anything.
            "/v1/uploads" | "/v1/uploads/{upload}" if *method == Method::OPTIONS => return Self::Open,
            "/v1/uploads" => return Self::Key(Scope::Upload, Subject::Own),
            // HEAD asks whoever writes to the upload to leave.
            "/v1/uploads/{upload}" if *method != Method::GET => {
                return Self::Key(Scope::Upload, Subject::Upload);
            }
            // Addresses of webhooks may hold secrets of their receivers.
            _ if template.starts_with("/v1/projects/{project}/webhooks") => {
                return Self::Key(Scope::Manage, Subject::Project);
            }
            "/v1/projects" if looks => return Self::Key(Scope::Read, Subject::Own),
            "/v1/projects/{project}/scans" if *method == Method::POST => {
                return Self::Key(Scope::Upload, Subject::Project);
            }
            _ => {}
        }
        let subject = if template.contains("{project}") {
            Subject::Project
        } else if template.contains("{job}") {
            Subject::Job
        } else if template.contains("{upload}") {
            Subject::Upload
        } else {
            Subject::Service
        };
        Self::Key(if looks { Scope::Read } else { Scope::Manage }, subject)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_route_that_nobody_thought_of_is_for_keys_that_manage_everything() {
        let rule = |method, template| Rule::of(&method, Some(template));
        assert_eq!(rule(Method::PUT, "/v1/new/{thing}"), Rule::Key(Scope::Manage, Subject::Service));
        assert_eq!(rule(Method::GET, "/v1/new/{thing}"), Rule::Key(Scope::Read, Subject::Service));
        let inside = rule(Method::POST, "/v1/projects/{project}/new");
        assert_eq!(inside, Rule::Key(Scope::Manage, Subject::Project));
        assert_eq!(rule(Method::POST, "/healthz"), Rule::Key(Scope::Manage, Subject::Service));
        assert_eq!(Rule::of(&Method::DELETE, None), Rule::Key(Scope::Read, Subject::Own));
    }
}
