//! From the arguments to the files to register, each under a name of its own.

use std::collections::{BTreeSet, HashMap};
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::Read;
use std::path::{Component, Path, PathBuf};

use anyhow::{Context, ensure};

use crate::cloud::sniff;

/// As much of a file as is looked at to recognise its format.
const HEAD_BYTES: u64 = 16 * 1024;

/// A file to register.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::cli) struct Input {
    /// Its file name; where several files share it, with as many folders before it as tell them apart.
    pub name: String,
    /// Where it is.
    pub path: PathBuf,
}

/// What the arguments stand for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::cli) struct Inputs {
    /// Ascending by name.
    pub files: Vec<Input>,
    /// Files of folders that hold no scan, ascending.
    pub ignored: Vec<String>,
}

/// Finds the files. A folder stands for those of its files (not of folders within it) whose content is in a known format; hidden
/// ones are left out. A file that is named itself is always taken, so that it is reported if it cannot be read.
///
/// # Errors
/// Where a folder cannot be listed, is the folder `out` for results, or there is no file at all.
pub(in crate::cli) fn gather(scans: &[PathBuf], out: Option<&Path>) -> anyhow::Result<Inputs> {
    let out = out.and_then(|out| out.canonicalize().ok());
    let (mut paths, mut ignored) = (BTreeSet::new(), BTreeSet::new());
    for path in scans {
        if !path.is_dir() {
            paths.insert(absolute(path)?);
            continue;
        }
        let folder = absolute(path)?;
        ensure!(
            Some(&folder) != out.as_ref(),
            "--out {} holds the scans; give another folder",
            path.display()
        );
        let entries = fs::read_dir(&folder).with_context(|| format!("cannot list {}", path.display()))?;
        for entry in entries {
            let file = entry.with_context(|| format!("cannot list {}", path.display()))?.path();
            let hidden = file.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
            if hidden || file.is_dir() {
                continue;
            }
            if is_scan(&file) {
                paths.insert(absolute(&file)?);
            } else {
                ignored.insert(file);
            }
        }
    }
    ensure!(!paths.is_empty(), "there is no scan; PLY, PCD, XYZ and PTS files are known");
    let paths: Vec<PathBuf> = paths.into_iter().collect();
    let names = distinct_names(&paths);
    let mut files: Vec<Input> =
        names.into_iter().zip(paths).map(|(name, path)| Input { name, path }).collect();
    files.sort_by(|a, b| a.name.cmp(&b.name));
    let ignored = ignored.iter().filter_map(|file| file.file_name()).map(readable).collect();
    Ok(Inputs { files, ignored })
}

/// The same for all ways to write a path, as far as it exists.
fn absolute(path: &Path) -> anyhow::Result<PathBuf> {
    path.canonicalize()
        .or_else(|_| std::path::absolute(path))
        .with_context(|| format!("{} is no path", path.display()))
}

/// Whether the content is in a known format, or cannot be looked at, which is to be reported later.
fn is_scan(file: &Path) -> bool {
    let mut head = Vec::new();
    let read = File::open(file).and_then(|file| file.take(HEAD_BYTES).read_to_end(&mut head));
    read.is_err() || sniff(&head).is_some()
}

/// For each path the shortest end of it that no other path has.
fn distinct_names(paths: &[PathBuf]) -> Vec<String> {
    let parts: Vec<Vec<String>> = paths
        .iter()
        .map(|path| path.components().filter(|c| matches!(c, Component::Normal(_))))
        .map(|components| components.map(|c| readable(c.as_os_str())).collect())
        .collect();
    let mut lengths = vec![1; paths.len()];
    loop {
        let names: Vec<String> = parts
            .iter()
            .zip(&lengths)
            .map(|(parts, length)| parts[parts.len().saturating_sub(*length)..].join("/"))
            .collect();
        let mut count: HashMap<&str, usize> = HashMap::new();
        for name in &names {
            *count.entry(name).or_default() += 1;
        }
        let mut longer = false;
        for ((name, parts), length) in names.iter().zip(&parts).zip(&mut lengths) {
            if count.get(name.as_str()).is_some_and(|n| *n > 1) && *length < parts.len() {
                *length += 1;
                longer = true;
            }
        }
        if !longer {
            return names;
        }
    }
}

/// A name as text; bytes that are no UTF-8 as `\x..`, so that different names stay different.
fn readable(name: &OsStr) -> String {
    let mut text = String::new();
    for chunk in name.as_encoded_bytes().utf8_chunks() {
        text.push_str(chunk.valid());
        for byte in chunk.invalid() {
            let _ = write!(text, "\\x{byte:02x}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_as_short_as_they_can_be() {
        let paths = ["/a/x/1.ply", "/a/y/1.ply", "/b/y/1.ply", "/a/2.ply"].map(PathBuf::from);
        assert_eq!(distinct_names(&paths), ["x/1.ply", "a/y/1.ply", "b/y/1.ply", "2.ply"]);
    }

    #[test]
    fn a_folder_stands_for_its_scans_and_a_named_file_for_itself() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, content: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, content).unwrap();
            path
        };
        file("scans/b.dat", "1 2 3\n4 5 6\n");
        file("scans/a.ply", "ply\nformat ascii 1.0\n");
        file("scans/poses.json", "{}");
        file("scans/.hidden.ply", "ply\n");
        file("scans/deeper/c.ply", "ply\n");
        let picture = file("a.ply", "\u{89}PNG");
        let scans = folder.path().join("scans");
        let out = folder.path().join("out");
        let found = gather(&[scans.clone(), picture, scans.join("../scans/a.ply")], Some(&out)).unwrap();
        let names: Vec<&str> = found.files.iter().map(|f| f.name.as_str()).collect();
        assert_eq!(names[1..], ["b.dat", "scans/a.ply"]);
        assert!(names[0].ends_with("/a.ply"), "{names:?}");
        assert_eq!(found.ignored, ["poses.json"]);
        assert!(gather(std::slice::from_ref(&scans), Some(&scans)).is_err());
    }
}
