//! `cairn register`: files in, one model out, by the same engine as the service but without a server.
//!
//! A scan is known by its content, so that neither names nor the order of the arguments nor the number of threads change
//! a pose. Files are decoded three times (to measure, to prepare, to merge) rather than kept: memory holds the prepared
//! scans and as many raw clouds as there are threads.

mod decisions;
pub(super) mod inputs;
mod open_joins;
mod output;
pub(super) mod pipeline;
mod poses;
mod report;
pub(super) mod source;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::progress::{Moment, Watch};
use super::signals::{INTERRUPTED, cancelled_by_signal};
use crate::cloud::metres_per_unit;
use crate::control::{Cancelled, Control, Seed};
use crate::project::{Interpretation, ProjectSettings, three_numbers};
use output::Staging;
use pipeline::Registration;
use report::Report;

/// Exit code when results were written, but some file could not be used.
const SOME_FAILED: u8 = 3;
/// Exit code when no two scans could be registered.
const NOTHING_REGISTERED: u8 = 4;

/// Register scans: files in, poses, a merged cloud and a picture out.
///
/// Writes poses.json, poses.tum, merged.ply, preview.png and report.json. Where the scans do not all hang together, these hold
/// the largest component, and poses-1.tum, merged-1.ply, preview-1.png … the others; poses.json and report.json hold all.
///
/// Exit code 0: results were written, and every file could be used (scans may wait, and components may be several: poses.json
/// says so). 3: results were written, but some file could not be used. 4: no two scans could be registered; poses.json and
/// report.json say why. 1: nothing was written. 130: interrupted; nothing was written.
#[derive(Debug, Clone, Args)]
pub struct RegisterArgs {
    /// Files, and folders that stand for all scans in them, told by their content: PLY, PCD, XYZ or PTS
    #[arg(required = true, value_name = "SCANS")]
    pub scans: Vec<PathBuf>,
    /// Folder for the results
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace the results of an earlier run in the folder
    #[arg(long)]
    pub force: bool,
    /// Threads that compute; they do not change the result [default: one for each core]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub threads: usize,
    /// Root of all random choices
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Voxel size from which every length scale derives [default: from the extents of the scans]
    #[arg(long, value_name = "METRES")]
    pub resolution: Option<f64>,
    /// Unit of the coordinates: mm, cm, m, km, in, ft, us-ft, or metres in one unit
    #[arg(long, value_name = "UNIT", default_value = "m", value_parser = unit)]
    pub units: f64,
    /// Against gravity in every scan's own frame, where scans are levelled, as 0,0,1 [default: unknown]
    #[arg(long, value_name = "X,Y,Z", value_parser = upward, allow_hyphen_values = true)]
    pub up: Option<[f64; 3]>,
    /// What you decided about pairs of scans that the data cannot tell apart, as a JSON list (the README shows one); report.json
    /// lists what is open, with the poses to choose from
    #[arg(long, value_name = "FILE")]
    pub decisions: Option<PathBuf>,
    /// Print the report as JSON
    #[arg(long)]
    pub json: bool,
    /// Print nothing but errors and, with --json, the report
    #[arg(long, short)]
    pub quiet: bool,
}

fn unit(text: &str) -> Result<f64, String> {
    metres_per_unit(text)
        .ok_or_else(|| "must be mm, cm, m, km, in, ft, us-ft, or metres in one unit".to_owned())
}

/// Three numbers with commas.
pub(super) fn upward(text: &str) -> Result<[f64; 3], String> {
    three_numbers(text).ok_or_else(|| "must be three numbers: x,y,z".to_owned())
}

/// Registers, writes the results, and says how it went by the exit code.
///
/// # Errors
/// Where nothing was written: options that make no sense, no scan, a folder that cannot be written or would be overwritten.
pub fn run(args: &RegisterArgs) -> anyhow::Result<ExitCode> {
    let started = Moment::now();
    let settings = ProjectSettings { seed: Seed(args.seed), resolution: args.resolution };
    settings.validate()?;
    let interpretation = Interpretation { metres_per_unit: args.units, sensor_position: None, up: args.up };
    interpretation.validate()?;
    let inputs = inputs::gather(&args.scans, Some(&args.out))?;
    let decisions = match &args.decisions {
        Some(path) => decisions::read(path, &inputs)?,
        None => Vec::new(),
    };
    let mut staging = Staging::begin(&args.out, args.force)?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build()?;

    let cancel = cancelled_by_signal()?;
    let watch = Watch::new(args.quiet);
    let control = Control { cancel: &cancel, observer: &watch };
    let result = pool.install(|| -> anyhow::Result<Report> {
        let registration = Registration::compute(&inputs, settings, interpretation, &decisions, control)?;
        output::write(&registration, &mut staging, control)?;
        let report = Report::new(&registration, &inputs, &watch, pool.current_num_threads(), started);
        staging.write("report.json", &serde_json::to_vec_pretty(&report)?)?;
        Ok(report)
    });
    watch.finish();
    let report = match result {
        Ok(report) => report,
        Err(error) if error.is::<Cancelled>() => {
            eprintln!("interrupted; nothing was written");
            return Ok(ExitCode::from(INTERRUPTED));
        }
        Err(error) => return Err(error),
    };
    staging.publish()?;
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else if !args.quiet {
        print!("{}", report.summary(&args.out));
    }
    Ok(if report.registered() == 0 {
        ExitCode::from(NOTHING_REGISTERED)
    } else if report.failed() > 0 {
        ExitCode::from(SOME_FAILED)
    } else {
        ExitCode::SUCCESS
    })
}
