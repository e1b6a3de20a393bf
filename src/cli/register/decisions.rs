//! `--decisions FILE`: what the user decided about pairs of scans, by their names.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use serde::Deserialize;
use serde_json::Value;

use super::inputs::Inputs;
use super::pipeline::DistinctScan;
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::mapping::Decision;
use crate::project::{KeptDecision, motion};

/// One entry of the file: the same as the body of `POST …/decisions`, but with names of files instead of ids.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    verdict: String,
    scan_a: String,
    scan_b: String,
    a_from_b: Option<Value>,
}

/// A decision about two files.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NamedDecision {
    scan_a: String,
    scan_b: String,
    joins: bool,
    a_from_b: Option<Pose>,
}

/// Reads and checks a file of decisions.
///
/// # Errors
/// Names the entry and what is wrong with it: an unknown file, the same one twice, a matrix that is no rigid motion.
pub(super) fn read(path: &Path, inputs: &Inputs) -> anyhow::Result<Vec<NamedDecision>> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let entries: Vec<Entry> =
        serde_json::from_str(&text).with_context(|| format!("{} is no list of decisions", path.display()))?;
    let most = KeptDecision::MOST as usize;
    ensure!(
        entries.len() <= most,
        "{} holds {} decisions; at most {most} are allowed",
        path.display(),
        entries.len()
    );
    let checked = entries.into_iter().enumerate().map(|(index, entry)| {
        check(entry, inputs).with_context(|| format!("{}, decision {index}", path.display()))
    });
    checked.collect()
}

fn check(entry: Entry, inputs: &Inputs) -> anyhow::Result<NamedDecision> {
    let joins = match entry.verdict.as_str() {
        "join" => true,
        "forbid" => false,
        _ => bail!("verdict: must be join or forbid"),
    };
    for (field, name) in [("scan_a", &entry.scan_a), ("scan_b", &entry.scan_b)] {
        ensure!(inputs.files.iter().any(|file| file.name == *name), "{field}: there is no scan {name:?}");
    }
    ensure!(entry.scan_a != entry.scan_b, "scan_b: a decision is about two scans");
    let a_from_b = entry.a_from_b.as_ref().map(motion).transpose().context("a_from_b")?;
    ensure!(!joins || a_from_b.is_some(), "a_from_b: a join needs it");
    Ok(NamedDecision { scan_a: entry.scan_a, scan_b: entry.scan_b, joins, a_from_b })
}

/// Decisions in the engine's terms. One about a file that could not be read says nothing, nor does one about two files of the
/// same content.
pub(super) fn by_key(decisions: &[NamedDecision], scans: &BTreeMap<ScanKey, DistinctScan>) -> Vec<Decision> {
    let mut keys: BTreeMap<&str, ScanKey> = BTreeMap::new();
    for (key, scan) in scans {
        keys.extend(scan.names.iter().map(|name| (name.as_str(), *key)));
    }
    let decision = |decision: &NamedDecision| {
        let a = *keys.get(decision.scan_a.as_str())?;
        let b = *keys.get(decision.scan_b.as_str()).filter(|b| **b != a)?;
        match (&decision.a_from_b, decision.joins) {
            (Some(a_from_b), true) => Some(Decision::join(a, b, a_from_b)),
            (None, true) => None,
            (a_from_b, false) => Some(Decision::forbid(a, b, a_from_b.as_ref())),
        }
    };
    decisions.iter().filter_map(decision).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::register::inputs::Input;

    #[test]
    fn a_wrong_entry_is_named_with_its_field() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("decisions.json");
        let file = |name: &str| Input { name: name.to_owned(), path: name.into() };
        let inputs = Inputs { files: vec![file("a.ply"), file("b.ply")], ignored: Vec::new() };
        let read = |text: &str| {
            fs::write(&path, text).unwrap();
            read(&path, &inputs).map_err(|e| format!("{e:#}"))
        };
        let unit = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
        let entry = |verdict: &str, b: &str, more: &str| {
            format!(r#"{{"verdict":"{verdict}","scan_a":"a.ply","scan_b":"{b}"{more}}}"#)
        };
        let good = [entry("forbid", "b.ply", ""), entry("join", "b.ply", &format!(r#","a_from_b":{unit}"#))];
        assert_eq!(read(&format!("[{}]", good.join(","))).unwrap().len(), 2);
        for (bad, field) in [
            (entry("join", "b.ply", ""), "a_from_b"),
            (entry("join", "b.ply", r#","a_from_b":[[1]]"#), "a_from_b"),
            (entry("maybe", "b.ply", ""), "verdict"),
            (entry("forbid", "a.ply", ""), "scan_b"),
            (entry("forbid", "c.ply", ""), "scan_b"),
            (entry("forbid", "b.ply", r#","pose":1"#), "pose"),
        ] {
            let error = read(&format!("[{},{bad}]", good[0])).unwrap_err();
            assert!(error.contains(field), "{error}");
        }
    }
}
