//! How far two components may stand in each other's free space, and what counts as that. Used by `join`, `bent_join` and `intrusion`.

use std::cell::OnceCell;

use super::component::Component;
use super::options::{JoinLevel, MappingOptions};
use super::surfaces::judge_inside;
use crate::graph::ScanGraph;
use crate::pairwise::Counts;

/// Firm support allows this many times the usual violation, at most.
const FIRM_LENIENCE: f64 = 1.5;
/// Of the points that are near the other side, at most this share may face another way. Right joins of components show up to 0.3.
const MAX_WRONG_NORMAL: f64 = 0.38;

/// The violation that a join may show: little more than the two sides show within themselves, so that clean data, where wrong joins of
/// alike rooms stand out, is judged more strictly than noisy data; more where support is firm, since a fit that is a little off
/// violates a little; and never more than the level says. What was bent, or has grown since, is allowed some times as much by those who
/// ask. What the sides show is only counted when that matters.
pub struct ViolationLimit<'m> {
    most: f64,
    floor: f64,
    firm_support: f64,
    usual: OnceCell<f64>,
    count: Box<dyn Fn() -> f64 + 'm>,
}

impl<'m> ViolationLimit<'m> {
    /// The limit for joining `a` and `b` at this level.
    #[must_use]
    pub fn new(
        graph: &'m ScanGraph,
        (a, b): (&'m Component, &'m Component),
        level: &JoinLevel,
        options: &'m MappingOptions,
    ) -> Self {
        let count = move || {
            let inside = judge_inside(graph, a).plus(&judge_inside(graph, b)).violation_share();
            options.violation_contrast * inside + options.violation_floor
        };
        Self {
            most: level.violation,
            floor: options.violation_floor,
            firm_support: options.firm_support,
            usual: OnceCell::new(),
            count: Box::new(count),
        }
    }

    /// Whether a join that has this support may violate free space by this share.
    #[must_use]
    pub fn admits(&self, violation: f64, support: f64) -> bool {
        violation <= self.most.min(self.floor) || violation <= self.share(support)
    }

    /// The largest share that is allowed for this support.
    #[must_use]
    pub fn share(&self, support: f64) -> f64 {
        let usual = *self.usual.get_or_init(&self.count);
        self.most.min(usual * (support / self.firm_support).clamp(1.0, FIRM_LENIENCE))
    }
}

/// The share of judged points that speak against a pose: in free space, or all of them where surfaces cross instead of coinciding,
/// which is no overlap, however clear of free space it is.
#[must_use]
pub fn violation_of(counts: &Counts) -> f64 {
    if counts.wrong_normal_share() > MAX_WRONG_NORMAL { 1.0 } else { counts.violation_share() }
}
