//! The part of many recordings that one worker processes.

use super::hash;
use odograph::error::{Error, Result};
use std::str::FromStr;

/// One of several parts of all recordings. A recording belongs to a part by the hash of its name,
/// so that workers agree without knowing each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// From 0 to one below `of`.
    pub number: u32,
    /// The number of parts.
    pub of: u32,
}

impl FromStr for Shard {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let numbers =
            text.split_once('/').and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match numbers {
            Some((number, of)) if number < of => Ok(Self { number, of }),
            Some((_, of)) if of > 0 => {
                Err(Error::usage(format!("{of} shards are counted from 0: 0/{of} to {}/{of}", of - 1)))
            }
            _ => Err(Error::usage("a shard is its number and how many there are, such as 3/64")),
        }
    }
}

impl Shard {
    /// Whether a recording of this name belongs to this part.
    pub fn contains(self, name: &str) -> bool {
        let start = &hash::of_bytes(name.as_bytes())[..16];
        u64::from_str_radix(start, 16).is_ok_and(|value| value % u64::from(self.of) == u64::from(self.number))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test fails by panicking
mod tests {
    use super::*;

    #[test]
    fn every_recording_is_in_one_shard() {
        let shards: Vec<Shard> = (0..8).map(|number| Shard { number, of: 8 }).collect();
        let mut sizes = [0; 8];
        for name in (0..1000).map(|number| format!("day/{number}")) {
            let within: Vec<&Shard> = shards.iter().filter(|shard| shard.contains(&name)).collect();
            assert_eq!(within.len(), 1, "{name}");
            sizes[within[0].number as usize] += 1;
        }
        // 125 each, with a standard deviation of 10.
        assert!(sizes.iter().all(|size| (75..175).contains(size)), "{sizes:?}");
    }

    #[test]
    fn shards_are_counted_from_zero() {
        assert_eq!("3/64".parse::<Shard>().unwrap(), Shard { number: 3, of: 64 });
        let refused = "64/64".parse::<Shard>().unwrap_err().to_string();
        assert_eq!(refused, "64 shards are counted from 0: 0/64 to 63/64");
        for wrong in ["", "3", "3/", "0/0", "-1/4", "a/b", "1/2/3"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
