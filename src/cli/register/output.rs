//! Writing results: all of them into a hidden folder first, then, when everything is there, into place.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use super::pipeline::Registration;
use super::poses::Poses;
use super::source::{Refusal, Source};
use crate::cloud::{MergedPly, PreviewOptions, PreviewScan, ScanKey, render, scan_color};
use crate::control::{Control, Stage};
use crate::features::SensorPosition;
use crate::geometry::Pose;
use crate::geometry::pose_text::to_tum;
use crate::mapping::ScanOutcome;

/// Names of results: alone, and with the number of a component before the extension.
const RESULTS: [(&str, &str); 5] =
    [("poses", "json"), ("report", "json"), ("poses", "tum"), ("merged", "ply"), ("preview", "png")];

/// Results on their way. What was not published is removed when this is dropped.
pub(super) struct Staging {
    out: PathBuf,
    folder: PathBuf,
    made_out: bool,
    published: bool,
}

impl Staging {
    /// Makes the folder, and refuses one that holds results unless they may be replaced.
    pub fn begin(out: &Path, force: bool) -> anyhow::Result<Self> {
        let made_out = !out.exists();
        fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
        let old = earlier_results(out)?;
        if let Some(first) = old.first() {
            ensure!(
                force,
                "{} exists; give --force to replace the results of an earlier run",
                first.display()
            );
        }
        let folder = out.join(format!(".cairn-register-{}", std::process::id()));
        fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
        Ok(Self { out: out.to_owned(), folder, made_out, published: false })
    }

    /// Writes a small result.
    pub fn write(&mut self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        let mut file = self.create(name)?;
        file.write_all(bytes).and_then(|()| file.flush()).with_context(|| format!("cannot write {name}"))
    }

    /// Begins a large result.
    fn create(&mut self, name: &str) -> anyhow::Result<BufWriter<File>> {
        let file = File::create(self.folder.join(name)).with_context(|| format!("cannot create {name}"))?;
        Ok(BufWriter::with_capacity(1 << 20, file))
    }

    /// Puts all results into place, and takes those of an earlier run away.
    pub fn publish(mut self) -> anyhow::Result<()> {
        for old in earlier_results(&self.out)? {
            fs::remove_file(&old).with_context(|| format!("cannot replace {}", old.display()))?;
        }
        let written =
            fs::read_dir(&self.folder).with_context(|| format!("cannot list {}", self.folder.display()))?;
        let mut names = written.map(|entry| Ok(entry?.file_name())).collect::<std::io::Result<Vec<_>>>()?;
        // Whoever finds the poses shall find the rest.
        names.sort_by_key(|name| name == "poses.json");
        for name in names {
            fs::rename(self.folder.join(&name), self.out.join(&name))
                .with_context(|| format!("cannot write {}", self.out.join(&name).display()))?;
        }
        self.published = true;
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // Nothing better can be done about a folder that cannot be removed than to leave it.
        let _ = fs::remove_dir_all(&self.folder);
        if self.made_out && !self.published {
            let _ = fs::remove_dir(&self.out);
        }
    }
}

/// Files in a folder whose names are ours.
fn earlier_results(out: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(out).with_context(|| format!("cannot list {}", out.display()))? {
        let path = entry?.path();
        if path.file_name().and_then(|name| name.to_str()).is_some_and(is_result) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

fn is_result(name: &str) -> bool {
    let Some((stem, extension)) = name.rsplit_once('.') else { return false };
    let alone =
        stem.rsplit_once('-').filter(|(_, n)| n.parse::<usize>().is_ok()).map_or(stem, |(stem, _)| stem);
    RESULTS.contains(&(alone, extension))
}

/// The name of a result of a component.
fn name_of(stem: &str, component: usize, extension: &str) -> String {
    if component == 0 { format!("{stem}.{extension}") } else { format!("{stem}-{component}.{extension}") }
}

/// Writes everything but the report.
pub(super) fn write(
    registration: &Registration,
    staging: &mut Staging,
    control: Control<'_>,
) -> anyhow::Result<()> {
    let mut text = serde_json::to_vec_pretty(&Poses::of(registration))?;
    text.push(b'\n');
    staging.write("poses.json", &text)?;
    let components = registration.snapshot.components.len();
    let total = (0..components).map(|component| registration.members(component).count()).sum();
    let mut done = 0;
    control.report(Stage::Export, done, total);
    for component in 0..components {
        staging.write(&name_of("poses", component, "tum"), tum(registration, component).as_bytes())?;
        write_cloud_and_picture(registration, component, staging, control, || {
            done += 1;
            control.report(Stage::Export, done, total);
        })?;
    }
    Ok(())
}

/// Scans of a component with their poses, in the order of their names.
fn tum(registration: &Registration, component: usize) -> String {
    let mut poses: Vec<(&str, Pose)> = registration
        .members(component)
        .filter_map(|(key, scan)| Some((scan, place(registration, key)?)))
        .flat_map(|(scan, pose)| scan.names.iter().map(move |name| (name.as_str(), pose)))
        .collect();
    poses.sort_by_key(|(name, _)| *name);
    to_tum(poses)
}

/// Reads the scans of a component one after another, moves each into the merged cloud, and keeps enough of it for the picture.
fn write_cloud_and_picture(
    registration: &Registration,
    component: usize,
    staging: &mut Staging,
    control: Control<'_>,
    mut one_more: impl FnMut(),
) -> anyhow::Result<()> {
    let members: Vec<_> = registration
        .members(component)
        .filter_map(|(key, scan)| Some((key, scan, place(registration, key)?)))
        .collect();
    let stride = PreviewScan::stride(members.iter().map(|(_, scan, _)| scan.points).sum());
    let file = staging.create(&name_of("merged", component, "ply"))?;
    let mut merged = MergedPly::new(file, members.iter().map(|(_, _, pose)| pose))?;
    let mut kept = Vec::with_capacity(members.len());
    for (index, (key, scan, pose)) in members.iter().enumerate() {
        control.check()?;
        let name = scan.names.first().map_or("", String::as_str);
        let source = Source::read_again(&scan.path, *key, &registration.interpretation, control.cancel)
            .map_err(|refusal| match refusal {
                Refusal::Cancelled(cancelled) => anyhow::Error::from(cancelled),
                Refusal::Failed(failure) => anyhow::anyhow!("{name}: {}", failure.detail),
            })?;
        let cloud = &source.decoded.cloud;
        merged.append(cloud, pose, scan_color(index)).context("cannot write the merged cloud")?;
        kept.push(PreviewScan::new(cloud, stride, pose, sensor(registration, *key, &source)));
        one_more();
    }
    merged.finish().context("cannot write the merged cloud")?;
    let parts: Vec<_> = kept.iter().enumerate().map(|(index, scan)| scan.part(index)).collect();
    let picture = render(&parts, PreviewOptions::default()).to_png()?;
    staging.write(&name_of("preview", component, "png"), &picture)
}

fn place(registration: &Registration, key: ScanKey) -> Option<Pose> {
    match registration.snapshot.scans.get(&key)? {
        ScanOutcome::Registered(scan) => Some(scan.model_from_scan),
        ScanOutcome::Waiting(_) => None,
    }
}

/// Where the sensor stood in the scan's own frame: as the file says, or the origin if the points bear it out.
fn sensor(registration: &Registration, key: ScanKey, source: &Source) -> Option<[f64; 3]> {
    if let SensorPosition::Known(position) = source.stance(&registration.interpretation).position {
        return Some(position);
    }
    let prepared = &registration.model.graph().scan(key)?.prepared;
    let believed = prepared.range_image.is_some();
    let at_origin = (0..3).all(|k| (f64::from(prepared.viewpoint[k]) + prepared.origin[k]).abs() < 1e-3);
    (believed && at_origin).then_some([0.0; 3])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_results_are_ours() {
        for ours in
            ["poses.json", "merged.ply", "merged-12.ply", "preview-1.png", "poses-3.tum", "report.json"]
        {
            assert!(is_result(ours), "{ours}");
        }
        for other in ["merged-a.ply", "scan-1.ply", "poses", "poses.txt", "my-poses.json"] {
            assert!(!is_result(other), "{other}");
        }
    }

    #[test]
    fn unpublished_results_leave_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("deep/out");
        let mut staging = Staging::begin(&out, false).unwrap();
        staging.write("poses.json", b"{}").unwrap();
        drop(staging);
        assert!(!out.exists());
    }

    #[test]
    fn earlier_results_are_kept_unless_forced_and_then_replaced_as_a_whole() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path();
        fs::write(out.join("merged-1.ply"), "old").unwrap();
        fs::write(out.join("notes.txt"), "mine").unwrap();
        assert!(Staging::begin(out, false).is_err());
        let mut staging = Staging::begin(out, true).unwrap();
        staging.write("poses.json", b"{}").unwrap();
        assert!(!out.join("poses.json").exists() && out.join("merged-1.ply").exists());
        staging.publish().unwrap();
        let mut names: Vec<_> = fs::read_dir(out).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["notes.txt", "poses.json"]);
    }
}
