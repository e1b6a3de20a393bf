//! The report as text for a terminal.

use std::fmt::Write as _;

use super::report::{Report, RunReport, SceneReport, Summary};
use crate::evaluate::{EcdfStep, EdgeFigures};

/// All scenes and the means.
pub(super) fn tables(report: &Report) -> String {
    let mut text = String::new();
    for scene in &report.scenes {
        scene_table(&mut text, scene);
    }
    for mean in &report.mean {
        let _ = writeln!(text, "mean of {} runs, {}:", mean.runs, mean.strategy.name());
        let recalls: Vec<String> =
            mean.recall.iter().map(|mean| format!("{} {}", mean.list, percent(Some(mean.recall)))).collect();
        let _ = writeln!(text, "  recall      {}", recalls.join("  "));
        mean_lines(&mut text, mean);
    }
    text
}

fn scene_table(text: &mut String, scene: &SceneReport) {
    let _ = writeln!(
        text,
        "{}: {} scans of {} place{}, {} pairs overlap, voxel {:.4} m, wrong beyond {:.3} m",
        scene.name,
        scene.scans,
        scene.places,
        if scene.places == 1 { "" } else { "s" },
        scene.overlapping_pairs,
        scene.resolution_m,
        scene.wrong_distance_m
    );
    for run in &scene.runs {
        run_lines(text, run);
    }
}

fn run_lines(text: &mut String, run: &RunReport) {
    let _ = writeln!(text, "  {}, seed {}", run.strategy.name(), run.seed);
    for list in &run.recall {
        let published = list
            .recall_published
            .map_or_else(String::new, |share| format!(" (published rule {})", percent(Some(share))));
        let _ = writeln!(
            text,
            "    recall      {:<11} {} of {} pairs, {}{published}",
            list.list,
            list.registered,
            list.pairs,
            percent(list.recall)
        );
    }
    let _ = writeln!(
        text,
        "    scans       {} of {} right, {} false merges, {} waiting, {} components",
        run.right,
        run.scans,
        run.false_merges.len(),
        run.waiting,
        run.components
    );
    for wrong in &run.false_merges {
        let how = if wrong.elsewhere {
            "is of another place".to_owned()
        } else {
            format!("is off by {:.1} deg and {:.2} m", wrong.rotation_deg, wrong.translation_m)
        };
        let _ = writeln!(text, "      wrong: {} {how}", wrong.name);
    }
    let _ = writeln!(text, "    edges       {}; kept {}", edges(&run.graph_edges), edges(&run.kept_edges));
    let ecdf = &run.ecdf;
    let _ = writeln!(text, "    all pairs   {} of {} connected, share below:", ecdf.connected, ecdf.pairs);
    let _ = writeln!(
        text,
        "      rotation    {}  mean {} median {} deg",
        curve(&ecdf.rotation_deg),
        number(ecdf.mean_rotation_deg),
        number(ecdf.median_rotation_deg)
    );
    let _ = writeln!(
        text,
        "      translation {}  mean {} median {} m",
        curve(&ecdf.translation_m),
        number(ecdf.mean_translation_m),
        number(ecdf.median_translation_m)
    );
    let stages = &run.seconds;
    let stage = |name: &str, seconds: &super::super::progress::Seconds| {
        format!("{name} {:.2}/{:.2}", seconds.wall, seconds.cpu)
    };
    let _ = writeln!(
        text,
        "    seconds     {}  {}  {}  {}  {}  {} (wall/cpu); {} of {} pairs tried{}{}",
        stage("prepare", &stages.prepare),
        stage("match", &stages.matching),
        stage("support", &stages.support),
        stage("map", &stages.map),
        stage("refine", &stages.refine),
        stage("total", &stages.total()),
        run.pairs_tried,
        run.pairs_all,
        run.peak_memory_bytes.map_or_else(String::new, |b| format!("; peak {} MiB", b >> 20)),
        run.longest_step_s.map_or_else(String::new, |s| format!("; longest step {s:.2} s")),
    );
}

fn mean_lines(text: &mut String, mean: &Summary) {
    let _ = writeln!(
        text,
        "  scans       {} right, {} false merges in all, {:.1} waiting, {:.1} components",
        percent(Some(mean.right)),
        mean.false_merges,
        mean.waiting,
        mean.components
    );
    let pair = |precision, recall| format!("precision {} recall {}", percent(precision), percent(recall));
    let _ = writeln!(
        text,
        "  edges       {}; kept {}",
        pair(mean.graph_precision, mean.graph_recall),
        pair(mean.kept_precision, mean.kept_recall)
    );
    let shares = |shares: &[f64]| shares.iter().map(|s| percent(Some(*s))).collect::<Vec<_>>().join(" ");
    let _ = writeln!(text, "  rotation    {}", shares(&mean.rotation_shares));
    let _ = writeln!(text, "  translation {}", shares(&mean.translation_shares));
    let _ = writeln!(
        text,
        "  seconds     {:.2} wall, {:.2} cpu; {:.0} ms cpu to prepare a scan, {:.1} ms to match a pair; {} of pairs tried{}",
        mean.wall_s,
        mean.cpu_s,
        mean.prepare_cpu_ms_a_scan,
        mean.match_cpu_ms_a_pair,
        percent(Some(mean.pairs_tried)),
        mean.peak_memory_bytes.map_or_else(String::new, |b| format!("; peak {} MiB", b >> 20)),
    );
}

fn edges(figures: &EdgeFigures) -> String {
    format!(
        "{} of {} right ({}), {} of {} true pairs ({})",
        figures.right,
        figures.claimed,
        percent(figures.precision),
        figures.found,
        figures.true_pairs,
        percent(figures.recall)
    )
}

fn curve(steps: &[EcdfStep]) -> String {
    let step = |step: &EcdfStep| format!("<{} {}", step.threshold, percent(Some(step.share)));
    steps.iter().map(step).collect::<Vec<_>>().join("  ")
}

fn number(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3}"))
}

/// One decimal, or a dash.
pub(super) fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "-".to_owned(), |share| format!("{:.1} %", 100.0 * share))
}
