//! Normal equations of a frame's fit: its pose and the nuisance parameters.
//!
//! The unknowns, in this order: the six numbers of the pose; the errors of height, roll and pitch
//! of the keyframe; the six numbers of the *skew*, the change of the pose from the first row of the
//! image to the last (readout time × rates), as a difference from the assumed one; and the six
//! coefficients of the shape of uneven ground. All but the pose are *whitened*: in units of their
//! prior standard deviation, so that a known quantity has a column of zeros and needs no special
//! case.

use super::MotionModel;

/// Unknowns of a pose.
pub const POSE: usize = 6;
/// Unknowns with those of the keyframe.
pub const WITH_KEYFRAME: usize = 9;
/// Unknowns with those of the shutter.
pub const WITH_SKEW: usize = 15;
/// Numbers of the shape that points of uneven ground share.
pub const SHAPE: usize = 6;
/// Unknowns with those of the shape.
pub const WITH_SHAPE: usize = WITH_SKEW + SHAPE;

/// Which of (x, y, heading, height, roll, pitch) are estimated: the first `count` of them.
#[derive(Debug, Clone, Copy)]
pub struct Unknowns {
    count: usize,
}

impl Unknowns {
    /// All six.
    pub const ALL: Self = Self { count: 6 };

    pub fn new(model: MotionModel) -> Self {
        Self { count: model.unknowns() }
    }

    /// Number of estimated unknowns.
    pub fn count(&self) -> usize {
        self.count
    }
}

/// Derivatives of one coordinate of a residual by the unknowns.
pub type Row = [f64; WITH_SHAPE];
/// A matrix over the unknowns.
pub type Square = [[f64; WITH_SHAPE]; WITH_SHAPE];

/// `A x = b` with A symmetric: information and slope of a least-squares problem. Only the first
/// `count` unknowns exist, and of A the lower triangle.
#[derive(Debug, Clone, Copy)]
pub struct NormalEquations {
    count: usize,
    matrix: Square,
    slope: Row,
}

impl NormalEquations {
    /// No information on `count` unknowns.
    pub fn new(count: usize) -> Self {
        Self { count, matrix: [[0.0; WITH_SHAPE]; WITH_SHAPE], slope: [0.0; WITH_SHAPE] }
    }

    /// Number of unknowns.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Gradient of the cost; the step is minus the inverse of the matrix times it.
    pub fn slope(&self) -> &Row {
        &self.slope
    }

    /// An entry of the information matrix.
    pub fn entry(&self, i: usize, k: usize) -> f64 {
        self.matrix[i.max(k)][i.min(k)]
    }

    /// Adds a residual.
    pub fn add(&mut self, row: &Row, error: f64, weight: f64) {
        // Constant lengths let the compiler unroll the loops.
        match self.count {
            POSE => self.add_of::<POSE>(row, error, weight),
            WITH_KEYFRAME => self.add_of::<WITH_KEYFRAME>(row, error, weight),
            WITH_SKEW => self.add_of::<WITH_SKEW>(row, error, weight),
            _ => self.add_of::<WITH_SHAPE>(row, error, weight),
        }
    }

    #[inline]
    fn add_of<const N: usize>(&mut self, row: &Row, error: f64, weight: f64) {
        for i in 0..N {
            let weighted = weight * row[i];
            let entries = self.matrix[i].iter_mut().zip(row);
            entries.take(i + 1).for_each(|(entry, by)| *entry += weighted * by);
            self.slope[i] += weighted * error;
        }
    }

    /// Adds a prior on unknown `i`, which is `deviation` from its mean, with this weight.
    pub fn add_prior(&mut self, i: usize, deviation: f64, weight: f64) {
        self.matrix[i][i] += weight;
        self.slope[i] += weight * deviation;
    }

    /// The information times a factor.
    pub fn scale(&mut self, factor: f64) {
        self.matrix.iter_mut().flatten().for_each(|entry| *entry *= factor);
    }

    /// Fixes unknown `i` at its present value.
    pub fn hold(&mut self, i: usize) {
        self.matrix[i] = [0.0; WITH_SHAPE];
        self.matrix.iter_mut().for_each(|row| row[i] = 0.0);
        self.matrix[i][i] = 1.0;
        self.slope[i] = 0.0;
    }

    /// The Cholesky factor; `None` where the unknowns are not determined.
    pub fn factor(&self) -> Option<Factor> {
        let mut lower = self.matrix;
        for i in 0..self.count {
            for k in 0..=i {
                let inner: f64 = (0..k).map(|m| lower[i][m] * lower[k][m]).sum();
                let left = lower[i][k] - inner;
                lower[i][k] = match i == k {
                    false => left / lower[k][k],
                    true if left > 0.0 && left.is_finite() => left.sqrt(),
                    true => return None,
                };
            }
        }
        Some(Factor { count: self.count, lower })
    }
}

/// A Cholesky factor of an information matrix.
#[derive(Debug, Clone, Copy)]
pub struct Factor {
    count: usize,
    lower: Square,
}

impl Factor {
    /// Solves for one right side.
    pub fn solve(&self, right: &Row) -> Row {
        let (n, lower) = (self.count, &self.lower);
        let mut x = *right;
        for i in 0..n {
            let inner: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
            x[i] = (x[i] - inner) / lower[i][i];
        }
        for i in (0..n).rev() {
            let inner: f64 = (i + 1..n).map(|k| lower[k][i] * x[k]).sum();
            x[i] = (x[i] - inner) / lower[i][i];
        }
        x
    }

    /// The inverse of the information matrix: the covariance.
    pub fn inverse(&self) -> Square {
        let mut inverse = [[0.0; WITH_SHAPE]; WITH_SHAPE];
        inverse.iter_mut().enumerate().take(self.count).for_each(|(i, column)| *column = self.column(i));
        inverse
    }

    /// One column of the inverse.
    pub fn column(&self, i: usize) -> Row {
        let mut unit = [0.0; WITH_SHAPE];
        unit[i] = 1.0;
        self.solve(&unit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_fitted_and_fixed_unknowns_stay() {
        // y = 2 + 3 x, seen without noise from an estimate of zero: the residual is -y.
        let mut equations = NormalEquations::new(POSE);
        for x in 0..5 {
            let x = f64::from(x);
            let mut row = [0.0; WITH_SHAPE];
            (row[0], row[1]) = (1.0, x);
            equations.add(&row, -(2.0 + 3.0 * x), 0.5);
        }
        assert!(equations.factor().is_none(), "four unknowns are not determined");
        (2..POSE).for_each(|i| equations.hold(i));
        let step = equations.factor().unwrap().solve(equations.slope());
        assert!((step[0] + 2.0).abs() < 1e-12 && (step[1] + 3.0).abs() < 1e-12, "{step:?}");
        let inverse = equations.factor().unwrap().inverse();
        for i in 0..POSE {
            for (k, column) in inverse.iter().enumerate().take(POSE) {
                let product: f64 = (0..POSE).map(|m| equations.entry(i, m) * column[m]).sum();
                assert!((product - f64::from(u8::from(i == k))).abs() < 1e-12);
            }
        }
    }
}
