//! The command line: one file a subcommand.

pub mod evaluate;
pub mod openapi;
pub mod serve;
pub mod simulate;
