//! `cairn bench pairs`: registers given pairs of scans, each pair alone, and says what it cost. Used by `benches/open3d`, which
//! runs another program on the same pairs and knows the truth.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail, ensure};
use clap::Args;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cli::progress::Moment;
use crate::cli::register::source::{Refusal, Source};
use crate::control::{CancelToken, Control, Seed, Silent};
use crate::features::{PrepareOptions, Scan, choose_resolution, natural_resolution, prepare};
use crate::pairwise::{match_pair, shipped_verifier};
use crate::project::Interpretation;

/// Register given pairs of scans, each pair alone.
///
/// Prints what the likeliest pose of each pair is, how likely it is right, and CPU seconds by stage. Scans are prepared once, also if
/// they are in several pairs, and each scene at the resolution that suits those of its scans that are in a pair.
#[derive(Debug, Clone, Args)]
pub struct PairsArgs {
    /// Scenes: folders with the scans, or with a folder `scans` of them. A scene is known by its last part.
    #[arg(required = true, value_name = "DIR")]
    pub scenes: Vec<PathBuf>,
    /// The pairs: `[{"scene": NAME, "a": FILE, "b": FILE}, …]`, files named without their folder.
    #[arg(long, value_name = "FILE")]
    pub pairs: PathBuf,
    /// Voxel size [default: from the extents of a scene's scans]
    #[arg(long, value_name = "METRES")]
    pub resolution: Option<f64>,
    /// Root of all random choices.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Threads that compute; they do not change the result [default: one for each core]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub threads: usize,
    /// Print one JSON object instead of a summary.
    #[arg(long)]
    pub json: bool,
}

/// A pair to register.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Pair {
    scene: String,
    a: String,
    b: String,
}

/// All that is printed.
#[derive(Debug, Serialize)]
struct Report {
    scenes: Vec<SceneReport>,
    pairs: Vec<PairReport>,
    /// Reading and decoding scans, seconds of user and system time; all threads together.
    decode_cpu_s: f64,
    /// Making them ready.
    prepare_cpu_s: f64,
    /// Registering the pairs.
    pairs_cpu_s: f64,
}

#[derive(Debug, Serialize)]
struct SceneReport {
    scene: String,
    /// Scans that are in a pair.
    scans: usize,
    resolution_m: f64,
}

#[derive(Debug, Serialize)]
struct PairReport {
    #[serde(flatten)]
    pair: Pair,
    matches: usize,
    hypotheses: usize,
    /// The likeliest pose, rows of a 4x4 matrix, between the frames of the files; none if there is no hypothesis.
    a_from_b: Option<[[f64; 4]; 4]>,
    /// How likely it is right, in [0, 1].
    likelihood: f64,
}

/// Runs the command.
///
/// # Errors
/// Names the file that cannot be read, or the pair that no scene has.
pub fn run(args: &PairsArgs) -> anyhow::Result<()> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build()?;
    let report = pool.install(|| measure(args))?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{}", summary(&report));
    }
    Ok(())
}

fn measure(args: &PairsArgs) -> anyhow::Result<Report> {
    let text = std::fs::read_to_string(&args.pairs)
        .with_context(|| format!("cannot read {}", args.pairs.display()))?;
    let pairs: Vec<Pair> =
        serde_json::from_str(&text).with_context(|| format!("{}", args.pairs.display()))?;
    let folders = by_name(&args.scenes)?;
    let mut wanted: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for pair in &pairs {
        ensure!(folders.contains_key(pair.scene.as_str()), "no folder is given for the scene {}", pair.scene);
        ensure!(pair.a != pair.b, "{} of {} is paired with itself", pair.a, pair.scene);
        wanted.entry(&pair.scene).or_default().extend([pair.a.as_str(), pair.b.as_str()]);
    }
    let mut report = Report {
        scenes: Vec::new(),
        pairs: Vec::new(),
        decode_cpu_s: 0.0,
        prepare_cpu_s: 0.0,
        pairs_cpu_s: 0.0,
    };
    let mut scans: BTreeMap<(&str, &str), Scan> = BTreeMap::new();
    for (scene, names) in &wanted {
        let folder = folders.get(*scene).ok_or_else(|| anyhow!("no folder is given for {scene}"))?;
        let names: Vec<&str> = names.iter().copied().collect();
        let resolution = load(folder, scene, &names, args, &mut report, &mut scans)?;
        report.scenes.push(SceneReport {
            scene: (*scene).to_owned(),
            scans: names.len(),
            resolution_m: resolution,
        });
    }
    let started = Moment::now();
    report.pairs = pairs
        .par_iter()
        .map(|pair| {
            let scan = |name| {
                scans.get(&(pair.scene.as_str(), name)).ok_or_else(|| anyhow!("{name} was not prepared"))
            };
            register(pair, scan(pair.a.as_str())?, scan(pair.b.as_str())?)
        })
        .collect::<anyhow::Result<_>>()?;
    report.pairs_cpu_s = started.until(&Moment::now()).cpu;
    Ok(report)
}

/// Folders by their last part.
fn by_name(folders: &[PathBuf]) -> anyhow::Result<BTreeMap<String, PathBuf>> {
    let mut named = BTreeMap::new();
    for folder in folders {
        let full = folder.canonicalize().with_context(|| format!("cannot open {}", folder.display()))?;
        let name = full.file_name().unwrap_or(full.as_os_str()).to_string_lossy().into_owned();
        let inner = full.join("scans");
        let content = if inner.is_dir() { inner } else { full };
        if named.insert(name.clone(), content).is_some() {
            bail!("two scenes are called {name}");
        }
    }
    Ok(named)
}

/// Reads and prepares scans of one scene, and gives the resolution used.
fn load<'p>(
    folder: &Path,
    scene: &'p str,
    names: &[&'p str],
    args: &PairsArgs,
    report: &mut Report,
    scans: &mut BTreeMap<(&'p str, &'p str), Scan>,
) -> anyhow::Result<f64> {
    let cancel = CancelToken::new();
    let interpretation = Interpretation::default();
    let started = Moment::now();
    let sources: Vec<Source> = names
        .par_iter()
        .map(|name| {
            Source::read(&folder.join(name), &interpretation, &cancel).map_err(|refusal| match refusal {
                Refusal::Failed(failure) => anyhow!("{name} of {scene}: {}", failure.detail),
                Refusal::Cancelled(cancelled) => cancelled.into(),
            })
        })
        .collect::<anyhow::Result<_>>()?;
    let natural: Vec<f64> =
        sources.iter().map(|source| natural_resolution(&source.decoded.cloud.points)).collect();
    let resolution = args.resolution.unwrap_or_else(|| choose_resolution(&natural));
    let decoded = Moment::now();
    let options = PrepareOptions::at(resolution, Seed(args.seed));
    let control = Control { cancel: &cancel, observer: &Silent };
    let prepared: Vec<Scan> = sources
        .par_iter()
        .zip(names)
        .map(|(source, name)| {
            let stance = source.stance(&interpretation);
            let prepared = prepare(source.key, &source.decoded.cloud, stance, &options, control)
                .with_context(|| format!("{name} of {scene}"))?;
            Ok(Scan::new(prepared))
        })
        .collect::<anyhow::Result<_>>()?;
    report.decode_cpu_s += started.until(&decoded).cpu;
    report.prepare_cpu_s += decoded.until(&Moment::now()).cpu;
    scans.extend(names.iter().map(|name| (scene, *name)).zip(prepared));
    Ok(resolution)
}

fn register(pair: &Pair, a: &Scan, b: &Scan) -> anyhow::Result<PairReport> {
    ensure!(a.key() != b.key(), "{} and {} of {} are one scan", pair.a, pair.b, pair.scene);
    let result = match_pair(a, b, &shipped_verifier());
    let best = result.hypotheses.first();
    let a_from_b = best.map(|hypothesis| {
        let local =
            if result.pair.a == a.key() { hypothesis.a_from_b } else { hypothesis.a_from_b.inverse() };
        (a.prepared.local_from_scan().inverse() * local * b.prepared.local_from_scan()).to_rows()
    });
    Ok(PairReport {
        pair: pair.clone(),
        matches: result.matches.len(),
        hypotheses: result.hypotheses.len(),
        a_from_b,
        likelihood: best.map_or(0.0, |hypothesis| 1.0 / (1.0 + (-hypothesis.logit).exp())),
    })
}

fn summary(report: &Report) -> String {
    let scans: usize = report.scenes.iter().map(|scene| scene.scans).sum();
    let pairs = report.pairs.len();
    let likely = report.pairs.iter().filter(|pair| pair.likelihood > 0.5).count();
    let per = |seconds: f64, of: usize| 1e3 * seconds / of.max(1) as f64;
    format!(
        "{pairs} pairs of {scans} scans in {} scenes: {likely} likelier right than not\n\
         CPU: {:.1} ms a scan to decode, {:.1} ms to prepare, {:.2} ms a pair\n",
        report.scenes.len(),
        per(report.decode_cpu_s, scans),
        per(report.prepare_cpu_s, scans),
        per(report.pairs_cpu_s, pairs),
    )
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;

    use super::*;

    /// A corner of a room with a few boxes, as text, moved by `shift`.
    fn corner(shift: [f64; 3]) -> String {
        let mut lines = String::new();
        for i in 0..60 {
            for j in 0..60 {
                let (u, v) = (f64::from(i) * 0.05, f64::from(j) * 0.05);
                let bump = if (i / 9 + j / 7) % 3 == 0 { 0.25 } else { 0.0 };
                for p in [[u, v, bump], [u, 3.0 - bump * 0.4, v], [3.0 + bump * 0.6, u, v]] {
                    let [x, y, z]: [f64; 3] = std::array::from_fn(|k| p[k] + shift[k]);
                    let _ = writeln!(lines, "{x} {y} {z}");
                }
            }
        }
        lines
    }

    fn args(folder: &Path) -> PairsArgs {
        PairsArgs {
            scenes: vec![folder.join("corner")],
            pairs: folder.join("pairs.json"),
            resolution: Some(0.06),
            seed: 0,
            threads: 1,
            json: true,
        }
    }

    #[test]
    fn a_pair_is_registered_between_the_frames_of_its_files() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("corner/scans")).unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("corner/scans/a.xyz", &corner([-1.0, -1.0, -1.5]));
        write("corner/scans/b.xyz", &corner([-0.9, -1.2, -1.4]));
        for (first, second, sign) in [("a", "b", -1.0), ("b", "a", 1.0)] {
            write(
                "pairs.json",
                &format!(r#"[{{"scene": "corner", "a": "{first}.xyz", "b": "{second}.xyz"}}]"#),
            );
            let report = measure(&args(folder.path())).unwrap();
            let pose = report.pairs[0].a_from_b.unwrap();
            for (row, expected) in pose.iter().zip([0.1, -0.2, 0.1]) {
                assert!((row[3] - sign * expected).abs() < 0.02, "{pose:?}");
            }
            assert!(report.pairs[0].likelihood > 0.0);
            assert!(summary(&report).starts_with("1 pairs of 2 scans in 1 scenes"));
        }
    }

    #[test]
    fn a_pair_of_an_unknown_scene_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("corner")).unwrap();
        std::fs::write(folder.path().join("pairs.json"), r#"[{"scene": "x", "a": "1", "b": "2"}]"#).unwrap();
        let error = measure(&args(folder.path())).unwrap_err().to_string();
        assert_eq!(error, "no folder is given for the scene x");
    }
}
