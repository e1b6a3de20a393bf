//! `cairn bench recall` as a user runs it, and the measure of the literature that it and `cairn evaluate` print.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use cairn::cli::simulate::write_survey;
use cairn::control::Seed;
use cairn::pairwise::shipped_verifier;
use cairn::simulate::{BuildingOptions, Layout, SurveyOptions, simulate};
use serde_json::Value;

fn cairn(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_cairn")).args(args).output().unwrap()
}

fn json(args: &[&str]) -> Value {
    let output = cairn(args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Two furnished rooms and their true poses.
fn survey(folder: &Path, layout: Layout, seed: u64) {
    let building = BuildingOptions { layout, rooms: 2, ..BuildingOptions::default() };
    let options =
        SurveyOptions { building, stations: 6, least_overlap: 0.5, seed: Seed(seed), ..Default::default() };
    write_survey(&simulate(&options).unwrap(), folder).unwrap();
}

/// The files hold random poses, errors about as large as tau, a scan that is not registered and another component. The expected
/// numbers are those of an independent program that follows the harness of the literature, on the same files.
#[test]
fn recall_is_that_of_the_reference_program() {
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/recall");
    let estimate = format!("{scene}/poses.json");
    for (tau, registered, published) in [
        ("0.1", [2, 0], [2.0 / 11.0, 0.0]),
        ("0.2", [5, 0], [4.0 / 11.0, 0.0]),
        ("0.3", [7, 2], [6.0 / 11.0, 2.0 / 5.0]),
    ] {
        let report = json(&["evaluate", "--estimate", &estimate, "--scene", scene, "--tau", tau, "--json"]);
        for (index, pairs) in [12, 5].into_iter().enumerate() {
            let list = &report["estimates"][0]["benchmarks"][index];
            assert_eq!(
                (list["pairs"].as_u64(), list["registered"].as_u64()),
                (Some(pairs), Some(registered[index]))
            );
            let by_published_rule = list["recall_published"].as_f64().unwrap();
            assert!((by_published_rule - published[index]).abs() < 1e-12, "{tau}: {list}");
        }
    }
}

#[test]
fn a_scene_is_measured_with_every_strategy_in_every_form() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    survey(folder.path(), Layout::Office, 2);
    let scene = at("");
    let poses = at("poses");
    let strategies = ["--strategy", "incremental,mst,global"];
    let mut args = vec!["bench", "recall", &scene, "--json", "--poses", &poses];
    args.extend(strategies);
    let report = json(&args);
    let runs = report["scenes"][0]["runs"].as_array().unwrap();
    let names: Vec<&str> = runs.iter().map(|run| run["strategy"].as_str().unwrap()).collect();
    assert_eq!(names, ["incremental", "mst", "global"]);
    for run in runs {
        assert_eq!((run["right"].as_u64(), run["waiting"].as_u64()), (Some(6), Some(0)), "{run:#}");
        assert!(run["false_merges"].as_array().unwrap().is_empty(), "{run:#}");
        assert_eq!(
            (&run["recall"][0]["list"], &run["recall"][0]["recall"]),
            (&"overlapping".into(), &1.0.into())
        );
        assert_eq!((run["ecdf"]["pairs"].as_u64(), run["ecdf"]["connected"].as_u64()), (Some(15), Some(15)));
        assert_eq!((run["pairs_tried"].as_u64(), run["pairs_all"].as_u64()), (Some(15), Some(15)));
        assert_eq!(run["kept_edges"]["precision"], 1.0, "{run:#}");
        for stage in ["prepare", "match"] {
            assert!(run["seconds"][stage]["cpu"].as_f64().unwrap() > 0.0, "{run:#}");
        }
    }
    assert!(runs[0]["seconds"]["refine"]["wall"].as_f64().unwrap() > 0.0);

    // What is written is what was measured.
    let name = Path::new(&scene).canonicalize().unwrap().file_name().unwrap().to_str().unwrap().to_owned();
    let (truth, written) = (at("poses.json"), format!("{poses}/{name}-incremental-0.json"));
    let evaluated = json(&["evaluate", "--estimate", &written, "--truth", &truth, "--json"]);
    assert_eq!(evaluated["estimates"][0]["truth"]["pairs"]["rotation_deg"], runs[0]["ecdf"]["rotation_deg"]);
    assert_eq!(evaluated["estimates"][0]["truth"]["right"], 6);

    // Scans one at a time, in two orders, with weights from a file.
    let weights = at("weights.json");
    fs::write(&weights, serde_json::to_string(&*shipped_verifier()).unwrap()).unwrap();
    let output = cairn(&[
        "bench",
        "recall",
        &scene,
        "--one-at-a-time",
        "--seeds",
        "2",
        "--verifier",
        &weights,
        "--markdown",
    ]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && text.contains("| incremental | 100.0 % | 0 | 0.0 | 1.0 |"), "{text}");
    assert!(text.contains(&shipped_verifier().provenance.to_string()), "{text}");
    let text = String::from_utf8(cairn(&["bench", "recall", &scene]).stdout).unwrap();
    assert!(text.contains("6 of 6 right, 0 false merges, 0 waiting, 1 components"), "{text}");
}

#[test]
fn scans_of_two_buildings_are_two_places() {
    let folder = tempfile::tempdir().unwrap();
    let mut truth = serde_json::Map::new();
    let mut groups = serde_json::Map::new();
    fs::create_dir(folder.path().join("scans")).unwrap();
    for (building, (layout, seed)) in [(Layout::Office, 1), (Layout::House, 3)].into_iter().enumerate() {
        let apart = folder.path().join(building.to_string());
        survey(&apart, layout, seed);
        let poses: Value =
            serde_json::from_str(&fs::read_to_string(apart.join("poses.json")).unwrap()).unwrap();
        for (name, pose) in poses.as_object().unwrap() {
            let new = format!("{building}-{name}");
            fs::rename(apart.join("scans").join(name), folder.path().join("scans").join(&new)).unwrap();
            truth.insert(new.clone(), pose.clone());
            groups.insert(new, building.into());
        }
    }
    let write = |name: &str, value: serde_json::Map<String, Value>| {
        fs::write(folder.path().join(name), Value::from(value).to_string()).unwrap();
    };
    write("poses.json", truth);
    write("groups.json", groups);
    let report = json(&["bench", "recall", folder.path().to_str().unwrap(), "--json"]);
    let (scene, run) = (&report["scenes"][0], &report["scenes"][0]["runs"][0]);
    assert_eq!((scene["scans"].as_u64(), scene["places"].as_u64()), (Some(12), Some(2)));
    assert_eq!(run["ecdf"]["pairs"], 30);
    assert_eq!(run["false_merges"].as_array().unwrap().len(), 0, "{run:#}");
    assert!(run["components"].as_u64().unwrap() >= 2, "{run:#}");
}

#[test]
fn what_cannot_be_measured_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().to_str().unwrap();
    let error = |args: &[&str]| {
        let output = cairn(args);
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    fs::write(folder.path().join("a.xyz"), "1 2 3\n4 5 6\n").unwrap();
    assert!(error(&["bench", "recall", scene]).contains("has no poses.json"));
    fs::write(folder.path().join("poses.json"), r#"{"b.ply": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}"#).unwrap();
    assert!(error(&["bench", "recall", scene]).contains("names none of the scans"));
    let weights = folder.path().join("poses.json");
    let said = error(&["bench", "recall", scene, "--verifier", weights.to_str().unwrap()]);
    assert!(said.contains("poses.json: no verifier"), "{said}");
    assert!(error(&["bench", "recall", scene, "--tau", "0"]).contains("--tau must be positive"));
}
