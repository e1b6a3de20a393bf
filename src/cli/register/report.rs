//! `report.json`: what came out, how good it is and what it cost; and the same in a few lines for people.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use serde::Serialize;

use super::inputs::Inputs;
use super::open_joins::{OpenJoinReport, UndoneReport, open_joins, undone};
use super::pipeline::Registration;
use super::poses::{PoseEntry, Poses, Status};
use crate::cli::progress::{Moment, Seconds, Watch};
use crate::control::Stage;
use crate::mapping::ScanOutcome;

/// Open joins that the summary tells one by one, at most.
const OPEN_JOINS_TOLD: usize = 5;

/// The report of a run.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    /// Version of this program.
    cairn: &'static str,
    /// Root of the random choices.
    seed: u64,
    /// Voxel size from which every length scale derives, metres.
    resolution: f64,
    /// Threads that computed.
    threads: usize,
    counts: Counts,
    /// Largest first.
    components: Vec<ComponentReport>,
    /// By file name.
    scans: BTreeMap<String, ScanReport>,
    pairs: Pairs,
    /// Joins that were not made although something speaks for them, the best supported first.
    open_joins: Vec<OpenJoinReport>,
    /// Placements that further scans contradicted, and that were taken back.
    undone: Vec<UndoneReport>,
    /// Files of folders that hold no scan.
    ignored: Vec<String>,
    seconds: Times,
}

/// Files by what became of them.
#[derive(Debug, Default, Serialize)]
struct Counts {
    files: usize,
    registered: usize,
    waiting: usize,
    failed: usize,
    /// Files with the content of another one; they are counted above too.
    duplicates: usize,
}

#[derive(Debug, Serialize)]
struct ComponentReport {
    component: usize,
    /// File names.
    scans: Vec<String>,
    /// The scan at identity.
    gauge: String,
    /// Points seen in at least two scans.
    landmarks: usize,
    observations: usize,
    /// Root mean square distance between observations and landmarks, metres.
    landmark_rms: f64,
}

#[derive(Debug, Serialize)]
struct ScanReport {
    #[serde(skip_serializing_if = "Option::is_none")]
    points: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    quality: Option<Quality>,
    #[serde(flatten)]
    outcome: PoseEntry,
}

/// How well a scan is held.
#[derive(Debug, Serialize)]
struct Quality {
    landmarks: usize,
    /// Scans that overlap it in a verified edge.
    neighbours: usize,
    /// Root mean square distance between its keypoints and their landmarks, metres.
    landmark_rms: f64,
}

/// Pairs of scans.
#[derive(Debug, Default, Serialize)]
struct Pairs {
    /// That there are.
    possible: usize,
    /// That were matched.
    tried: usize,
    /// Of those, that are more likely to overlap as found than not.
    verified: usize,
}

/// Time in seconds.
#[derive(Debug, Serialize)]
struct Times {
    #[serde(flatten)]
    total: Seconds,
    /// By stage; what no stage reported is in the total only.
    stages: BTreeMap<Stage, Seconds>,
}

impl Report {
    /// Of a run that began at `started`.
    pub fn new(
        registration: &Registration,
        inputs: &Inputs,
        watch: &Watch,
        threads: usize,
        started: Moment,
    ) -> Self {
        let poses = Poses::of(registration);
        let mut counts = Counts { files: inputs.files.len(), ..Counts::default() };
        for entry in poses.scans.values() {
            match entry.status {
                Status::Registered => counts.registered += 1,
                Status::Waiting => counts.waiting += 1,
                Status::Failed => counts.failed += 1,
            }
            counts.duplicates += usize::from(entry.duplicate_of.is_some());
        }
        let fit = registration.snapshot.scans.len();
        let edges = registration.model.graph().edges();
        let pairs = Pairs {
            possible: fit * fit.saturating_sub(1) / 2,
            tried: edges.len(),
            verified: edges.filter(|edge| edge.best_score() > 0.0).count(),
        };
        Self {
            cairn: env!("CARGO_PKG_VERSION"),
            seed: registration.settings.seed.0,
            resolution: registration.resolution,
            threads,
            counts,
            components: components(registration),
            scans: scans(registration, poses),
            pairs,
            open_joins: open_joins(registration),
            undone: undone(registration),
            ignored: inputs.ignored.clone(),
            seconds: Times { total: started.until(&Moment::now()), stages: watch.stages() },
        }
    }

    /// Files that are in a component.
    pub fn registered(&self) -> usize {
        self.counts.registered
    }

    /// Files that could not be used.
    pub fn failed(&self) -> usize {
        self.counts.failed
    }

    /// The report for people.
    pub fn summary(&self, out: &Path) -> String {
        let mut text = String::new();
        for (name, scan) in &self.scans {
            let status = match scan.outcome.status {
                Status::Registered => continue,
                Status::Waiting => "waits",
                Status::Failed => "failed",
            };
            let _ = writeln!(text, "{name} {status}: {}", scan.outcome.because());
        }
        for undone in &self.undone {
            let _ = writeln!(text, "{}", undone.line());
        }
        for open in self.open_joins.iter().take(OPEN_JOINS_TOLD) {
            let _ = writeln!(text, "{}", open.line());
        }
        if self.open_joins.len() > OPEN_JOINS_TOLD {
            let _ = writeln!(
                text,
                "{} more open joins are in report.json",
                self.open_joins.len() - OPEN_JOINS_TOLD
            );
        }
        let Counts { files, registered, waiting, failed, duplicates } = self.counts;
        let _ = write!(text, "{registered} of {files} scans registered");
        for (count, what) in [(waiting, "waiting"), (failed, "failed"), (duplicates, "duplicates")] {
            if count > 0 {
                let _ = write!(text, ", {count} {what}");
            }
        }
        let _ = writeln!(text, "; resolution {:.4} m", self.resolution);
        for c in &self.components {
            let _ = writeln!(
                text,
                "component {}: {} scans, {} landmarks, rms {:.1} mm",
                c.component,
                c.scans.len(),
                c.landmarks,
                1000.0 * c.landmark_rms
            );
        }
        let Seconds { wall, cpu } = self.seconds.total;
        let _ = writeln!(
            text,
            "{} of {} pairs tried; {wall:.1} s, {cpu:.1} s of CPU; results in {}",
            self.pairs.tried,
            self.pairs.possible,
            out.display()
        );
        text
    }
}

fn components(registration: &Registration) -> Vec<ComponentReport> {
    let report = |(index, component): (usize, &crate::mapping::ComponentSnapshot)| {
        let mut scans: Vec<String> =
            registration.members(index).flat_map(|(_, scan)| scan.names.iter().cloned()).collect();
        scans.sort();
        let gauge = registration.scans.get(&component.gauge).and_then(|scan| scan.names.first());
        ComponentReport {
            component: index,
            scans,
            gauge: gauge.cloned().unwrap_or_default(),
            landmarks: component.landmarks,
            observations: component.observations,
            landmark_rms: component.landmark_rms,
        }
    };
    registration.snapshot.components.iter().enumerate().map(report).collect()
}

fn scans(registration: &Registration, poses: Poses) -> BTreeMap<String, ScanReport> {
    let mut known = BTreeMap::new();
    for (key, scan) in &registration.scans {
        for name in &scan.names {
            known.insert(name.as_str(), (scan.points, registration.snapshot.scans.get(key)));
        }
    }
    let report = |(name, outcome): (String, PoseEntry)| {
        let scan = known.get(name.as_str());
        let quality = match scan.and_then(|(_, outcome)| *outcome) {
            Some(ScanOutcome::Registered(place)) => Some(Quality {
                landmarks: place.landmarks,
                neighbours: place.neighbours,
                landmark_rms: place.landmark_rms,
            }),
            _ => None,
        };
        (name, ScanReport { points: scan.map(|(points, _)| *points), quality, outcome })
    };
    poses.scans.into_iter().map(report).collect()
}
