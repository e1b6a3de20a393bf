//! Who sent a request, and what that lets them do.

use axum::extract::FromRequestParts;
use axum::http::StatusCode;
use axum::http::request::Parts;

use crate::http::Problem;
use crate::project::{Key, KeyId, ProjectId, Reach, Scope};
use crate::storage::StorageError;

/// Who sent the request. Handlers take it as an argument where the address alone does not say what is asked for.
#[derive(Debug, Clone)]
pub(in crate::http) enum Caller {
    /// Somebody without a key, where that is allowed: may do everything.
    Anyone,
    /// The holder of a key.
    Holder(Box<Key>),
}

impl Caller {
    /// Refuses unless the caller may do this in this project. A project that the key does not reach is answered as one
    /// that does not exist.
    pub fn admit(&self, scope: Scope, project: ProjectId) -> Result<(), Problem> {
        self.admit_to(scope, project, StorageError::NoProject(project))
    }

    /// As [`Caller::admit`], for something in a project: `absent` is what is answered if it does not exist.
    pub(super) fn admit_to(
        &self,
        scope: Scope,
        project: ProjectId,
        absent: StorageError,
    ) -> Result<(), Problem> {
        match self {
            Self::Holder(key) if !key.reach.covers(project) => Err(absent.into()),
            _ => self.has(scope),
        }
    }

    /// Refuses unless the caller may do this to the service as a whole.
    pub(super) fn admit_everywhere(&self, scope: Scope) -> Result<(), Problem> {
        self.has(scope)?;
        if self.granted().is_some() {
            let detail =
                "this key holds in some projects only, and this needs one that holds in every project";
            return Err(Problem::new(StatusCode::FORBIDDEN, "not-allowed", detail));
        }
        Ok(())
    }

    /// Refuses unless the caller may do this where its key holds.
    pub(super) fn has(&self, scope: Scope) -> Result<(), Problem> {
        match self {
            Self::Holder(key) if key.scope < scope => {
                let (has, needs) = (key.scope.as_str(), scope.as_str());
                let detail = format!("this needs a key with scope `{needs}`, and this key has scope `{has}`");
                Err(Problem::new(StatusCode::FORBIDDEN, "not-allowed", detail))
            }
            _ => Ok(()),
        }
    }

    /// The key on whose account the request is.
    pub fn key(&self) -> Option<KeyId> {
        match self {
            Self::Anyone => None,
            Self::Holder(key) => Some(key.id),
        }
    }

    /// The key, if the caller reaches only the projects that were granted to it one by one.
    pub fn granted(&self) -> Option<KeyId> {
        match self {
            Self::Holder(key) if key.reach != Reach::Everything => Some(key.id),
            _ => None,
        }
    }
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let caller = parts.extensions.get::<Self>().cloned();
        caller.ok_or_else(|| Problem::internal("a handler asks who calls on a route that is open to all"))
    }
}
