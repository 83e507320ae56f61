//! Fuzz test: decodes damaged copies of recordings and prints the outcome:
//!
//! `ODOGRAPH_FFMPEG= cargo run --release -p odograph-video --example damage -- 300 drive.mp4 …`.
//!
//! Each copy has bytes changed, ranges overwritten or moved, or is truncated, all from a fixed
//! seed. A panic, or a copy that takes more than 20 seconds, ends the program with the number of
//! the copy, which remains as `odograph-damaged-*` in the temporary folder.

#![allow(clippy::print_stdout)]

use odograph::error::{Error, Result};
use odograph_video::{SourceOptions, open};
use std::path::{Path, PathBuf};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

/// SplitMix64 by Sebastiano Vigna.
struct DamageRandom(u64);

impl DamageRandom {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound.max(1) as u64) as usize
    }
}

fn damaged(original: &[u8], random: &mut DamageRandom) -> Vec<u8> {
    let mut bytes = original.to_vec();
    // Half of the damage is in the header, where sizes and counts are.
    let reach = if random.below(2) == 0 { bytes.len().min(4096) } else { bytes.len() };
    for _ in 0..1 + random.below(4) {
        match random.below(6) {
            0..=2 => {
                for _ in 0..1 + random.below(16) {
                    let at = random.below(reach);
                    bytes[at] = random.next() as u8;
                }
            }
            3 => {
                let (at, length) = (random.below(reach), random.below(256));
                let end = (at + length).min(bytes.len());
                bytes[at..end].fill([0, 0xff][random.below(2)]);
            }
            4 => {
                let (from, to, length) = (random.below(bytes.len()), random.below(reach), random.below(512));
                let length = length.min(bytes.len() - from).min(bytes.len() - to);
                bytes.copy_within(from..from + length, to);
            }
            _ => {
                let end = random.below(bytes.len());
                bytes.truncate(end.max(64).min(bytes.len()));
                return bytes;
            }
        }
    }
    bytes
}

fn decode(path: &Path) -> Result<(u64, usize)> {
    let mut source =
        open(path, &SourceOptions { max_frames: Some(150), color: true, ..SourceOptions::default() })?;
    let mut frames = 0;
    while let Some(frame) = source.next_frame()? {
        frames += 1;
        std::hint::black_box(frame.rgb());
    }
    Ok((frames, source.take_warnings().len()))
}

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let count: u64 =
        arguments.next().and_then(|n| n.parse().ok()).ok_or_else(|| Error::usage("how many copies?"))?;
    for path in arguments.map(PathBuf::from) {
        let original = std::fs::read(&path).map_err(|error| Error::input(error.to_string()))?;
        let extension = path.extension().unwrap_or_default().to_string_lossy().into_owned();
        let copy = std::env::temp_dir().join(format!("odograph-damaged-{}.{extension}", std::process::id()));
        let (mut whole, mut warned, mut refused, mut slowest) = (0, 0, 0, (0.0, 0));
        for number in 0..count {
            let bytes = damaged(&original, &mut DamageRandom(number));
            std::fs::write(&copy, bytes).map_err(|error| Error::output(error.to_string()))?;
            let (sender, receiver) = channel();
            let (start, file) = (Instant::now(), copy.clone());
            std::thread::spawn(move || sender.send(decode(&file)));
            match receiver.recv_timeout(Duration::from_secs(20)) {
                Ok(Ok((_, 0))) => whole += 1,
                Ok(Ok(_)) => warned += 1,
                Ok(Err(error)) if !error.to_string().contains('\n') => refused += 1,
                Ok(Err(error)) => return Err(error),
                Err(why) => return Err(Error::input(format!("{} number {number}: {why}", path.display()))),
            }
            let seconds = start.elapsed().as_secs_f64();
            if seconds > slowest.0 {
                slowest = (seconds, number);
            }
        }
        println!(
            "{}: {whole} decoded, {warned} with a warning, {refused} refused, slowest {:.1} s (number {})",
            path.display(),
            slowest.0,
            slowest.1
        );
    }
    Ok(())
}
