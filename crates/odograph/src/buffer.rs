//! Lists whose memory is used again: what one frame's tracks filled, the next frame's fill.
//!
//! A frame needs a handful of lists of a few hundred entries each, for a millisecond. Handing each of them down as a buffer of the caller's
//! would make every step of the pipeline know the insides of the next; taken from the system anew, they would be the only memory that a
//! frame between keyframes asks for.

use std::cell::RefCell;
use std::ops::{Deref, DerefMut};

/// A list that goes back to its thread's store when it is dropped; otherwise a `Vec`.
#[derive(Debug, Clone, PartialEq)]
pub struct Buffer<T: Stored>(Vec<T>);

/// What lists are kept of. Implemented by [`stored!`].
pub trait Stored: Sized {
    /// Does something with the lists that wait in this thread; nothing where the thread is ending.
    fn with_store<R>(work: impl FnOnce(&mut Vec<Vec<Self>>) -> R) -> Option<R>;
}

/// At most so many lists of a kind wait in a thread.
const MOST_WAITING: usize = 8;

/// Keeps lists of these types.
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

/// For [`stored!`].
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
    /// An empty list, with the memory of an earlier one.
    pub fn new() -> Self {
        Self(T::with_store(Vec::pop).flatten().unwrap_or_default())
    }

    /// A list of `count` times the same.
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
            if waiting.len() < MOST_WAITING {
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
    fn a_list_has_the_memory_of_the_one_before_and_nothing_of_what_was_in_it() {
        let first: Buffer<f64> = (0..1000).map(f64::from).collect();
        let memory = first.as_ptr();
        drop(first);
        let second: Buffer<f64> = std::iter::once(7.0).collect();
        assert_eq!(second.as_ptr(), memory);
        assert_eq!(**second, [7.0]);
        assert_eq!(**Buffer::of(true, 3), [true; 3]);
    }
}
