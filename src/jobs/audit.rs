//! Whether stored blobs mean something to this program. Used by the command line's check.

use crate::mapping::ModelSnapshot;
use crate::storage::{Role, unpack};

/// Why a sound blob cannot be understood, if it cannot. Uploads are the clients' and may be anything; what can be made again is
/// made again if it cannot be read.
#[must_use]
pub fn undecodable(role: &Role, bytes: &[u8]) -> Option<String> {
    match role {
        Role::Content { .. } => unpack(bytes).err().map(|e| e.to_string()),
        Role::Snapshot(_) => ModelSnapshot::from_bytes(bytes).err().map(|e| e.to_string()),
        Role::Upload { .. } | Role::Derived => None,
    }
}
