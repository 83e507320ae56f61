//! Which frames are looked at.

use std::ops::Range;

/// Number of stretches, and the consecutive frames of each: two and a half seconds at 30 frames per
/// second, in which most drives show a tilt.
const STRETCHES: u64 = 4;
const LENGTH: u64 = 75;

/// Frames that are passed at most, five minutes at 30 per second: a video is decoded from its
/// beginning.
const MOST_PASSED: u64 = 9000;

/// Distance of the stretches of a recording that does not state its length.
const STEP_WHERE_UNKNOWN: u64 = 4 * LENGTH;

/// Stretches of a recording of this many frames, by their indices.
pub fn of(frames: Option<u64>) -> Vec<Range<u64>> {
    let step = match frames.map(|frames| frames.min(MOST_PASSED)) {
        // The number may be an estimate: more frames are looked at where there are more.
        Some(frames) if frames <= STRETCHES * LENGTH => {
            return std::iter::once(0..STRETCHES * LENGTH).collect();
        }
        Some(frames) => (frames - LENGTH) / (STRETCHES - 1),
        None => STEP_WHERE_UNKNOWN,
    };
    (0..STRETCHES).map(|k| k * step..k * step + LENGTH).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretches_are_spread_over_the_recording_and_bounded() {
        assert_eq!(of(Some(40)).iter().map(|one| (one.start, one.end)).collect::<Vec<_>>(), [(0, 300)]);
        assert_eq!(of(Some(1083)), vec![0..75, 336..411, 672..747, 1008..1083]);
        for frames in [None, Some(301), Some(u64::MAX)] {
            let stretches = of(frames);
            assert_eq!(stretches.iter().map(|one| one.end - one.start).sum::<u64>(), 300, "{frames:?}");
            assert!(stretches.windows(2).all(|pair| pair[0].end <= pair[1].start), "{stretches:?}");
            assert!(stretches.last().is_some_and(|last| last.end <= MOST_PASSED), "{stretches:?}");
        }
    }
}
