//! Folders that survive a power cut: their names are synced in the folders that hold them.

use std::fs::{DirBuilder, File};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use super::StorageError;

/// Makes a folder for the eyes of its owner alone, with all above it that are missing, and sees to it that their names last. One that
/// is there is left as it is, and so nothing is left where this fails. Blocks.
pub(super) fn make_private(folder: &Path) -> Result<(), StorageError> {
    let new = missing(folder);
    let Some((last, above)) = new.split_last() else { return Ok(()) };
    let made = above.iter().try_for_each(|folder| make(folder, 0o777)).and_then(|()| make(last, 0o700));
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

fn make(folder: &Path, mode: u32) -> io::Result<()> {
    match DirBuilder::new().mode(mode).create(folder) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && folder.is_dir() => Ok(()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::storage::Store;

    fn mode(folder: &Path) -> u32 {
        fs::metadata(folder).unwrap().permissions().mode() & 0o777
    }

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

    #[tokio::test]
    async fn a_data_directory_that_is_made_is_its_owners_alone_and_one_that_is_there_stays_as_it_is() {
        let dir = tempfile::tempdir().unwrap();
        let data = dir.path().join("above/data");
        Store::open(&data).await.unwrap().close().await;
        assert_eq!(mode(&data), 0o700);
        let shared = dir.path().join("shared");
        fs::create_dir(&shared).unwrap();
        fs::set_permissions(&shared, fs::Permissions::from_mode(0o750)).unwrap();
        Store::open(&shared).await.unwrap().close().await;
        assert_eq!(mode(&shared), 0o750);
        let copy = dir.path().join("copies/copy");
        crate::storage::backup(&data, &copy, crate::storage::Sharing::Links).await.unwrap();
        assert_eq!(mode(&copy), 0o700, "it holds the same secrets");
    }
}
