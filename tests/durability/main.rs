//! The promise to those who upload, kept by the real binary: killed, on disks that fail or fill up, with scans that crash it, with jobs
//! that are dismissed, with files that rot, and with data that an older program wrote.

mod disk;
mod dismissal;
mod first_schema;
mod kill;
mod once;
mod poison;
mod process;
mod resident;
#[path = "../shared/room.rs"]
mod room;
mod subjects;
mod tus;
mod upkeep;
