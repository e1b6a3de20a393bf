//! From files to a model: measure, choose the resolution, prepare, register.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::decisions::{NamedDecision, by_key};
use super::inputs::{Input, Inputs};
use super::source::{Failure, Refusal, Source};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control, Stage};
use crate::features::{PrepareOptions, PreparedScan, choose_resolution, natural_resolution, prepare};
use crate::mapping::{Decisions, LiveModel, MappingOptions, ModelSnapshot};
use crate::project::{Interpretation, ProjectSettings};

/// A scan, in however many files its content is.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::cli) struct DistinctScan {
    /// Names of the files, ascending; the first stands for them all.
    pub names: Vec<String>,
    /// Where the first is.
    pub path: PathBuf,
    /// Points in it.
    pub points: u64,
    /// The resolution that suits it alone, metres.
    pub natural: f64,
}

/// Scans and the model that was made of them.
pub(super) struct Registration {
    /// What was set.
    pub settings: ProjectSettings,
    /// How files were read.
    pub interpretation: Interpretation,
    /// Voxel size, metres.
    pub resolution: f64,
    /// All scans that could be read, in the order of their content.
    pub scans: BTreeMap<ScanKey, DistinctScan>,
    /// Of those, the ones that cannot take part.
    pub unfit: BTreeMap<ScanKey, Failure>,
    /// Files that could not be read, by name.
    pub unreadable: BTreeMap<String, Failure>,
    /// The live model, for what its snapshot does not say.
    pub model: LiveModel,
    /// The model.
    pub snapshot: ModelSnapshot,
}

impl Registration {
    /// Runs all stages in the ambient thread pool. A scan that cannot take part is noted, and the others go on.
    pub fn compute(
        inputs: &Inputs,
        settings: ProjectSettings,
        interpretation: Interpretation,
        decisions: &[NamedDecision],
        control: Control<'_>,
    ) -> Result<Self, Cancelled> {
        let (scans, unreadable) = measure(&inputs.files, &interpretation, control)?;
        let natural: Vec<f64> = scans.values().map(|scan| scan.natural).collect();
        let resolution = settings.resolution.unwrap_or_else(|| choose_resolution(&natural));
        let options = PrepareOptions::at(resolution, settings.seed);
        let (prepared, unfit) = prepare_all(&scans, &interpretation, &options, control)?;
        let mut model = LiveModel::new(MappingOptions {
            seed: settings.seed,
            decisions: Decisions::new(&by_key(decisions, &scans)),
            ..MappingOptions::default()
        });
        model.register(prepared, control)?;
        let snapshot = model.snapshot();
        Ok(Self { settings, interpretation, resolution, scans, unfit, unreadable, model, snapshot })
    }

    /// Scans of a component, in the order of their content.
    pub fn members(&self, component: usize) -> impl Iterator<Item = (ScanKey, &DistinctScan)> {
        let members = self.snapshot.components.get(component).map(|c| c.scans.as_slice());
        members.unwrap_or_default().iter().filter_map(|key| Some((*key, self.scans.get(key)?)))
    }
}

pub(in crate::cli) type Measured = (BTreeMap<ScanKey, DistinctScan>, BTreeMap<String, Failure>);

/// Decodes every file once, and keeps only what is known of it then. `files` are ascending by name.
pub(in crate::cli) fn measure(
    files: &[Input],
    interpretation: &Interpretation,
    control: Control<'_>,
) -> Result<Measured, Cancelled> {
    let counter = Counter::new(Stage::Decode, files.len(), control);
    let measured: Vec<Result<(ScanKey, DistinctScan), Refusal>> = files
        .par_iter()
        .map(|file| {
            let source = Source::read(&file.path, interpretation, control.cancel);
            let measured = source.map(|source| {
                let points = &source.decoded.cloud.points;
                let scan = DistinctScan {
                    names: vec![file.name.clone()],
                    path: file.path.clone(),
                    points: points.len() as u64,
                    natural: natural_resolution(points),
                };
                (source.key, scan)
            });
            counter.one_more();
            measured
        })
        .collect();
    let (mut scans, mut unreadable) = (BTreeMap::<ScanKey, DistinctScan>::new(), BTreeMap::new());
    for (file, measured) in files.iter().zip(measured) {
        match measured {
            Ok((key, scan)) => {
                scans.entry(key).and_modify(|same| same.names.push(file.name.clone())).or_insert(scan);
            }
            Err(refusal) => {
                unreadable.insert(file.name.clone(), refusal.failure()?);
            }
        }
    }
    Ok((scans, unreadable))
}

pub(in crate::cli) type Prepared = (Vec<Arc<PreparedScan>>, BTreeMap<ScanKey, Failure>);

/// Prepares every scan, in the order of their content.
pub(in crate::cli) fn prepare_all(
    scans: &BTreeMap<ScanKey, DistinctScan>,
    interpretation: &Interpretation,
    options: &PrepareOptions,
    control: Control<'_>,
) -> Result<Prepared, Cancelled> {
    let counter = Counter::new(Stage::Prepare, scans.len(), control);
    let one = |(key, scan): (&ScanKey, &DistinctScan)| -> Result<PreparedScan, Refusal> {
        let source = Source::read_again(&scan.path, *key, interpretation, control.cancel)?;
        let prepared =
            prepare(*key, &source.decoded.cloud, source.stance(interpretation), options, counter.quiet());
        counter.one_more();
        Ok(prepared?)
    };
    let results: Vec<(ScanKey, Result<PreparedScan, Refusal>)> =
        scans.par_iter().map(|entry| (*entry.0, one(entry))).collect();
    let (mut prepared, mut unfit) = (Vec::with_capacity(results.len()), BTreeMap::new());
    for (key, result) in results {
        match result {
            Ok(scan) => prepared.push(Arc::new(scan)),
            Err(refusal) => {
                unfit.insert(key, refusal.failure()?);
            }
        }
    }
    Ok((prepared, unfit))
}

/// Counts finished scans of a stage from all threads.
struct Counter<'a> {
    stage: Stage,
    done: AtomicUsize,
    total: usize,
    control: Control<'a>,
}

impl<'a> Counter<'a> {
    fn new(stage: Stage, total: usize, control: Control<'a>) -> Self {
        control.report(stage, 0, total);
        Self { stage, done: AtomicUsize::new(0), total, control }
    }

    fn one_more(&self) {
        let done = 1 + self.done.fetch_add(1, Ordering::Relaxed);
        self.control.report(self.stage, done, self.total);
    }

    /// The same cancellation, but without the progress of a single scan.
    fn quiet(&self) -> Control<'a> {
        Control { observer: &crate::control::Silent, ..self.control }
    }
}
