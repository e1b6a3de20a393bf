//! Known truth from files: true or estimated poses, and the pairs that benchmarks score. Used by the commands that measure.

use std::path::Path;

use anyhow::Context;

use crate::evaluate::Estimate;
use crate::geometry::pose_text::{InfoEntry, LogEntry, parse_info, parse_log};

/// The benchmarks that a scene folder may hold.
const BENCHMARKS: [&str; 2] = ["3DMatch", "3DLoMatch"];

/// The pairs of a benchmark.
#[derive(Debug, Clone)]
pub(super) struct PairList {
    /// What it is called.
    pub name: String,
    /// The two files, for messages.
    pub files: String,
    /// True relative poses.
    pub pairs: Vec<LogEntry>,
    /// Their information matrices, in the same order.
    pub weights: Vec<InfoEntry>,
}

impl PairList {
    /// Reads a Redwood log and the information file that belongs to it.
    pub fn read(name: String, log: &Path, info: &Path) -> anyhow::Result<Self> {
        let pairs = parse_log(&read(log)?).with_context(|| format!("{}", log.display()))?;
        let weights = parse_info(&read(info)?).with_context(|| format!("{}", info.display()))?;
        Ok(Self { name, files: format!("{} and {}", log.display(), info.display()), pairs, weights })
    }
}

/// The lists of pairs in the folder of a scene: `3DMatch_gt.log` and `.info`, `3DLoMatch_gt.log` and `.info`, as far as they are there.
pub(super) fn pair_lists(scene: &Path) -> anyhow::Result<Vec<PairList>> {
    BENCHMARKS
        .iter()
        .map(|name| (*name, scene.join(format!("{name}_gt.log")), scene.join(format!("{name}_gt.info"))))
        .filter(|(_, log, _)| log.exists())
        .map(|(name, log, info)| PairList::read(name.to_owned(), &log, &info))
        .collect()
}

/// Poses in any layout that [`Estimate::parse`] knows.
pub(super) fn read_estimate(path: &Path) -> anyhow::Result<Estimate> {
    Estimate::parse(&read(path)?).with_context(|| format!("{}", path.display()))
}

/// A text file.
pub(super) fn read(path: &Path) -> anyhow::Result<String> {
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// The last part of a path, for a table.
pub(super) fn label(path: impl AsRef<Path>) -> String {
    let path = path.as_ref();
    // `.` and `..` have a name only where they lead.
    let resolved = if path.file_name().is_none() { path.canonicalize().ok() } else { None };
    let path = resolved.as_deref().unwrap_or(path);
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
