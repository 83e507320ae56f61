//! When and how a command is ended.

use std::time::Duration;

/// A signal that ends a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndingSignal {
    /// Not to be caught: the program stops between two instructions.
    Kill,
    /// Asks the program to end, as a service manager does.
    Terminate,
    /// Asks the program to end, as Ctrl-C does.
    Interrupt,
}

/// When a command is ended, and how.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    /// After its start.
    pub after: Duration,
    pub signal: EndingSignal,
    /// Whether another process reads the map just before.
    pub watched: bool,
}

/// The random moments at which a command is ended.
#[derive(Debug)]
pub struct Moments {
    state: u64,
    duration: Duration,
}

impl Moments {
    /// Moments within the duration of a command and a tenth beyond.
    pub fn new(seed: u64, name: &str, duration: Duration) -> Self {
        let state = name.bytes().fold(seed, |state, byte| state.wrapping_mul(31).wrapping_add(byte.into()));
        Self { state, duration }
    }

    /// SplitMix64 by Sebastiano Vigna.
    fn random(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.state;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// The next one: half of the signals are SIGKILL, and half of the maps are watched.
    pub fn next(&mut self) -> Moment {
        let share = self.random() as f64 / u64::MAX as f64;
        let signal = match self.random() % 4 {
            0 => EndingSignal::Terminate,
            1 => EndingSignal::Interrupt,
            _ => EndingSignal::Kill,
        };
        let watched = self.random().is_multiple_of(2);
        Moment { after: self.duration.mul_f64(1.1 * share), signal, watched }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_repeat_and_cover_the_whole_duration() {
        let moments = |seed| {
            let mut moments = Moments::new(seed, "run", Duration::from_secs(1));
            (0..200).map(move |_| moments.next()).collect::<Vec<_>>()
        };
        let seconds =
            |moments: &[Moment]| moments.iter().map(|moment| moment.after.as_secs_f64()).collect::<Vec<_>>();
        let first = moments(1);
        assert_eq!(seconds(&first), seconds(&moments(1)));
        assert_ne!(seconds(&first), seconds(&moments(2)));
        assert!(seconds(&first).iter().any(|&s| s < 0.05) && seconds(&first).iter().any(|&s| s > 1.0));
        let kills = first.iter().filter(|moment| moment.signal == EndingSignal::Kill).count();
        assert!((70..130).contains(&kills), "{kills}");
    }
}
