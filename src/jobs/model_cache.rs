//! The live models of projects that were worked on lately, so that the next scan need not read everything back.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use crate::mapping::LiveModel;
use crate::project::{ProjectId, VersionNumber};

/// At most so many models at once, least recently used first out.
pub(super) const CAPACITY: usize = 4;

/// Models by project, each exactly as its version was published.
#[derive(Debug, Default)]
pub(super) struct ModelCache {
    models: Mutex<VecDeque<(ProjectId, VersionNumber, LiveModel)>>,
}

impl ModelCache {
    /// A copy of the model of this version, if it is here.
    pub fn get(&self, project: ProjectId, version: VersionNumber) -> Option<LiveModel> {
        let mut models = self.models.lock().unwrap_or_else(PoisonError::into_inner);
        let at = models.iter().position(|(p, v, _)| *p == project && *v == version)?;
        let found = models.remove(at)?;
        let model = found.2.clone();
        models.push_back(found);
        Some(model)
    }

    /// Whether a model of this project is here, of whatever version.
    pub fn knows(&self, project: ProjectId) -> bool {
        self.models.lock().unwrap_or_else(PoisonError::into_inner).iter().any(|(p, _, _)| *p == project)
    }

    /// Forgets all models but those of the `n` projects that were worked on last.
    pub fn keep_newest(&self, n: usize) {
        let mut models = self.models.lock().unwrap_or_else(PoisonError::into_inner);
        let forgotten = models.len().saturating_sub(n);
        models.drain(..forgotten);
    }

    /// Gives back the memory that finer surfaces take in the models of all projects but this: only the one that is worked on keeps them, for the scan
    /// that arrives next.
    pub fn forget_fine_of_others(&self, project: ProjectId) {
        let models = self.models.lock().unwrap_or_else(PoisonError::into_inner);
        for (_, _, other) in models.iter().filter(|(p, _, _)| *p != project) {
            other.forget_fine();
        }
    }

    /// The same of all projects.
    pub fn forget_fine(&self) {
        for (_, _, model) in self.models.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            model.forget_fine();
        }
    }

    /// Keeps the model of a version in place of an older one of the project.
    pub fn put(&self, project: ProjectId, version: VersionNumber, model: LiveModel) {
        let mut models = self.models.lock().unwrap_or_else(PoisonError::into_inner);
        models.retain(|(p, _, _)| *p != project);
        models.push_back((project, version, model));
        while models.len() > CAPACITY {
            models.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::control::{CancelToken, Control, Silent};
    use crate::mapping::MappingOptions;
    use crate::pairwise::test_survey::hall;

    #[test]
    fn only_the_asked_version_is_found_and_the_oldest_project_goes_first() {
        let cache = ModelCache::default();
        let ids: Vec<ProjectId> = (0..5).map(|i| ProjectId(i.into())).collect();
        for id in &ids {
            cache.put(*id, VersionNumber(1), LiveModel::new(MappingOptions::default()));
        }
        assert!(cache.get(ids[0], VersionNumber(1)).is_none());
        assert!(cache.get(ids[4], VersionNumber(1)).is_some());
        assert!(cache.get(ids[4], VersionNumber(2)).is_none());
        cache.keep_newest(1);
        assert!(cache.knows(ids[4]) && !ids[..4].iter().any(|id| cache.knows(*id)));
    }
    #[test]
    fn only_the_project_that_is_worked_on_keeps_finer_surfaces() {
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let mut model = LiveModel::new(MappingOptions::default());
        let scans = hall(2).scans.into_iter().map(|(scan, _)| Arc::new(scan.prepared)).collect();
        model.register(scans, control).expect("nobody cancels");
        let kept = model.clone();
        let unpacked = || kept.graph().scans().filter(|scan| scan.is_unpacked()).count();
        let (cache, first, second) = (ModelCache::default(), ProjectId(1.into()), ProjectId(2.into()));
        cache.put(first, VersionNumber(1), model);
        cache.forget_fine_of_others(first);
        assert_eq!(unpacked(), 2);
        cache.forget_fine_of_others(second);
        assert_eq!(unpacked(), 0);
        assert!(kept.graph().scans().all(|scan| scan.fine().is_some()) && unpacked() == 2);
        cache.forget_fine();
        assert_eq!(unpacked(), 0);
        assert!(cache.knows(first), "the model itself stays");
    }
}
