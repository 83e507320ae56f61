//! The order of what is read of a recording by the times in it.
//!
//! A time may be wrong, a message may be recorded after one that was taken later, and a clock may
//! be set while it is recorded. All are decided by what follows: a few elements are held back, and
//! the earliest of them that is after all before it is next.
//!
//! * An element that many later ones overtake, or that is not after what was given before it, has
//!   a wrong time and is left out.
//! * Where all that are held are earlier than the last one, the clock was set back. Where all are
//!   much later, and the recorder saw no such pause, it was set forward. What follows counts on
//!   without the jump.

use crate::arrival_clock::ArrivalClock;
use std::collections::VecDeque;

/// Number of elements that are held back: one may be recorded three later than it was taken, and
/// of three wrong times in a row each costs its own element only. More would hold more images in
/// memory.
const HELD: usize = 4;
/// The clock was set forward if a step is longer than this, seconds, and longer than the recorder
/// saw by this fraction of it. Between the two clocks lies the time that messages take to the
/// recorder, which changes by a second where a computer is busy.
const JUMP_S: f64 = 2.0;
const UNSEEN: f64 = 0.5;
/// Number of the last elements whose median step is the usual one.
const RECENT: usize = 15;
/// The usual step before there are two elements, seconds.
const ASSUMED_STEP_S: f64 = 1.0 / 30.0;

/// An element with its times.
#[derive(Debug)]
pub(crate) struct Timed<T> {
    /// When it was taken, seconds; not a number if nothing says it.
    pub time_s: f64,
    /// When it was recorded, seconds, by the recorder's clock; `None` if nothing says it.
    pub recorded_s: Option<f64>,
    pub item: T,
}

/// Gives elements in the order of their times.
#[derive(Debug)]
pub(crate) struct TimeOrder<T> {
    /// In the order in which they were read, each with the number of later ones given before it.
    held: VecDeque<(Timed<T>, usize)>,
    at_end: bool,
    /// Makes times even that come in bursts.
    clock: Option<ArrivalClock>,
    /// What is added to times since the clock was set, seconds.
    shift_s: f64,
    /// The last ones given: time and when they were recorded.
    recent: VecDeque<(f64, Option<f64>)>,
    first_s: Option<f64>,
    left_out: u64,
    jumps: u64,
    /// The first jump: time after the first element, and length, seconds.
    first_jump: Option<(f64, f64)>,
}

impl<T> TimeOrder<T> {
    pub fn new() -> Self {
        Self {
            held: VecDeque::new(),
            at_end: false,
            clock: None,
            shift_s: 0.0,
            recent: VecDeque::new(),
            first_s: None,
            left_out: 0,
            jumps: 0,
            first_jump: None,
        }
    }

    /// Gives even times to elements whose own come in bursts.
    pub fn evened(mut self) -> Self {
        self.clock = Some(ArrivalClock::default());
        self
    }

    /// The next element and its time, seconds, which increases strictly; `None` after the last.
    pub fn next<E>(
        &mut self,
        mut read: impl FnMut() -> Result<Option<Timed<T>>, E>,
    ) -> Result<Option<(f64, T)>, E> {
        loop {
            while !self.at_end && self.held.len() < HELD {
                match read()? {
                    Some(timed) if timed.time_s.is_finite() => self.held.push_back((timed, 0)),
                    Some(_) => self.left_out += 1,
                    None => self.at_end = true,
                }
            }
            if self.held.is_empty() {
                return Ok(None);
            }
            if let Some(index) = self.choose() {
                return Ok(self.give(index));
            }
        }
    }

    /// The index of what is next; `None` where something was left out or a jump was found instead.
    fn choose(&mut self) -> Option<usize> {
        let time_s = |(timed, _): &(Timed<T>, usize)| timed.time_s + self.shift_s;
        let mut by_time: Vec<usize> = (0..self.held.len()).collect();
        by_time.sort_by(|&a, &b| time_s(&self.held[a]).total_cmp(&time_s(&self.held[b])));
        let times = |index: usize| (time_s(&self.held[index]), self.held[index].0.recorded_s);
        let (earliest, latest) = (*by_time.first()?, *by_time.last()?);
        let Some(&last) = self.recent.back() else {
            // One that is far before all others is wrong, or of a clock that was set back.
            let is_alone =
                |pair: &&[usize]| self.held.len() > 2 && self.is_jump(times(pair[0]), times(pair[1]));
            return by_time.get(by_time.windows(2).take_while(is_alone).count()).copied();
        };
        if times(latest).0 < last.0 {
            self.jump(times(earliest), last);
            return None;
        }
        let Some(&next) = by_time.iter().find(|&&index| times(index).0 > last.0) else {
            self.leave_out(0);
            return None;
        };
        if self.is_jump(last, times(next)) {
            match self.held[next].1 {
                0 => self.jump(times(next), last),
                // Others were before it, and none came after it: it is the one that is wrong.
                _ => self.leave_out(next),
            }
            return None;
        }
        Some(next)
    }

    fn leave_out(&mut self, index: usize) {
        self.held.remove(index);
        self.left_out += 1;
    }

    /// Whether a step from one time to another is that of a clock that was set forward.
    fn is_jump(&self, (from_s, recorded_s): (f64, Option<f64>), to: (f64, Option<f64>)) -> bool {
        let step_s = to.0 - from_s;
        let seen = recorded_s.zip(to.1).map(|(from_s, to_s)| (to_s - from_s) * self.times_per_recorded());
        // A recorder without a clock has the same time for all.
        step_s > JUMP_S && seen.is_some_and(|seen_s| seen_s != 0.0 && seen_s < UNSEEN * step_s)
    }

    /// Seconds per second of the recorder, which is not 1 where a recording is played faster into
    /// another.
    fn times_per_recorded(&self) -> f64 {
        let ends = self.recent.front().zip(self.recent.back()).filter(|_| self.recent.len() == RECENT);
        let recorded_s = ends.and_then(|(first, last)| Some(last.1? - first.1?));
        match (ends, recorded_s) {
            (Some((first, last)), Some(recorded_s)) if recorded_s > 0.0 => (last.0 - first.0) / recorded_s,
            _ => 1.0,
        }
    }

    /// Lets times count on from the last one.
    fn jump(&mut self, next: (f64, Option<f64>), last: (f64, Option<f64>)) {
        let mut steps: Vec<f64> =
            self.recent.iter().zip(self.recent.iter().skip(1)).map(|(a, b)| b.0 - a.0).collect();
        steps.sort_by(f64::total_cmp);
        let usual_s = steps.get(steps.len() / 2).copied().unwrap_or(ASSUMED_STEP_S);
        // The camera may have paused as well.
        let seen_s = next.1.zip(last.1).map_or(0.0, |(to_s, from_s)| to_s - from_s);
        let step_s = if seen_s > JUMP_S { seen_s } else { usual_s };
        let by_s = next.0 - (last.0 + step_s);
        self.shift_s -= by_s;
        self.jumps += 1;
        self.first_jump.get_or_insert((last.0 - self.first_s.unwrap_or(last.0), by_s));
    }

    fn give(&mut self, index: usize) -> Option<(f64, T)> {
        let (Timed { time_s, recorded_s, item }, _) = self.held.remove(index)?;
        let time_s = time_s + self.shift_s;
        self.held.iter_mut().take(index).for_each(|(_, overtaken)| *overtaken += 1);
        let (before, shift_s) = (self.held.len(), self.shift_s);
        self.held.retain(|(timed, overtaken)| {
            *overtaken == 0 || (*overtaken < HELD && timed.time_s + shift_s > time_s)
        });
        self.left_out += (before - self.held.len()) as u64;
        self.first_s.get_or_insert(time_s);
        self.recent.push_back((time_s, recorded_s));
        if self.recent.len() > RECENT {
            self.recent.pop_front();
        }
        Some((self.clock.as_mut().map_or(time_s, |clock| clock.time_s(time_s)), item))
    }

    /// Drains the warnings, one sentence each; `what` is as in `images on /camera`.
    pub fn take_warnings(&mut self, what: &str) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.clock.is_some() {
            warnings.push(format!(
                "the times of the {what} come in bursts, as those at which a network delivers them; even times are                  used instead"
            ));
        }
        let (was, why) = match self.left_out {
            1 => ("was", "its time does"),
            _ => ("were", "their times do"),
        };
        if self.left_out > 0 {
            warnings.push(format!(
                "{} of the {what} {was} left out, because {why} not fit those before and after",
                self.left_out
            ));
            self.left_out = 0;
        }
        if let Some((at_s, by_s)) = self.first_jump.take() {
            let more = match std::mem::take(&mut self.jumps) - 1 {
                0 => String::new(),
                more => format!(", and {more} times more"),
            };
            warnings.push(format!(
                "the clock of the {what} was set {} by {:.2} s, {at_s:.2} s after the first{more}; their times count \
                 on without the jump",
                if by_s < 0.0 { "back" } else { "forward" },
                by_s.abs()
            ));
        }
        warnings
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::convert::Infallible;

    /// The numbers of the elements in the order of their times, their times, and the warnings, of
    /// elements with times and the times of recording.
    fn ordered(
        times_s: &[f64],
        recorded_s: impl Fn(usize) -> Option<f64>,
    ) -> (Vec<(usize, f64)>, Vec<String>) {
        let mut order = TimeOrder::new();
        let mut input = times_s.iter().enumerate();
        let mut read = || -> Result<_, Infallible> {
            Ok(input.next().map(|(n, &time_s)| Timed { time_s, recorded_s: recorded_s(n), item: n }))
        };
        let mut given = Vec::new();
        while let Ok(Some((time_s, number))) = order.next(&mut read) {
            given.push((number, time_s));
        }
        assert!(given.windows(2).all(|pair| pair[0].1 < pair[1].1), "{given:?}");
        (given, order.take_warnings("images on /cam"))
    }

    /// Recorded 4 ms later, give or take 3 ms.
    fn recorded_s(n: usize) -> Option<f64> {
        Some(0.1 * n as f64 + 0.004 + 0.001 * (n * 7 % 4) as f64)
    }

    fn even() -> Vec<f64> {
        (0..60).map(|n| 0.1 * f64::from(n)).collect()
    }

    fn numbers(given: &[(usize, f64)]) -> Vec<usize> {
        given.iter().map(|(number, _)| *number).collect()
    }

    #[test]
    fn times_in_order_stay_as_they_are() {
        // A pause that the recorder saw, or may have seen.
        let mut times = even();
        times[30..].iter_mut().for_each(|time_s| *time_s += 50.0);
        let paused = |n: usize| recorded_s(n).map(|s| s + if n < 30 { 0.0 } else { 50.0 });
        for (times, recorded) in [
            (even(), &recorded_s as &dyn Fn(usize) -> Option<f64>),
            (times.clone(), &paused),
            (times.clone(), &|_| None),
            (times.clone(), &|_| Some(0.0)),
            // Played five times as fast into another recording.
            (times.clone(), &|n| paused(n).map(|s| s / 5.0)),
        ] {
            let (given, warnings) = ordered(&times, recorded);
            assert_eq!(given, times.iter().copied().enumerate().collect::<Vec<_>>());
            assert_eq!(warnings, [""; 0]);
        }
    }

    #[test]
    fn a_wrong_time_costs_its_own_element_only() {
        for at in [0, 1, 2, 3, 30, 56, 57, 58, 59] {
            for wrong in [1000.0, -1000.0, 3.0, -3.0, f64::NAN] {
                let mut times = even();
                times[at] += wrong;
                let (given, warnings) = ordered(&times, recorded_s);
                let kept: Vec<usize> = numbers(&given).into_iter().filter(|number| *number != at).collect();
                let others: Vec<usize> = (0..60).filter(|number| *number != at).collect();
                assert_eq!(kept, others, "{at} {wrong}");
                assert!(
                    given.iter().all(|&(n, s)| n == at || (s - 0.1 * n as f64).abs() < 1e-9),
                    "{at} {wrong}"
                );
                assert!(warnings.len() == 1 || given.len() == 60, "{at} {wrong}: {warnings:?}");
            }
        }
        // Without the times of recording the same, but that a last one far ahead is a pause.
        let mut times = even();
        (times[0], times[30], times[45]) = (1000.0, 1000.0, -1000.0);
        let (given, warnings) = ordered(&times, |_| None);
        assert_eq!(given.len(), 57);
        assert_eq!(
            warnings,
            ["3 of the images on /cam were left out, because their times do not fit those before and after"]
        );
    }

    #[test]
    fn a_clock_that_is_set_goes_on_without_the_jump() {
        let set = |at: usize, by: f64| {
            let mut times = even();
            times[at..].iter_mut().for_each(|time_s| *time_s += by);
            ordered(&times, recorded_s)
        };
        for (at, by) in [(2, 5.0), (3, 5.0), (3, -5.0), (57, -5.0), (58, 5.0)] {
            assert_eq!(numbers(&set(at, by).0), (0..60).collect::<Vec<_>>(), "{at} {by}");
        }
        for by in [5.0, -5.0, 1.7e9, -0.5] {
            let (given, warnings) = set(20, by);
            assert_eq!(numbers(&given), (0..60).collect::<Vec<_>>(), "{by}");
            for (n, time_s) in given {
                // 1.7e9 s in doubles are exact to 2e-7 s.
                assert!((time_s - 0.1 * n as f64).abs() < 1e-6, "{by} {n}: {time_s}");
            }
            let way = if by < 0.0 { "back" } else { "forward" };
            assert_eq!(
                warnings,
                [format!(
                    "the clock of the images on /cam was set {way} by {:.2} s, 1.90 s after the first; their times count \
                     on without the jump",
                    by.abs()
                )]
            );
        }
    }

    #[test]
    fn elements_that_were_overtaken_on_the_way_are_sorted() {
        for late in 1..HELD {
            let mut times = even();
            times[10..=10 + late].rotate_left(1);
            let (given, warnings) = ordered(&times, recorded_s);
            let read: Vec<f64> = given.iter().map(|(_, time_s)| *time_s).collect();
            assert_eq!((read, warnings), (even(), Vec::new()), "{late}");
        }
    }

    #[test]
    fn the_same_time_is_given_once() {
        let times: Vec<f64> = (0..60).map(|n| 0.2 * f64::from(n / 2)).collect();
        let (given, warnings) = ordered(&times, recorded_s);
        assert_eq!(numbers(&given), (0..60).step_by(2).collect::<Vec<_>>());
        assert!(
            warnings.len() == 1 && warnings[0].starts_with("30 of the images on /cam were left out"),
            "{warnings:?}"
        );
    }
}
