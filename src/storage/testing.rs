//! What tests of the store begin with: a store in a folder of its own, projects, blobs and scans.

use super::{FreshBlob, NewScan, Seal, Store, StoredBlob};
use crate::project::{ContentKey, Interpretation, Name, ProjectId, ProjectSettings};

/// A store with a project.
pub struct Fixture {
    pub store: Store,
    pub project: ProjectId,
    /// Where it is; deleted with this.
    pub dir: tempfile::TempDir,
}

impl Fixture {
    pub async fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let project = project(&store).await;
        Self { store, project, dir }
    }

    /// A blob with this text.
    pub fn blob(&self, text: &str) -> FreshBlob {
        self.store.blobs.put(text.as_bytes()).unwrap()
    }
}

/// A new project.
pub async fn project(store: &Store) -> ProjectId {
    let name = Name::parse("test").unwrap();
    store.create_project(&name, &ProjectSettings::default(), Seal::none()).await.unwrap().id
}

/// A scan that was uploaded as this blob, as yet without rows.
pub fn new_scan(project: ProjectId, key: u128, blob: StoredBlob) -> NewScan {
    NewScan {
        project,
        key: ContentKey(key),
        name: Name::parse("scan").unwrap(),
        format: "ply".to_owned(),
        blob: blob.id,
        bytes: blob.bytes,
        interpretation: Interpretation::default(),
        sender: None,
    }
}
