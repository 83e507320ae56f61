//! Time measurement for the examples.

/// Processor time of this thread, milliseconds. Other load of the machine affects it only through
/// shared caches and memory. Wall-clock time on systems without it.
#[cfg(unix)]
pub fn busy_ms() -> f64 {
    let busy = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    1e3 * busy.tv_sec as f64 + 1e-6 * busy.tv_nsec as f64
}

/// Wall-clock time, milliseconds, as a fallback.
#[cfg(not(unix))]
pub fn busy_ms() -> f64 {
    static BEGUN: std::sync::LazyLock<std::time::Instant> = std::sync::LazyLock::new(std::time::Instant::now);
    1e3 * BEGUN.elapsed().as_secs_f64()
}
