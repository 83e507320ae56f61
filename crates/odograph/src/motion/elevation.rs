//! Ground that is not flat: elevations of ground points above the plane z = 0 (plane plus parallax,
//! M. Irani and P. Anandan, 1996).
//!
//! In two views of a point the parallax along the epipolar line determines its elevation, the rest
//! of the residual the pose. The elevation of every point is an unknown of the fit that is
//! eliminated at once (Schur complement): the less the elevation is known, the less a residual
//! weighs along its parallax. Derivation: `docs/math/elevation.md`.

use crate::buffer::stored;
use crate::geometry::GroundPoint;
use nalgebra::Vector3;

/// Normal distribution of the elevation of a ground point above the plane z = 0.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Elevation {
    /// Metres.
    pub mean_m: f64,
    /// Metres².
    pub variance_m2: f64,
}

stored!(Elevation);

impl Elevation {
    /// On the plane z = 0, exactly.
    pub const FLAT: Self = Self { mean_m: 0.0, variance_m2: 0.0 };
}

/// A ground point at another elevation, metres, on the same ray of a camera at `centre`.
pub fn along_ray(centre: &Vector3<f64>, ground: GroundPoint, from_m: f64, to_m: f64) -> GroundPoint {
    let nearer = (centre.z - to_m) / (centre.z - from_m);
    GroundPoint::new(centre.x + nearer * (ground.x_m - centre.x), centre.y + nearer * (ground.y_m - centre.y))
}

/// Measurement of the elevation of a point by a frame, given the pose of the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredElevation {
    /// The posterior.
    pub elevation: Elevation,
    /// The prior's mean, metres.
    pub prior_m: f64,
    /// Elevation from the residual alone, without the prior, metres.
    pub alone_m: f64,
    /// The inverse of its variance, 1/metres².
    pub information: f64,
    /// The parallax of a metre of elevation, squared, pixels².
    pub parallax_squared: f64,
    /// Whether an elevation within the highest allowed one explains the residual.
    pub is_plausible: bool,
    /// Whether it differs significantly from the prior.
    pub is_significant: bool,
}

stored!(MeasuredElevation);

/// A residual split into the component along the parallax of its point and the rest.
#[derive(Debug, Clone, Copy, Default)]
pub struct Parallax {
    /// Derivative of the pixel by the elevation, whitened, pixels per metre.
    by_elevation: [f64; 2],
    /// Its squared length.
    squared: f64,
    /// Residual along it and squared residual across it, pixels and pixels².
    along: f64,
    across_squared: f64,
}

impl Parallax {
    /// Of a point behind the camera.
    pub const NONE: Self = Self { by_elevation: [0.0; 2], squared: 0.0, along: 0.0, across_squared: 0.0 };

    /// Of a residual and its derivative by the elevation.
    pub fn new(error: [f64; 2], by_elevation: [f64; 2]) -> Self {
        let [x, y] = by_elevation;
        let squared = x * x + y * y;
        let along = if squared > 0.0 { (x * error[0] + y * error[1]) / squared.sqrt() } else { 0.0 };
        let length_squared = error[0] * error[0] + error[1] * error[1];
        Self { by_elevation, squared, along, across_squared: length_squared - along * along }
    }

    /// Multiplies two whitened coordinates by the inverse square root of the covariance that noise
    /// and variance of the elevation give.
    pub fn whitener(&self, variance_m2: f64, noise_px2: f64) -> impl Fn(&mut f64, &mut f64) + use<> {
        let [x, y] = self.by_elevation;
        // I − (1 − s / √(s² + P |d|²)) d dᵀ / |d|²
        let shrunk = 1.0 - (1.0 + variance_m2 * self.squared / noise_px2).sqrt().recip();
        let part = if self.squared > 0.0 { shrunk / self.squared } else { 0.0 };
        move |first, second| {
            let along = part * (x * *first + y * *second);
            *first -= along * x;
            *second -= along * y;
        }
    }

    /// Posterior elevation given the pose. It is plausible up to `highest_m` above or below its
    /// prior.
    pub fn measured(&self, prior: Elevation, noise_px2: f64, highest_m: f64) -> MeasuredElevation {
        let information = self.squared / noise_px2;
        let difference_m = if self.squared > 0.0 { -self.along / self.squared.sqrt() } else { 0.0 };
        let part = prior.variance_m2 * information / (1.0 + prior.variance_m2 * information);
        let elevation = Elevation {
            mean_m: prior.mean_m + part * difference_m,
            variance_m2: prior.variance_m2 * (1.0 - part),
        };
        let is_plausible =
            difference_m.abs() < highest_m && self.across_squared < SIGNIFICANT_SQUARED * noise_px2;
        let is_significant = is_plausible
            && difference_m * difference_m * information
                > SIGNIFICANT_SQUARED * (1.0 + prior.variance_m2 * information);
        MeasuredElevation {
            elevation,
            prior_m: prior.mean_m,
            alone_m: prior.mean_m + difference_m,
            information,
            parallax_squared: self.squared,
            is_plausible,
            is_significant,
        }
    }

    /// The squared residual across the parallax, pixels².
    pub fn across_squared(&self) -> f64 {
        self.across_squared
    }

    /// Length of the residual after the elevation is estimated, pixels.
    pub fn remaining_px(&self, variance_m2: f64, noise_px2: f64) -> f64 {
        let remaining = self.along * noise_px2 / (variance_m2 * self.squared + noise_px2);
        (remaining * remaining + self.across_squared).sqrt()
    }
}

/// The roughness of the ground, from elevations of the same points in two frames: relief is the
/// same in both, noise is not.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Roughness {
    /// Products of the two elevations in units of their standard deviations, and how many.
    products: f64,
    count: f64,
    /// Products in metres², weighted by their information, and the weights.
    weighted: f64,
    weight: f64,
    is_rough: bool,
}

impl Roughness {
    /// Adds a point that two frames found at elevations above the level of the ground, metres, with
    /// their information, 1/metres².
    pub fn add(&mut self, [first, second]: [(f64, f64); 2]) {
        let product = first.0 * second.0;
        self.products += product * (first.1 * second.1).sqrt();
        self.count += 1.0;
        self.weighted += product * second.1;
        self.weight += second.1;
    }

    /// Adds the points of a frame if it has enough of them; earlier frames are forgotten
    /// exponentially. The standard deviations are those of all that the frame leaves unexplained;
    /// `noise_share` is the share of noise in their squares. What else is left may be relief.
    pub fn learn(&mut self, now: &Self, noise_share: f64) {
        if now.count < MIN_POINTS {
            return;
        }
        for (sum, now) in [
            (&mut self.products, now.products),
            (&mut self.count, now.count),
            (&mut self.weighted, now.weighted),
            (&mut self.weight, now.weight),
        ] {
            *sum = FORGETTING_FACTOR * *sum + now;
        }
        let threshold = if self.is_rough { SMOOTH_BELOW * noise_share } else { ROUGH_ABOVE };
        self.is_rough = self.products > threshold * self.count;
    }

    /// Declares the ground rough, because nothing else explains a frame.
    pub fn begin(&mut self) {
        if !self.is_rough {
            *self = Self { is_rough: true, ..Self::default() };
        }
    }

    /// Variance of the elevations as soon as they exceed the noise, which is before the ground is
    /// taken to be rough, metres².
    pub fn suspected_m2(&self) -> f64 {
        if self.products > SUSPECTED_ABOVE * self.count {
            (self.weighted / self.weight).max(0.0)
        } else {
            0.0
        }
    }

    /// Variance of the elevations, metres²: zero unless the ground is rough.
    pub fn variance_m2(&self) -> f64 {
        match (self.is_rough, self.weight > 0.0) {
            (false, _) => 0.0,
            (true, false) => f64::MIN_POSITIVE,
            (true, true) => (self.weighted / self.weight).max(f64::MIN_POSITIVE),
        }
    }
}

/// Minimum number of points of a frame. Not derived; chosen.
const MIN_POINTS: f64 = 20.0;

/// Weight of earlier frames relative to the present one. Not derived; chosen.
const FORGETTING_FACTOR: f64 = 0.7;

/// Mean product of two elevations, in units of their standard deviations, above which the ground is
/// rough. Noise that both share gives 1. Measured: 11 at most with motion blur, compression and
/// printed sheets that do not lie flat; 32 on gravel of ±5 mm at a height of 0.75 m; hundreds on
/// undulating ground.
const ROUGH_ABOVE: f64 = 12.0;

/// Mean product above which ground may be rough, which its covariance then includes. Chosen
/// between noise, which gives 1 where frames share it, and [`ROUGH_ABOVE`].
const SUSPECTED_ABOVE: f64 = 4.0;

/// Mean product, in units of the noise, below which rough ground ends (hysteresis). Not derived;
/// chosen.
const SMOOTH_BELOW: f64 = 3.0;

/// Threshold of a squared residual over its variance: three standard deviations.
pub const SIGNIFICANT_SQUARED: f64 = 9.0;

/// Highest elevation of a kerb, as a fraction of the camera's height. Not derived; chosen.
pub const MAX_KERB_HEIGHT: f64 = 0.15;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whitened_residual_has_the_covariance_of_noise_and_elevation() {
        let (variance_m2, noise_px2) = (4e-4, 0.01);
        let parallax = Parallax::new([0.3, -0.1], [200.0, 150.0]);
        let whiten = parallax.whitener(variance_m2, noise_px2);
        // Along the parallax √(s² + P d²) is 5.001 px, and must become 0.1 px.
        let (mut x, mut y) = (0.8 * 5.001, 0.6 * 5.001);
        whiten(&mut x, &mut y);
        assert!((x.hypot(y) - 0.1).abs() < 1e-4, "{x} {y}");
        let (mut x, mut y) = (-0.6, 0.8);
        whiten(&mut x, &mut y);
        assert!((x + 0.6).abs() < 1e-12 && (y - 0.8).abs() < 1e-12, "across the parallax nothing changes");
    }

    #[test]
    fn a_parallax_gives_the_elevation_weighted_with_its_prior() {
        // A point 10 mm higher than thought, seen with 200 px per metre: predicted 2 px short.
        let parallax = Parallax::new([-2.0, 0.0], [200.0, 0.0]);
        let prior = Elevation { mean_m: 0.005, variance_m2: 1e-4 };
        let measured = parallax.measured(prior, 0.04, 0.1);
        assert!((measured.alone_m - 0.015).abs() < 1e-12);
        // Information 1e6 against 1e4 of the prior.
        assert!((measured.elevation.mean_m - (0.005 + 0.01 * 1e6 / 1.01e6)).abs() < 1e-12);
        assert!((measured.elevation.variance_m2 - 1.0 / 1.01e6).abs() < 1e-15);
        assert!(measured.is_plausible && !measured.is_significant);
        assert!(parallax.measured(Elevation::FLAT, 0.04, 0.1).is_significant);
        assert!(!parallax.measured(Elevation::FLAT, 0.04, 0.005).is_plausible);
    }

    #[test]
    fn only_relief_is_the_same_in_two_frames() {
        let mut random = crate::motion::Random::new(7);
        let mut uniform = || random.below(1 << 20) as f64 / f64::from(1 << 20);
        let mut normal = || (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
        let (mut rough, mut flat) = (Roughness::default(), Roughness::default());
        let (mut of_rough, mut of_flat) = (Roughness::default(), Roughness::default());
        for _ in 0..200 {
            let elevation_m = 0.005 * normal();
            let noisy = [0.001 * normal(), 0.001 * normal()];
            of_rough.add(noisy.map(|noise| (elevation_m + noise, 1e6)));
            of_flat.add(noisy.map(|noise| (noise, 1e6)));
        }
        rough.learn(&of_rough, 1.0);
        flat.learn(&of_flat, 1.0);
        assert!((rough.variance_m2().sqrt() - 0.005).abs() < 0.001, "{}", rough.variance_m2());
        assert_eq!(flat.variance_m2(), 0.0);
        // A frame that leaves three times the noise says nothing against relief that was found.
        let mut unclear = Roughness::default();
        (0..200).for_each(|_| unclear.add([(0.001 * normal() + 0.001, 1e6); 2]));
        for noise_share in [0.1, 1.0] {
            let mut begun = Roughness::default();
            begun.begin();
            begun.learn(&unclear, noise_share);
            assert_eq!(begun.variance_m2() > 0.0, noise_share < 1.0);
        }
    }
}
