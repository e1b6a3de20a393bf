//! Folders that survive a power cut: their names are synced in the folders that hold them.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use super::StorageError;

/// Makes a folder, with all above it that are missing, and sees to it that their names last. One that
/// is there is left as it is, and so nothing is left where this fails. Blocks.
pub(super) fn make_lasting(folder: &Path) -> Result<(), StorageError> {
    let new = missing(folder);
    let made = new.iter().try_for_each(|folder| make(folder));
    let lasting = made
        .map_err(StorageError::io("making a directory"))
        .and_then(|()| names_of(&new).map_err(StorageError::io("syncing the name of a directory")));
    if lasting.is_err() {
        for folder in new.iter().rev() {
            // It was not made, or somebody else uses it already.
            let _ = std::fs::remove_dir(folder);
        }
    }
    lasting
}

/// Syncs the names of folders.
fn names_of(folders: &[PathBuf]) -> io::Result<()> {
    folders.iter().try_for_each(|folder| sync(holder(folder)))
}

/// Syncs the names in a folder.
fn sync(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Those of a folder and all above it that are not there, from above.
fn missing(folder: &Path) -> Vec<PathBuf> {
    let above = folder.ancestors().take_while(|f| !f.as_os_str().is_empty() && !f.exists());
    let mut missing: Vec<PathBuf> = above.map(Path::to_owned).collect();
    missing.reverse();
    missing
}

/// The folder that holds the name of another.
fn holder(folder: &Path) -> &Path {
    folder.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn make(folder: &Path) -> io::Result<()> {
    match std::fs::create_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && folder.is_dir() => Ok(()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_is_missing_is_found_and_where_its_names_are_kept() {
        let dir = tempfile::tempdir().unwrap();
        let data = dir.path().join("a/b/c");
        assert_eq!(missing(&data), [dir.path().join("a"), dir.path().join("a/b"), data.clone()]);
        assert!(missing(dir.path()).is_empty());
        assert_eq!(missing(Path::new("not-here/data")), ["not-here", "not-here/data"].map(PathBuf::from));
        assert_eq!(holder(&data), dir.path().join("a/b"));
        assert_eq!(holder(Path::new("not-here")), Path::new("."));
    }
}
