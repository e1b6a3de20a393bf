//! API keys as plain data: who may do what, where, until when and how much.

use std::collections::BTreeSet;

use super::{KeyId, Name, ProjectId, Timestamp};

/// What a key may do. Each includes the ones before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scope {
    /// Look at everything and download it.
    Read,
    /// Send scans.
    Upload,
    /// Ask for jobs, decide, delete, and register webhooks.
    Manage,
}

impl Scope {
    /// Every scope, the smallest first.
    pub const ALL: [Self; 3] = [Self::Read, Self::Upload, Self::Manage];

    /// The word that is stored and shown.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Upload => "upload",
            Self::Manage => "manage",
        }
    }

    /// The scope of this word.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scope| scope.as_str() == word)
    }
}

/// Where a key holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reach {
    /// In every project, those to come included, and for the service as a whole.
    Everything,
    /// In these projects only.
    Projects(BTreeSet<ProjectId>),
}

impl Reach {
    /// Whether it holds in a project.
    #[must_use]
    pub fn covers(&self, project: ProjectId) -> bool {
        match self {
            Self::Everything => true,
            Self::Projects(projects) => projects.contains(&project),
        }
    }
}

/// How much there may be at once. `None` is no limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Limits {
    /// Bytes of uploads that were not deleted.
    pub bytes: Option<u64>,
    /// Scans that were not deleted.
    pub scans: Option<u64>,
    /// Jobs that have not ended.
    pub queued_jobs: Option<u64>,
    /// Uploads in several requests that are neither complete nor expired.
    pub open_uploads: Option<u64>,
}

/// A key, without its secret.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key {
    /// Its id, which is no secret.
    pub id: KeyId,
    /// What the operator calls it, such as the rig that has it.
    pub name: Name,
    /// What it may do.
    pub scope: Scope,
    /// Where.
    pub reach: Reach,
    /// How much.
    pub limits: Limits,
    /// When it was made.
    pub created: Timestamp,
    /// From when on it opens nothing.
    pub expires: Option<Timestamp>,
    /// When it was revoked.
    pub revoked: Option<Timestamp>,
}

impl Key {
    /// Whether it opens anything at a moment.
    #[must_use]
    pub fn is_valid(&self, now: Timestamp) -> bool {
        self.revoked.is_none() && self.expires.is_none_or(|end| now < end)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scopes_include_the_smaller_ones_and_survive_their_words() {
        assert!(Scope::Read < Scope::Upload && Scope::Upload < Scope::Manage);
        for scope in Scope::ALL {
            assert_eq!(Scope::from_word(scope.as_str()), Some(scope));
        }
        assert_eq!(Scope::from_word("admin"), None);
    }

    #[test]
    fn a_key_opens_nothing_from_its_end_on_or_once_it_is_revoked() {
        let key = Key {
            id: KeyId::generate(),
            name: Name::parse("rig").unwrap(),
            scope: Scope::Upload,
            reach: Reach::Projects(BTreeSet::new()),
            limits: Limits::default(),
            created: Timestamp(0),
            expires: Some(Timestamp(10)),
            revoked: None,
        };
        assert!(key.is_valid(Timestamp(9)) && !key.is_valid(Timestamp(10)));
        assert!(!Key { revoked: Some(Timestamp(1)), ..key }.is_valid(Timestamp(2)));
    }
}
