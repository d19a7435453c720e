//! How much memory the rows of a data set may take. No number depends on it: rows give the same bits from memory and from a file.

use std::{fs, path::PathBuf};

/// Of the memory that is free, the rows of a data set may take one part in so many; the rest is for networks and for other programs.
const SHARE: u64 = 2;
/// Where the system does not say how much is free.
const UNKNOWN_BYTES: u64 = 8 << 30;

/// Where rows may be kept.
#[derive(Clone, Debug)]
pub struct Room {
    /// Rows that take more than this are kept in a file.
    pub memory_bytes: u64,
    /// Folder for that file; made where it is not there.
    pub scratch: PathBuf,
}

impl Room {
    /// `memory_mib` MiB, by default half of the memory that is free, and files in `scratch`.
    pub fn new(memory_mib: Option<u64>, scratch: PathBuf) -> Self {
        let bytes = memory_mib.map_or_else(|| free_bytes() / SHARE, |mib| mib.saturating_mul(1 << 20));
        Self { memory_bytes: bytes, scratch }
    }
}

impl Default for Room {
    /// Half of the memory that is free, and the folder for temporary files.
    fn default() -> Self {
        Self::new(None, std::env::temp_dir())
    }
}

/// What the machine has left, or the container where that is less.
fn free_bytes() -> u64 {
    let machine = fs::read_to_string("/proc/meminfo").ok().and_then(|text| available(&text));
    let number = |name: &str| fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok()?.trim().parse::<u64>().ok();
    let container = number("memory.max").zip(number("memory.current")).map(|(max, current)| max.saturating_sub(current));
    machine.into_iter().chain(container).min().unwrap_or(UNKNOWN_BYTES)
}

/// `MemAvailable` of /proc/meminfo, bytes.
fn available(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_what_is_free_unless_told() {
        let text = "MemTotal:       24689764 kB\nMemFree:         1024 kB\nMemAvailable:    2048 kB\n";
        assert_eq!(available(text), Some(2 << 20));
        assert_eq!(available("MemTotal: 1 kB\n"), None);
        assert_eq!(Room::new(Some(3), PathBuf::new()).memory_bytes, 3 << 20);
        assert!(Room::default().memory_bytes > 0);
    }
}
