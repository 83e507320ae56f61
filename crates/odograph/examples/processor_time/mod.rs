//! What the examples measure speed with.

/// Time that this thread has had a processor for, milliseconds: on a busy machine what is measured costs no more than on an idle one, but for memory that
/// others use too. Where the system does not tell it, time on the clock.
#[cfg(unix)]
pub fn busy_ms() -> f64 {
    let busy = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    1e3 * busy.tv_sec as f64 + 1e-6 * busy.tv_nsec as f64
}

/// Time on the clock, milliseconds, for want of that.
#[cfg(not(unix))]
pub fn busy_ms() -> f64 {
    static BEGUN: std::sync::LazyLock<std::time::Instant> = std::sync::LazyLock::new(std::time::Instant::now);
    1e3 * BEGUN.elapsed().as_secs_f64()
}
