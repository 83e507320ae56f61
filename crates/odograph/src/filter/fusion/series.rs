//! A sensor's record as a function of time.

use crate::error::{Error, Result};
use crate::numerics::median;

/// Measured quantity of a sensor. Angles are counter-clockwise seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Turn rate about the vertical axis, rad/s; one channel.
    TurnRate,
    /// Turn rates about the three axes of a sensor of unknown orientation, rad/s; three channels.
    TurnRates,
    /// Heading with an arbitrary zero, radians; one channel.
    Heading,
    /// Speed of a wheel, m/s, negative backwards; one channel.
    Speed,
    /// Distance travelled by a wheel with an arbitrary zero, metres, decreasing backwards; one
    /// channel.
    Way,
    /// Height above the ground, metres; one channel.
    Height,
    /// Distance to the ground along the camera's optical axis, metres; one channel.
    AxisDistance,
}

impl Quantity {
    fn channels(self) -> usize {
        if self == Self::TurnRates { 3 } else { 1 }
    }
}

/// Record of one sensor with strictly increasing times. Its clock may have an offset from the
/// camera's.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorRecord {
    quantity: Quantity,
    times_s: Vec<f64>,
    channels: Vec<Vec<f64>>,
    /// Integral of each channel from the first sample; for [`Quantity::Way`] the distance itself.
    integrals: Vec<Vec<f64>>,
    /// Longest interval between two samples that is not a dropout, seconds.
    longest_step_s: f64,
}

impl SensorRecord {
    /// A record of samples `values` (one or three channels, depending on the quantity) at
    /// `times_s`.
    ///
    /// Fails if there are fewer than two samples, a number is not finite, a time is not later than
    /// the one before, or the channels differ in length.
    pub fn new(quantity: Quantity, times_s: Vec<f64>, values: Vec<Vec<f64>>) -> Result<Self> {
        if times_s.len() < 2 {
            return Err(Error::input(format!(
                "a sensor record needs at least two readings and has {}; give that of the whole recording",
                times_s.len()
            )));
        }
        if values.len() != quantity.channels() || values.iter().any(|channel| channel.len() != times_s.len())
        {
            return Err(Error::input("the channels of a sensor record do not fit its times"));
        }
        if let Some(bad) = times_s.iter().chain(values.iter().flatten()).find(|value| !value.is_finite()) {
            return Err(Error::input(format!("a sensor record holds {bad}; all its numbers must be finite")));
        }
        if let Some(pair) = times_s.windows(2).find(|pair| pair[1] <= pair[0]) {
            return Err(Error::input(format!(
                "the time {} s of a sensor record is not later than {} s before it",
                pair[1], pair[0]
            )));
        }
        let mut channels = values;
        if quantity == Quantity::Heading {
            channels.iter_mut().for_each(|channel| unwrap(channel));
        }
        let integrals = channels.iter().map(|channel| match quantity {
            Quantity::Way => channel.clone(),
            _ => integral(&times_s, channel),
        });
        let integrals = integrals.collect();
        let mut steps: Vec<f64> = times_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        // Interpolates over a few lost samples, but not over dropouts.
        let longest_step_s = (5.0 * median(&mut steps).unwrap_or(0.0)).max(0.1);
        Ok(Self { quantity, times_s, channels, integrals, longest_step_s })
    }

    /// The measured quantity.
    pub fn quantity(&self) -> Quantity {
        self.quantity
    }

    /// First and last time, seconds.
    pub fn span_s(&self) -> (f64, f64) {
        (self.times_s[0], self.times_s[self.times_s.len() - 1])
    }

    /// The samples: time in seconds and the value of each channel; headings are unwrapped.
    pub fn samples(&self) -> impl Iterator<Item = (f64, Vec<f64>)> + '_ {
        let values = |i: usize| self.channels.iter().map(|channel| channel[i]).collect();
        self.times_s.iter().enumerate().map(move |(i, &time_s)| (time_s, values(i)))
    }

    /// Linearly interpolated value of a channel at a time; `None` outside the record and in
    /// dropouts.
    pub(super) fn at(&self, channel: usize, time_s: f64) -> Option<f64> {
        let (i, since_s, step_s) = self.place(time_s)?;
        let values = &self.channels[channel];
        Some(values[i] + (values[i + 1] - values[i]) * since_s / step_s)
    }

    /// Integral of a channel (for [`Quantity::Way`] the distance) from one time to a later one;
    /// `None` outside the record and across dropouts.
    pub(super) fn between(&self, channel: usize, from_s: f64, to_s: f64) -> Option<f64> {
        let (from, to) = (self.place(from_s)?, self.place(to_s)?);
        let hole = |i: usize| self.times_s[i + 1] - self.times_s[i] > self.longest_step_s;
        // The scan is short: consecutive frames are rarely more than a few samples apart.
        if (from.0..=to.0).any(hole) {
            return None;
        }
        Some(self.integral_at(channel, to) - self.integral_at(channel, from))
    }

    fn integral_at(&self, channel: usize, (i, since_s, step_s): (usize, f64, f64)) -> f64 {
        let (integral, values) = (&self.integrals[channel], &self.channels[channel]);
        match self.quantity {
            Quantity::Way => integral[i] + (integral[i + 1] - integral[i]) * since_s / step_s,
            _ => {
                let slope = (values[i + 1] - values[i]) / step_s;
                integral[i] + since_s * (values[i] + 0.5 * slope * since_s)
            }
        }
    }

    /// Index of the sample before a time, the time since it, and the interval from it to the next
    /// sample.
    fn place(&self, time_s: f64) -> Option<(usize, f64, f64)> {
        let (first_s, last_s) = self.span_s();
        if !(first_s..=last_s).contains(&time_s) {
            return None;
        }
        let i =
            self.times_s.partition_point(|&sample_s| sample_s <= time_s).clamp(1, self.times_s.len() - 1) - 1;
        let step_s = self.times_s[i + 1] - self.times_s[i];
        (step_s <= self.longest_step_s).then_some((i, time_s - self.times_s[i], step_s))
    }
}

/// Unwraps angles: removes jumps of whole turns between samples.
fn unwrap(angles: &mut [f64]) {
    for i in 1..angles.len() {
        let step = crate::geometry::wrap_angle(angles[i] - angles[i - 1]);
        angles[i] = angles[i - 1] + step;
    }
}

fn integral(times_s: &[f64], values: &[f64]) -> Vec<f64> {
    let mut sum = 0.0;
    let mut integral = vec![0.0];
    for (times_s, values) in times_s.windows(2).zip(values.windows(2)) {
        sum += 0.5 * (times_s[1] - times_s[0]) * (values[0] + values[1]);
        integral.push(sum);
    }
    integral
}
