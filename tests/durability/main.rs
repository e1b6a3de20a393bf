//! The promise to those who upload, kept by the real binary: killed, on disks that fail or fill up, with scans that crash it, with files
//! that rot, and with data that an older program wrote.

mod disk;
mod first_schema;
mod kill;
mod poison;
mod process;
mod upkeep;
