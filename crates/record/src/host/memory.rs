// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much memory this process may still take.

use std::fs;
use std::path::Path;

/// Bytes that can be had without swapping: by the kernel's estimate, and by the limit of this process' control group.
/// `None` where the system does not report it.
pub fn available() -> Option<u64> {
    let of_host = bytes_of("MemAvailable:", &fs::read_to_string("/proc/meminfo").ok()?)?;
    let of_group = fs::read_to_string("/proc/self/cgroup").ok().and_then(|text| {
        let group = text.lines().find_map(|line| line.strip_prefix("0::/"))?;
        let dir = Path::new("/sys/fs/cgroup").join(group);
        let number = |name: &str| fs::read_to_string(dir.join(name)).ok()?.trim().parse::<u64>().ok();
        Some(number("memory.max")?.saturating_sub(number("memory.current")?))
    });
    Some(of_group.map_or(of_host, |of_group| of_group.min(of_host)))
}

/// Bytes behind a key in a text of `/proc`, such as `MemAvailable:` of `/proc/meminfo`.
pub(super) fn bytes_of(key: &str, text: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    line.trim().trim_end_matches("kB").trim().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::{available, bytes_of};

    #[test]
    fn the_kernel_says_it_in_kib() {
        let text = "MemTotal:       24617232 kB\nMemFree:  1 kB\nMemAvailable:   20480 kB\n";
        assert_eq!(bytes_of("MemAvailable:", text), Some(20 << 20));
        assert_eq!(bytes_of("MemAvailable:", "MemTotal: 3 kB\n"), None);
        assert_eq!(bytes_of("MemAvailable:", "MemAvailable: much\n"), None);
        assert!(available().is_none_or(|bytes| bytes > 1 << 20));
    }
}
