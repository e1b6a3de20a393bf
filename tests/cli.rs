//! `cairn register` and `cairn demo` as a user runs them: the real binary on files.
//!
//! With `CAIRN_TEST_DATA` (a folder of real scans with `3dmatch`, `object` and `rgbd` in it) real scenes are registered too.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use cairn::cli::simulate::write_survey;
use cairn::control::Seed;
use cairn::evaluate::{Estimate, Tolerance, TruthReport, against_truth};
use cairn::pairwise::Verifier;
use cairn::simulate::{BuildingOptions, Layout, SurveyOptions, simulate};
use serde_json::Value;
use tempfile::TempDir;

fn cairn<S: AsRef<OsStr>>(args: impl IntoIterator<Item = S>) -> Output {
    Command::new(env!("CARGO_BIN_EXE_cairn")).args(args).output().unwrap()
}

/// Runs `cairn register` on these paths and expects an exit code.
fn register<P: AsRef<Path>>(scans: &[P], out: &Path, options: &[&str], code: i32) -> Output {
    let mut args: Vec<&OsStr> = vec!["register".as_ref()];
    args.extend(scans.iter().map(|path| path.as_ref().as_os_str()));
    args.extend(["--out".as_ref(), out.as_os_str()]);
    args.extend(options.iter().map(AsRef::<OsStr>::as_ref));
    let output = cairn(args);
    assert_eq!(output.status.code(), Some(code), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

/// Simulates two furnished rooms, scanned by a panoramic scanner; scans are in `scans`, the truth in `poses.json`.
fn survey(folder: &Path, layout: Layout, seed: u64, stations: usize) {
    let building = BuildingOptions { layout, rooms: 2, ..BuildingOptions::default() };
    let options =
        SurveyOptions { building, stations, least_overlap: 0.5, seed: Seed(seed), ..Default::default() };
    write_survey(&simulate(&options).unwrap(), folder).unwrap();
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

fn estimate(path: &Path) -> Estimate {
    Estimate::parse(&fs::read_to_string(path).unwrap()).unwrap()
}

fn compared(poses: &Path, truth: &Path) -> TruthReport {
    against_truth(&estimate(poses), &estimate(truth), Tolerance::default())
}

/// Files in a folder, ascending.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

fn name(path: &Path) -> String {
    path.file_name().unwrap().to_str().unwrap().to_owned()
}

/// Entries of `poses.json` by file name.
fn entries(out: &Path) -> BTreeMap<String, Value> {
    serde_json::from_value(json(&out.join("poses.json"))["scans"].take()).unwrap()
}

#[test]
fn a_survey_is_registered_right_and_alike_at_any_order_names_and_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    survey(folder.path(), Layout::Office, 2, 8);
    register(&[at("scans")], &at("one"), &["--threads", "1"], 0);
    let truth = compared(&at("one/poses.json"), &at("poses.json"));
    assert_eq!((truth.right, truth.wrong, truth.components.len()), (8, 0, 1), "{truth:?}");
    let results = files(&at("one")).iter().map(|path| name(path)).collect::<Vec<_>>();
    assert_eq!(results, ["merged.ply", "poses.json", "poses.tum", "preview.png", "report.json"]);

    let mut shuffled = files(&at("scans"));
    shuffled.reverse();
    shuffled.swap(1, 5);
    register(&shuffled, &at("two"), &["--threads", "2"], 0);
    let bytes = |path: &str| fs::read(at(path)).unwrap();
    for result in ["poses.json", "poses.tum", "merged.ply", "preview.png"] {
        assert!(bytes(&format!("one/{result}")) == bytes(&format!("two/{result}")), "{result} differs");
    }

    fs::create_dir(at("renamed")).unwrap();
    let mut new_name = BTreeMap::new();
    for (index, file) in shuffled.iter().enumerate() {
        new_name.insert(name(file), format!("{index}.scan"));
        fs::copy(file, at("renamed").join(format!("{index}.scan"))).unwrap();
    }
    register(&[at("renamed")], &at("three"), &[], 0);
    let (one, three) = (entries(&at("one")), entries(&at("three")));
    for (old, new) in new_name {
        assert_eq!(one[&old], three[&new], "{old}");
    }
    assert!(bytes("one/merged.ply") == bytes("three/merged.ply"));
}

#[test]
fn two_buildings_are_never_put_into_one_component() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    survey(&at("a"), Layout::Office, 1, 6);
    survey(&at("b"), Layout::House, 3, 6);
    register(&[at("a/scans"), at("b/scans")], &at("out"), &["--json"], 0);
    let building: BTreeSet<String> = files(&at("a/scans")).iter().map(|path| name(path)).collect();
    let mut of_component: BTreeMap<u64, BTreeSet<bool>> = BTreeMap::new();
    for (name, entry) in entries(&at("out")) {
        if let Some(component) = entry["component"].as_u64() {
            of_component.entry(component).or_default().insert(building.contains(&name));
        }
    }
    assert!(of_component.len() >= 2 && of_component.values().all(|buildings| buildings.len() == 1));
    for result in ["poses-1.tum", "merged-1.ply", "preview-1.png"] {
        assert!(at("out").join(result).is_file(), "{result}");
    }
}

#[test]
fn bad_files_and_duplicates_are_named_and_the_others_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    survey(folder.path(), Layout::House, 1, 5);
    let scans = files(&at("scans"));
    let whole = fs::read(&scans[0]).unwrap();
    fs::write(at("scans/truncated.ply"), &whole[..whole.len() / 2]).unwrap();
    fs::write(at("scans/small.xyz"), "0 0 0\n1 0 0\n0 1 0\n").unwrap();
    fs::write(at("scans/readme.txt"), "not a scan").unwrap();
    fs::create_dir(at("more")).unwrap();
    fs::copy(&scans[0], at("more").join(name(&scans[0]))).unwrap();
    let missing = at("missing.ply");
    let output = register(&[at("scans"), at("more"), missing], &at("out"), &["--json"], 3);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let counts =
        serde_json::json!({ "files": 9, "registered": 6, "waiting": 0, "failed": 3, "duplicates": 1 });
    assert_eq!(report["counts"], counts);
    assert_eq!(report["ignored"], serde_json::json!(["readme.txt"]));
    let poses = entries(&at("out"));
    for (file, reason) in [
        ("truncated.ply", "unreadable-scan"),
        ("missing.ply", "unreadable-scan"),
        ("small.xyz", "unfit-scan"),
    ] {
        let entry = &poses[file];
        assert_eq!((&entry["status"], &entry["reason"]), (&"failed".into(), &reason.into()), "{entry}");
        assert_eq!((&entry["pose"], &entry["component"]), (&Value::Null, &Value::Null));
    }
    let (first, second) = (format!("more/{}", name(&scans[0])), format!("scans/{}", name(&scans[0])));
    assert_eq!(poses[&second]["duplicate_of"], first.as_str());
    assert_eq!(poses[&second]["pose"], poses[&first]["pose"]);
    assert!(poses[&first]["pose"].is_array());
}

#[test]
fn results_are_not_overwritten_unasked_and_nothing_is_written_without_scans() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir(at("scans")).unwrap();
    let output = register(&[at("scans")], &at("out"), &[], 1);
    assert!(String::from_utf8_lossy(&output.stderr).contains("there is no scan"));
    assert!(!at("out").exists());
    fs::write(at("scans/a.xyz"), "0 0 0\n1 0 0\n0 1 0\n").unwrap();
    register(&[at("scans")], &at("out"), &[], 4);
    register(&[at("scans")], &at("out"), &[], 1);
    register(&[at("scans")], &at("out"), &["--force", "--quiet"], 4);
    assert_eq!(
        files(&at("out")).iter().map(|path| name(path)).collect::<Vec<_>>(),
        ["poses.json", "report.json"]
    );
    register(&[at("scans")], &at("out2"), &["--units", "furlong"], 2);
}

#[test]
fn the_demo_ends_with_a_model_and_its_files() {
    let folder = tempfile::tempdir().unwrap();
    survey(folder.path(), Layout::Office, 3, 6);
    let (scans, dir) = (folder.path().join("scans"), folder.path().join("demo"));
    let args = ["demo", "--exit", "--json", "--listen", "127.0.0.1:0", "--scans"].map(OsStr::new);
    let args = [&args[..], &[scans.as_os_str(), "--dir".as_ref(), dir.as_os_str()]].concat();
    let output = cairn(args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(figures["scans"], 6);
    assert_eq!(figures["truth"]["right"], 6, "{figures}");
    assert_eq!(estimate(&dir.join("poses.json")).placed.len(), 6);
    assert!(fs::read(dir.join("merged.ply")).unwrap().starts_with(b"ply\n"));
    assert!(fs::read(dir.join("preview.png")).unwrap().starts_with(b"\x89PNG"));
    assert!(fs::read_to_string(dir.join("poses.tum")).unwrap().lines().count() > 12);
}

/// The folder of real scans, or a remark that the test is skipped.
fn real_data() -> Option<PathBuf> {
    let data = std::env::var_os("CAIRN_TEST_DATA").map(PathBuf::from);
    if data.is_none() {
        eprintln!("skipped: CAIRN_TEST_DATA is not set");
    }
    data
}

/// Copies the scans of a scene under names that say nothing of their order, registers them, and writes `poses.json` in the true
/// names. Returns the registration's folder.
fn register_shuffled(scene: &Path) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let (scans, out) = (folder.path().join("scans"), folder.path().join("out"));
    fs::create_dir(&scans).unwrap();
    let mut true_name = BTreeMap::new();
    for file in files(&scene.join("scans")) {
        let hidden = format!("{}.ply", &blake3::hash(name(&file).as_bytes()).to_hex()[..12]);
        fs::copy(&file, scans.join(&hidden)).unwrap();
        true_name.insert(hidden, name(&file));
    }
    register(&[scans], &out, &[], 0);
    let named: BTreeMap<String, Value> =
        entries(&out).into_iter().map(|(hidden, entry)| (true_name[&hidden].clone(), entry)).collect();
    fs::write(folder.path().join("poses.json"), serde_json::to_string(&named).unwrap()).unwrap();
    folder
}

#[test]
fn the_3dmatch_scenes_reach_the_promised_recall_with_shuffled_names() {
    let Some(data) = real_data() else { return };
    let mut args: Vec<PathBuf> = vec!["evaluate".into(), "--json".into()];
    let mut results = Vec::new();
    for scene in files(&data.join("3dmatch")) {
        let result = register_shuffled(&scene);
        args.extend(["--estimate".into(), result.path().join("poses.json"), "--scene".into(), scene]);
        results.push(result);
    }
    let report: Value = serde_json::from_slice(&cairn(&args).stdout).unwrap();
    let recall = |index: usize| report["mean"][index]["recall"].as_f64().unwrap();
    eprintln!("mean recall {:.4} and {:.4}", recall(0), recall(1));
    assert!(recall(0) >= 0.97 && recall(1) >= 0.88, "{report:#}");
}

/// Registers a scene and expects every scan within a distance (metres) of its true place, in one component.
fn assert_registers_whole(scene: &Path, metres: f64) {
    let result = register_shuffled(scene);
    let tolerance = Tolerance { rotation_deg: 5.0, translation_m: metres };
    let truth = estimate(&scene.join("poses.json"));
    let report = against_truth(&estimate(&result.path().join("poses.json")), &truth, tolerance);
    assert_eq!((report.right, report.components.len()), (report.scans, 1), "{report:?}");
}

#[test]
fn raw_depth_frames_register_whole() {
    let Some(data) = real_data() else { return };
    assert_registers_whole(&data.join("rgbd/redkitchen_30x20"), 0.2);
}

#[test]
fn a_statue_registers_whole_without_a_flag() {
    let Some(data) = real_data() else { return };
    assert_registers_whole(&data.join("object/dragon_stand"), 0.02);
}

#[test]
fn calibration_gives_the_same_weights_at_any_number_of_threads_and_names_no_path() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("my-rooms");
    survey(&scene, Layout::Office, 3, 6);
    let run = |threads: &str| {
        let out = folder.path().join(threads);
        fs::create_dir(&out).unwrap();
        let file = |name: &str| out.join(name).into_os_string();
        let place = format!("home={}", scene.display());
        let words = ["calibrate", "--simulated", "house-panoramic,hall-panoramic", "--stations", "6", &place];
        let more = ["--leave-one-out", "--threads", threads, "--quiet", "--json"];
        let mut args: Vec<std::ffi::OsString> = words.iter().chain(&more).map(Into::into).collect();
        args.extend(["--out".into(), file("all.json"), "--out-dir".into(), out.clone().into_os_string()]);
        args.extend(["--diagram".into(), file("diagram.svg")]);
        let output = cairn(args);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        (out, output.stdout)
    };
    let ((one, report), (two, again)) = (run("1"), run("2"));
    assert_eq!(report, again);
    assert_eq!(
        files(&one).iter().map(|path| name(path)).collect::<Vec<_>>(),
        ["all.json", "diagram.svg", "simulated-only.json", "without-home.json"]
    );
    for path in files(&one) {
        assert_eq!(fs::read(&path).unwrap(), fs::read(two.join(name(&path))).unwrap());
    }
    let text = fs::read_to_string(one.join("all.json")).unwrap();
    assert!(!text.contains(folder.path().to_str().unwrap()), "the path of this machine is in the weights");
    let verifier = Verifier::parse(&text).unwrap();
    assert_eq!(
        verifier.provenance.command,
        "cairn calibrate --simulated house-panoramic,hall-panoramic --seed 7 --stations 6 home=my-rooms"
    );
    let scenes: Vec<&str> = verifier.provenance.scenes.iter().map(|scene| scene.name.as_str()).collect();
    assert_eq!(scenes, ["my-rooms", "house-panoramic", "hall-panoramic"]);
    assert!(verifier.provenance.scenes.iter().all(|scene| scene.right > 0 && scene.wrong > 0));
    let without = Verifier::parse(&fs::read_to_string(one.join("without-home.json")).unwrap()).unwrap();
    assert!(without.provenance.scenes.iter().all(|scene| scene.name != "my-rooms"));
    let report: Value = serde_json::from_slice(&report).unwrap();
    assert!(report["reliability"]["error"].as_f64().unwrap() < 0.3);
}

#[test]
fn calibration_says_what_a_folder_lacks() {
    let folder = tempfile::tempdir().unwrap();
    survey(folder.path(), Layout::Office, 3, 2);
    fs::remove_file(folder.path().join("poses.json")).unwrap();
    let scene = folder.path().to_str().unwrap();
    let output = cairn(["calibrate", "--simulated", "none", scene, "--out", "weights.json", "--quiet"]);
    assert_eq!(output.status.code(), Some(1));
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.contains("holds no truth: neither poses.json nor"), "{error}");
}
