//! Calibration of a sensor against the camera (clock offset, scale, bias, mounting, noise), and its
//! acceptance.

use super::camera_motion::{MeasuredFrame, MotionStep};
use super::fit::{Fit, ObservationRow, ParameterPrior, TimeOffset, fit, time_offset};
use super::rejection::Reason;
use super::series::{Quantity, SensorRecord};
use crate::numerics::{median, normal_sigma};
use nalgebra::{Matrix4, Vector4};

/// Calibration of a rate sensor against the camera.
#[derive(Debug, Clone)]
pub struct Calibrated {
    pub offset: TimeOffset,
    /// Gyroscope: three scale factors (one for a single axis) and the bias, rad/s. Wheel: forward
    /// and left motion in the camera's frame per metre of wheel distance, and the lever arm:
    /// position of the camera forward and left of the wheel, metres.
    pub parameters: Vector4<f64>,
    pub covariance: Matrix4<f64>,
    /// Spectral density of the noise of the integrated signal: variance per second.
    pub density: f64,
    /// Seconds in which sensor and camera were compared, and the number of them with a
    /// contradiction.
    pub seconds: usize,
    pub contradictions: usize,
    /// Mean normalised innovation squared over the seconds; 1 if the estimated noise is consistent.
    pub nis: f64,
}

impl Calibrated {
    /// With the noise that all seconds show, not only most of them: a few seconds do not tell which
    /// of them are exceptions.
    pub fn widened(mut self) -> Self {
        let factor = self.nis.max(1.0);
        self.density *= factor;
        self.covariance *= factor;
        self
    }
}

/// Maximum number of observations; more do not improve the estimate.
const MAX_ROWS: usize = 5000;

/// Gate on the normalised innovation squared: the 99.9 % quantile of χ² with one degree of freedom.
pub const CONSISTENT_NIS: f64 = 10.83;

/// Largest fraction of seconds with a contradiction for a sensor to be accepted.
pub const MAX_CONTRADICTIONS: f64 = 0.2;

/// Largest accepted noise of a gyroscope over one second, radians: ten times that of the cheapest
/// one.
const WORST_TURN_RAD: f64 = 0.05;

/// Largest accepted noise of a wheel over one second: metres, and a fraction of the speed.
const WORST_WAY_M: f64 = 0.02;
const WORST_WAY_SHARE: f64 = 0.1;

/// Least excitation: total rotation of the camera to determine the axes of a gyroscope, radians,
/// and total translation to determine the scale of a wheel, metres.
const MIN_TURN_RAD: f64 = 0.3;
const MIN_WAY_M: f64 = 0.3;

/// Least temporal overlap of sensor and camera, seconds.
const MIN_S: f64 = 2.0;

fn thinned(steps: &[MotionStep]) -> Vec<MotionStep> {
    steps.iter().step_by(steps.len().div_ceil(MAX_ROWS).max(1)).copied().collect()
}

/// Calibrates a gyroscope against the camera's heading changes. It may contradict them in
/// `patience` seconds, however few are compared.
pub fn gyro(record: &SensorRecord, steps: &[MotionStep], patience: usize) -> Result<Calibrated, Reason> {
    let channels = if record.quantity() == Quantity::TurnRates { 3 } else { 1 };
    let row = |step: &MotionStep, offset_s: f64| {
        let mut design = Vector4::new(0.0, 0.0, 0.0, -step.duration_s());
        for channel in 0..channels {
            design[channel] = record.between(channel, step.from_s + offset_s, step.to_s + offset_s)?;
        }
        Some(ObservationRow { design, target: step.turn_rad, duration_s: step.duration_s(), second: false })
    };
    let turned_rad: f64 = steps.iter().map(|step| step.turn_rad.abs()).sum();
    if channels == 3 && turned_rad < MIN_TURN_RAD {
        return Err(Reason::TooLittleTurning);
    }
    // A single axis is vertical, upright or upside down, with a scale error of a few percent; three
    // axes have an unknown orientation.
    let prior = |sign: f64| match channels {
        1 => ParameterPrior {
            mean: Vector4::new(sign, 0.0, 0.0, 0.0),
            sigma: Vector4::new(0.03, 1e-6, 1e-6, 0.5),
        },
        _ => ParameterPrior { mean: Vector4::zeros(), sigma: Vector4::new(1.0, 1.0, 1.0, 0.5) },
    };
    let signs: &[f64] = if channels == 1 { &[1.0, -1.0] } else { &[1.0] };
    let calibrate = |&sign: &f64| {
        calibrated(steps, 1, &prior(sign), |step, offset_s| row(step, offset_s).map(|row| vec![row]))
    };
    let candidates: Vec<(Calibrated, Vec<Seconds>)> =
        signs.iter().map(calibrate).collect::<Result<_, _>>()?;
    let best = candidates.into_iter().min_by(|a, b| a.0.density.total_cmp(&b.0.density));
    let (found, seconds) = best.ok_or(Reason::NoOverlap)?;
    let scale = found.parameters.fixed_rows::<3>(0).norm();
    if found.density.sqrt() > WORST_TURN_RAD {
        return Err(contradiction(&seconds, WORST_TURN_RAD.powi(2)));
    }
    if !(0.85..1.15).contains(&scale) {
        // A scale of nearly 0 is that of readings that have nothing to do with the turns.
        return Err(match scale > LEAST_SCALE {
            true => Reason::Scale { percent: (100.0 / scale).round() as u32 },
            false => contradiction(&seconds, WORST_TURN_RAD.powi(2)),
        });
    }
    believed(found, patience)
}

/// Smallest scale of a gyroscope that turns as the camera does: its rates are a hundred times too
/// large, and those in degrees 57 times.
const LEAST_SCALE: f64 = 0.01;

/// Calibrates a wheel against the camera's translations. It may contradict them in `patience`
/// seconds, however few are compared.
pub fn wheel(record: &SensorRecord, steps: &[MotionStep], patience: usize) -> Result<Calibrated, Reason> {
    let rows = |step: &MotionStep, offset_s: f64| {
        let way_m = record.between(0, step.from_s + offset_s, step.to_s + offset_s)?;
        let (turn, duration_s) = (step.turn_rad, step.duration_s());
        let row = |design, target, second| ObservationRow { design, target, duration_s, second };
        Some(vec![
            row(Vector4::new(way_m, 0.0, 0.0, -turn), step.ahead_m, false),
            row(Vector4::new(0.0, way_m, turn, 0.0), step.left_m, true),
        ])
    };
    let moved_m: f64 = steps.iter().map(|step| step.ahead_m.hypot(step.left_m)).sum();
    if moved_m < MIN_WAY_M {
        return Err(Reason::TooLittleMovement);
    }
    let prior = ParameterPrior { mean: Vector4::zeros(), sigma: Vector4::new(10.0, 10.0, 0.5, 0.5) };
    let (found, seconds) = calibrated(steps, 2, &prior, rows)?;
    let duration_s: f64 = steps.iter().map(MotionStep::duration_s).sum();
    let worst_m = WORST_WAY_M + WORST_WAY_SHARE * moved_m / duration_s;
    if found.density.sqrt() > worst_m {
        return Err(contradiction(&seconds, worst_m.powi(2)));
    }
    believed(found, patience)
}

fn believed(found: Calibrated, patience: usize) -> Result<Calibrated, Reason> {
    if found.contradictions as f64 > (MAX_CONTRADICTIONS * found.seconds as f64).max(patience as f64) {
        return Err(Reason::Contradicts { seconds: found.contradictions, of: found.seconds });
    }
    Ok(found)
}

/// Counts the seconds in which the sensor differs from the camera by more than two standard
/// deviations of the largest accepted noise.
fn contradiction(seconds: &[Seconds], worst_density: f64) -> Reason {
    let off = |second: &&Seconds| second.sum.powi(2) > 4.0 * worst_density * second.duration_s;
    Reason::Contradicts { seconds: seconds.iter().filter(off).count(), of: seconds.len() }
}

/// Sum of the residuals of about a second.
#[derive(Debug, Clone, Copy)]
struct Seconds {
    sum: f64,
    duration_s: f64,
}

impl Seconds {
    /// The sum normalised to one second.
    fn whitened(&self) -> f64 {
        self.sum / self.duration_s.sqrt()
    }
}

/// Estimates clock offset, parameters and noise; `rows` returns `rows_per_step` observations for
/// each step.
fn calibrated(
    steps: &[MotionStep],
    rows_per_step: usize,
    prior: &ParameterPrior,
    rows: impl Fn(&MotionStep, f64) -> Option<Vec<ObservationRow>>,
) -> Result<(Calibrated, Vec<Seconds>), Reason> {
    let few = thinned(steps);
    let all_rows = |offset_s: f64| few.iter().filter_map(|step| rows(step, offset_s)).flatten().collect();
    let offset = time_offset(all_rows, prior, 1.0);
    let compared: Vec<(MotionStep, Vec<ObservationRow>)> =
        steps.iter().filter_map(|step| rows(step, offset.offset_s).map(|rows| (*step, rows))).collect();
    if compared.iter().map(|(step, _)| step.duration_s()).sum::<f64>() < MIN_S {
        return Err(Reason::NoOverlap);
    }
    let flat: Vec<ObservationRow> = compared.iter().flat_map(|(_, rows)| rows.iter().copied()).collect();
    let Fit { parameters, covariance, residuals, density: fitted, .. } = fit(&flat, prior, None);
    // Each direction has its own noise; the sensor's is the larger one, because a wheel carries
    // little information about lateral motion.
    let mut density = fitted;
    let mut directions: Vec<Vec<Seconds>> = Vec::new();
    for nth in 0..rows_per_step {
        let of_direction = || residuals.iter().skip(nth).step_by(rows_per_step).copied();
        let seconds = in_seconds(compared.iter().map(|(step, _)| step).zip(of_direction()));
        let whitened: Vec<f64> = compared
            .iter()
            .zip(of_direction())
            .map(|((step, _), residual)| residual / step.duration_s().sqrt())
            .collect();
        // Correlated errors, such as wheel slip, appear over a second and not over a frame. Their
        // estimate is inflated for its own uncertainty when there are few seconds.
        let lasting: Vec<f64> = seconds.iter().map(Seconds::whitened).collect();
        let unsure = 1.0 + 2.0 / (lasting.len().max(1) as f64).sqrt();
        let lasting = normal_sigma(&lasting).powi(2) * unsure;
        density = density.max(normal_sigma(&whitened).powi(2)).max(lasting);
        directions.push(seconds);
    }
    let nis = |second: &Seconds| second.whitened().powi(2) / density;
    let count = directions[0].len();
    let contradicts = |i: usize| directions.iter().any(|seconds| nis(&seconds[i]) > CONSISTENT_NIS);
    let all: Vec<f64> = directions.iter().flatten().map(nis).collect();
    let found = Calibrated {
        offset,
        parameters,
        covariance: covariance * (density / fitted),
        density,
        seconds: count,
        contradictions: (0..count).filter(|&i| contradicts(i)).count(),
        nis: all.iter().sum::<f64>() / all.len().max(1) as f64,
    };
    let worst = |i: usize| {
        directions.iter().map(|seconds| seconds[i]).max_by(|a, b| a.sum.abs().total_cmp(&b.sum.abs()))
    };
    Ok((found, (0..count).filter_map(worst).collect()))
}

fn in_seconds<'a>(residuals: impl Iterator<Item = (&'a MotionStep, f64)>) -> Vec<Seconds> {
    let mut seconds = Vec::new();
    let mut sum = Seconds { sum: 0.0, duration_s: 0.0 };
    let mut end: Option<(f64, usize)> = None;
    for (step, residual) in residuals {
        if end.is_some_and(|(end_s, segment)| end_s != step.from_s || segment != step.segment) {
            // discards an incomplete second before a discontinuity
            sum = Seconds { sum: 0.0, duration_s: 0.0 };
        }
        sum.sum += residual;
        sum.duration_s += step.duration_s();
        end = Some((step.to_s, step.segment));
        if sum.duration_s >= 1.0 - 1e-6 {
            seconds.push(std::mem::replace(&mut sum, Seconds { sum: 0.0, duration_s: 0.0 }));
        }
    }
    seconds
}

/// Measurement of a state (heading or height) by a sensor, averaged over about a second.
#[derive(Debug, Clone, Copy)]
pub struct Sight {
    /// The middle node.
    pub node: usize,
    /// The reading at that node, corrected for the camera's motion within the second.
    pub reading: f64,
    pub variance: f64,
}

/// Readings of a compass or range finder, one per second, with their variance.
#[derive(Debug, Clone)]
pub struct Sighted {
    pub offset: TimeOffset,
    pub sights: Vec<Sight>,
    /// Standard deviation of a reading averaged over a second.
    pub sigma: f64,
    /// Variance of a single sample.
    pub single: f64,
}

/// Averaging window for the estimation of the clock offset, seconds.
const WINDOW_S: f64 = 0.4;

/// A sensor that measures a state of the camera, and the camera's own values.
struct StateComparison<'a> {
    record: &'a SensorRecord,
    nodes: &'a [MeasuredFrame],
    /// Factor of the reading at a node.
    factor: &'a dyn Fn(&MeasuredFrame) -> f64,
    /// The camera's value at a node.
    camera: &'a dyn Fn(&MeasuredFrame) -> f64,
    /// Variance of the camera's value relative to the start.
    drift: &'a dyn Fn(&MeasuredFrame) -> f64,
}

impl StateComparison<'_> {
    fn sighted(&self) -> Result<Sighted, Reason> {
        let offset = self.time_offset();
        let (mut sights, mut scatters) = self.averaged(offset.offset_s);
        if (sights.len() as f64) < MIN_S {
            return Err(Reason::NoOverlap);
        }
        // Samples within a quarter of a second are counted as one, because their errors are
        // correlated.
        let scatter = median(&mut scatters).unwrap_or(0.0) / 4.0;
        let lasting = [1, 4, 16].map(|length| self.allan_variance(&sights, length));
        let variance = lasting.into_iter().fold(scatter.max(1e-10), f64::max);
        sights.iter_mut().for_each(|sight| sight.variance = variance);
        Ok(Sighted { offset, sights, sigma: variance.sqrt(), single: variance.max(4.0 * scatter) })
    }

    /// The clock offset, from window averages: values interpolated between two samples have less
    /// noise than the samples, which would bias the offset.
    fn time_offset(&self) -> TimeOffset {
        let Self { record, nodes, factor, camera, .. } = *self;
        let mean = |node: &MeasuredFrame, time_s: f64| {
            let (from_s, to_s) = (time_s - 0.5 * WINDOW_S, time_s + 0.5 * WINDOW_S);
            record.between(0, from_s, to_s).map(|sum| factor(node) * sum / WINDOW_S)
        };
        let stride = nodes.len().div_ceil(MAX_ROWS).max(1);
        let spacing_s = match nodes {
            [first, .., last] => (last.time_s - first.time_s) / (nodes.len() - 1) as f64 * stride as f64,
            _ => WINDOW_S,
        };
        let nothing = ParameterPrior { mean: Vector4::zeros(), sigma: Vector4::repeat(1.0) };
        // Differences over one second cancel the sensor's bias and the camera's drift.
        let rows = |offset_s: f64| {
            let read = nodes.iter().step_by(stride);
            let differences: Vec<(&MeasuredFrame, f64)> = read
                .filter_map(|node| mean(node, node.time_s + offset_s).map(|z| (node, z - camera(node))))
                .collect();
            let mut earlier = 0;
            let mut rows = Vec::with_capacity(differences.len());
            for (node, difference) in &differences {
                while differences[earlier].0.time_s <= node.time_s - 1.0 {
                    earlier += 1;
                }
                let (before, then) = &differences[earlier.saturating_sub(1)];
                if earlier > 0 && before.segment == node.segment {
                    rows.push(ObservationRow {
                        design: Vector4::zeros(),
                        target: difference - then,
                        duration_s: 1.0,
                        second: false,
                    });
                }
            }
            rows
        };
        time_offset(rows, &nothing, (spacing_s / WINDOW_S).min(1.0))
    }

    /// Readings averaged over a second, their variances still unknown, and the variance of the
    /// samples within each.
    fn averaged(&self, offset_s: f64) -> (Vec<Sight>, Vec<f64>) {
        let Self { record, nodes, factor, camera, .. } = *self;
        let reading = |node: &MeasuredFrame, time_s: f64| record.at(0, time_s).map(|z| factor(node) * z);
        let read: Vec<(usize, f64)> = nodes
            .iter()
            .enumerate()
            .filter_map(|(i, node)| reading(node, node.time_s + offset_s).map(|z| (i, z - camera(node))))
            .collect();
        let (mut sights, mut scatters) = (Vec::new(), Vec::new());
        let mut start = 0;
        for end in 1..=read.len() {
            let (first, last) = (&nodes[read[start].0], &nodes[read[end - 1].0]);
            let next = read.get(end).map(|(i, _)| &nodes[*i]);
            let full =
                next.is_none_or(|next| next.segment != first.segment || next.time_s - first.time_s >= 1.0);
            if !full {
                continue;
            }
            let mean = read[start..end].iter().map(|(_, z)| z).sum::<f64>() / (end - start) as f64;
            let node = read[(start + end) / 2].0;
            if last.time_s - first.time_s >= 0.5 {
                sights.push(Sight { node, reading: mean + camera(&nodes[node]), variance: 0.0 });
                let square = read[start..end].iter().map(|(_, z)| (z - mean).powi(2)).sum::<f64>();
                scatters.push(square / (end - start) as f64);
            }
            start = end;
        }
        (sights, scatters)
    }

    /// Allan variance (D. Allan, "Statistics of atomic frequency standards", 1966) over `length`
    /// readings, scaled to one reading, so that correlated errors have more weight. The part
    /// explained by the camera's own drift is subtracted.
    fn allan_variance(&self, sights: &[Sight], length: usize) -> f64 {
        let Self { nodes, camera, drift, .. } = *self;
        let means: Vec<(&MeasuredFrame, f64)> = sights
            .chunks_exact(length)
            .map(|chunk| {
                let difference = |sight: &Sight| sight.reading - camera(&nodes[sight.node]);
                let mean = chunk.iter().map(difference).sum::<f64>() / length as f64;
                (&nodes[chunk[length / 2].node], mean)
            })
            .collect();
        let pairs = means.windows(2).filter(|pair| pair[0].0.segment == pair[1].0.segment);
        let (changes, drifts): (Vec<f64>, Vec<f64>) =
            pairs.map(|pair| (pair[1].1 - pair[0].1, (drift(pair[1].0) - drift(pair[0].0)).max(0.0))).unzip();
        if changes.len() < 3 && length > 1 {
            return 0.0;
        }
        // A variance from few differences is itself uncertain: the drift is inflated by three
        // standard deviations.
        let count = changes.len().max(1) as f64;
        let drift = drifts.iter().sum::<f64>() / count * (1.0 + 3.0 * (2.0 / count).sqrt());
        0.5 * length as f64 * (normal_sigma(&changes).powi(2) - drift)
    }
}

/// Subtracts the median of each segment from its values, because the sensor's bias is unknown.
fn centred(values: &[(usize, f64)]) -> Vec<f64> {
    let mut centred = Vec::with_capacity(values.len());
    for segment in values.chunk_by(|a, b| a.0 == b.0) {
        let mut values: Vec<f64> = segment.iter().map(|(_, value)| *value).collect();
        let zero = median(&mut values).unwrap_or(0.0);
        centred.extend(segment.iter().map(|(_, value)| value - zero));
    }
    centred
}

/// Largest accepted standard deviation of a compass, radians.
const WORST_HEADING_RAD: f64 = 0.35;

/// Largest accepted standard deviation of a range finder, as a fraction of the height.
const WORST_HEIGHT_SHARE: f64 = 0.05;

/// Calibrates a compass against the camera's heading.
pub fn heading(record: &SensorRecord, nodes: &[MeasuredFrame]) -> Result<Sighted, Reason> {
    let camera = |node: &MeasuredFrame| node.heading_rad;
    let drift = |node: &MeasuredFrame| node.keyframe_covariance[(2, 2)];
    let found =
        StateComparison { record, nodes, factor: &|_| 1.0, camera: &camera, drift: &drift }.sighted()?;
    within(found, nodes, camera, WORST_HEADING_RAD)
}

/// Calibrates a range finder against the camera's height.
pub fn range(record: &SensorRecord, nodes: &[MeasuredFrame]) -> Result<Sighted, Reason> {
    let along_axis = record.quantity() == Quantity::AxisDistance;
    let factor = |node: &MeasuredFrame| if along_axis { node.tilt_cosine } else { 1.0 };
    let camera = |node: &MeasuredFrame| node.height_m;
    let drift = |node: &MeasuredFrame| node.height_variance;
    let found =
        StateComparison { record, nodes, factor: &factor, camera: &camera, drift: &drift }.sighted()?;
    let height_m = nodes.iter().map(|node| node.height_m).sum::<f64>() / nodes.len().max(1) as f64;
    within(found, nodes, camera, WORST_HEIGHT_SHARE * height_m)
}

fn within(
    found: Sighted,
    nodes: &[MeasuredFrame],
    camera: impl Fn(&MeasuredFrame) -> f64,
    worst: f64,
) -> Result<Sighted, Reason> {
    if found.sigma <= worst {
        return Ok(found);
    }
    let differences: Vec<(usize, f64)> =
        found.sights.iter().map(|s| (nodes[s.node].segment, s.reading - camera(&nodes[s.node]))).collect();
    let off = centred(&differences).iter().filter(|difference| difference.abs() > worst).count();
    Err(Reason::Contradicts { seconds: off.max(1), of: found.sights.len() })
}
