//! How much address space the process has ever had: a parser that believes a count and reserves room for it shows here, even
//! if it never touches that room.

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
