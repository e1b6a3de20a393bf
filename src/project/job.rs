//! A job: work that was accepted, and what became of it.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{JobId, ProjectId, ScanId, Timestamp};

/// What a job does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum JobKind {
    /// Reads one scan and adds it to the model.
    Registration,
    /// Bundle adjustment over all landmarks.
    GlobalBundleAdjustment,
    /// Moves the keypoints of tracks onto each other, then adjusts.
    TrackRefinement,
    /// Joint refinement over the dense clouds of all overlapping pairs.
    DenseRefinement,
    /// Builds the model again from the scans and pairs at hand.
    Rebuild,
    /// Takes a deleted scan out of the model.
    Removal,
    /// Makes the model obey what clients have decided.
    Decision,
}

/// The text names no kind of job.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no kind of job")]
pub struct BadJobKind(pub String);

impl JobKind {
    /// Every kind.
    pub const ALL: [Self; 7] = [
        Self::Registration,
        Self::GlobalBundleAdjustment,
        Self::TrackRefinement,
        Self::DenseRefinement,
        Self::Rebuild,
        Self::Removal,
        Self::Decision,
    ];

    /// The word that is stored and shown.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Registration => "registration",
            Self::GlobalBundleAdjustment => "global-bundle-adjustment",
            Self::TrackRefinement => "track-refinement",
            Self::DenseRefinement => "dense-refinement",
            Self::Rebuild => "rebuild",
            Self::Removal => "removal",
            Self::Decision => "decision",
        }
    }

    /// Whether a client may ask for it; the others come with an upload, a deletion or a decision.
    #[must_use]
    pub fn on_request(self) -> bool {
        !matches!(self, Self::Registration | Self::Removal | Self::Decision)
    }
}

impl FromStr for JobKind {
    type Err = BadJobKind;

    fn from_str(word: &str) -> Result<Self, BadJobKind> {
        Self::ALL
            .into_iter()
            .find(|k| k.as_str() == word)
            .ok_or_else(|| BadJobKind(word.chars().take(60).collect()))
    }
}

impl fmt::Display for JobKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// How far a job has come, in the words of OGC API Processes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum JobState {
    /// It waits for a worker.
    Accepted,
    /// A worker is or was at it; between its two stages and after a worker's death it stays in this state.
    Running,
    /// It is done; the outcome says what came of it.
    Succeeded,
    /// It will never be done; the error says why.
    Failed,
    /// A client no longer wants it.
    Dismissed,
}

impl JobState {
    /// Every state.
    pub const ALL: [Self; 5] =
        [Self::Accepted, Self::Running, Self::Succeeded, Self::Failed, Self::Dismissed];

    /// The word that is stored and shown.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Dismissed => "dismissed",
        }
    }

    /// The state of a word.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.as_str() == word)
    }

    /// Whether nothing will change any more.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Dismissed)
    }
}

/// Where a job queues. A registration passes both lanes, every other kind only the second.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// Work on one scan alone: any number at once.
    Ingest,
    /// Work on a project's model: one job (with the batch that it leads) at a time in a project.
    Map,
}

impl Lane {
    /// The word that is stored.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ingest => "ingest",
            Self::Map => "map",
        }
    }

    /// The lane of this word.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        [Self::Ingest, Self::Map].into_iter().find(|lane| lane.as_str() == word)
    }

    /// The lane that is not this one.
    #[must_use]
    pub fn other(self) -> Self {
        match self {
            Self::Ingest => Self::Map,
            Self::Map => Self::Ingest,
        }
    }
}

/// Why a job or a scan failed, in words for the client.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fault {
    /// A stable word for programs, such as `unreadable-scan`.
    pub code: String,
    /// What is wrong, and where.
    pub detail: String,
}

/// A job as it is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: JobId,
    /// The project that it works on.
    pub project: ProjectId,
    /// The scan that it is about, for registrations and removals.
    pub scan: Option<ScanId>,
    /// What it does.
    pub kind: JobKind,
    /// How far it has come.
    pub state: JobState,
    /// The stage that it is in, such as `match`.
    pub stage: Option<String>,
    /// Percent done, 0 to 100; never falls.
    pub progress: u8,
    /// How often a worker has taken it up.
    pub attempt: u32,
    /// What came of it, once succeeded.
    pub outcome: Option<Value>,
    /// Why it failed.
    pub fault: Option<Fault>,
    /// Grows with every change that a client can see.
    pub revision: u64,
    /// When it was accepted.
    pub created: Timestamp,
    /// When a worker took it up first.
    pub started: Option<Timestamp>,
    /// When it reached its final state.
    pub finished: Option<Timestamp>,
    /// When it changed last.
    pub updated: Timestamp,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_kinds_and_states_round_trip() {
        for kind in JobKind::ALL {
            assert_eq!(kind.as_str().parse(), Ok(kind));
            assert_eq!(serde_json::to_value(kind).unwrap(), kind.as_str());
        }
        for state in JobState::ALL {
            assert_eq!(JobState::from_word(state.as_str()), Some(state));
        }
    }
}
