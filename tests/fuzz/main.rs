//! Fuzzing on stable Rust: every parser that outside input can reach, fed with damaged variants of good and of once
//! troublesome inputs (`corpus/`), and checked for what it promises: no panic, no runaway memory, and the laws in `targets`.
//!
//! `cargo test --test fuzz` is the short form: some thousand inputs a parser, the same every time. The long form runs each
//! for a time, from a seed of its own:
//!
//! ```sh
//! CAIRN_FUZZ_MINUTES=30 CAIRN_FUZZ_SEED=$RANDOM cargo test --release --test fuzz -- --nocapture --test-threads 2 pcd
//! ```
//!
//! An input that breaks a promise is written to `target/tmp/`, and its path is in the message: add it to the corpus of its parser
//! when the fault is fixed, and it is tried first ever after. With `CAIRN_FUZZ_KEEP=1` inputs that lead to an answer that no
//! other has led to are added to the corpus by themselves.

mod corpus;
mod engine;
mod machine;
mod mutate;
mod targets;

use engine::fuzz;

#[test]
fn ply() {
    fuzz("ply", &targets::PLY, targets::scan);
}

#[test]
fn pcd() {
    fuzz("pcd", &targets::PCD, targets::scan);
}

#[test]
fn text() {
    fuzz("text", &targets::TEXT, targets::scan);
}

#[test]
fn decoded_scans_are_prepared() {
    fuzz("prepare", &targets::TEXT, targets::prepared);
}

#[test]
fn poses() {
    fuzz("poses", &targets::POSES, targets::poses);
}

#[test]
fn motions_of_decisions() {
    fuzz("motion", &targets::JSON, targets::motion_of_decision);
}

#[test]
fn upload_headers() {
    fuzz("headers", &targets::HEADERS, targets::headers);
}

#[test]
fn model_snapshots() {
    fuzz("snapshot", &[], targets::snapshot);
}

#[test]
fn prepared_scans() {
    fuzz("prepared", &[], targets::prepared_scan);
}
