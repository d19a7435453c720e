//! Settings that libraries read once, before `main` could set them safely: a program that lacks one starts itself anew with it.

use std::{env, io, os::unix::process::CommandExt, process::Command};

/// The programs have threads of their own, each with whole operations: candle and rayon are to use one. (candle reads `/proc/cpuinfo`
/// anew for every product otherwise.)
pub const ONE_THREAD_EACH: [(&str, &str); 2] = [("RAYON_NUM_THREADS", "1"), ("CANDLE_NUM_THREADS", "1")];

/// For the C library's allocator. A training step asks for the same large blocks as the one before; given back in between, each would be
/// cleared by the system anew (a quarter of a step of the DiT).
pub const KEEP_MEMORY: [(&str, &str); 3] =
    [("MALLOC_MMAP_THRESHOLD_", "1073741824"), ("MALLOC_TRIM_THRESHOLD_", "4294967296"), ("MALLOC_TOP_PAD_", "67108864")];

/// Goes on if every variable is set, to whatever value; otherwise this program begins again, with the same arguments and these values for
/// what was missing.
///
/// # Errors
/// If the system does not start it; it can go on without.
pub fn with_environment(variables: &[(&str, &str)]) -> io::Result<()> {
    let missing: Vec<_> = variables.iter().filter(|(name, _)| env::var_os(name).is_none()).copied().collect();
    if missing.is_empty() {
        return Ok(());
    }
    Err(Command::new(env::current_exe()?).args(env::args_os().skip(1)).envs(missing).exec())
}
