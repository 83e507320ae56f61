//! A bounded queue between two threads that can drop its oldest items.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Behaviour of a full queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The producer blocks; nothing is lost.
    Wait,
    /// The oldest item is dropped; the producer never blocks, and the consumer never receives stale
    /// data.
    NewestWins,
}

/// A bounded queue between one producer and one consumer.
#[derive(Debug)]
pub struct Newest<T> {
    policy: Policy,
    capacity: usize,
    state: Mutex<QueueState<T>>,
    changed: Condvar,
}

#[derive(Debug)]
struct QueueState<T> {
    queue: VecDeque<T>,
    given: u64,
    dropped: u64,
    closed: bool,
}

/// Result of [`Newest::take`].
#[derive(Debug, PartialEq, Eq)]
pub enum Taken<T> {
    /// The oldest item of the queue.
    Item(T),
    /// Timeout: the queue stayed empty.
    Nothing,
    /// The queue is closed and empty.
    End,
}

impl<T> Newest<T> {
    /// Creates a queue for at most `capacity` items (at least one).
    pub fn new(policy: Policy, capacity: usize) -> Self {
        let state = QueueState { queue: VecDeque::new(), given: 0, dropped: 0, closed: false };
        Self { policy, capacity: capacity.max(1), state: Mutex::new(state), changed: Condvar::new() }
    }

    fn state(&self) -> MutexGuard<'_, QueueState<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds an item, according to the policy; `false` if the queue is closed.
    pub fn give(&self, item: T) -> bool {
        let mut state = self.state();
        while self.policy == Policy::Wait && state.queue.len() >= self.capacity && !state.closed {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        if state.closed {
            return false;
        }
        if state.queue.len() >= self.capacity {
            state.queue.pop_front();
            state.dropped += 1;
        }
        state.queue.push_back(item);
        state.given += 1;
        drop(state);
        self.changed.notify_all();
        true
    }

    /// Removes the oldest item, after waiting for it for at most `patience`.
    pub fn take(&self, patience: Duration) -> Taken<T> {
        let until = Instant::now() + patience;
        let mut state = self.state();
        loop {
            if let Some(item) = state.queue.pop_front() {
                drop(state);
                self.changed.notify_all();
                return Taken::Item(item);
            }
            let left = until.saturating_duration_since(Instant::now());
            if state.closed {
                return Taken::End;
            } else if left.is_zero() {
                return Taken::Nothing;
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Closes the queue: no more items can be added, those in the queue can still be taken.
    pub fn close(&self) {
        self.state().closed = true;
        self.changed.notify_all();
    }

    /// Number of items in the queue.
    pub fn waiting(&self) -> usize {
        self.state().queue.len()
    }

    /// Number of items added in total, and of those dropped.
    pub fn counts(&self) -> (u64, u64) {
        let state = self.state();
        (state.given, state.dropped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn newest_items_are_kept_and_dropped_ones_counted() {
        let queue = Newest::new(Policy::NewestWins, 2);
        (0..5).for_each(|k| assert!(queue.give(k)));
        assert_eq!(queue.counts(), (5, 3));
        assert_eq!(queue.take(Duration::ZERO), Taken::Item(3));
        queue.close();
        assert!(!queue.give(9));
        assert_eq!(queue.take(Duration::ZERO), Taken::Item(4));
        assert_eq!(queue.take(Duration::ZERO), Taken::End);
    }

    #[test]
    fn blocking_policy_loses_no_items() {
        let queue = Newest::new(Policy::Wait, 2);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                (0..100).for_each(|k| assert!(queue.give(k)));
                queue.close();
            });
            for k in 0..100 {
                assert_eq!(queue.take(Duration::from_secs(60)), Taken::Item(k));
            }
            assert_eq!(queue.take(Duration::from_secs(60)), Taken::End);
        });
        assert_eq!(queue.counts(), (100, 0));
    }
}
