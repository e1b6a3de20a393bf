//! One job at work: what it may use ([`Task`]), and the project's model while the job changes it ([`Session`]).

use std::collections::HashMap;
use std::sync::Arc;

use serde_json::Value;

use super::content::{content_of, edges_of};
use super::decide::engine_decisions;
use super::error::DAMAGED;
use super::model_cache::ModelCache;
use super::parameters::{Parameters, content_key, scan_key};
use super::prepared::prepare_all;
use super::progress::ProgressSink;
use super::workers::WorkerOptions;
use super::{Compute, JobError, Panicked};
use crate::control::{CancelToken, Control};
use crate::features::PreparedScan;
use crate::mapping::{Decision, LiveModel, MappingOptions, ModelSnapshot};
use crate::pairwise::PairResult;
use crate::project::{
    ContentKey, Fault, JobId, KeptDecision, ModelContent, Project, ProjectId, Scan, ScanId, ScanState,
    Standing, VersionNumber,
};
use crate::storage::{BlobId, Claim, NewVersion, Publication, Retry, ScanChange, Store, pack};

/// What a job may use.
pub(super) struct Task {
    pub store: Store,
    pub compute: Compute,
    pub models: Arc<ModelCache>,
    pub options: WorkerOptions,
    pub claim: Claim,
    pub cancel: CancelToken,
    pub progress: Arc<ProgressSink>,
}

impl Task {
    /// Runs a part of the job in the thread pool, under the job's cancellation and progress.
    pub async fn compute<T: Send + 'static>(
        &self,
        work: impl FnOnce(Control<'_>) -> T + Send + 'static,
    ) -> Result<T, Panicked> {
        let (cancel, progress) = (self.cancel.clone(), Arc::clone(&self.progress));
        self.compute.run(move || work(Control { cancel: &cancel, observer: &*progress })).await
    }
}

/// A project's model in the hands of the one job that may change it.
pub(super) struct Session {
    pub project: Project,
    /// Under which scans are prepared and pairs matched.
    pub parameters: Parameters,
    /// A copy: the cached one stays as it is until this one is published.
    pub model: LiveModel,
    /// The version that the job starts from, as readers see it.
    pub before: ModelContent,
    /// Hash of that version's snapshot, if both can be read.
    snapshot_before: Option<BlobId>,
    /// What clients had decided when the job opened the model …
    kept: Vec<KeptDecision>,
    /// … and the same in the engine's terms.
    decisions: Vec<Decision>,
    /// Scans that cannot take part after all, found on the way.
    pub unfit: Vec<(ScanId, Fault)>,
    /// Deleted scans that the model holds no more once this is published.
    pub forgotten: Vec<ScanId>,
}

impl Session {
    /// Opens the newest version of a project's model. Deleted scans whose removals failed are left out of it.
    pub async fn open(task: &Task, id: ProjectId) -> Result<Self, JobError> {
        task.models.forget_fine_of_others(id);
        let project = task.store.project(id).await?;
        let parameters = Parameters::choose(&task.store, &project).await?;
        let kept = task.store.all_decisions(project.id).await?;
        let decisions = if kept.is_empty() {
            Vec::new()
        } else {
            engine_decisions(&kept, &scans_by_key(task, project.id).await?)
        };
        let mut session = Self {
            model: LiveModel::new(parameters.mapping_options(&decisions)),
            parameters,
            project,
            before: ModelContent::default(),
            snapshot_before: None,
            kept,
            decisions,
            unfit: Vec::new(),
            forgotten: task.store.undone_removals(id).await?,
        };
        if session.project.head == VersionNumber::EMPTY {
            return Ok(session);
        }
        let (version, engine) = task.store.version(session.project.id, session.project.head).await?;
        let parameters = Parameters { resolution: version.resolution, seed: session.project.settings.seed };
        let snapshot = BlobId::parse(&version.snapshot)?;
        session.parameters = parameters;
        session.snapshot_before = Some(snapshot);
        session.read_before(task, version.resolution).await?;
        if engine != parameters.engine() {
            // Another engine made this model: what it stored means nothing to this one.
            session.remake(task, parameters, Vec::new()).await?;
        } else if let Some(model) = task.models.get(session.project.id, session.project.head) {
            session.model = model;
        } else {
            match session.restore(task, snapshot).await {
                Err(JobError::Failed { fault, .. }) if fault.code == DAMAGED => {
                    // The uploads are what counts; all else follows from them.
                    tracing::warn!(
                        detail = fault.detail,
                        "the newest version is damaged; the model is made anew"
                    );
                    session.snapshot_before = None;
                    session.remake(task, parameters, Vec::new()).await?;
                }
                other => other?,
            }
        }
        session.leave_out_forgotten(task).await?;
        Ok(session)
    }

    /// Takes what is to be forgotten out of the model.
    async fn leave_out_forgotten(&mut self, task: &Task) -> Result<(), JobError> {
        if self.forgotten.is_empty() {
            return Ok(());
        }
        let all = task.store.scans_ever(self.project.id).await?;
        for (scan, _) in &all {
            if self.forgotten.contains(&scan.id) {
                tracing::warn!(scan = %scan.id, "a scan is taken out of the model whose removal had failed");
                self.remove(scan, &all);
            }
        }
        Ok(())
    }

    /// Reads the newest version as readers see it. If that is damaged, the rows of its scans tell enough to go on, and a new version
    /// is published whatever becomes of the model.
    async fn read_before(&mut self, task: &Task, resolution: f64) -> Result<(), JobError> {
        let project = self.project.id;
        self.before = match task.store.content(project, Some(self.project.head)).await {
            Ok((_, content)) => content,
            Err(error) if error.is_damage() => {
                tracing::warn!(%error, "what readers see of the newest version is damaged; it is written anew");
                self.snapshot_before = None;
                let scans = task.store.standings(project).await?;
                ModelContent { resolution, scans, ..ModelContent::default() }
            }
            Err(error) => return Err(error.into()),
        };
        Ok(())
    }

    /// Reads the model back from its snapshot, its prepared scans and its pairs.
    async fn restore(&mut self, task: &Task, snapshot: BlobId) -> Result<(), JobError> {
        let blobs = task.store.blobs.clone();
        let bytes = task.compute(move |_| blobs.get(snapshot)).await??;
        let snapshot = ModelSnapshot::from_bytes(&bytes).map_err(|e| JobError::for_good(DAMAGED, e))?;
        let by_key = scans_by_key(task, self.project.id).await?;
        let known: Vec<Scan> =
            snapshot.scans.keys().filter_map(|key| by_key.get(&content_key(*key)).cloned()).collect();
        let scans = prepare_all(task, &known, self.parameters).await?;
        let scans: Vec<Arc<PreparedScan>> = scans.into_iter().collect::<Result<_, JobError>>()?;
        let rows = task.store.pairs(self.project.id, &self.parameters.engine()).await?;
        let options = self.options();
        self.model = task
            .compute(move |_| -> Result<LiveModel, JobError> {
                let known = |key| snapshot.scans.contains_key(&key);
                let mut pairs = Vec::with_capacity(rows.len());
                for row in rows {
                    let result: PairResult =
                        postcard::from_bytes(&row).map_err(|e| JobError::for_good(DAMAGED, e))?;
                    if known(result.pair.a) && known(result.pair.b) {
                        pairs.push(result);
                    }
                }
                Ok(LiveModel::restore(options, &snapshot, scans, pairs)?)
            })
            .await??;
        Ok(())
    }

    /// Makes the model anew under other parameters, from the uploads of its scans and of `more`. A scan that turns out
    /// unfit is left out and noted.
    pub async fn remake(
        &mut self,
        task: &Task,
        parameters: Parameters,
        more: Vec<Scan>,
    ) -> Result<(), JobError> {
        let by_key = scans_by_key(task, self.project.id).await?;
        let known: HashMap<ScanId, &Scan> = by_key.values().map(|s| (s.id, s)).collect();
        let takes_part = |(id, standing): &&(ScanId, Standing)| {
            !matches!(standing, Standing::Failed(_)) && !self.forgotten.contains(id)
        };
        let old = self.before.scans.iter().filter(takes_part);
        let mut all: Vec<Scan> = old.filter_map(|(id, _)| known.get(id).map(|s| (*s).clone())).collect();
        all.extend(more);
        self.parameters = parameters;
        self.model = LiveModel::new(self.options());
        self.extend(task, all).await
    }

    /// Adds scans to the model. A scan that turns out unfit is left out and noted.
    pub async fn extend(&mut self, task: &Task, scans: Vec<Scan>) -> Result<(), JobError> {
        let mut fit: Vec<Arc<PreparedScan>> = Vec::with_capacity(scans.len());
        let all = prepare_all(task, &scans, self.parameters).await?;
        for (scan, prepared) in scans.iter().zip(all) {
            match prepared {
                Ok(prepared) => fit.push(prepared),
                Err(JobError::Failed { fault, retry: Retry::Never }) => self.unfit.push((scan.id, fault)),
                Err(other) => return Err(other),
            }
        }
        self.change(task, move |model, control| model.register(fit, control)).await??;
        Ok(())
    }

    /// Changes the model in the thread pool.
    pub async fn change<T: Send + 'static>(
        &mut self,
        task: &Task,
        change: impl FnOnce(&mut LiveModel, Control<'_>) -> T + Send + 'static,
    ) -> Result<T, JobError> {
        let empty = LiveModel::new(self.options());
        let mut model = std::mem::replace(&mut self.model, empty);
        let (model, result) = task
            .compute(move |control| {
                let result = change(&mut model, control);
                (model, result)
            })
            .await?;
        self.model = model;
        Ok(result)
    }

    /// Publishes what has become of the model, if anything has. `outcome` is asked for the end of each job of the claim,
    /// given the content and the number of the version that readers see from now on.
    pub async fn publish(
        mut self,
        task: &Task,
        outcome: impl Fn(&ModelContent, VersionNumber, JobId) -> Result<Value, Fault>,
    ) -> Result<(), JobError> {
        let by_key = scans_by_key(task, self.project.id).await?;
        let blobs = task.store.blobs.clone();
        let (parameters, old) = (self.parameters, self.snapshot_before);
        let first = self.project.head == VersionNumber::EMPTY;
        let decisions = self.kept.iter().map(|kept| (kept.id, kept.decision)).collect();
        let (model, written, pairs) = {
            let empty = LiveModel::new(self.options());
            let mut model = std::mem::replace(&mut self.model, empty);
            task.compute(move |_| -> Result<_, JobError> {
                let pairs = stored_pairs(model.take_new_pairs())?;
                let snapshot = model.snapshot();
                let bytes = snapshot.to_bytes().map_err(|e| JobError::for_good("internal-error", e))?;
                let stored = blobs.put(&bytes)?;
                let mut content = content_of(&snapshot, &by_key, parameters.resolution);
                content.edges = edges_of(model.graph(), &content, &by_key);
                content.decisions = decisions;
                let nothing = first && content.scans.is_empty();
                if nothing || old == Some(stored.id) {
                    return Ok((model, None, pairs));
                }
                let readable = blobs.put(&pack(&content)?)?;
                Ok((model, Some((stored, readable, content)), pairs))
            })
            .await??
        };
        let from = self.project.head;
        let number = if written.is_some() { from.next() } else { from };
        // The fresh blobs live until the publication is committed.
        let version = written.as_ref().map(|(s, readable, c)| new_version(s.id, readable.id, c));
        let content = written.as_ref().map_or(&self.before, |(_, _, content)| content);
        let publication = Publication {
            project: self.project.id,
            kind: task.claim.job.kind,
            from,
            version,
            pairs,
            engine: parameters.engine(),
            scans: changes(&self.before, content, &self.unfit),
            forgotten: self.forgotten,
            outcomes: task.claim.lease.all().map(|job| (job, outcome(content, number, job))).collect(),
        };
        task.store.publish(&task.claim.lease, &publication).await?;
        task.models.put(self.project.id, number, model);
        Ok(())
    }

    /// Makes the model obey what clients have decided. Nothing happens if it does already.
    pub async fn obey(&mut self, task: &Task) -> Result<(), JobError> {
        let decisions = self.decisions.clone();
        self.change(task, move |model, control| model.decide(&decisions, control)).await??;
        Ok(())
    }

    /// What the engine is asked to do in this project.
    fn options(&self) -> MappingOptions {
        self.parameters.mapping_options(&self.decisions)
    }

    /// Takes a deleted scan out of the model, unless its content came again and is in the model as another of the project's scans,
    /// which are `all`, each with whether it was deleted. Returns whether it was there.
    pub fn remove(&mut self, scan: &Scan, all: &[(Scan, bool)]) -> bool {
        let in_model = |state| matches!(state, ScanState::Registered | ScanState::Waiting);
        let again = all.iter().any(|(other, gone)| !gone && other.key == scan.key && in_model(other.state));
        !again && self.model.remove(scan_key(scan.key))
    }
}

/// A project's scans by what the engine calls them. Of two with the same content, one was deleted.
async fn scans_by_key(task: &Task, project: ProjectId) -> Result<HashMap<ContentKey, Scan>, JobError> {
    let mut by_key = HashMap::new();
    for (scan, deleted) in task.store.scans_ever(project).await? {
        if !deleted || !by_key.contains_key(&scan.key) {
            by_key.insert(scan.key, scan);
        }
    }
    Ok(by_key)
}

fn new_version(snapshot: BlobId, readable: BlobId, content: &ModelContent) -> NewVersion {
    let registered = content.placed(None).count();
    NewVersion {
        snapshot,
        content: readable,
        resolution: content.resolution,
        components: content.components.len(),
        registered,
        waiting: content.scans.len() - registered,
    }
}

/// Scans whose standing differs between two versions, and those that fell out.
fn changes(before: &ModelContent, after: &ModelContent, unfit: &[(ScanId, Fault)]) -> Vec<ScanChange> {
    let old: HashMap<ScanId, &Standing> = before.scans.iter().map(|(id, s)| (*id, s)).collect();
    let moved = after.scans.iter().filter(|(id, standing)| old.get(id) != Some(&standing));
    moved
        .cloned()
        .chain(unfit.iter().map(|(id, fault)| (*id, Standing::Failed(fault.clone()))))
        .map(|(scan, standing)| ScanChange { scan, standing })
        .collect()
}

/// Results of pairs as they are stored.
fn stored_pairs(pairs: Vec<PairResult>) -> Result<Vec<(ContentKey, ContentKey, Vec<u8>)>, JobError> {
    pairs
        .into_iter()
        .map(|result| {
            let bytes = postcard::to_stdvec(&result).map_err(|e| JobError::for_good("internal-error", e))?;
            Ok((content_key(result.pair.a), content_key(result.pair.b), bytes))
        })
        .collect()
}
