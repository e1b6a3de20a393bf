//! What the demo says at its end.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context;
use serde::Serialize;

use super::display::Standing;
use crate::evaluate::{Estimate, Tolerance, against_truth};

/// The figures of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Figures {
    pub scans: usize,
    pub registered: usize,
    pub components: usize,
    pub landmarks: usize,
    /// Against the truth, if it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth: Option<AgainstTruth>,
    pub seconds: Seconds,
    /// Where the service answers.
    pub url: String,
}

/// Placement against the truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct AgainstTruth {
    /// Scans with a true pose.
    pub scans: usize,
    /// Of those, the ones that are in a component and where they belong in it.
    pub right: usize,
    /// Of those, the ones that are in a component, but somewhere else.
    pub wrong: usize,
    /// What counts as right.
    pub tolerance: Tolerance,
    pub median_translation_mm: Option<f64>,
    pub median_rotation_deg: Option<f64>,
}

/// Times by the clock on the wall.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Seconds {
    /// From the first upload until every scan was registered or waiting.
    pub registration: f64,
    /// Global bundle adjustment, from the request to its end.
    pub bundle_adjustment: f64,
    /// From the start of the command until everything was downloaded.
    pub total: f64,
}

impl AgainstTruth {
    /// Compares downloaded poses with the truth.
    pub fn of(poses: &Path, truth: &Estimate) -> anyhow::Result<Self> {
        let text =
            std::fs::read_to_string(poses).with_context(|| format!("cannot read {}", poses.display()))?;
        let report = against_truth(&Estimate::parse(&text)?, truth, Tolerance::default());
        Ok(Self {
            scans: report.scans,
            right: report.right,
            wrong: report.wrong,
            tolerance: report.tolerance,
            median_translation_mm: report.median_translation_mm,
            median_rotation_deg: report.median_rotation_deg,
        })
    }
}

impl Figures {
    /// Of the last standing.
    pub fn new(last: &Standing, truth: Option<AgainstTruth>, seconds: Seconds, url: String) -> Self {
        Self {
            scans: last.scans.iter().sum(),
            registered: last.registered,
            components: last.components,
            landmarks: last.landmarks,
            truth,
            seconds,
            url,
        }
    }

    /// For people.
    pub fn text(&self, dir: &Path) -> String {
        let Self { scans, registered, components, landmarks, .. } = self;
        let plural = if *components == 1 { "" } else { "s" };
        let mut text = format!(
            "{registered} of {scans} scans registered in {components} component{plural}, {landmarks} landmarks\n"
        );
        if let Some(truth) = &self.truth {
            let Tolerance { rotation_deg, translation_m } = truth.tolerance;
            let _ = writeln!(
                text,
                "{} of {} scans right (within {translation_m} m and {rotation_deg} deg of the truth), {} wrong",
                truth.right, truth.scans, truth.wrong
            );
            if let (Some(mm), Some(degrees)) = (truth.median_translation_mm, truth.median_rotation_deg) {
                let _ = writeln!(text, "median error {mm:.1} mm, {degrees:.3} deg");
            }
        }
        let Seconds { registration, bundle_adjustment, total } = self.seconds;
        let _ = writeln!(
            text,
            "registration {registration:.1} s, bundle adjustment {bundle_adjustment:.1} s, everything {total:.1} s"
        );
        let _ =
            writeln!(text, "results in {}: poses.json, poses.tum, merged.ply, preview.png", dir.display());
        text
    }
}
