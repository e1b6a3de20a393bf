//! The peak of the process's memory, where the system tells: Linux, from `/proc/self`.

use std::fs;

/// Forgets the peak so far, so that the next one is that of what follows. Where the system does not allow it, peaks only grow.
pub(super) fn forget_peak() {
    // 5 resets the high-water mark of the resident set (proc(5)); nothing depends on it.
    let _ = fs::write("/proc/self/clear_refs", "5");
}

/// The most bytes that were resident at once, `None` where the system does not tell.
pub(super) fn peak_bytes() -> Option<u64> {
    peak_in(&fs::read_to_string("/proc/self/status").ok()?)
}

/// The peak in the text of a process's `/proc/…/status`, bytes.
pub(super) fn peak_in(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    kilobytes.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_read_in_bytes() {
        assert_eq!(peak_in("Name:\tcairn\nVmPeak:\t 9 kB\nVmHWM:\t   12345 kB\n"), Some(12345 * 1024));
        assert_eq!(peak_in("VmHWM:\t? kB\n"), None);
        assert_eq!(peak_in(""), None);
    }
}
