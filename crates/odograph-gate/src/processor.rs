//! Processor time, and its reference unit.

use std::hint::black_box;

/// Processor time of this thread, milliseconds. Other load affects it only through the caches.
#[cfg(unix)]
pub fn busy_ms() -> f64 {
    let busy = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    1e3 * busy.tv_sec as f64 + 1e-6 * busy.tv_nsec as f64
}

/// Wall-clock time, milliseconds, on systems without per-thread processor time.
#[cfg(not(unix))]
pub fn busy_ms() -> f64 {
    static BEGUN: std::sync::LazyLock<std::time::Instant> = std::sync::LazyLock::new(std::time::Instant::now);
    1e3 * BEGUN.elapsed().as_secs_f64()
}

/// Time of a fixed workload on this thread, milliseconds: image downsampling and scalar arithmetic,
/// as in a frame. Times are compared in multiples of it, so that a slower machine is no regression.
/// It uses nothing of the library, so that no change of the library changes the unit.
pub fn reference_ms() -> f64 {
    let (width, height) = (640, 480);
    let sample = |i: u32| i.wrapping_mul(2_654_435_761).to_be_bytes()[0];
    let image: Vec<u8> = (0..width * height).map(|i| sample(i as u32)).collect();
    let mut half = vec![0u8; width / 2 * (height / 2)];
    let mut best = f64::INFINITY;
    for _ in 0..9 {
        let begun = busy_ms();
        for _ in 0..8 {
            for (rows, out) in black_box(&image).chunks_exact(2 * width).zip(half.chunks_exact_mut(width / 2))
            {
                let (upper, lower) = rows.split_at(width);
                for (x, out) in out.iter_mut().enumerate() {
                    let four = [upper[2 * x], upper[2 * x + 1], lower[2 * x], lower[2 * x + 1]];
                    *out = (four.iter().map(|&sample| u16::from(sample)).sum::<u16>() / 4) as u8;
                }
            }
            black_box(&half);
        }
        let mut sum = 0.0f64;
        for i in 0..200_000 {
            sum = (sum * 0.999 + f64::from(i) * 1e-6).sqrt();
        }
        black_box(sum);
        best = best.min(busy_ms() - begun);
    }
    best
}

/// Peak resident memory of this process so far, megabytes; `None` if the system does not report it.
pub fn peak_memory_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kilobytes / 1024.0)
}
