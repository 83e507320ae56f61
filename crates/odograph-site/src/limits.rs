//! Limits on what robots may send, so that one that floods the site takes neither its memory nor
//! the time of the others.

use crate::protocol::MAX_BODY;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Requests of a robot per second in the long run. A robot on the move sends two; one that catches
/// up sends its records in sixteens, so that an hour at 1 m/s takes 16 s.
const REQUESTS_PER_S: f64 = 32.0;
/// Requests of a robot at once, after a pause.
const REQUESTS_AT_ONCE: f64 = 64.0;
/// Bodies of a robot that are in memory at the same time, bytes. A robot sends one at a time; where
/// its connection broke, the site may still wait for the rest of the one before.
const BODIES_OF_A_ROBOT: usize = 2 * MAX_BODY;
/// Bodies of all robots that are in memory at the same time, bytes.
const BODIES: usize = 8 * MAX_BODY;
/// Number of robots of which the rate is known; one of which it is not may send as after a pause.
const MAX_ROBOTS: usize = 4096;

/// The limits of a site.
#[derive(Debug, Clone, Default)]
pub struct Limits(Arc<Mutex<InUse>>);

#[derive(Debug, Default)]
struct InUse {
    bytes: usize,
    robots: BTreeMap<String, RobotUse>,
}

#[derive(Debug)]
struct RobotUse {
    bytes: usize,
    rate: Rate,
}

/// Leave to have a body in memory; ends when dropped.
#[derive(Debug)]
pub struct Permit {
    in_use: Arc<Mutex<InUse>>,
    robot: String,
    bytes: usize,
}

impl Limits {
    /// Counts a request of a robot. Fails if there were too many.
    pub fn request(&self, robot: &str, now: Instant) -> Result<(), String> {
        match lock(&self.0).robot(robot, now).rate.take(REQUESTS_PER_S, REQUESTS_AT_ONCE, now) {
            true => Ok(()),
            false => Err(format!("robot {robot} sends more than {REQUESTS_PER_S} requests per second")),
        }
    }

    /// Reserves memory for a body of a robot. Fails if that, or all together, has too much already.
    pub fn body(&self, robot: &str, bytes: usize, now: Instant) -> Result<Permit, String> {
        let mut in_use = lock(&self.0);
        if in_use.bytes + bytes > BODIES {
            return Err("all robots together send more than the site has memory for".to_owned());
        }
        let of_robot = in_use.robot(robot, now);
        if of_robot.bytes + bytes > BODIES_OF_A_ROBOT {
            return Err(format!("robot {robot} sends several large requests at the same time"));
        }
        of_robot.bytes += bytes;
        in_use.bytes += bytes;
        Ok(Permit { in_use: Arc::clone(&self.0), robot: robot.to_owned(), bytes })
    }
}

impl InUse {
    fn robot(&mut self, name: &str, now: Instant) -> &mut RobotUse {
        if self.robots.len() >= MAX_ROBOTS && !self.robots.contains_key(name) {
            // Those that have bodies in memory are few, as bodies are bounded.
            self.robots.retain(|_, robot| robot.bytes > 0);
        }
        let new = || RobotUse { bytes: 0, rate: Rate::new(REQUESTS_AT_ONCE, now) };
        self.robots.entry(name.to_owned()).or_insert_with(new)
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut in_use = lock(&self.in_use);
        in_use.bytes -= self.bytes;
        if let Some(robot) = in_use.robots.get_mut(&self.robot) {
            robot.bytes -= self.bytes;
        }
    }
}

fn lock(in_use: &Mutex<InUse>) -> MutexGuard<'_, InUse> {
    in_use.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A token bucket.
#[derive(Debug)]
pub struct Rate {
    left: f64,
    at: Instant,
}

impl Rate {
    /// A full one.
    pub fn new(most: f64, now: Instant) -> Self {
        Self { left: most, at: now }
    }

    /// Takes one, where there is one; `per_s` come back each second, up to `most`.
    pub fn take(&mut self, per_s: f64, most: f64, now: Instant) -> bool {
        let passed_s = now.saturating_duration_since(self.at).as_secs_f64();
        (self.left, self.at) = (most.min(self.left + per_s * passed_s), now);
        let any = self.left >= 1.0;
        if any {
            self.left -= 1.0;
        }
        any
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_flood_of_requests_is_limited_for_its_robot_alone() {
        let limits = Limits::default();
        let now = Instant::now();
        let taken = (0..1000).filter(|_| limits.request("a", now).is_ok()).count();
        assert_eq!(taken, 64);
        assert!(limits.request("b", now).is_ok());
        let later = now + Duration::from_millis(250);
        assert_eq!((0..1000).filter(|_| limits.request("a", later).is_ok()).count(), 8);
        // A long pause is worth no more than the start.
        let much_later = now + Duration::from_secs(3600);
        assert_eq!((0..1000).filter(|_| limits.request("a", much_later).is_ok()).count(), 64);
    }

    #[test]
    fn bodies_in_memory_are_bounded_for_each_robot_and_in_all() {
        let limits = Limits::default();
        let now = Instant::now();
        let body = |robot: &str| limits.body(robot, MAX_BODY, now);
        let of_a = [body("a").unwrap(), body("a").unwrap()];
        assert!(body("a").unwrap_err().contains("robot a"));
        let of_others: Vec<Permit> = (0..6).map(|robot| body(&format!("robot-{robot}")).unwrap()).collect();
        assert!(body("b").unwrap_err().contains("all robots"));
        drop(of_a);
        assert!(body("b").is_ok() && body("a").is_ok(), "the memory is free again");
        drop(of_others);
        assert_eq!(lock(&limits.0).bytes, 0);
    }

    #[test]
    fn names_without_end_take_bounded_memory() {
        let limits = Limits::default();
        let now = Instant::now();
        let held = limits.body("held", 1, now).unwrap();
        for robot in 0..3 * MAX_ROBOTS {
            limits.request(&format!("robot-{robot}"), now).unwrap();
        }
        assert!(lock(&limits.0).robots.len() <= MAX_ROBOTS);
        drop(held);
        assert_eq!(lock(&limits.0).robots.get("held").unwrap().bytes, 0);
    }
}
