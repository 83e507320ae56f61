//! Reusable buffers: a thread-local free list of `Vec`s whose capacity survives from frame to
//! frame.
//!
//! A frame needs a few lists of a few hundred entries each for about a millisecond. Passing buffers
//! down from the caller would expose the internals of every stage to the next. Allocating them anew
//! would be the only heap allocations of a frame between keyframes.

use std::cell::RefCell;
use std::ops::{Deref, DerefMut};

/// A `Vec` that returns to the free list of its thread when it is dropped.
#[derive(Debug, Clone, PartialEq)]
pub struct Buffer<T: Stored>(Vec<T>);

/// Element types that have a free list. Implemented by [`stored!`].
pub trait Stored: Sized {
    /// Calls `work` with the free list of this thread; `None` while the thread is being destroyed.
    fn with_store<R>(work: impl FnOnce(&mut Vec<Vec<Self>>) -> R) -> Option<R>;
}

/// Maximum length of the free list of one type in one thread.
const MAX_WAITING: usize = 8;

/// Implements [`Stored`] for each of the given types, with one thread-local free list per type.
macro_rules! stored {
    ($($kind:ty),* $(,)?) => { $(
        impl $crate::buffer::Stored for $kind {
            fn with_store<R>(work: impl FnOnce(&mut Vec<Vec<Self>>) -> R) -> Option<R> {
                thread_local! {
                    static WAITING: std::cell::RefCell<Vec<Vec<$kind>>> = const { std::cell::RefCell::new(Vec::new()) };
                }
                $crate::buffer::with(&WAITING, work)
            }
        }
    )* };
}
pub(crate) use stored;

stored!(bool, f64, usize);

/// Accesses the thread-local free list for [`stored!`]. `None` where it is destroyed or already
/// borrowed.
pub(crate) fn with<T, R>(
    waiting: &'static std::thread::LocalKey<RefCell<Vec<Vec<T>>>>,
    work: impl FnOnce(&mut Vec<Vec<T>>) -> R,
) -> Option<R> {
    waiting
        .try_with(|waiting| waiting.try_borrow_mut().ok().map(|mut waiting| work(&mut waiting)))
        .ok()
        .flatten()
}

impl<T: Stored> Buffer<T> {
    /// An empty list. Takes its capacity from the free list where one is available.
    pub fn new() -> Self {
        Self(T::with_store(Vec::pop).flatten().unwrap_or_default())
    }

    /// A list of `count` copies of `value`.
    pub fn of(value: T, count: usize) -> Self
    where
        T: Clone,
    {
        let mut buffer = Self::new();
        buffer.resize(count, value);
        buffer
    }
}

impl<T: Stored> Default for Buffer<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Stored> Drop for Buffer<T> {
    fn drop(&mut self) {
        let mut list = std::mem::take(&mut self.0);
        if list.capacity() == 0 {
            return;
        }
        list.clear();
        let _ = T::with_store(|waiting| {
            if waiting.len() < MAX_WAITING {
                waiting.push(list);
            }
        });
    }
}

impl<T: Stored> Deref for Buffer<T> {
    type Target = Vec<T>;

    fn deref(&self) -> &Vec<T> {
        &self.0
    }
}

impl<T: Stored> DerefMut for Buffer<T> {
    fn deref_mut(&mut self) -> &mut Vec<T> {
        &mut self.0
    }
}

impl<T: Stored> FromIterator<T> for Buffer<T> {
    fn from_iter<I: IntoIterator<Item = T>>(items: I) -> Self {
        let mut buffer = Self::new();
        buffer.extend(items);
        buffer
    }
}

impl<'a, T: Stored> IntoIterator for &'a Buffer<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_list_reuses_memory_but_not_contents() {
        let first: Buffer<f64> = (0..1000).map(f64::from).collect();
        let memory = first.as_ptr();
        drop(first);
        let second: Buffer<f64> = std::iter::once(7.0).collect();
        assert_eq!(second.as_ptr(), memory);
        assert_eq!(**second, [7.0]);
        assert_eq!(**Buffer::of(true, 3), [true; 3]);
    }
}
