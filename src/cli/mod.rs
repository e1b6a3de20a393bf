//! The command line: one file or folder a subcommand.

pub mod backup;
pub mod bench;
pub mod calibrate;
pub mod check;
pub mod demo;
pub mod evaluate;
pub mod key;
pub mod openapi;
mod progress;
pub mod register;
pub mod serve;
mod signals;
pub mod simulate;
mod truth;
pub mod work;
