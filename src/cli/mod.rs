//! The command line: one file a subcommand.

pub mod evaluate;
pub mod simulate;
