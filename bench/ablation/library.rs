//! Overrides of one constant or one branch at a time, for `bench/ablation.py`.

use std::sync::atomic::{AtomicU8, AtomicU64, AtomicUsize, Ordering::Relaxed};

/// Which constant or branch is overridden; `usize::MAX` for none.
pub static CURRENT: AtomicUsize = AtomicUsize::new(usize::MAX);
/// The bits of the factor on a constant; a branch is taken where the factor is positive.
pub static FACTOR: AtomicU64 = AtomicU64::new(0);
/// What was reached: 1 for a constant or a branch that was taken, 2 for a branch that was not.
pub static REACHED: [AtomicU8; COUNT] = [const { AtomicU8::new(0) }; COUNT];

/// A number type of tuned constants.
pub trait Tuned: Copy {
    /// The value multiplied by the factor.
    fn times(self, factor: f64) -> Self;
}

macro_rules! tuned {
    ($($kind:ty)*) => {$(
        impl Tuned for $kind {
            fn times(self, factor: f64) -> Self {
                (self as f64 * factor) as $kind
            }
        }
    )*};
}
tuned!(f64 f32 usize u64 u32 i64 i32 u8);

fn mark(id: usize, bit: u8) {
    if REACHED[id].load(Relaxed) & bit == 0 {
        REACHED[id].fetch_or(bit, Relaxed);
    }
}

fn factor() -> f64 {
    f64::from_bits(FACTOR.load(Relaxed))
}

/// The value of a constant.
#[inline]
pub fn value<T: Tuned>(id: usize, value: T) -> T {
    mark(id, 1);
    if CURRENT.load(Relaxed) == id { value.times(factor()) } else { value }
}

/// The outcome of a condition.
#[inline]
pub fn branch(id: usize, holds: bool) -> bool {
    mark(id, if holds { 1 } else { 2 });
    if CURRENT.load(Relaxed) == id { factor() > 0.0 } else { holds }
}
