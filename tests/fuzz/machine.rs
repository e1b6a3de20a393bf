//! What the machine gave: the address space the process has ever had (a parser that believes a count and reserves room for
//! it shows here, even if it never touches that room), and the processor's time, so that a busy machine shortens no campaign.

use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// More than the parsers together need, less than one that reserves what a hostile header asks for.
const LIMIT_KB: u64 = 3 << 20;

/// Asserts that no parser has asked for gigabytes so far. Where the system does not tell, nothing is known.
pub fn check(what: &str) {
    let Ok(status) = std::fs::read_to_string("/proc/self/status") else { return };
    let peak = status
        .lines()
        .find_map(|line| line.strip_prefix("VmPeak:"))
        .and_then(|rest| rest.trim().strip_suffix(" kB").and_then(|number| number.parse::<u64>().ok()));
    let Some(peak) = peak else { return };
    assert!(peak < LIMIT_KB, "the address space has grown to {peak} kB within the last inputs of {what}");
}

/// Processor time of the calling thread; where the system does not tell, the time that has passed.
pub fn processor_time() -> Duration {
    static BEGUN: LazyLock<Instant> = LazyLock::new(Instant::now);
    let begun = *BEGUN;
    std::fs::read_to_string("/proc/thread-self/schedstat")
        .ok()
        .and_then(|text| text.split_whitespace().next()?.parse().ok())
        .map_or_else(|| begun.elapsed(), Duration::from_nanos)
}
