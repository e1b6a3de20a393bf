//! The report as Markdown, as `docs/benchmarks.md` has it.

use std::fmt::Write as _;

use super::published::PUBLISHED;
use super::report::{Report, Strategy, Summary};
use super::tables::percent;
use crate::evaluate::{ROTATION_STEPS_DEG, TRANSLATION_STEPS_M};

/// The lists of the literature.
const LISTS: [&str; 2] = ["3DMatch", "3DLoMatch"];

/// All tables: recall with published figures, placement, error curves, cost.
pub(super) fn tables(report: &Report) -> String {
    let mut text = String::new();
    let rows = rows(report);
    recall(&mut text, report, &rows);
    placement(&mut text, &rows);
    curves(&mut text, report);
    cost(&mut text, &rows);
    let mut provenances: Vec<&str> = report.scenes.iter().map(|s| s.verifier.as_str()).collect();
    provenances.dedup();
    let _ = writeln!(text, "Verifier: {}.", provenances.join("; "));
    text
}

/// A summary of each scene and strategy, then of all scenes.
fn rows(report: &Report) -> Vec<(String, Strategy, Summary)> {
    let mut rows = Vec::new();
    for scene in &report.scenes {
        for mean in &report.mean {
            let runs: Vec<_> = scene.runs.iter().filter(|run| run.strategy == mean.strategy).collect();
            if let Some(summary) = Summary::of(&runs) {
                rows.push((scene.name.clone(), mean.strategy, summary));
            }
        }
    }
    if report.scenes.len() > 1 {
        for mean in &report.mean {
            rows.push(("**mean**".to_owned(), mean.strategy, mean.clone()));
        }
    }
    rows
}

fn recall(text: &mut String, report: &Report, rows: &[(String, Strategy, Summary)]) {
    let mut lists: Vec<&str> = Vec::new();
    for mean in report.mean.iter().flat_map(|mean| &mean.recall) {
        if !lists.contains(&mean.list.as_str()) {
            lists.push(&mean.list);
        }
    }
    let _ = writeln!(text, "| registration recall | strategy | {} |", lists.join(" | "));
    let _ = writeln!(text, "|---|---|{}", "---|".repeat(lists.len()));
    for (scene, strategy, summary) in rows {
        let of = |list: &&str| summary.recall.iter().find(|mean| mean.list == **list).map(|mean| mean.recall);
        let cells: Vec<String> = lists.iter().map(|list| percent(of(list))).collect();
        let _ = writeln!(text, "| {scene} | {} | {} |", strategy.name(), cells.join(" | "));
    }
    if lists == LISTS {
        for row in &PUBLISHED {
            let (high, low) = (row.match_percent, row.lo_percent);
            let _ = writeln!(text, "| *published* | {} | {high:.1} % | {low:.1} % |", row.method);
        }
    }
    text.push('\n');
}

fn placement(text: &mut String, rows: &[(String, Strategy, Summary)]) {
    text.push_str(
        "| placement | strategy | right | false merges | waiting | components | edges: precision | recall | kept edges: precision | recall |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    for (scene, strategy, s) in rows {
        let _ = writeln!(
            text,
            "| {scene} | {} | {} | {} | {:.1} | {:.1} | {} | {} | {} | {} |",
            strategy.name(),
            percent(Some(s.right)),
            s.false_merges,
            s.waiting,
            s.components,
            percent(s.graph_precision),
            percent(s.graph_recall),
            percent(s.kept_precision),
            percent(s.kept_recall)
        );
    }
    text.push('\n');
}

fn curves(text: &mut String, report: &Report) {
    let steps = |steps: &[f64], unit: &str| {
        steps.iter().map(|step| format!("< {step} {unit}")).collect::<Vec<_>>().join(" | ")
    };
    let columns = ROTATION_STEPS_DEG.len() + TRANSLATION_STEPS_M.len();
    let _ = writeln!(
        text,
        "| relative poses of all pairs | {} | {} |",
        steps(&ROTATION_STEPS_DEG, "deg"),
        steps(&TRANSLATION_STEPS_M, "m")
    );
    let _ = writeln!(text, "|---|{}", "---|".repeat(columns));
    for mean in &report.mean {
        let shares: Vec<String> =
            mean.rotation_shares.iter().chain(&mean.translation_shares).map(|s| percent(Some(*s))).collect();
        let _ = writeln!(text, "| {} | {} |", mean.strategy.name(), shares.join(" | "));
    }
    text.push('\n');
}

fn cost(text: &mut String, rows: &[(String, Strategy, Summary)]) {
    text.push_str(
        "| cost | strategy | pairs tried | wall s | CPU s | CPU ms to prepare a scan | CPU ms to match a pair | peak MiB |\n\
         |---|---|---|---|---|---|---|---|\n",
    );
    for (scene, strategy, s) in rows {
        let _ = writeln!(
            text,
            "| {scene} | {} | {} | {:.1} | {:.1} | {:.0} | {:.1} | {} |",
            strategy.name(),
            percent(Some(s.pairs_tried)),
            s.wall_s,
            s.cpu_s,
            s.prepare_cpu_ms_a_scan,
            s.match_cpu_ms_a_pair,
            s.peak_memory_bytes.map_or_else(|| "-".to_owned(), |bytes| (bytes >> 20).to_string())
        );
    }
    text.push('\n');
}
