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

/// A fixed workload, timed piece by piece between the frames: times are compared in multiples of
/// it, so that a slower or a busier machine is no regression.
///
/// It does what a frame does: it halves an image, samples patches between its pixels and computes
/// in `f64`. It uses nothing of the library, so that no change of the library changes the unit.
///
/// Vectors of 256 bits, which only the tracker uses, cost up to twice as much where the processor
/// computes them in two halves; ratios to an earlier such workload were 1.5 times as large there.
/// The baseline is from such a processor.
#[derive(Debug)]
pub struct Reference {
    image: Vec<u8>,
    half: Vec<u8>,
    /// Total time of the pieces so far, milliseconds.
    total_ms: f64,
    /// Number of pieces so far.
    pieces: usize,
}

/// Size of the image of the workload.
const WIDTH: usize = 640;
const HEIGHT: usize = 480;

/// Side of a sampled patch, and number of patches per piece.
const PATCH: usize = 16;
const PATCHES: usize = 400;

/// Pieces that make one unit.
const PIECES: f64 = 8.0;

impl Default for Reference {
    fn default() -> Self {
        let sample = |i: u32| i.wrapping_mul(2_654_435_761).to_be_bytes()[0];
        Self {
            image: (0..WIDTH * HEIGHT).map(|i| sample(i as u32)).collect(),
            half: vec![0; WIDTH / 2 * (HEIGHT / 2)],
            total_ms: 0.0,
            pieces: 0,
        }
    }
}

impl Reference {
    /// Does one piece of the workload, and adds its time.
    pub fn time_a_piece(&mut self) {
        let begun = busy_ms();
        piece(black_box(&self.image), &mut self.half);
        black_box(&self.half);
        self.total_ms += busy_ms() - begun;
        self.pieces += 1;
    }

    /// Mean time of the workload, milliseconds; NaN before the first piece.
    pub fn mean_ms(&self) -> f64 {
        PIECES * self.total_ms / self.pieces as f64
    }
}

fn piece(image: &[u8], half: &mut [u8]) {
    for (rows, out) in image.chunks_exact(2 * WIDTH).zip(half.chunks_exact_mut(WIDTH / 2)) {
        let (upper, lower) = rows.split_at(WIDTH);
        for (x, out) in out.iter_mut().enumerate() {
            let four = [upper[2 * x], upper[2 * x + 1], lower[2 * x], lower[2 * x + 1]];
            *out = (four.iter().map(|&sample| u16::from(sample)).sum::<u16>() / 4) as u8;
        }
    }
    let mut sums = [0.0f32; PATCH];
    for i in 0..PATCHES {
        let (left, top) = (i * 151 % (WIDTH - PATCH - 1), i * 97 % (HEIGHT - PATCH - 1));
        let part = i as f32 / PATCHES as f32;
        for y in top..top + PATCH {
            let row = |y: usize| &image[y * WIDTH + left..][..PATCH + 1];
            let (upper, lower) = (row(y), row(y + 1));
            for (x, sum) in sums.iter_mut().enumerate() {
                let along = |row: &[u8]| {
                    let [here, next] = [row[x], row[x + 1]].map(f32::from);
                    here + part * (next - here)
                };
                let (above, below) = (along(upper), along(lower));
                let sample = above + part * (below - above);
                *sum += sample * sample;
            }
        }
    }
    black_box(sums);
    let mut sum = 0.0f64;
    for i in 0..10_000 {
        sum = (sum * 0.999 + f64::from(i) * 1e-6).sqrt();
    }
    black_box(sum);
}

/// Peak resident memory of this process so far, megabytes; `None` if the system does not report it.
pub fn peak_memory_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: f64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kilobytes / 1024.0)
}
