//! `/v1/projects/{p}/poses`: poses as JSON or in the text forms of other programs.

use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::io;

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderName, header};
use axum::response::{IntoResponse, Response};
use futures_util::Stream;
use futures_util::stream::unfold;
use serde::Serialize;
use tokio::sync::mpsc;
use utoipa::ToSchema;

use super::aside::aside;
use super::extract::Ids;
use super::problem::{Problem, Problems};
use super::query::Params;
use super::reading::Reading;
use super::router::Api;
use crate::geometry::Pose;
use crate::geometry::pose_text::{LogEntry, to_kitti, to_log, to_tum};
use crate::project::{ModelContent, Name, ProjectId, ScanId, Standing, VersionNumber};

/// A scan's pose.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct PoseBody {
    /// The scan.
    #[schema(value_type = String)]
    scan: ScanId,
    /// `model_from_scan`: 4x4, row-major, metres; null while the scan waits.
    #[schema(value_type = Option<Vec<Vec<f64>>>)]
    pose: Option<[[f64; 4]; 4]>,
    /// The component in whose frame the pose is; 0 is the largest.
    component: Option<usize>,
}

/// Poses of a version.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct PosesBody {
    /// The version.
    #[schema(value_type = u32)]
    version: VersionNumber,
    /// By name of the scan; names that occur twice have the scan's id behind them.
    scans: BTreeMap<String, PoseBody>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Json,
    Tum,
    Log,
    Kitti,
}

impl Form {
    fn from_word(word: &str) -> Option<Self> {
        match word {
            "json" => Some(Self::Json),
            "tum" => Some(Self::Tum),
            "3dmatch-log" => Some(Self::Log),
            "kitti" => Some(Self::Kitti),
            _ => None,
        }
    }
}

/// A scan of the version with its name.
struct Named {
    scan: ScanId,
    name: String,
    place: Option<(usize, Pose)>,
}

/// Downloads poses. `json` and `3dmatch-log` hold all components unless one is chosen; `tum` and `kitti` hold one, the
/// largest if none is chosen, because their poses are all in one frame. `3dmatch-log` holds every pair of scans that
/// share a component; its numbers count all scans of the version in the natural order of their names, from 0.
#[utoipa::path(get, path = "/v1/projects/{project}/poses", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("format" = Option<String>, Query, description = "json (if absent), tum, 3dmatch-log or kitti",
        pattern = "^(json|tum|3dmatch-log|kitti)$"),
    ("version" = Option<u32>, Query, description = "Number of the version; the newest if absent"),
    ("component" = Option<u32>, Query, description = "Only this component")),
    responses(
    (status = 200, description = "The poses", content((PosesBody = "application/json"), (String = "text/plain")),
        headers(("cairn-version" = u32, description = "Number of the version"))),
    Problems))]
pub(super) async fn get_poses(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Response, Problem> {
    let form =
        query.with("format", "json, tum, 3dmatch-log or kitti", Form::from_word)?.unwrap_or(Form::Json);
    let version = query.version()?;
    let component = query.value("component", "the index of a component")?;
    query.finish()?;
    let reading = api.readings.read(&api.store, project, version).await?;
    let names = api.store.names_ever(project).await?;
    aside(move || poses(form, &reading, component, names)).await?
}

/// The answer with the poses of a version.
fn poses(
    form: Form,
    reading: &Reading,
    component: Option<usize>,
    names: Vec<(ScanId, Name)>,
) -> Result<Response, Problem> {
    let version = reading.version;
    let scans = named(&reading.content, component, names);
    let of = |component: usize| {
        scans.iter().filter_map(move |s| {
            let (c, pose) = s.place?;
            (c == component).then_some((s.name.as_str(), pose))
        })
    };
    let text = match form {
        Form::Json => {
            let body = PosesBody { version, scans: bodies(scans) };
            let text = serde_json::to_vec(&body).map_err(Problem::internal)?;
            let headers = [
                (header::CONTENT_TYPE, "application/json".to_owned()),
                (HeaderName::from_static("cairn-version"), version.to_string()),
            ];
            return Ok((headers, text).into_response());
        }
        Form::Tum => Body::from(to_tum(of(component.unwrap_or(0)))),
        Form::Kitti => Body::from(to_kitti(of(component.unwrap_or(0)).map(|(_, pose)| pose))),
        Form::Log => Body::from_stream(log(scans)),
    };
    let headers = [
        (header::CONTENT_TYPE, "text/plain; charset=utf-8".to_owned()),
        (HeaderName::from_static("cairn-version"), version.to_string()),
    ];
    Ok((headers, text).into_response())
}

/// The scans of a version in the natural order of their names.
fn named(content: &ModelContent, component: Option<usize>, names: Vec<(ScanId, Name)>) -> Vec<Named> {
    let standings: HashMap<ScanId, &Standing> = content.scans.iter().map(|(id, s)| (*id, s)).collect();
    let mut scans = Vec::new();
    for (scan, name) in names {
        let place = match standings.get(&scan) {
            None => continue,
            Some(Standing::Registered(p)) => Some((p.component, p.model_from_scan)),
            Some(_) => None,
        };
        let place = place.filter(|(c, _)| component.is_none_or(|wanted| wanted == *c));
        scans.push(Named { scan, name: name.to_string(), place });
    }
    scans.sort_by_cached_key(|s| (natural(&s.name), s.scan));
    scans
}

fn bodies(scans: Vec<Named>) -> BTreeMap<String, PoseBody> {
    let mut bodies = BTreeMap::new();
    for Named { scan, name, place } in scans {
        let name = if bodies.contains_key(&name) { format!("{name} ({scan})") } else { name };
        let (component, pose) = (place.map(|(c, _)| c), place.map(|(_, pose)| pose.to_rows()));
        bodies.insert(name, PoseBody { scan, pose, component });
    }
    bodies
}

/// Pieces of a log that wait for a slow client, each of one scan with all later ones.
const LOG_PIECES: usize = 4;

/// Every pair of scans that share a component, written while it is sent: the text grows with the square of the scans.
fn log(scans: Vec<Named>) -> impl Stream<Item = io::Result<String>> {
    let (sender, receiver) = mpsc::channel(LOG_PIECES);
    tokio::task::spawn_blocking(move || {
        let pieces =
            (0..scans.len()).map(|i| to_log(&entries_from(&scans, i))).filter(|text| !text.is_empty());
        for piece in pieces {
            // The client has gone if nobody receives.
            if sender.blocking_send(Ok(piece)).is_err() {
                return;
            }
        }
    });
    unfold(receiver, |mut receiver| async move { Some((receiver.recv().await?, receiver)) })
}

/// The pairs of scan `i` with the later scans of its component.
fn entries_from(scans: &[Named], i: usize) -> Vec<LogEntry> {
    let number = |i: usize| u32::try_from(i).unwrap_or(u32::MAX);
    let Some((component, model_from_i)) = scans.get(i).and_then(|s| s.place) else { return Vec::new() };
    let i_from_model = model_from_i.inverse();
    let later = scans.iter().enumerate().skip(i + 1);
    later
        .filter_map(|(j, scan)| {
            let (_, model_from_j) = scan.place.filter(|(c, _)| *c == component)?;
            let i_from_j = i_from_model * model_from_j;
            Some(LogEntry { i: number(i), j: number(j), n: number(scans.len()), i_from_j })
        })
        .collect()
}

/// A key by which `scan_10` sorts after `scan_9`: the name with its runs of digits padded.
fn natural(name: &str) -> String {
    let mut key = String::new();
    let mut digits = String::new();
    for c in name.chars().chain(std::iter::once('\0')) {
        if c.is_ascii_digit() {
            digits.push(c);
            continue;
        }
        if !digits.is_empty() {
            let _ = write!(key, "{:0>20}", digits.trim_start_matches('0'));
            digits.clear();
        }
        key.push(c);
    }
    key
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_by_their_numbers() {
        let mut names = ["cloud_bin_10.ply", "cloud_bin_9.ply", "cloud_bin_0.ply", "b2"];
        names.sort_by_cached_key(|n| natural(n));
        assert_eq!(names, ["b2", "cloud_bin_0.ply", "cloud_bin_9.ply", "cloud_bin_10.ply"]);
    }
}
