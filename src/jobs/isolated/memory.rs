//! How much memory a process takes, where the system tells: Linux, from `/proc`.

use std::fs;

/// Memory that a process takes at this moment, bytes; `None` where the system does not tell, or when the process is gone.
pub(super) fn taken_by(process: u32) -> Option<u64> {
    resident_in(&fs::read_to_string(format!("/proc/{process}/status")).ok()?)
}

/// What is resident of a process, in the text of its `/proc/…/status`, bytes.
fn resident_in(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    kibibytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_resident_is_read_in_bytes() {
        assert_eq!(resident_in("Name:\tcairn\nVmHWM:\t 9 kB\nVmRSS:\t   12345 kB\n"), Some(12345 * 1024));
        assert_eq!(resident_in("VmRSS:\t? kB\n"), None);
        assert_eq!(resident_in(""), None);
    }
}
