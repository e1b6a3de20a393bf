//! `cairn evaluate`: figures of merit of estimated poses, from files.
//!
//! Reads files and prints; all measures are in [`crate::evaluate`].

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::Args;
use serde::Serialize;

use super::truth::{PairList, label, pair_lists, read_estimate};
use crate::evaluate::{Ecdf, EcdfStep, Recall, Tolerance, TruthReport, against_truth, recall};

/// Measure how good estimated poses are.
///
/// Give the truth as benchmark files (--scene, or --gt-log with --gt-info), as poses (--truth), or both. Options that
/// belong to one estimate may be repeated with it, in the same order.
#[derive(Debug, Clone, Args)]
pub struct EvaluateArgs {
    /// Estimated poses: `{"scans": {name: {"pose": 4x4, "component": id}}}` or `{name: 4x4}`.
    #[arg(long, value_name = "poses.json", required = true)]
    pub estimate: Vec<PathBuf>,
    /// Folder of a 3DMatch scene: `3DMatch_gt.log` and `.info`, `3DLoMatch_gt.log` and `.info`.
    #[arg(long, value_name = "DIR")]
    pub scene: Vec<PathBuf>,
    /// Redwood log of true pairs, for a single estimate; with --gt-info. May be repeated.
    #[arg(long, value_name = "FILE", conflicts_with = "scene", requires = "gt_info")]
    pub gt_log: Vec<PathBuf>,
    /// Information matrices of the pairs in --gt-log, in the same order.
    #[arg(long, value_name = "FILE", requires = "gt_log")]
    pub gt_info: Vec<PathBuf>,
    /// True poses, in any layout that --estimate has.
    #[arg(long, value_name = "poses.json")]
    pub truth: Vec<PathBuf>,
    /// Largest root mean square distance of a registered pair, metres.
    #[arg(long, default_value_t = 0.2, value_name = "METRES")]
    pub tau: f64,
    /// Scans further from their true place are wrong, metres.
    #[arg(long, default_value_t = 0.2, value_name = "METRES")]
    pub max_translation: f64,
    /// Scans turned further from their true pose are wrong, degrees.
    #[arg(long, default_value_t = 5.0, value_name = "DEGREES")]
    pub max_rotation: f64,
    /// Print one JSON object instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// All that is printed.
#[derive(Debug, Serialize)]
struct Report {
    tau_m: f64,
    estimates: Vec<EstimateReport>,
    /// Means over the estimates, by benchmark.
    mean: Vec<MeanRecall>,
}

#[derive(Debug, Serialize)]
struct EstimateReport {
    name: String,
    scans_registered: usize,
    benchmarks: Vec<BenchmarkReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    truth: Option<TruthReport>,
}

#[derive(Debug, Serialize)]
struct BenchmarkReport {
    benchmark: String,
    #[serde(flatten)]
    recall: Recall,
}

#[derive(Debug, Serialize)]
struct MeanRecall {
    benchmark: String,
    recall: Option<f64>,
    recall_published: Option<f64>,
}

/// Runs the command.
///
/// # Errors
/// Names the file that cannot be read or is malformed, or the options that do not fit together.
pub fn run(args: &EvaluateArgs) -> anyhow::Result<()> {
    let report = evaluate(args)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{}", tables(&report));
    }
    Ok(())
}

fn evaluate(args: &EvaluateArgs) -> anyhow::Result<Report> {
    ensure!(args.tau.is_finite() && args.tau > 0.0, "--tau must be a positive length, not {}", args.tau);
    let count = args.estimate.len();
    for (option, given) in [("--scene", args.scene.len()), ("--truth", args.truth.len())] {
        ensure!(given == 0 || given == count, "{count} --estimate need as many {option}, not {given}");
    }
    ensure!(
        args.gt_log.len() == args.gt_info.len(),
        "every --gt-log needs its --gt-info: {} and {} are given",
        args.gt_log.len(),
        args.gt_info.len()
    );
    ensure!(
        args.gt_log.is_empty() || count == 1,
        "--gt-log fits a single --estimate; use --scene for several"
    );
    if args.scene.is_empty() && args.gt_log.is_empty() && args.truth.is_empty() {
        bail!("nothing to compare with: give --scene, or --gt-log and --gt-info, or --truth");
    }
    let mut estimates = Vec::with_capacity(count);
    for (index, path) in args.estimate.iter().enumerate() {
        let estimate = read_estimate(path)?;
        let scene = args.scene.get(index);
        let mut benchmarks = Vec::new();
        for list in lists(args, scene)? {
            let recall = recall(&estimate, &list.pairs, &list.weights, args.tau)
                .with_context(|| list.files.clone())?;
            benchmarks.push(BenchmarkReport { benchmark: list.name, recall });
        }
        let tolerance = Tolerance { rotation_deg: args.max_rotation, translation_m: args.max_translation };
        let truth = match args.truth.get(index) {
            Some(truth) => Some(against_truth(&estimate, &read_estimate(truth)?, tolerance)),
            None => None,
        };
        estimates.push(EstimateReport {
            name: label(scene.unwrap_or(path)),
            scans_registered: estimate.placed.len(),
            benchmarks,
            truth,
        });
    }
    Ok(Report { tau_m: args.tau, mean: means(&estimates), estimates })
}

/// The pairs that an estimate is measured on.
fn lists(args: &EvaluateArgs, scene: Option<&PathBuf>) -> anyhow::Result<Vec<PairList>> {
    let Some(scene) = scene else {
        let files = args.gt_log.iter().zip(&args.gt_info);
        return files.map(|(log, info)| PairList::read(label(log), log, info)).collect();
    };
    let lists = pair_lists(scene)?;
    ensure!(!lists.is_empty(), "{} holds neither 3DMatch_gt.log nor 3DLoMatch_gt.log", scene.display());
    Ok(lists)
}

fn means(estimates: &[EstimateReport]) -> Vec<MeanRecall> {
    let mut names: Vec<&str> = Vec::new();
    for benchmark in estimates.iter().flat_map(|e| &e.benchmarks) {
        if !names.contains(&benchmark.benchmark.as_str()) {
            names.push(&benchmark.benchmark);
        }
    }
    let mean = |name: &str, measure: fn(&Recall) -> Option<f64>| {
        let all = estimates.iter().flat_map(|e| &e.benchmarks).filter(|b| b.benchmark == name);
        let values: Vec<f64> = all.filter_map(|b| measure(&b.recall)).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    names
        .into_iter()
        .map(|name| MeanRecall {
            benchmark: name.to_owned(),
            recall: mean(name, |r| r.recall),
            recall_published: mean(name, |r| r.recall_published),
        })
        .collect()
}

fn tables(report: &Report) -> String {
    let mut text = String::new();
    for estimate in &report.estimates {
        let _ = writeln!(text, "{}: {} scans registered", estimate.name, estimate.scans_registered);
        for BenchmarkReport { benchmark, recall } in &estimate.benchmarks {
            let _ = writeln!(
                text,
                "  {benchmark:<16} {:>5} of {:>5} pairs within {} m   recall {} (published rule {})",
                recall.registered,
                recall.pairs,
                report.tau_m,
                percent(recall.recall),
                percent(recall.recall_published)
            );
        }
        if let Some(truth) = &estimate.truth {
            truth_tables(&mut text, truth);
        }
    }
    if report.estimates.len() > 1 {
        for mean in &report.mean {
            let (recall, published) = (percent(mean.recall), percent(mean.recall_published));
            let _ =
                writeln!(text, "mean {:<13} recall {recall} (published rule {published})", mean.benchmark);
        }
    }
    text
}

fn truth_tables(text: &mut String, truth: &TruthReport) {
    let Tolerance { rotation_deg, translation_m } = truth.tolerance;
    let _ = writeln!(
        text,
        "  against the truth: {} of {} scans right (within {rotation_deg} deg and {translation_m} m), {} wrong, {} not registered",
        truth.right,
        truth.scans,
        truth.wrong,
        truth.scans - truth.registered
    );
    if let (Some(degrees), Some(millimetres)) = (truth.median_rotation_deg, truth.median_translation_mm) {
        let _ = writeln!(text, "  median error: {degrees:.3} deg, {millimetres:.1} mm");
    }
    for component in &truth.components {
        let _ = writeln!(
            text,
            "  component {:<6} {:>4} scans, {:>4} right; median {:.3} deg, {:.1} mm; worst {:.2} deg, {:.0} mm",
            component.component,
            component.scans,
            component.right,
            component.median_rotation_deg,
            component.median_translation_mm,
            component.worst_rotation_deg,
            component.worst_translation_mm
        );
        for wrong in &component.wrong {
            let (degrees, metres) = (wrong.rotation_deg, wrong.translation_m);
            let _ = writeln!(text, "    wrong: {} by {degrees:.1} deg and {metres:.2} m", wrong.name);
        }
    }
    let Ecdf { pairs, connected, rotation_deg, translation_m, .. } = &truth.pairs;
    let _ = writeln!(text, "  relative poses of all {pairs} pairs ({connected} connected), share below:");
    let _ = writeln!(text, "    rotation    {}", curve(rotation_deg, "deg"));
    let _ = writeln!(text, "    translation {}", curve(translation_m, "m"));
}

fn curve(steps: &[EcdfStep], unit: &str) -> String {
    let step = |step: &EcdfStep| format!("{:>5} {unit} {}", step.threshold, percent(Some(step.share)));
    steps.iter().map(step).collect::<Vec<_>>().join("  ")
}

fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "    -".to_owned(), |share| format!("{:5.1} %", 100.0 * share))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        args: EvaluateArgs,
    }

    fn args(words: &[&str]) -> EvaluateArgs {
        Cli::try_parse_from([&["evaluate"], words].concat()).unwrap().args
    }

    #[test]
    fn files_are_measured_and_printed() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            path.to_str().unwrap().to_owned()
        };
        let matrix = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
        let poses =
            write("p.json", &format!(r#"{{"cloud_bin_0.ply": {matrix}, "cloud_bin_2.ply": {matrix}}}"#));
        write("3DMatch_gt.log", "0 2 3\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n");
        let rows: Vec<&str> = vec!["1 1 1 1 1 1"; 6];
        let info = write("3DMatch_gt.info", &format!("0 2 3\n{}\n", rows.join("\n")));
        let scene = folder.path().to_str().unwrap();

        let report = evaluate(&args(&["--estimate", &poses, "--scene", scene, "--truth", &poses])).unwrap();
        assert_eq!(report.estimates[0].benchmarks[0].recall.registered, 1);
        let text = tables(&report);
        assert!(text.contains("2 of 2 scans right") && text.contains("recall 100.0 %"), "{text}");
        assert_eq!(serde_json::to_value(&report).unwrap()["mean"][0]["recall"], 1.0);

        std::fs::write(&info, "0 2 3\n1 1\n").unwrap();
        let error = evaluate(&args(&["--estimate", &poses, "--scene", scene])).unwrap_err();
        assert!(
            format!("{error:#}").ends_with("3DMatch_gt.info: line 2 has 2 values, but 6 are expected"),
            "{error:#}"
        );
    }

    #[test]
    fn options_that_do_not_fit_are_refused() {
        assert!(
            evaluate(&args(&["--estimate", "a.json"]))
                .unwrap_err()
                .to_string()
                .contains("nothing to compare")
        );
        let error = evaluate(&args(&["--estimate", "a", "--estimate", "b", "--truth", "c"])).unwrap_err();
        assert!(error.to_string().contains("as many --truth"), "{error}");
    }
}
