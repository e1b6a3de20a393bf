//! The layers point downwards: every `crate::` path in the sources is an edge that the table allows.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// What each layer may use besides itself and `control`, which all may use. `*` is everything.
const ALLOWED: &[(&str, &[&str])] = &[
    ("control", &[]),
    ("geometry", &[]),
    ("cloud", &["geometry"]),
    ("features", &["geometry", "cloud"]),
    ("pairwise", &["geometry", "cloud", "features"]),
    ("graph", &["geometry", "cloud", "features", "pairwise"]),
    ("optimize", &["geometry"]),
    ("mapping", &["geometry", "cloud", "features", "pairwise", "graph", "optimize"]),
    ("baseline", &["geometry", "cloud", "features", "pairwise", "graph", "optimize"]),
    ("evaluate", &["geometry", "cloud"]),
    ("simulate", &["geometry", "cloud"]),
    ("calibrate", &["geometry", "cloud", "features", "pairwise", "graph", "simulate"]),
    ("project", &["geometry"]),
    ("storage", &["geometry", "project"]),
    (
        "jobs",
        &["geometry", "cloud", "features", "pairwise", "graph", "optimize", "mapping", "project", "storage"],
    ),
    ("http", &["geometry", "project", "storage", "jobs"]),
    ("cli", &["*"]),
    ("config", &["*"]),
    ("telemetry", &["*"]),
    ("app", &["*"]),
];

/// Crates of the service: the core, which is a function of its inputs, knows none of them.
const SERVICE_CRATES: &[&str] =
    &["tokio", "axum", "sqlx", "reqwest", "tower", "std::fs", "std::net", "SystemTime"];
const CORE: &[&str] = &[
    "control",
    "geometry",
    "cloud",
    "features",
    "pairwise",
    "graph",
    "optimize",
    "mapping",
    "baseline",
    "evaluate",
    "simulate",
    "calibrate",
];

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// (layer, file, text without its comments) of every source file except the crate root and the binary.
fn files() -> Vec<(String, PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut paths = Vec::new();
    sources(&root, &mut paths);
    let mut files = Vec::new();
    for path in paths {
        let inside = path.strip_prefix(&root).unwrap();
        let first = inside.components().next().unwrap().as_os_str().to_str().unwrap();
        let layer = first.trim_end_matches(".rs").to_owned();
        if layer == "lib" || layer == "main" {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        let code: Vec<&str> = text.lines().map(|l| l.split("//").next().unwrap_or("")).collect();
        files.push((layer, inside.to_owned(), code.join("\n")));
    }
    files
}

/// Whether a file of this name holds unit tests, or what they share, and nothing else.
fn is_of_tests(name: &str) -> bool {
    name == "tests.rs" || name.starts_with("test_")
}

/// The modules that follow `crate::` in a text, braces included.
fn used(code: &str) -> Vec<String> {
    let mut modules = Vec::new();
    for (at, path) in code.match_indices("crate::") {
        let rest = &code[at + path.len()..];
        let list = rest
            .strip_prefix('{')
            .map_or_else(|| vec![rest], |inner| inner.split('}').next().unwrap_or("").split(',').collect());
        for item in list {
            let word: String = item.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
            if !word.is_empty() {
                modules.push(word);
            }
        }
    }
    modules
}

#[test]
fn every_path_between_layers_is_an_edge_of_the_table() {
    let table: BTreeMap<&str, &[&str]> = ALLOWED.iter().copied().collect();
    let mut wrong = Vec::new();
    for (layer, file, code) in files() {
        let allowed =
            table.get(layer.as_str()).unwrap_or_else(|| panic!("layer {layer} is not in the table"));
        // Unit tests may also simulate what they test on, and so may files that only they use.
        let only_tests = file.file_name().and_then(|name| name.to_str()).is_some_and(is_of_tests);
        let start = if only_tests { Some(0) } else { code.find("#[cfg(test)]") };
        let (code, tests) = code.split_at(start.unwrap_or(code.len()));
        let in_tests = used(tests).into_iter().filter(|module| module != "simulate");
        for module in used(code).into_iter().chain(in_tests) {
            let fine = module == layer || module == "control" || allowed.contains(&"*");
            if !fine && !allowed.contains(&module.as_str()) {
                wrong.push(format!("{}: {layer} may not use {module}", file.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_core_knows_no_runtime_socket_database_file_or_clock() {
    let mut wrong = Vec::new();
    for (layer, file, code) in files() {
        let code = code.split("#[cfg(test)]").next().unwrap_or("");
        if CORE.contains(&layer.as_str()) {
            let found = SERVICE_CRATES.iter().filter(|name| code.contains(*name));
            wrong.extend(found.map(|name| format!("{} names {name}", file.display())));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn paths_are_found_alone_and_in_braces() {
    assert_eq!(used("use crate::cloud::PointCloud;"), ["cloud"]);
    assert_eq!(used("use crate::{app, telemetry};\nlet x = crate::jobs::f();"), ["app", "telemetry", "jobs"]);
}
