//! Cairn fits many 3-D scans of one place into one model.
//!
//! The crate is built in layers that point downwards only (a test reads the `crate::` paths and fails on a
//! wrong edge). The **core**, from [`control`] to [`calibrate`], is a function of its inputs: no async runtime, socket,
//! database, file, clock or global random source. The **service**, from [`project`] up, keeps projects of scans
//! on disk, runs the core on them in jobs, and answers HTTP. `ARCHITECTURE.md` tells how the two meet.

// What a stranger sends must not stop the service; tests may stop at the first surprise (`clippy.toml`).
#![warn(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

pub mod control;
pub mod geometry;

pub mod cloud;

pub mod features;

pub mod pairwise;

pub mod graph;

pub mod optimize;

pub mod mapping;

pub mod baseline;

pub mod evaluate;
pub mod simulate;

pub mod calibrate;

pub mod project;

pub mod storage;

pub mod jobs;

pub mod http;

pub mod app;
pub mod cli;
pub mod config;
pub mod telemetry;
