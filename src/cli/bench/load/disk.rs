//! What the disk does alone: large blocks, each synced before the next, as `dd bs=64M oflag=dsync` writes them.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Instant;

const BLOCK: usize = 64 << 20;

/// Writes so many mebibytes into a file of the directory and removes it. Returns megabytes a second.
pub(super) fn write(folder: &Path, mebibytes: usize) -> anyhow::Result<f64> {
    let path = folder.join("bench-load.blocks");
    let dsync = rustix::fs::OFlags::DSYNC.bits() as i32;
    let mut file =
        OpenOptions::new().write(true).create(true).truncate(true).custom_flags(dsync).open(&path)?;
    let block = vec![0x5a; BLOCK];
    let (total, begun) = (mebibytes << 20, Instant::now());
    let mut left = total;
    while left > 0 {
        let now = left.min(BLOCK);
        file.write_all(block.get(..now).unwrap_or(&block))?;
        left -= now;
    }
    let seconds = begun.elapsed().as_secs_f64();
    fs::remove_file(path)?;
    Ok(total as f64 / 1e6 / seconds)
}
