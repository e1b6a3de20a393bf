//! What every stored result of the engine depends on besides the scans themselves.

use crate::cloud::ScanKey;
use crate::control::Seed;
use crate::features::{PrepareOptions, choose_resolution};
use crate::mapping::{Decision, Decisions, MappingOptions};
use crate::project::{ContentKey, Project};
use crate::storage::{StorageError, Store};

/// Names the form and meaning of prepared scans, pair results and snapshots. Another one makes the cached ones of old programs
/// unreachable, so it changes whenever the engine's numbers do.
const ENGINE: &str = "engine/13";

/// How many scans, by arrival, decide a project's resolution.
pub const DECIDING_SCANS: u32 = 8;

/// The engine's parameters for one project.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Parameters {
    /// Voxel size from which every length scale derives, metres.
    pub resolution: f64,
    /// Root of the random choices.
    pub seed: Seed,
}

impl Parameters {
    /// What the owner set, or what the first scans that are decoded suggest.
    pub async fn choose(store: &Store, project: &Project) -> Result<Self, StorageError> {
        let resolution = match project.settings.resolution {
            Some(resolution) => resolution,
            None => choose_resolution(&store.first_scales(project.id, DECIDING_SCANS).await?),
        };
        Ok(Self { resolution, seed: project.settings.seed })
    }

    /// A text that is equal for equal parameters only.
    pub fn engine(&self) -> String {
        format!("{ENGINE} resolution {} seed {}", self.resolution, self.seed.0)
    }

    /// The key under which a prepared scan is remembered.
    pub fn prepared_key(&self, scan: ContentKey) -> blake3::Hash {
        blake3::hash(format!("prepared {} {:032x}", self.engine(), scan.0).as_bytes())
    }

    /// As the engine takes them for preparing.
    pub fn prepare_options(&self) -> PrepareOptions {
        PrepareOptions::at(self.resolution, self.seed)
    }

    /// As the engine takes them for mapping, together with what clients decided.
    pub fn mapping_options(&self, decisions: &[Decision]) -> MappingOptions {
        MappingOptions { seed: self.seed, decisions: Decisions::new(decisions), ..MappingOptions::default() }
    }
}

/// The engine's name for a scan.
pub(super) fn scan_key(key: ContentKey) -> ScanKey {
    ScanKey(key.0)
}

/// The service's name for the engine's scan.
pub(super) fn content_key(key: ScanKey) -> ContentKey {
    ContentKey(key.0)
}
